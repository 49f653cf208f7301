"""A whole session as a rosbag2/MCAP file: what a recording of the real cell holds.

The robot stands at every station for a second, nine samples of joints and frames long;
the cameras shoot in the middle. Station j is at ``10 (j + 1)`` seconds. The frame
``triangle`` is static on the flange; with a tool change it moves in ``/tf``.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from handeye_tri.errors import MissingDependencyError
from handeye_tri.exchange.camera_info import (
    DISTORTION_MODELS,
    RectifiedCamera,
    rectify,
    unrectified,
)
from handeye_tri.exchange.results import Results
from handeye_tri.records import Floats
from handeye_tri.se3 import quaternion_wxyz

SESSION_TOPIC = "/handeye_tri/session"
_SECOND = 10**9
_PERIOD = 10 * _SECOND
_SAMPLES = range(-4, 5)
_STEP = _SECOND // 10


@dataclass(frozen=True, slots=True, eq=False)
class Bag:
    """What goes into the file.

    Attributes:
        results: The calibrated session.
        about: JSON on what the session is: verdict, cell, software.
        photograph: PNG of (camera, station); None where it was not taken.
        joint_names: Names of the arm's q joints; empty where poses are all there is.
        joints: Reported joints, shape (n, q), rad or m.
        description: URDF of the robot, or "".
        links: (parent, child, parent_from_child of shape (n, 4, 4)) of every link.
    """

    results: Results
    about: str
    photograph: Callable[[str, int], bytes | None]
    joint_names: tuple[str, ...] = ()
    joints: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    description: str = ""
    links: Sequence[tuple[str, str, Floats]] = ()


def import_ros() -> tuple[Any, Any]:
    """The modules that write and describe ROS messages.

    Raises:
        MissingDependencyError: the extra is not installed.
    """
    try:
        from mcap_ros2 import writer
        from rosbags import typesys
    except ImportError as error:
        raise MissingDependencyError(
            f"bags need the packages mcap, mcap-ros2-support and rosbags ({error}); "
            'install them with: pip install "handeye-tri[ros]"'
        ) from None
    return writer, typesys


# What late listeners must get, too.
_LATCHED = ("/tf_static", "/robot_description", SESSION_TOPIC)


def _quality_of_service(topic: str) -> str:
    """As rosbag2 notes it: reliable; durability 1 is kept for late listeners, 2 not."""
    depth, durability = (1, 1) if topic in _LATCHED else (10, 2)
    no_limit = "{sec: 9223372036, nsec: 854775807}"
    return (
        f"- {{history: 1, depth: {depth}, reliability: 1, durability: {durability}, "
        f"deadline: {no_limit}, lifespan: {no_limit}, liveliness: 1, "
        f"liveliness_lease_duration: {no_limit}, "
        "avoid_ros_namespace_conventions: false}"
    )


def session_rosbag2(bag: Bag, name: str) -> dict[str, bytes]:
    """The files of a rosbag2 folder called ``name``.

    Raises:
        MissingDependencyError: the extra ``ros`` is not installed.
    """
    counts: dict[str, tuple[str, int]] = {}
    times = []
    for topic, kind, time, _ in _messages(bag):
        counts[topic] = (kind, counts.get(topic, (kind, 0))[1] + 1)
        times.append(time)
    file = f"{name}_0.mcap"
    span = (
        f"{{nanoseconds_since_epoch: {min(times)}}}",
        f"{{nanoseconds: {max(times) - min(times)}}}",
    )
    text = (
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n"
        f"  duration: {span[1]}\n  starting_time: {span[0]}\n"
        f"  message_count: {len(times)}\n  topics_with_message_count:\n"
    )
    for topic, (kind, count) in counts.items():
        text += (
            f"    - topic_metadata:\n        name: {topic}\n"
            f"        type: {kind.replace('/', '/msg/')}\n"
            "        serialization_format: cdr\n"
            f'        offered_qos_profiles: "{_quality_of_service(topic)}"\n'
            f"      message_count: {count}\n"
        )
    text += (
        '  compression_format: ""\n  compression_mode: ""\n'
        f"  relative_file_paths: [{file}]\n  files:\n    - path: {file}\n"
        f"      starting_time: {span[0]}\n      duration: {span[1]}\n"
        f"      message_count: {len(times)}\n"
    )
    return {file: session_mcap(bag), "metadata.yaml": text.encode()}


def session_mcap(bag: Bag) -> bytes:
    """The file, with a CRC over every chunk, the data and the summary.

    Raises:
        MissingDependencyError: the extra ``ros`` is not installed.
    """
    writer, typesys = import_ros()
    types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    buffer = io.BytesIO()
    file = writer.Writer(buffer, enable_crcs=True)
    schemas: dict[str, Any] = {}
    channels: dict[str, int] = file._channel_ids

    def write(topic: str, kind: str, time: int, message: dict[str, Any]) -> None:
        if kind not in schemas:
            package, name = kind.split("/")
            definition, _ = types.generate_msgdef(
                f"{package}/msg/{name}", ros_version=2
            )
            schemas[kind] = file.register_msgdef(f"{package}/msg/{name}", definition)
        if topic not in channels:
            # Readers of a folder hold this against its metadata.yaml, as rosbag2 writes
            # it; the encoder would register the channel without.
            channels[topic] = file._writer.register_channel(
                topic=topic,
                message_encoding="cdr",
                schema_id=schemas[kind].id,
                metadata={"offered_qos_profiles": _quality_of_service(topic)},
            )
        file.write_message(topic, schemas[kind], message, log_time=time)

    for message in _messages(bag):
        write(*message)
    file.finish()
    return buffer.getvalue()


def _messages(bag: Bag) -> Iterable[tuple[str, str, int, dict[str, Any]]]:
    """Topic, type, time in nanoseconds and content, in the order of time."""
    results, frames = bag.results, bag.results.frames
    calibration = results.calibration
    start = _PERIOD - 2 * _SECOND
    yield SESSION_TOPIC, "std_msgs/String", start, {"data": bag.about}
    if bag.description:
        text = {"data": bag.description}
        yield "/robot_description", "std_msgs/String", start, text
    fixed = [
        _transform(start, frames.base, frames.camera(camera.name), motion.matrix)
        for camera, motion in zip(
            calibration.cameras, calibration.base_from_camera, strict=True
        )
    ]
    rigs = [mount.flange_from_triangle.matrix for mount in calibration.mounts]
    if len(rigs) == 1:
        fixed.append(_transform(start, frames.flange, "triangle", rigs[0]))
    yield "/tf_static", "tf2_msgs/TFMessage", start, {"transforms": fixed}
    pair = rectify(calibration.cameras, calibration.base_from_camera)
    for j, pose in enumerate(results.base_from_flange):
        middle = (j + 1) * _PERIOD
        for k in _SAMPLES:
            time = middle + k * _STEP
            moved = [_transform(time, frames.base, frames.flange, pose)]
            moved += [
                _transform(time, parent, child, poses[j])
                for parent, child, poses in bag.links
            ]
            if len(rigs) > 1:
                rig = rigs[results.mounts[j]]
                moved.append(_transform(time, frames.flange, "triangle", rig))
            yield "/tf", "tf2_msgs/TFMessage", time, {"transforms": moved}
            if bag.joint_names:
                state = _joint_state(time, bag.joint_names, bag.joints[j])
                yield "/joint_states", "sensor_msgs/JointState", time, state
            if k == 0:
                for i, camera in enumerate(calibration.cameras):
                    yield from _view(bag, i, camera.name, j, middle, pair)


def _view(
    bag: Bag,
    i: int,
    name: str,
    station: int,
    time: int,
    pair: tuple[RectifiedCamera, ...] | None,
) -> Iterable[tuple[str, str, int, dict[str, Any]]]:
    data = bag.photograph(name, station)
    if data is None:
        return
    camera = bag.results.calibration.cameras[i]
    header = _header(time, bag.results.frames.camera(name))
    picture = {"header": header, "format": "png", "data": data}
    yield f"/{name}/image/compressed", "sensor_msgs/CompressedImage", time, picture
    rectified = unrectified(camera) if pair is None else pair[i]
    info = {
        "header": header,
        "height": camera.image_size[1],
        "width": camera.image_size[0],
        "distortion_model": DISTORTION_MODELS[camera.lens.model],
        "d": camera.lens.coefficients.tolist(),
        "k": camera.intrinsics.matrix.ravel().tolist(),
        "r": rectified.rotation.ravel().tolist(),
        "p": rectified.projection.ravel().tolist(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": {
            "x_offset": 0,
            "y_offset": 0,
            "height": 0,
            "width": 0,
            "do_rectify": False,
        },
    }
    yield f"/{name}/camera_info", "sensor_msgs/CameraInfo", time, info


def _header(time: int, frame: str) -> dict[str, Any]:
    stamp = {"sec": time // _SECOND, "nanosec": time % _SECOND}
    return {"stamp": stamp, "frame_id": frame}


def _joint_state(time: int, names: Sequence[str], joints: Floats) -> dict[str, Any]:
    return {
        "header": _header(time, ""),
        "name": list(names),
        "position": joints.tolist(),
        "velocity": [],
        "effort": [],
    }


def _transform(time: int, parent: str, child: str, pose: Floats) -> dict[str, Any]:
    w, x, y, z = quaternion_wxyz(pose[:3, :3]).tolist()
    return {
        "header": _header(time, parent),
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
            "rotation": {"x": x, "y": y, "z": z, "w": w},
        },
    }
