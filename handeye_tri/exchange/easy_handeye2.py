"""The ``.calib`` files of easy_handeye2."""

from __future__ import annotations

from handeye_tri.exchange.results import Results, xyz_quaternion


def easy_handeye2_calib(results: Results) -> dict[str, str]:
    """One file per camera, by the camera's name.

    ``calibration_type: eye_on_base``: the transform is the pose of
    ``tracking_base_frame`` (the camera's optical frame) in ``robot_base_frame``,
    metres; it maps the former's coordinates to the latter.
    """
    calibration, frames = results.calibration, results.frames
    files = {}
    for camera, motion in zip(
        calibration.cameras, calibration.base_from_camera, strict=True
    ):
        optical = frames.camera(camera.name)
        lines = [
            *results.head,
            f"transform: pose of {optical} in {frames.base}, metres (it maps the "
            "coordinates of the former to the latter).",
        ]
        translation, rotation = xyz_quaternion(motion)
        text = "".join(f"# {line}\n" for line in lines)
        text += (
            "parameters:\n"
            f"  name: {results.cell}_{camera.name}\n"
            "  calibration_type: eye_on_base\n"
            f"  robot_base_frame: {frames.base}\n"
            f"  robot_effector_frame: {frames.flange}\n"
            f"  tracking_base_frame: {optical}\n"
            "  tracking_marker_frame: triangle\n"
            "  freehand_robot_movement: true\n"
            "  move_group_namespace: /\n"
            "  move_group: manipulator\n"
            "transform:\n  translation:\n"
        )
        text += "".join(f"    {key}: {value}\n" for key, value in translation.items())
        text += "  rotation:\n"
        text += "".join(f"    {key}: {value}\n" for key, value in rotation.items())
        files[camera.name] = text
    return files
