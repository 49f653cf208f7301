"""Trajectories in TUM format: ``t x y z qx qy qz qw`` on each line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handeye_tri.se3 import quaternion_wxyz
from handeye_tri.storage.files import write_bytes

Floats = NDArray[np.float64]


def write_tum(path: Path, times: Floats, poses: Floats, remark: str) -> None:
    """Write a trajectory; every number reads back to the same bits.

    Args:
        path: The file.
        times: Shape (n,), increasing.
        poses: Shape (n, 4, 4), metres.
        remark: What the file holds; one line.

    Raises:
        StorageError: it cannot be written.
    """
    write_bytes(path, tum_text(times, poses, [remark]).encode())


def tum_text(times: Floats, poses: Floats, remarks: Sequence[str]) -> str:
    """What such a file holds.

    Args:
        times: Shape (n,), increasing; written to a tenth.
        poses: Shape (n, 4, 4), metres.
        remarks: Lines for its head.
    """
    lines = [*(f"# {remark}" for remark in remarks), "# t x y z qx qy qz qw"]
    for time, pose in zip(times.tolist(), poses, strict=True):
        w, x, y, z = quaternion_wxyz(pose[:3, :3]).tolist()
        row = [f"{time:.1f}", *map(repr, (*pose[:3, 3].tolist(), x, y, z, w))]
        lines.append(" ".join(row))
    return "\n".join(lines) + "\n"
