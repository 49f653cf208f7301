"""Robot poses in text files: CSV of any layout, TUM, EuRoC/ASL, YAML and JSON.

A table says nothing about what its numbers mean, so the user does, in one word:
``--pose-format ROTATION:LENGTH[,ANGLE]``, such as ``rotation-vector:mm,rad`` (UR
pendants), ``euler-zyx-moving:mm,deg`` (KUKA's A B C), ``quaternion-wxyz:mm``,
``axis-angle:m,deg`` (three numbers of the axis, then the angle) or ``matrix:m`` (16 or
12 numbers, row by row). The position comes first.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from handeye_tri.counting import counted
from handeye_tri.errors import InputError, StorageError
from handeye_tri.exchange.capture import MAX_POSES
from handeye_tri.records import Floats, RobotDirection
from handeye_tri.se3 import se3_inverse
from handeye_tri.storage import PoseReader, read_bytes, read_structured

Json = dict[str, Any]
TableKind = Literal["csv", "tum", "euroc", "yaml"]
DIRECTIONS: tuple[RobotDirection, ...] = ("flange_in_base", "base_in_flange")
# Header names of a column that names a row rather than being a coordinate.
_KEYS = ("name", "image", "station", "time_s", "timestamp_ns")
_QUATERNIONS = ("quaternion-wxyz", "quaternion-xyzw")
_HINT = (
    "matrix:m, quaternion-wxyz:m, quaternion-xyzw:m, rotation-vector:mm,rad, "
    "axis-angle:m,deg, euler-zyx-moving:mm,deg (mm or m, deg or rad, any order of x y "
    "z, fixed or moving axes)"
)


@dataclass(frozen=True, slots=True)
class PoseFormat:
    """What the numbers of a row mean.

    Attributes:
        rotation: "matrix", "quaternion-wxyz", "quaternion-xyzw", "rotation-vector",
            "axis-angle" or "euler".
        length: "m" or "mm".
        angle: "rad" or "deg"; "" where the rotation has no angles.
        order: Of Euler's axes, such as "zyx"; "" otherwise.
        about: "fixed" or "moving" axes; "" otherwise.
    """

    rotation: str
    length: str
    angle: str = ""
    order: str = ""
    about: str = ""

    @classmethod
    def parse(cls, text: str) -> PoseFormat:
        """Read ``--pose-format``.

        Raises:
            InputError: something is missing or unknown; lists what there is.
        """
        match = re.fullmatch(r"([a-z-]+):(m|mm)(?:,(rad|deg))?", text.strip())
        if match is None:
            raise InputError(
                f"--pose-format must be one of {_HINT}; got {text!r} (units are "
                "stated, never guessed)"
            )
        rotation, length, angle = match[1], match[2], match[3] or ""
        order = about = ""
        euler = re.fullmatch(r"euler-([xyz]{3})-(fixed|moving)", rotation)
        if euler is not None:
            rotation, order, about = "euler", euler[1], euler[2]
            if order[0] == order[1] or order[1] == order[2]:
                raise InputError(
                    f"--pose-format: two successive angles about {order[1]} are one; "
                    f"got the order {order!r}"
                )
        has_angle = rotation in ("euler", "rotation-vector", "axis-angle")
        if not has_angle and rotation not in ("matrix", *_QUATERNIONS):
            raise InputError(
                f"--pose-format: there is no rotation {rotation!r}; use one of {_HINT}"
            )
        if has_angle != bool(angle):
            what = "needs ,rad or ,deg" if has_angle else "has no angle to state"
            raise InputError(f"--pose-format: {rotation} {what}; got {text!r}")
        return cls(rotation, length, angle, order, about)

    @property
    def counts(self) -> tuple[int, ...]:
        """How many numbers a row may have."""
        if self.rotation == "matrix":
            return (16, 12)
        return (6,) if self.rotation in ("euler", "rotation-vector") else (7,)

    def pose(self, row: Sequence[float]) -> Json:
        """A row as the reader of poses takes it."""
        if self.rotation == "matrix":
            full = [*row, 0.0, 0.0, 0.0, 1.0] if len(row) == 12 else list(row)
            return {f"matrix_{self.length}": full}
        turn: Any = list(row[3:])
        key = self.rotation.replace("-", "_")
        if self.rotation in _QUATERNIONS:
            key = "quaternion"
            turn = dict(zip(self.rotation[-4:], turn, strict=True))
        elif self.rotation == "euler":
            degrees = turn if self.angle == "deg" else np.degrees(turn).tolist()
            turn = {"order": self.order, "about": self.about, "angles_deg": degrees}
        elif self.rotation == "axis-angle":
            key = f"rotation_vector_{self.angle}"
            length = float(np.linalg.norm(turn[:3]))
            # An axis of another length than 1 was not meant as an axis.
            unit = abs(length - 1) < 1e-3
            turn = [a / length * turn[3] if unit else np.nan for a in turn[:3]]
        else:
            key = f"rotation_vector_{self.angle}"
        return {f"translation_{self.length}": list(row[:3]), key: turn}


@dataclass(frozen=True, slots=True, eq=False)
class PoseTable:
    """Poses of a file.

    Attributes:
        base_from_flange: Shape (n, 4, 4), metres.
        names: What the file calls each pose; empty where it does not.
        times: Shape (n,), seconds; None where the file has none.
    """

    base_from_flange: Floats
    names: tuple[str, ...] = ()
    times: Floats | None = None


def read_pose_table(
    path: Path,
    kind: TableKind,
    *,
    pose_format: PoseFormat | None,
    direction: RobotDirection | None,
    orthonormalise: bool = False,
) -> PoseTable:
    """Read the robot's poses.

    Args:
        path: The file.
        kind: "csv" (``pose_format`` needed), "tum", "euroc" or "yaml" (JSON too).
        pose_format: What the numbers of a CSV row mean.
        direction: Whether a pose is that of the flange in the base or the inverse;
            YAML states it itself.
        orthonormalise: Take rotations that are rounded.

    Raises:
        StorageError: missing, not text, or not YAML.
        InputError: something is missing, contradictory or no number; names the line.
    """
    reader = PoseReader(path, orthonormalise)
    if kind == "yaml":
        if pose_format or direction:
            raise InputError(
                f"{path}: YAML states directions and units itself; leave out "
                "--pose-format and --direction"
            )
        return _structured(path, reader)
    if direction is None:
        raise InputError(
            f"{path}: say what a pose is: --direction flange_in_base (maps flange to "
            "base coordinates, what most pendants show) or base_in_flange"
        )
    if (kind == "csv") != (pose_format is not None):
        raise InputError(
            f"{path}: a CSV file needs --pose-format, one of {_HINT}"
            if kind == "csv"
            else f"{path}: {kind} fixes its own format; leave out --pose-format"
        )
    header, rows = _rows(path, reader)
    if kind == "tum":
        layout, keys = PoseFormat("quaternion-xyzw", "m"), ["time_s"]
        _need_columns(reader, rows, (8,), "t x y z qx qy qz qw")
    elif kind == "euroc":
        layout, keys = PoseFormat("quaternion-wxyz", "m"), ["timestamp_ns"]
        _check_euroc(reader, header, rows)
        rows = [(line, cells[:8]) for line, cells in rows]
    else:
        assert pose_format is not None
        layout = pose_format
        keys = _key_columns(reader, header, rows, layout)
    return _table(reader, layout, keys, header, rows, direction)


def _rows(
    path: Path, reader: PoseReader
) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Header, if there is one, and rows of cells with their line numbers."""
    try:
        lines = read_bytes(path).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise StorageError(f"{path}: this is not a text file") from None
    if len(lines) > MAX_POSES:
        raise reader.fail(f"{len(lines)} lines are more than the {MAX_POSES} allowed")
    header: list[str] = []
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(lines, 1):
        text = line.strip()
        comment = text.startswith("#")
        text = text.lstrip("#").strip()
        if not text:
            continue
        cells = _split(text)
        if comment or (not rows and not header and not _is_number(cells[-1])):
            # The first comment or line without numbers names the columns.
            header = header or cells
            continue
        rows.append((number, cells))
    if not rows:
        raise reader.fail("there is no pose in it")
    return header, rows


def _split(text: str) -> list[str]:
    for mark in (";", ",", "\t"):
        if mark in text:
            try:
                cells = next(csv.reader([text], delimiter=mark))
            except csv.Error:
                cells = text.split(mark)
            return [cell.strip() for cell in cells]
    return text.split()


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _need_columns(
    reader: PoseReader,
    rows: list[tuple[int, list[str]]],
    counts: tuple[int, ...],
    what: str,
) -> None:
    for line, cells in rows:
        if len(cells) not in counts:
            raise reader.fail(
                f"line {line} has {counted(len(cells), 'column')}; {what} has "
                f"{' or '.join(map(str, counts))}"
            )


def _check_euroc(
    reader: PoseReader, header: list[str], rows: list[tuple[int, list[str]]]
) -> None:
    for line, cells in rows:
        if len(cells) < 8:
            raise reader.fail(
                f"line {line} has {counted(len(cells), 'column')}; EuRoC/ASL poses "
                "have at least 8: timestamp [ns], p_x p_y p_z [m], q_w q_x q_y q_z"
            )
    named = " ".join(header)
    if header and ("[ns]" not in header[0].replace(" ", "") or "[m]" not in named):
        raise reader.fail(
            "the head of an EuRoC/ASL file names timestamp [ns] and positions [m], "
            f"got {named[:80]!r}"
        )


def _key_columns(
    reader: PoseReader,
    header: list[str],
    rows: list[tuple[int, list[str]]],
    layout: PoseFormat,
) -> list[str]:
    """Names of the leading columns that are no coordinates."""
    keys: list[str] = []
    for cell in header:
        if cell not in _KEYS:
            break
        keys.append(cell)
    counts = tuple(len(keys) + count for count in layout.counts)
    first = len(rows[0][1])
    if first not in counts and not keys:
        raise reader.fail(
            f"line {rows[0][0]} has {counted(first, 'column')}, {layout.rotation} has "
            f"{' or '.join(map(str, layout.counts))}; where a first column names the "
            f"pose, add a header line that calls it {', '.join(_KEYS)}"
        )
    _need_columns(reader, rows, counts, f"{layout.rotation} after {len(keys)} names")
    for cell in header[len(keys) :]:
        _contradicts(reader, cell, layout)
    return keys


def _contradicts(reader: PoseReader, cell: str, layout: PoseFormat) -> None:
    """Refuse a column whose name states another unit than the user."""
    match = re.search(r"(?:_|\[|\(| )(mm|m|deg|rad)[\])]?$", cell.strip().lower())
    if match is None:
        return
    stated = layout.length if match[1] in ("m", "mm") else layout.angle
    if match[1] != stated:
        raise reader.fail(
            f"the column {cell!r} is in {match[1]}, but --pose-format says "
            f"{stated or 'no angle'}; one of the two is wrong"
        )


def _table(
    reader: PoseReader,
    layout: PoseFormat,
    keys: list[str],
    header: list[str],
    rows: list[tuple[int, list[str]]],
    direction: RobotDirection,
) -> PoseTable:
    poses, names, times = [], [], []
    for line, cells in rows:
        where = f"line {line}"
        values = [
            float(reader.numbers(cell, (), f"{where}, column {k}"))
            for k, cell in enumerate(cells[len(keys) :], len(keys) + 1)
        ]
        poses.append(reader.pose(layout.pose(values), where))
        for key, cell in zip(keys, cells, strict=False):
            if key == "time_s":
                times.append(float(reader.numbers(cell, (), f"{where}, {key}")))
            elif key == "timestamp_ns":
                if not re.fullmatch(r"\d{1,20}", cell):
                    raise reader.fail(f"{where}: {key} must be whole, got {cell!r:.40}")
                times.append(int(cell) / 1e9)
            else:
                names.append(cell)
    return _directed(reader, np.array(poses), names, times, direction)


def _directed(
    reader: PoseReader,
    poses: Floats,
    names: Sequence[str],
    times: Sequence[float],
    direction: RobotDirection,
) -> PoseTable:
    given = np.array(times)
    if len(given) > 1 and not (np.diff(given) > 0).all():
        i = int(np.argmin(np.diff(given)))
        raise reader.fail(
            f"times must increase, but pose {i + 1} at {given[i + 1]:.6f} s follows "
            f"{given[i]:.6f} s"
        )
    return PoseTable(
        poses if direction == "flange_in_base" else se3_inverse(poses),
        tuple(names),
        given if len(given) else None,
    )


def _structured(path: Path, reader: PoseReader) -> PoseTable:
    """Poses whose keys name everything, see :mod:`handeye_tri.storage.pose_files`."""
    data = read_structured(path)
    if not isinstance(data, Mapping):
        raise reader.fail('it must be a mapping with "robot_poses" and "poses"')
    reader.only(data, {"robot_poses", "poses"}, "the head")
    direction = reader.word(data, "robot_poses")
    items = reader.items(reader.need(data, "poses", "the head"), "poses")
    poses = [reader.pose(item, f"poses[{i}]") for i, item in enumerate(items)]
    names = [str(item["name"]) for item in items if "name" in item]
    times = [
        float(reader.numbers(item["time_s"], (), f"poses[{i}].time_s"))
        for i, item in enumerate(items)
        if "time_s" in item
    ]
    for key, found in (("name", names), ("time_s", times)):
        if len(found) not in (0, len(items)):
            raise reader.fail(f"{len(found)} of {len(items)} poses have {key!r}")
    return _directed(
        reader,
        np.array(poses),
        names,
        times,
        direction,  # type: ignore[arg-type]
    )
