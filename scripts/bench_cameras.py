"""Rows 1, 2, 3, 5 and 8 of `bench.py`: calibrating cameras."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
from bench_rows import Gate, Measured, Peers, Row, here
from scipy.optimize import least_squares

from handeye_tri.calibrate_cameras import calibrate_trials
from handeye_tri.camera import Intrinsics, PinholeCamera
from handeye_tri.se3 import so3_exp
from handeye_tri.triangle import TriangleRig

IMAGE_SIZE = (1024, 768)
OPENCV = "opencv-python-headless==4.14.*"

# Row 8: views of a Monte-Carlo study.
TRIANGLE = TriangleRig(0.13, 0.12, float(np.radians(65.0)))
FOOT = (0.05, 0.035)
HALF_TURNS = 11
TRIALS = 1000
# The peers are slow and alike in all trials: they do as many as this.
PEER_TRIALS = 20
SIGMA_PX = 0.2


def rotations(rng: np.random.Generator, n: int) -> Any:
    """Targets that lean 20 to 55 degrees to any side, turned by any angle."""
    azimuth = rng.uniform(0, 2 * np.pi, n)
    lean = np.radians(rng.uniform(20, 55, n))
    axis = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(n)], axis=1)
    spin = np.zeros((n, 3))
    spin[:, 2] = rng.uniform(0, 2 * np.pi, n)
    return so3_exp(axis * lean[:, None]) @ so3_exp(spin)


@cache
def half_turns() -> tuple[Any, Any]:
    """Pixels (trials, half-turns, before and after, 3, 2) and the true poses."""
    rng = np.random.default_rng([8, 0])
    camera = PinholeCamera(
        "camera", Intrinsics(1720.0, 1715.0, 0.0, 519.3, 377.8), IMAGE_SIZE
    )
    turn = TRIANGLE.half_turn("normal", FOOT)
    points = np.stack([TRIANGLE.points, turn.apply(TRIANGLE.points)])
    poses, exact = [], []
    while len(poses) < HALF_TURNS:
        rotation = rotations(rng, 1)[0]
        centre = np.array([*rng.uniform(-0.08, 0.08, 2), rng.uniform(0.8, 1.0)])
        translation = centre - rotation @ np.append(FOOT, 0.0)
        pixels = camera.project(points @ rotation.T + translation)
        if (pixels > 5).all() and (pixels < np.array(IMAGE_SIZE) - 6).all():
            exact.append(pixels)
            poses.append((rotation, translation))
    noise = rng.standard_normal((TRIALS, HALF_TURNS, 2, 3, 2))
    return np.array(exact) + SIGMA_PX * noise, poses


def monte_carlo() -> Callable[[], Any]:
    pixels, _ = half_turns()
    return partial(
        calibrate_trials,
        pixels[:, :, 0],
        pixels[:, :, 1],
        TRIANGLE,
        image_size=IMAGE_SIZE,
        sigma_px=SIGMA_PX,
    )


def opencv_trials(peers: Peers) -> Measured:
    """The same six points a half-turn as flat targets, O known, no skew, no lens."""
    pixels, _ = half_turns()
    turn = TRIANGLE.half_turn("normal", FOOT)
    points = np.concatenate([TRIANGLE.points, turn.apply(TRIANGLE.points)])
    views = pixels[:PEER_TRIALS].reshape(PEER_TRIALS, HALF_TURNS, 6, 2)
    arguments = (points, views, IMAGE_SIZE)
    return peers.elsewhere(
        "bench_peers", "opencv_pinhole_trials", arguments, needs=OPENCV
    )


def scipy_trials(_peers: Peers) -> Measured:
    """The same unknowns and residuals, derivatives by differences, from the truth."""
    pixels, poses = half_turns()
    start = np.concatenate(
        [
            [1720.0, 1715.0, 0.0, 519.3, 377.8, *FOOT],
            *(np.concatenate([np.zeros(3), t]) for _, t in poses),
        ]
    )
    rotation = np.array([r for r, _ in poses])
    scale = np.array([10.0, 10.0, 1.0, 10.0, 10.0, 1e-3, 1e-3])
    scale = np.concatenate([scale, np.full(6 * HALF_TURNS, 1e-2)])
    plane = TRIANGLE.points[:, :2]

    def residuals(unknowns: Any, observed: Any) -> Any:
        fx, fy, skew, cx, cy = unknowns[:5]
        own = unknowns[7:].reshape(HALF_TURNS, 6)
        turned = so3_exp(own[:, :3]) @ rotation
        points = np.concatenate([plane, 2 * unknowns[5:7] - plane])
        local = points @ np.swapaxes(turned[:, :, :2], 1, 2) + own[:, None, 3:]
        x, y = local[..., 0] / local[..., 2], local[..., 1] / local[..., 2]
        predicted = np.stack([fx * x + skew * y + cx, fy * y + cy], axis=-1)
        return ((predicted - observed) / SIGMA_PX).ravel()

    observed = pixels[:PEER_TRIALS].reshape(PEER_TRIALS, HALF_TURNS, 6, 2)

    def solve() -> Any:
        return np.array(
            [
                2.0
                * least_squares(
                    residuals, start, x_scale=scale, xtol=1e-10, args=(one,)
                ).cost
                for one in observed
            ]
        )

    return here(solve)


def all_converged(ours: Any, _theirs: Any) -> Gate:
    share = float(ours.converged.mean())
    return Gate(share == 1.0, f"{100 * share:.1f} % of our trials converge")


def same_costs(ours: Any, theirs: Any) -> Gate:
    worst = float(np.abs(ours.chi2[:PEER_TRIALS] / theirs - 1).max())
    return Gate(worst <= 1e-6, f"costs agree with scipy's to {worst:.1e}")


def rows() -> list[Row]:
    study = f"Monte-Carlo, {TRIALS} trials of {2 * HALF_TURNS} views"
    return [
        Row(
            number=8,
            work=study,
            peer="cv2 4.14, O known",
            bar=33.0,
            ours=monte_carlo,
            theirs=opencv_trials,
            gate=all_converged,
            units=(TRIALS, PEER_TRIALS),
        ),
        Row(
            number=8,
            work=study,
            peer="scipy, by differences",
            bar=150.0,
            ours=monte_carlo,
            theirs=scipy_trials,
            gate=same_costs,
            units=(TRIALS, PEER_TRIALS),
            threads=False,
        ),
    ]
