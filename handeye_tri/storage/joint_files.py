"""Lists of joint values as CSV: one column a joint, its unit in the name.

Where the triangle is held by two mounts, a column says which, from 1.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handeye_tri.counting import counted
from handeye_tri.errors import InputError
from handeye_tri.storage.files import read_bytes, write_bytes

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

_TURNS = {"deg": np.pi / 180, "rad": 1.0}
_SHIFTS = {"mm": 1e-3, "m": 1.0}
# Lines and characters in a line beyond which a file is no list of stations.
_MOST_LINES = 100_000
_MOUNT = "mount"


def read_joint_list(
    path: Path, names: Sequence[str], slides: NDArray[np.bool_], mounts: int = 1
) -> tuple[Floats, Ints]:
    """Read stations: a header such as ``s_deg,l_deg,...``, then a line a station.

    Columns may come in any order.

    Args:
        path: A CSV file.
        names: Of the arm's q joints.
        slides: Which of them slide, shape (q,).
        mounts: How many the cell has; with two, a column ``mount`` must say which of
            them, from 1, holds the triangle at each station.

    Returns:
        Joints, shape (n, q), rad or m, in the order of ``names``; and the mounts, from
        0, shape (n,).

    Raises:
        InputError: a joint is missing, unknown or without unit, a value is no number,
            the cell has no such mount; names file, line and column.
    """
    rows = _rows(path)
    header = [column.strip() for column in rows[0]]
    factors, places = [], []
    for name, slide in zip(names, slides, strict=True):
        units = _SHIFTS if slide else _TURNS
        known = {f"{name}_{unit}": factor for unit, factor in units.items()}
        here = [column for column in header if column in known]
        if len(here) != 1:
            raise InputError(
                f"{path}: line 1 must have one column for joint {name}, "
                f"{' or '.join(known)}; it has {', '.join(here or header)}"
            )
        factors.append(known[here[0]])
        places.append(header.index(here[0]))
    said = [k for k, column in enumerate(header) if column == _MOUNT]
    if len(said) != 1 and (said or mounts > 1):
        raise InputError(
            f"{path}: line 1 must have one column {_MOUNT}, since the cell has "
            f"{counted(mounts, 'mount')}; it has {', '.join(header)}"
        )
    if len(header) != len(places) + len(said):
        extra = [c for k, c in enumerate(header) if k not in (*places, *said)]
        raise InputError(
            f"{path}: line 1 has columns that are no joint of the arm: "
            f"{', '.join(extra)}; its joints are {', '.join(names)}"
        )
    values = [
        [_number(path, line, header[k], row, k) for k in places]
        for line, row in enumerate(rows[1:], 2)
        if row
    ]
    if len(values) < 2:
        raise InputError(
            f"{path}: holds {counted(len(values), 'station')}, needs at least 2"
        )
    held = np.zeros(len(values), dtype=np.intp)
    if said:
        lines = [(line, row) for line, row in enumerate(rows[1:], 2) if row]
        held = _mounts(path, lines, said[0], mounts)
    return np.array(values) * factors, held


def _mounts(
    path: Path, lines: Sequence[tuple[int, list[str]]], place: int, mounts: int
) -> Ints:
    """Mounts from 0, of numbered lines with a column that says them from 1."""
    known = [str(k + 1) for k in range(mounts)]
    held: list[int] = []
    changes = []
    for line, row in lines:
        text = row[place].strip() if place < len(row) else ""
        if text not in known:
            raise InputError(
                f"{path}: line {line}, {_MOUNT}: {text!r} is none of the cell's "
                f"mounts; it must be {' or '.join(known)}"
            )
        if held and known.index(text) != held[-1]:
            changes.append(str(line))
        held.append(known.index(text))
    if len(changes) > 1:
        raise InputError(
            f"{path}: the mount changes in lines {', '.join(changes)}, but a programme "
            "has one tool change; put all stations of one mount before the others"
        )
    return np.array(held, dtype=np.intp)


def _rows(path: Path) -> list[list[str]]:
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: byte {error.start} is no UTF-8 text; write a CSV file"
        ) from None
    if text.count("\n") > _MOST_LINES:
        raise InputError(f"{path}: more than {_MOST_LINES} lines; this is no programme")
    try:
        rows = list(csv.reader(io.StringIO(text)))
    except csv.Error as error:
        raise InputError(f"{path}: is no CSV file ({error})") from None
    if not rows:
        raise InputError(f"{path}: is empty; line 1 must name the joints and units")
    return rows


def _number(path: Path, line: int, column: str, row: list[str], place: int) -> float:
    text = row[place].strip() if place < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"{path}: line {line}, {column}: {text!r} is no finite number")
    return value


def write_joint_list(
    path: Path,
    names: Sequence[str],
    slides: NDArray[np.bool_],
    joints: Floats,
    mounts: Ints | None = None,
) -> None:
    """Write stations so that :func:`read_joint_list` reads the same values.

    Args:
        path: The file.
        names: Of the arm's q joints.
        slides: Which of them slide, shape (q,).
        joints: Shape (n, q), rad or m; written in degrees and millimetres.
        mounts: Which mount holds the triangle there, from 0, shape (n,); None: the
            cell has one, and no column says it.
    """
    units = np.where(slides, "mm", "deg")
    scale = np.where(slides, 1e3, 180 / np.pi)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    header = [f"{name}_{unit}" for name, unit in zip(names, units, strict=True)]
    rows = [[repr(float(v)) for v in row] for row in joints * scale]
    if mounts is not None:
        header.append(_MOUNT)
        for row, mount in zip(rows, mounts, strict=True):
            row.append(str(mount + 1))
    writer.writerow(header)
    writer.writerows(rows)
    write_bytes(path, text.getvalue().encode())
