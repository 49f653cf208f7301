"""The peer of row 6 of `bench.py`; runs in its environment, without handeye_tri."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


def park(a: Any, b: Any, more_a: Any, more_b: Any) -> Callable[[], Any]:
    """OpenCV's Park and Martin for a standing camera; all pairs of poses.

    Args:
        a: base_from_flange, (n, 4, 4), metres.
        b: camera_from_target, (n, 4, 4), metres.
        more_a: Other sets of poses, (s, k, 4, 4), solved before the clock runs.
        more_b: The same.

    Returns:
        A call that returns base_from_camera of a and b, and of each other set.

    Raises:
        ImportError: this OpenCV has none (5.0 has not).
    """
    import cv2
    from cv2 import CALIB_HAND_EYE_PARK, calibrateHandEye

    cv2.setNumThreads(1)

    def taken_apart(a: Any, b: Any) -> list[list[Any]]:
        # For a standing camera OpenCV wants the robot's poses inverted.
        parts = []
        for poses in (np.linalg.inv(a), b):
            parts += [list(poses[:, :3, :3]), list(poses[:, :3, 3])]
        return parts

    def solved(parts: list[list[Any]]) -> Any:
        rotation, translation = calibrateHandEye(*parts, method=CALIB_HAND_EYE_PARK)
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = rotation, translation[:, 0]
        return found

    others = np.array(
        [solved(taken_apart(*pair)) for pair in zip(more_a, more_b, strict=True)]
    )
    parts = taken_apart(a, b)
    return lambda: (solved(parts), others)
