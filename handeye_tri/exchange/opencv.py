"""OpenCV FileStorage YAML: every camera, where it stands, and the rig."""

from __future__ import annotations

from handeye_tri.exchange.results import Results, number, skew_effect_px
from handeye_tri.records import Floats, triangle_name


def opencv_yaml(results: Results) -> str:
    """The whole result in one file for ``cv2.FileStorage``.

    ``cameras`` lists the names; under each name stand ``image_width``,
    ``image_height``, ``camera_matrix`` (3x3, px), ``distortion_coefficients`` (5x1 or
    8x1, OpenCV's order) and ``base_from_camera_m`` (4x4). Cameras after the first have
    ``R`` and ``T_m`` as ``cv2.stereoRectify`` takes them: from the first camera's
    frame to this one's.
    """
    calibration, frames = results.calibration, results.frames
    lines = [
        *results.head,
        "Lengths in metres, K in pixels; pixel (0, 0) is the centre of the first.",
        f"base_from_camera_m maps {frames.camera('<camera>')} (optical: z forward, "
        f"x right, y down) to {frames.base}.",
        "R, T_m: x_camera = R x_first + T_m, as cv2.stereoRectify takes them.",
        f"flange_from_triangle_m maps the triangle's frame to {frames.flange}; rows of "
        "markers_in_flange_m are A, B, C.",
    ]
    if calibration.other_mounts:
        lines.append(
            "The same with _2 before _m: on the second mount, after the tool change."
        )
    for camera in calibration.cameras:
        k = camera.intrinsics
        if k.skew:
            effect = skew_effect_px(k.fy, k.cy, camera.image_size[1], k.skew)
            lines.append(
                f"{camera.name}: the skew factor {k.skew:.6g} px stands in "
                "camera_matrix, but OpenCV's functions ignore it, which moves a pixel "
                f"by {effect:.3g} px at most."
            )
    # OpenCV wants the directive and the separator before everything else.
    text = "%YAML:1.0\n---\n" + "".join(f"# {line}\n" for line in lines)
    text += f'verdict: "{results.verdict}"\n'
    names = ", ".join(f'"{camera.name}"' for camera in calibration.cameras)
    text += f"cameras: [ {names} ]\n"
    first = calibration.base_from_camera[0]
    for i, camera in enumerate(calibration.cameras):
        place = calibration.base_from_camera[i]
        text += f"{camera.name}:\n"
        text += f"   image_width: {camera.image_size[0]}\n"
        text += f"   image_height: {camera.image_size[1]}\n"
        text += _matrix("camera_matrix", camera.intrinsics.matrix, "   ")
        text += _matrix(
            "distortion_coefficients", camera.lens.coefficients[:, None], "   "
        )
        text += _matrix("base_from_camera_m", place.matrix, "   ")
        if i:
            camera_from_first = place.inverse() @ first
            text += _matrix("R", camera_from_first.rotation, "   ")
            text += _matrix("T_m", camera_from_first.translation[:, None], "   ")
    for index, mount in enumerate(calibration.mounts):
        name = triangle_name(index)
        suffix = name.removeprefix(triangle_name())
        text += _matrix(f"{name}_m", mount.flange_from_triangle.matrix)
        text += _matrix(f"markers_in_flange{suffix}_m", mount.markers)
    return text


def _matrix(name: str, values: Floats, indent: str = "") -> str:
    rows, columns = values.shape
    inner = indent + "   "
    data = f",\n{inner}    ".join(
        ", ".join(number(v) for v in row) for row in values.tolist()
    )
    return (
        f"{indent}{name}: !!opencv-matrix\n{inner}rows: {rows}\n"
        f"{inner}cols: {columns}\n{inner}dt: d\n{inner}data: [ {data} ]\n"
    )
