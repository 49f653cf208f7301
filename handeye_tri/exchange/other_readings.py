"""What else the numbers of a table of poses could mean, to be named, never taken."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from handeye_tri.errors import InputError, StorageError
from handeye_tri.exchange.pose_tables import DIRECTIONS, PoseFormat, read_pose_table
from handeye_tri.records import Floats

_SEVEN = ("quaternion-wxyz", "quaternion-xyzw", "axis-angle")
_SIX = ("rotation-vector", "euler-zyx-moving", "euler-xyz-fixed", "euler-xyz-moving")


def other_readings(path: Path, stated: PoseFormat) -> Iterator[tuple[str, Floats]]:
    """Read a CSV file by every other common format of as many numbers.

    Args:
        path: The file.
        stated: What its numbers are said to mean.

    Yields:
        The options that say so, and the poses, base_from_flange, (n, 4, 4), metres.
        Formats that the file contradicts are left out.
    """
    rotations = {7: _SEVEN, 6: _SIX}.get(stated.counts[0], (stated.rotation,))
    lengths = sorted(("m", "mm"), key=lambda unit: unit != stated.length)
    for length in lengths:
        for rotation in rotations:
            turns = rotation not in ("matrix", *_SEVEN[:2])
            for angle in (",deg", ",rad") if turns else ("",):
                word = f"{rotation}:{length}{angle}"
                for direction in DIRECTIONS:
                    try:
                        table = read_pose_table(
                            path,
                            "csv",
                            pose_format=PoseFormat.parse(word),
                            direction=direction,
                        )
                    except (InputError, StorageError):
                        continue
                    yield (
                        f"--pose-format {word} --direction {direction}",
                        table.base_from_flange,
                    )
