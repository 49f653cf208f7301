"""ROS 2 static transforms: the command for each camera, and a launch file."""

from __future__ import annotations

from handeye_tri.exchange.results import Results, xyz_quaternion


def static_tf_arguments(results: Results) -> dict[str, str]:
    """Arguments of ``tf2_ros static_transform_publisher``, by camera.

    By flags, metres and a quaternion: the older form of bare numbers is read as yaw
    pitch roll or as a quaternion, depending on their count.
    """
    calibration, frames = results.calibration, results.frames
    result = {}
    for camera, motion in zip(
        calibration.cameras, calibration.base_from_camera, strict=True
    ):
        translation, rotation = xyz_quaternion(motion)
        flags = [f"--{key} {value}" for key, value in translation.items()]
        flags += [f"--q{key} {value}" for key, value in rotation.items()]
        flags.append(f"--frame-id {frames.base}")
        flags.append(f"--child-frame-id {frames.camera(camera.name)}")
        result[camera.name] = " ".join(flags)
    return result


def static_tf_commands(results: Results) -> list[str]:
    """Commands to type, one per camera."""
    return [
        f"ros2 run tf2_ros static_transform_publisher {arguments}"
        for arguments in static_tf_arguments(results).values()
    ]


def static_tf_launch(results: Results) -> str:
    """A launch file in YAML (``ros2 launch FILE``), the commands in its head."""
    frames = results.frames
    lines = [
        *results.head,
        f"Poses of the cameras' optical frames (z forward, x right, y down) in "
        f"{frames.base}, metres and unit quaternions.",
        "The same by hand:",
        *static_tf_commands(results),
    ]
    text = "".join(f"# {line}\n" for line in lines) + "launch:\n"
    for name, arguments in static_tf_arguments(results).items():
        text += (
            "- node:\n    pkg: tf2_ros\n    exec: static_transform_publisher\n"
            f"    name: {name}_in_{_node_name(frames.base)}\n    args: '{arguments}'\n"
        )
    return text


def _node_name(frame: str) -> str:
    """A frame's name in the alphabet of node names."""
    return "".join(c if c.isalnum() or c == "_" else "_" for c in frame)
