"""ROS recordings: rosbag2 folders, bare .mcap files and ROS 1 bags, without ROS.

Messages are decoded by the definitions that ship with ``rosbags``, never by those in
the file, from which code would have to be made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import HandEyeError, InputError, StorageError
from handeye_tri.exchange.bag_check import (
    bound_chunks,
    check_mcap,
    refuse_compressed,
)
from handeye_tri.exchange.bag_images import decode_message
from handeye_tri.exchange.capture import MAX_POSES, ImageStream, PoseStream
from handeye_tri.exchange.mcap_bag import SESSION_TOPIC, import_ros
from handeye_tri.exchange.tf_tree import Frames
from handeye_tri.records import Floats, RobotDirection
from handeye_tri.se3 import rotation_from_quaternion_wxyz, se3_inverse

_IMAGE = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_JOINTS = "sensor_msgs/msg/JointState"
_TF = "tf2_msgs/msg/TFMessage"
_POSE = "geometry_msgs/msg/PoseStamped"
_TEXT = "std_msgs/msg/String"
_KNOWN = (*_IMAGE, _JOINTS, _TF, _POSE, _TEXT)


@dataclass(frozen=True, slots=True)
class Forward:
    """The robot's kinematics, for joint states.

    Attributes:
        names: What the bag calls the q joints, from the base outward.
        pose: ``base_from_flange``, shape (n, 4, 4), of joints (n, q).
    """

    names: tuple[str, ...]
    pose: Callable[[Floats], Floats]


class BagFile:
    """A recording.

    Attributes:
        path: The file or folder.
        topics: Type and number of messages by topic.
    """

    def __init__(self, path: Path) -> None:
        """Look into a recording.

        Raises:
            StorageError: missing, damaged, or no recording.
            MissingDependencyError: the extra ``ros`` is not installed.
        """
        if not path.exists():
            raise StorageError(f"{path}: there is no such recording")
        import_ros()
        self.path = path
        self._ros1 = path.suffix == ".bag"
        if path.is_dir():
            refuse_compressed(path)
        files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        for file in files:
            if file.suffix == ".mcap":
                check_mcap(file)
        with self._open() as reader:
            self.topics = {
                c.topic: (str(c.msgtype), int(c.msgcount)) for c in reader.connections
            }

    @contextmanager
    def _open(self) -> Iterator[Any]:
        """The library's reader; what it raises becomes one sentence."""
        from rosbags import rosbag1, rosbag2

        try:
            kind = rosbag1.Reader if self._ros1 else rosbag2.Reader
            with kind(self.path) as reader:
                if self._ros1:
                    bound_chunks(reader)
                yield reader
        except HandEyeError:
            raise
        except FileNotFoundError as error:
            raise StorageError(f"{self.path}: a part is missing ({error})") from None
        except Exception as error:
            # Damaged recordings make the library raise anything.
            raise StorageError(
                f"{self.path}: this is no readable recording, or a damaged one "
                f"({type(error).__name__}: {' '.join(str(error).split()):.120}); "
                "a .bag, an .mcap, or a rosbag2 folder is needed"
            ) from None

    def of_type(self, *kinds: str) -> list[str]:
        """Topics of some types."""
        return [topic for topic, (kind, _) in self.topics.items() if kind in kinds]

    def listing(self) -> str:
        """Topics that could serve, for messages."""
        rows = [
            f"{topic} ({kind.rpartition('/')[2]}, {count})"
            for topic, (kind, count) in self.topics.items()
            if kind in _KNOWN
        ]
        return ", ".join(rows) or "no topic of use"

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, float, Any]]:
        """Topic, time in seconds and message; the header's stamp where it has one.

        Raises:
            InputError: a topic is not there, or of a type that is not known.
            StorageError: a message is damaged.
        """
        for topic, logged, message in self._logged(topics):
            yield topic, _stamp(message, logged), message

    def _logged(
        self, topics: Sequence[str], at: int | None = None
    ) -> Iterator[tuple[str, int, Any]]:
        """Topic, when it was recorded (ns) and message; all, or those of one moment."""
        from rosbags.typesys import Stores, get_typestore

        for topic in topics:
            kind = self.topics.get(topic, ("", 0))[0]
            if kind not in _KNOWN:
                raise InputError(
                    f"{self.path}: there is no topic {topic!r} of a known type; there "
                    f"is {self.listing()}"
                )
        store = get_typestore(Stores.ROS1_NOETIC if self._ros1 else Stores.ROS2_HUMBLE)
        decode = store.deserialize_ros1 if self._ros1 else store.deserialize_cdr
        with self._open() as reader:
            chosen = [c for c in reader.connections if c.topic in topics]
            if not chosen:
                return
            stop = None if at is None else at + 1
            for connection, time, raw in reader.messages(chosen, at, stop):
                yield connection.topic, time, decode(raw, connection.msgtype)

    def about(self) -> str | None:
        """What this project writes on a session that it exports."""
        if self.topics.get(SESSION_TOPIC, ("", 0))[0] != _TEXT:
            return None
        for _, _, message in self.messages([SESSION_TOPIC]):
            return str(message.data)
        return None

    # -- cameras ---------------------------------------------------------------

    def propose_images(self, cameras: Sequence[str]) -> dict[str, str]:
        """The image topic that has a camera's name in it, where there is just one.

        Raises:
            InputError: for a camera there is none, or there are several.
        """
        topics = self.of_type(*_IMAGE)
        found = {}
        for camera in cameras:
            fits = [t for t in topics if camera in t.split("/")]
            if len(fits) != 1:
                raise InputError(
                    f"{self.path}: {len(fits)} image topics are named after camera "
                    f"{camera}; name them with --image {camera}=TOPIC; there is "
                    f"{self.listing()}"
                )
            found[camera] = fits[0]
        return found

    def images(self, topics: Mapping[str, str]) -> dict[str, ImageStream]:
        """When each camera took its images; they are read when asked for.

        Raises:
            InputError: a topic is not there.
        """
        for topic in topics.values():
            if topic not in self.of_type(*_IMAGE):
                raise InputError(
                    f"{self.path}: there is no image topic {topic!r}; there is "
                    f"{self.listing()}"
                )
        taken: dict[str, list[tuple[float, int]]] = {t: [] for t in topics.values()}
        for topic, logged, message in self._logged(list(taken)):
            taken[topic].append((_stamp(message, logged), logged))
        return {
            camera: self._image_stream(topic, sorted(taken[topic]))
            for camera, topic in topics.items()
        }

    def _image_stream(self, topic: str, taken: list[tuple[float, int]]) -> ImageStream:
        def read(index: int) -> NDArray[np.uint8]:
            time, logged = taken[index]
            for _, _, message in self._logged([topic], at=logged):
                if _stamp(message, logged) == time:
                    return decode_message(
                        message, f"{self.path}, {topic} at {time:.3f} s"
                    )
            raise StorageError(f"{self.path}: {topic} has lost its message at {time} s")

        return ImageStream(tuple(time for time, _ in taken), read)

    # -- the robot -------------------------------------------------------------

    def propose_robot(self, *, has_model: bool) -> str:
        """Joint states where there is a model for them.

        Raises:
            InputError: nothing is there that needs no further word.
        """
        topics = self.of_type(_JOINTS)
        if has_model and len(topics) == 1:
            return f"joints:{topics[0]}"
        raise InputError(
            f"{self.path}: say where the robot's poses are: --robot tf:BASE,FLANGE "
            "(frames), --robot pose:TOPIC (PoseStamped), or --robot joints:TOPIC "
            f"(needs a cell with a robot model); there is {self.listing()}"
        )

    def robot(
        self, source: str, forward: Forward | None, direction: RobotDirection | None
    ) -> PoseStream:
        """The robot's poses over time.

        Args:
            source: "joints:TOPIC", "tf:BASE,FLANGE" or "pose:TOPIC".
            forward: Kinematics, for joint states.
            direction: For "pose": whether it is the flange in the base or the inverse.

        Raises:
            InputError: the source is written otherwise, is not there, or is empty.
        """
        kind, _, rest = source.partition(":")
        if kind == "joints" and rest:
            return self._by_joints(rest, forward)
        if kind == "tf" and rest.count(",") == 1:
            return self._by_frames(*(name.strip() for name in rest.split(",")))
        if kind == "pose" and rest:
            return self._by_poses(rest, direction)
        raise InputError(
            "--robot must be joints:TOPIC, tf:BASE,FLANGE or pose:TOPIC, got "
            f"{source!r}"
        )

    def _by_joints(self, topic: str, forward: Forward | None) -> PoseStream:
        if forward is None:
            raise InputError(
                "--robot joints: the cell has no robot model to compute poses with; "
                "use a cell of schema handeye_tri.cell/1, or --robot tf or pose"
            )
        times, rows = [], []
        there: dict[str, int] = {}
        for _, time, message in self._typed(topic, _JOINTS):
            where = {name: i for i, name in enumerate(message.name)}
            there.update(where)
            # Grippers and tracks report on the same topic, in messages of their own.
            if all(name in where for name in forward.names):
                if len(message.position) != len(message.name):
                    raise InputError(
                        f"{self.path}: {topic} at {time:.3f} s has {len(message.name)} "
                        f"names and {len(message.position)} positions"
                    )
                rows.append([message.position[where[n]] for n in forward.names])
                times.append(time)
        if not rows:
            lacking = [n for n in forward.names if n not in there] or forward.names
            raise InputError(
                f"{self.path}: {topic} never reports the joints {', '.join(lacking)}; "
                f"it has {', '.join(there) or 'none'}; name its joints in the order of "
                "the cell's arm with --joints"
            )
        joints = np.array(rows, dtype=float)
        if not np.isfinite(joints).all():
            raise InputError(f"{self.path}: {topic} holds joints that are no numbers")
        ordered, order = _ascending(times)
        return PoseStream(ordered, forward.pose(joints[order]), joints[order])

    def _by_frames(self, base: str, flange: str) -> PoseStream:
        frames = Frames(base, flange)
        times, poses = [], []
        topics = self.of_type(_TF)
        if not topics:
            raise InputError(
                f"{self.path}: there are no frames (TFMessage); there is "
                f"{self.listing()}"
            )
        for topic, time, message in self.messages(topics):
            stamps = [_stamp(t, int(round(1e9 * time))) for t in message.transforms]
            links = [
                (
                    t.header.frame_id,
                    t.child_frame_id,
                    _motion(
                        t.transform.translation,
                        t.transform.rotation,
                        f"{self.path}, {topic}",
                    ),
                )
                for t in message.transforms
            ]
            if frames.update(links) and (pose := frames.pose()) is not None:
                times.append(max(stamps))
                poses.append(pose)
        if not poses:
            raise InputError(
                f"{self.path}: no chain of frames leads from {base!r} to {flange!r}; "
                f"there are {frames.known:.300}"
            )
        # A latched static frame may be stamped long before.
        ordered, order = _ascending(times)
        return PoseStream(ordered, np.array(poses)[order], np.zeros((len(order), 0)))

    def _by_poses(self, topic: str, direction: RobotDirection | None) -> PoseStream:
        if direction is None:
            raise InputError(
                f"--robot pose:{topic}: say what a pose is: --direction flange_in_base "
                "(maps flange to base coordinates) or base_in_flange"
            )
        times, poses = [], []
        for _, time, message in self._typed(topic, _POSE):
            pose = message.pose
            where = f"{self.path}, {topic} at {time:.3f} s"
            poses.append(_motion(pose.position, pose.orientation, where))
            times.append(time)
        if not poses:
            raise InputError(f"{self.path}: {topic} is empty")
        ordered, order = _ascending(times)
        matrices = np.array(poses)[order]
        return PoseStream(
            ordered,
            matrices if direction == "flange_in_base" else se3_inverse(matrices),
            np.zeros((len(order), 0)),
        )

    def _typed(self, topic: str, kind: str) -> Iterable[tuple[str, float, Any]]:
        if topic not in self.of_type(kind):
            raise InputError(
                f"{self.path}: there is no topic {topic!r} of type {kind}; there is "
                f"{self.listing()}"
            )
        for number, message in enumerate(self.messages([topic])):
            if number >= MAX_POSES:
                raise InputError(f"{self.path}: {topic} has over {MAX_POSES} messages")
            yield message


def _ascending(times: Sequence[float]) -> tuple[Floats, NDArray[np.intp]]:
    """Times in order, the last of those that are the same, and where they were."""
    given = np.array(times, dtype=float)
    order = np.argsort(given, kind="stable")
    last = np.append(np.diff(given[order]) > 0, True)
    return given[order][last], order[last]


def _stamp(message: Any, fallback_ns: int) -> float:
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None or (stamp.sec == 0 and stamp.nanosec == 0):
        return fallback_ns / 1e9
    return float(stamp.sec + stamp.nanosec / 1e9)


def _motion(translation: Any, rotation: Any, where: str) -> Floats:
    """Matrix of a message's vector and quaternion, shape (4, 4), metres."""
    q = np.array([rotation.w, rotation.x, rotation.y, rotation.z], dtype=float)
    t = np.array([translation.x, translation.y, translation.z], dtype=float)
    if not np.isfinite([*q, *t]).all() or abs(np.linalg.norm(q) - 1) > 1e-3:
        raise InputError(
            f"{where}: a pose is no rigid motion (quaternion {q.tolist()})"
        )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_quaternion_wxyz(q / np.linalg.norm(q))
    matrix[:3, 3] = t
    return matrix
