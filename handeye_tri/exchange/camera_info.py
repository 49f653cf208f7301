"""ROS camera_info YAML files, rectified where the cameras are a pair.

Format: ``sensor_msgs/CameraInfo`` as ``camera_calibration_parsers`` reads it.
``plumb_bob`` has k1 k2 p1 p2 k3, ``rational_polynomial`` k1 k2 p1 p2 k3 k4 k5 k6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handeye_tri.camera import PinholeCamera
from handeye_tri.exchange.results import Results, flat, skew_effect_px
from handeye_tri.records import Floats
from handeye_tri.se3 import SE3

DISTORTION_MODELS = {"radtan": "plumb_bob", "rational": "rational_polynomial"}


@dataclass(frozen=True, slots=True, eq=False)
class RectifiedCamera:
    """How one camera's image becomes that of an ideal pair.

    Attributes:
        rotation: Rectified from camera frame, shape (3, 3).
        projection: From the left camera's rectified frame to pixels, shape (3, 4);
            [0, 3] is -f * baseline (px m) for the right camera.
    """

    rotation: Floats
    projection: Floats


def unrectified(camera: PinholeCamera) -> RectifiedCamera:
    """One camera by itself: only its lens is taken out."""
    k = camera.intrinsics
    straight = [[k.fx, 0, k.cx, 0], [0, k.fy, k.cy, 0], [0, 0, 1, 0]]
    return RectifiedCamera(np.eye(3), np.array(straight, dtype=float))


def rectify(
    cameras: tuple[PinholeCamera, ...], base_from_camera: tuple[SE3, ...]
) -> tuple[RectifiedCamera, ...] | None:
    """Rectification of a horizontal pair; None where there is none.

    Both images are turned so that their rows lie along the baseline and both look
    along the mean of the optical axes (Fusiello, Trucco and Verri 2000,
    doi:10.1007/s001380050120); one focal length and one principal point for both, the
    latter such that the rays of the two image centres stay in the middle.
    """
    if len(cameras) != 2:
        return None
    first_from_second = base_from_camera[0].inverse() @ base_from_camera[1]
    baseline = float(np.linalg.norm(first_from_second.translation))
    if baseline == 0:
        return None
    along = first_from_second.translation / baseline
    first_is_left = bool(along[0] > 0)
    x = along if first_is_left else -along
    ahead = np.array([0.0, 0.0, 1.0]) + first_from_second.rotation[:, 2]
    z = ahead - (ahead @ x) * x
    # Mostly one above or behind the other, or not looking the same way.
    if x[0] < 0.7 or np.linalg.norm(z) < 1.0:
        return None
    z = z / np.linalg.norm(z)
    rotations = [np.array([x, np.cross(z, x), z])]
    rotations.append(rotations[0] @ first_from_second.rotation)
    focal = float(
        np.mean([f for c in cameras for f in (c.intrinsics.fx, c.intrinsics.fy)])
    )
    centres = []
    for camera, rotation in zip(cameras, rotations, strict=True):
        middle = 0.5 * (np.array(camera.image_size) - 1)
        ray = rotation @ np.append(camera.normalised(middle), 1.0)
        centres.append(middle - focal * ray[:2] / ray[2])
    centre = np.mean(centres, axis=0)
    result = []
    for i, rotation in enumerate(rotations):
        is_left = (i == 0) == first_is_left
        projection = np.array(
            [
                [focal, 0, centre[0], 0 if is_left else -focal * baseline],
                [0, focal, centre[1], 0],
                [0, 0, 1, 0],
            ],
            dtype=float,
        )
        result.append(RectifiedCamera(rotation, projection))
    return tuple(result)


def camera_info_yaml(results: Results) -> dict[str, str]:
    """One file per camera, by the camera's name."""
    calibration = results.calibration
    pair = rectify(calibration.cameras, calibration.base_from_camera)
    return {
        camera.name: _file(
            results, camera, unrectified(camera) if pair is None else pair[i], pair
        )
        for i, camera in enumerate(calibration.cameras)
    }


def _file(
    results: Results,
    camera: PinholeCamera,
    rectified: RectifiedCamera,
    pair: tuple[RectifiedCamera, ...] | None,
) -> str:
    k = camera.intrinsics
    lines = list(results.head)
    lines.append(
        "Pixels; pixel (0, 0) is the centre of the first. Optical frame "
        f"{results.frames.camera(camera.name)}: z forward, x right, y down."
    )
    if pair is None:
        lines.append("rectification_matrix is the identity: no horizontal pair.")
    else:
        lines.append(
            f"This is the {'left' if rectified.projection[0, 3] == 0 else 'right'} "
            "camera of the pair, as the pair itself looks. rectification_matrix: "
            "rectified frame from optical frame. projection_matrix[0, 3]: -f * "
            "baseline, px m, in the right camera, 0 in the left one."
        )
    if k.skew:
        effect = skew_effect_px(k.fy, k.cy, camera.image_size[1], k.skew)
        lines.append(
            f"camera_matrix has the skew factor {k.skew:.6g} px; ROS ignores it, "
            f"which moves a pixel by {effect:.3g} px at most."
        )
    text = "".join(f"# {line}\n" for line in lines)
    text += f"image_width: {camera.image_size[0]}\n"
    text += f"image_height: {camera.image_size[1]}\n"
    text += f"camera_name: {camera.name}\n"
    text += _matrix("camera_matrix", k.matrix)
    text += f"distortion_model: {DISTORTION_MODELS[camera.lens.model]}\n"
    text += _matrix("distortion_coefficients", camera.lens.coefficients[None])
    text += _matrix("rectification_matrix", rectified.rotation)
    return text + _matrix("projection_matrix", rectified.projection)


def _matrix(name: str, values: Floats) -> str:
    rows, columns = values.shape
    return f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: {flat(values)}\n"
