"""Time `solve_axzb` against OpenCV's Park side by side: one table.

    python scripts/bench_hand_eye.py [--rounds 5] [--seeds 200]

Interleaved rounds in one process with one thread, the median of the ratios. A ratio
counts only if the accuracy over the seeds does: rotation within 1.01 of Park's,
translation within 0.75. OpenCV's needs a cv2 that has calibrateHandEye (4.14 has, 5.0
has not); without one, only our times are printed. Exits with 1 where a bar is missed.
"""

from __future__ import annotations

import os

# Before numpy is imported.
os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from handeye_tri.hand_eye import solve_axzb
from handeye_tri.se3 import (
    rotation_from_quaternion_wxyz,
    se3_exp,
    se3_inverse,
    se3_log,
)

BARS = {22: 10.0, 100: 250.0, 1000: 10000.0}
SIGMA = np.repeat([0.5e-3, np.radians(0.1)], 3)


def poses(rng: np.random.Generator, n: int, spread: float) -> Any:
    found = np.tile(np.eye(4), (n, 1, 1))
    found[:, :3, :3] = rotation_from_quaternion_wxyz(rng.standard_normal((n, 4)))
    found[:, :3, 3] = spread * rng.standard_normal((n, 3))
    return found


def draw(seed: int, n: int) -> tuple[Any, Any, Any]:
    """base_from_flange, camera_from_target and the true base_from_camera."""
    rng = np.random.default_rng([6, seed])
    x, z = poses(rng, 2, 0.2)
    a = poses(rng, n, 0.5)
    b = se3_inverse(z) @ a @ x @ se3_exp(SIGMA * rng.standard_normal((n, 6)))
    return a, b, z


def park() -> Callable[[Any, Any], Any] | None:
    """OpenCV's Park for a standing camera: it wants the robot's poses inverted."""
    try:
        import cv2
    except ImportError:
        return None
    if not hasattr(cv2, "calibrateHandEye"):
        return None
    cv2.setNumThreads(1)

    def solve(a: Any, b: Any) -> Any:
        inverse = se3_inverse(a)
        rotation, translation = cv2.calibrateHandEye(
            list(inverse[:, :3, :3]),
            list(inverse[:, :3, 3]),
            list(b[:, :3, :3]),
            list(b[:, :3, 3]),
            method=cv2.CALIB_HAND_EYE_PARK,
        )
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = rotation, translation[:, 0]
        return found

    return solve


def seconds(call: Callable[[], Any], least: float) -> float:
    """Best time of one call within about ``least`` seconds."""
    best, spent = np.inf, 0.0
    while spent < least:
        started = time.perf_counter()
        call()
        took = time.perf_counter() - started
        best, spent = min(best, took), spent + took
    return float(best)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seeds", type=int, default=200)
    arguments = parser.parse_args()
    peer = park()
    good = True
    if peer is not None:
        squares = np.zeros((2, 2))
        for seed in range(arguments.seeds):
            a, b, z = draw(seed, 22)
            for row, found in enumerate((solve_axzb(a, b)[1].matrix, peer(a, b))):
                error = se3_log(se3_inverse(z) @ found).reshape(2, 3)
                squares[row] += (error**2).sum(axis=1)
        translation, rotation = np.sqrt(squares[0] / squares[1])
        good = rotation <= 1.01 and translation <= 0.75
        print(
            f"errors over Park's, {arguments.seeds} seeds of 22 poses: rotation "
            f"{rotation:.3f} (bar 1.01), translation {translation:.3f} (bar 0.75)"
        )
    for n, bar in BARS.items():
        a, b, _ = draw(0, n)
        ours, ratios = [], []
        for _ in range(arguments.rounds):
            ours.append(seconds(lambda a=a, b=b: solve_axzb(a, b), 0.05))
            if peer is not None:
                ratios.append(seconds(lambda a=a, b=b: peer(a, b), 0.05) / ours[-1])
        line = f"{n:>6} poses: {1e3 * np.median(ours):8.3f} ms"
        if ratios:
            ratio = float(np.median(ratios))
            good &= ratio >= bar
            line += f", Park takes {ratio:8.0f} x as long (bar {bar:.0f})"
        print(line)
    times = []
    for n in (10_000, 100_000):
        a, b, _ = draw(0, n)
        times.append(seconds(lambda a=a, b=b: solve_axzb(a, b), 0.1))
        print(f"{n:>6} poses: {1e3 * times[-1]:8.3f} ms")
    growth = times[1] / times[0]
    print(f"ten times the poses take {growth:.1f} x as long")
    sys.exit(0 if good and growth < 15 else 1)


if __name__ == "__main__":
    main()
