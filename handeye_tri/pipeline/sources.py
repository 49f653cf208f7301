"""From what a user names on the command line to stations with images."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from handeye_tri import storage
from handeye_tri.config import Cell, CellToCalibrate, parse_any_cell
from handeye_tri.counting import counted
from handeye_tri.errors import InputError
from handeye_tri.exchange.capture import Capture, PoseStream, Stillness
from handeye_tri.exchange.image_folders import (
    TimeUnit,
    euroc_images,
    find_images,
    paired_stations,
    timed_images,
)
from handeye_tri.exchange.other_readings import other_readings
from handeye_tri.exchange.pose_tables import (
    PoseFormat,
    PoseTable,
    TableKind,
    read_pose_table,
)
from handeye_tri.exchange.standstill import stations_from_streams
from handeye_tri.records import Floats, RobotDirection

if TYPE_CHECKING:
    from handeye_tri.exchange.bags import BagFile, Forward

# What each format is, in a few words.
SOURCES = {
    "images": "a folder of images, and --poses",
    "euroc": "EuRoC/ASL camera folders, and --poses",
    "bag": "a rosbag2 folder, an .mcap file or a ROS 1 .bag",
    "moveit": "a folder of images, and MoveIt's samples as --poses",
}
_KINDS: Mapping[str, TableKind] = {
    ".csv": "csv",
    ".tum": "tum",
    ".yaml": "yaml",
    ".yml": "yaml",
    ".json": "yaml",
}


@dataclass(frozen=True, slots=True)
class Named:
    """What the user names beside format and source; None or empty: not named.

    Attributes:
        cell: Path of the cell's description, or a shipped name.
        poses: File of the robot's poses.
        poses_kind: Its kind.
        pose_format: What its numbers mean.
        direction: What a pose maps to what.
        images: Topic, folder or pattern by camera.
        image_times: Unit of the times that images are named by.
        robot: Where a recording has the robot's poses.
        joints: What the recording calls the arm's joints.
        still: When the robot counts as standing.
        orthonormalise: Take rotations that are rounded.
        tool_change: The first station with the cell's second mount.
    """

    cell: str | None = None
    poses: Path | None = None
    poses_kind: TableKind | None = None
    pose_format: str | None = None
    direction: RobotDirection | None = None
    images: Mapping[str, str] = field(default_factory=dict)
    image_times: TimeUnit | None = None
    robot: str | None = None
    joints: tuple[str, ...] = ()
    still: Stillness = field(default_factory=Stillness)
    orthonormalise: bool = False
    tool_change: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What a source holds.

    Attributes:
        capture: Stations with images.
        cell: What is calibrated.
        cell_file: Where its description was.
        model_file: The robot's model; "" where there is none.
        proposals: Options that were taken as proposed, as a user would type them.
        tool_change: The first station with the cell's second mount, as named, or as
            the source itself has it; None where neither says so.
        others: What else the poses' numbers could mean: the options that say so, and
            the poses so read, (n, 4, 4), metres.
    """

    capture: Capture
    cell: CellToCalibrate
    cell_file: str
    model_file: str
    proposals: tuple[str, ...] = ()
    tool_change: int | None = None
    others: Callable[[], Iterable[tuple[str, Floats]]] = tuple


def read_source(layout: str, source: Path, named: Named) -> Found:
    """Read a source of one of SOURCES.

    Raises:
        InputError: something is not named, contradictory or not there.
        StorageError: a file is missing or damaged.
        MissingDependencyError: for recordings, the extra ``ros`` is not installed.
    """
    if layout == "bag":
        return _from_bag(source, named)
    if named.cell is None:
        raise InputError("say what is calibrated: --cell CELL.yaml (scenes/README.md)")
    cell, cell_file, model_file = _cell(named.cell)
    _check_cameras(named.images, cell)
    if named.poses is None:
        raise InputError(f"{layout} needs the robot's poses: --poses FILE")
    capture = (
        _from_euroc(source, named, cell)
        if layout == "euroc"
        else _from_images(layout, source, named, cell)
    )
    found = Found(
        *(capture, cell, cell_file, model_file), tool_change=named.tool_change
    )
    if named.pose_format is None or named.image_times is not None:
        return found
    stated = PoseFormat.parse(named.pose_format)
    return replace(found, others=partial(other_readings, named.poses, stated))


def _cell(name: str) -> tuple[CellToCalibrate, str, str]:
    path = storage.find_cell(name)
    cell = storage.read_any_cell(path)
    model = str(storage.find_model(cell, path)) if isinstance(cell, Cell) else ""
    return cell, str(path), model


def _check_cameras(images: Mapping[str, str], cell: CellToCalibrate) -> None:
    names = [camera.name for camera in cell.cameras]
    unknown = [name for name in images if name not in names]
    if unknown:
        raise InputError(
            f"--image {unknown[0]}=...: the cell has no camera {unknown[0]!r}, it has "
            f"{', '.join(names)}"
        )


def _table(named: Named, default: TableKind | None = None) -> PoseTable:
    path = named.poses
    assert path is not None
    kind = named.poses_kind or default or _KINDS.get(path.suffix.lower())
    if kind is None:
        raise InputError(
            f"{path}: the name does not say what it is; add --poses-kind csv, tum, "
            "euroc or yaml"
        )
    return read_pose_table(
        path,
        kind,
        pose_format=None
        if named.pose_format is None
        else PoseFormat.parse(named.pose_format),
        direction=named.direction,
        orthonormalise=named.orthonormalise,
    )


def _stream(table: PoseTable, path: Path | None) -> PoseStream:
    import numpy as np

    if table.times is None:
        raise InputError(
            f"{path}: matching by time needs times: a first column called time_s or "
            "timestamp_ns, or a TUM file"
        )
    poses = table.base_from_flange
    return PoseStream(table.times, poses, np.zeros((len(poses), 0)))


def _from_images(
    layout: str, source: Path, named: Named, cell: CellToCalibrate
) -> Capture:
    if layout == "moveit":
        assert named.poses is not None
        if named.pose_format or named.direction or named.poses_kind:
            raise InputError(
                "moveit states its own format; leave out --pose-format, --direction "
                "and --poses-kind"
            )
        pairs = storage.read_moveit_samples(
            named.poses, "eye_to_hand", orthonormalise=named.orthonormalise
        )
        table = PoseTable(pairs.base_from_flange)
    else:
        table = _table(named)
    patterns = {
        camera.name: named.images.get(camera.name, f"{camera.name}/*")
        for camera in cell.cameras
    }
    paths = find_images(source, patterns)
    if named.image_times is None:
        return paired_stations(table, paths)
    streams = {
        camera: timed_images(found, named.image_times)
        for camera, found in paths.items()
    }
    return stations_from_streams(_stream(table, named.poses), streams, named.still)


def _from_euroc(source: Path, named: Named, cell: CellToCalibrate) -> Capture:
    lacking = [c.name for c in cell.cameras if c.name not in named.images]
    if lacking:
        there = sorted(path.parent.name for path in source.glob("*/data.csv"))
        raise InputError(
            f"say which folder is camera {lacking[0]}: --image {lacking[0]}=cam0; "
            f"{source} has {', '.join(there) or 'no folder with data.csv'}"
        )
    streams = {}
    for camera, folder in named.images.items():
        if Path(folder).is_absolute() or ".." in Path(folder).parts:
            raise InputError(f"--image {camera}={folder}: it must stay below {source}")
        streams[camera] = euroc_images(source / folder)
    table = _table(named, "euroc")
    return stations_from_streams(_stream(table, named.poses), streams, named.still)


def _from_bag(source: Path, named: Named) -> Found:
    from handeye_tri.exchange.bags import BagFile

    for option, value in (
        ("--poses", named.poses),
        ("--pose-format", named.pose_format),
    ):
        if value is not None:
            raise InputError(f"a recording has its own poses; leave out {option}")
    bag = BagFile(source)
    proposals = []
    if named.cell is None:
        cell, cell_file, model_file = _cell_of(bag, source)
        proposals.append(f"the cell that {source.name} describes (--cell)")
    else:
        cell, cell_file, model_file = _cell(named.cell)
    _check_cameras(named.images, cell)
    topics = dict(named.images)
    missing = [c.name for c in cell.cameras if c.name not in topics]
    for camera, topic in bag.propose_images(missing).items():
        topics[camera] = topic
        proposals.append(f"--image {camera}={topic}")
    robot = named.robot
    if robot is None:
        robot = bag.propose_robot(has_model=bool(model_file))
        proposals.append(f"--robot {robot}")
    forward = None
    if robot.startswith("joints:") and isinstance(cell, Cell):
        forward = _forward(cell, Path(model_file), named.joints)
    stream = bag.robot(robot, forward, named.direction)
    capture = stations_from_streams(stream, bag.images(topics), named.still)
    change = named.tool_change
    if change is None and cell.second_mount is not None:
        change = _tool_change_of(bag)
        if change is not None:
            proposals.append(f"--tool-change {change}")
    return Found(capture, cell, cell_file, model_file, tuple(proposals), change)


def _cell_of(bag: BagFile, source: Path) -> tuple[CellToCalibrate, str, str]:
    """The cell that an exported session carries."""
    text = bag.about()
    if text is None:
        raise InputError(
            f"{source}: it does not describe the cell; add --cell CELL.yaml "
            "(scenes/README.md)"
        )
    try:
        data = json.loads(text)["session"]["cell"]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise InputError(f"{source}: its session is not readable; add --cell") from None
    if not isinstance(data, dict):
        raise InputError(f"{source}: its cell is no mapping; add --cell")
    cell = parse_any_cell(data, str(source))
    model = ""
    if isinstance(cell, Cell):
        # A recording from elsewhere names no files of this machine.
        if "/" in cell.arm.model or ".." in cell.arm.model:
            raise InputError(
                f"{source}: its cell has a robot model of its own "
                f"({cell.arm.model!r:.80}); add --cell with the path of yours"
            )
        model = str(storage.find_model(cell, source))
    return cell, str(source), model


def _tool_change_of(bag: BagFile) -> int | None:
    """The first station with the second mount, as an exported session carries it.

    Raises:
        InputError: the session begins with the second mount.
    """
    try:
        change = json.loads(bag.about() or "{}")["tool_change"]
        before, mount = change["before"], change["mount"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    if type(before) is not int:
        return None
    if mount == 0:
        raise InputError(
            f"{bag.path}: this session begins with its second mount; exchange rig and "
            f"second_mount in a cell of your own, and name it with --cell, and "
            f"--tool-change {before}"
        )
    return before


def _forward(cell: Cell, model: Path, joints: Sequence[str]) -> Forward:
    from handeye_tri.arm import Arm
    from handeye_tri.exchange.bags import Forward
    from handeye_tri.simulate import compile_mechanism

    arm = Arm(compile_mechanism(cell, model))
    names = tuple(joints) or arm.joint_names
    if len(names) != len(arm.joint_names) or len(set(names)) < len(names):
        raise InputError(
            f"--joints must name {counted(len(arm.joint_names), 'joint')} in the order "
            f"of {', '.join(arm.joint_names)}; got {', '.join(names)}"
        )
    return Forward(names, arm.forward)
