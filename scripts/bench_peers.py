"""Peers of the cameras' rows; runs in their environment, which has no handeye_tri.

    uv venv PEERS; uv pip install --python PEERS/bin/python \
        opencv-python-headless==4.14.* gtsam vision-calibration

Each function takes data and returns the call that is measured.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


def opencv_camera(points: Any, pixels: Any, size: tuple[int, int]) -> Callable[[], Any]:
    """cv2.calibrateCamera: K without skew and the five lens coefficients.

    Args:
        points: Of the target, (p, 3), metres.
        pixels: Shape (n, p, 2).
        size: Of the image.
    """
    import cv2

    cv2.setNumThreads(1)
    target = [np.asarray(points, np.float32)] * len(pixels)
    views = list(np.asarray(pixels, np.float32))

    def calibrate() -> Any:
        rms, k, lens, *_ = cv2.calibrateCamera(target, views, size, None, None)
        return rms, k, lens.ravel()

    return calibrate


def opencv_pinhole_trials(
    points: Any, pixels: Any, size: tuple[int, int]
) -> Callable[[], Any]:
    """cv2.calibrateCamera without lens on each of t sets of views.

    Args:
        points: Of the target, (p, 3), metres.
        pixels: Shape (t, n, p, 2).
        size: Of the image.
    """
    import cv2

    cv2.setNumThreads(1)
    target = [np.asarray(points, np.float32)] * pixels.shape[1]
    trials = [list(np.asarray(views, np.float32)) for views in pixels]
    flags = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    flags |= cv2.CALIB_ZERO_TANGENT_DIST

    def calibrate() -> Any:
        return np.array(
            [
                cv2.calibrateCamera(target, views, size, None, None, flags=flags)[0]
                for views in trials
            ]
        )

    return calibrate
