"""Row 6 of `bench.py`: hand-eye calibration of bare poses.

Ours is `solve_axzb`, checks of its input included. The gate: errors of the standing
camera's pose over 200 seeds of 22 poses, with 0.5 mm and 0.1 degrees of noise on what
the camera sees, against OpenCV's Park.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from bench_rows import Gate, Measured, Peers, Row, here

from handeye_tri.hand_eye import solve_axzb
from handeye_tri.se3 import (
    rotation_from_quaternion_wxyz,
    se3_exp,
    se3_inverse,
    se3_log,
)

BARS = {22: 10.0, 100: 250.0, 1000: 10000.0}
SEEDS, POSES = 200, 22
SIGMA = np.repeat([0.5e-3, np.radians(0.1)], 3)
MOST_ROTATION, MOST_TRANSLATION = 1.01, 0.75
MANY, VERY_MANY = 10_000, 100_000


def random_poses(rng: np.random.Generator, n: int, spread: float) -> Any:
    found = np.tile(np.eye(4), (n, 1, 1))
    found[:, :3, :3] = rotation_from_quaternion_wxyz(rng.standard_normal((n, 4)))
    found[:, :3, 3] = spread * rng.standard_normal((n, 3))
    return found


def draw(seed: int, n: int) -> tuple[Any, Any, Any]:
    """base_from_flange, camera_from_target and the true base_from_camera."""
    rng = np.random.default_rng([6, seed])
    x, z = random_poses(rng, 2, 0.2)
    a = random_poses(rng, n, 0.5)
    b = se3_inverse(z) @ a @ x @ se3_exp(SIGMA * rng.standard_normal((n, 6)))
    return a, b, z


def sets() -> tuple[Any, Any, Any]:
    """Poses and truth of all seeds, shape (seeds, poses, 4, 4) and (seeds, 4, 4)."""
    a, b, z = zip(*(draw(seed, POSES) for seed in range(SEEDS)), strict=True)
    return np.array(a), np.array(b), np.array(z)


def as_good_as_park(_ours: Any, theirs: Any) -> Gate:
    """RMS errors over the seeds, ours over Park's."""
    a, b, z = sets()
    found = np.array(
        [solve_axzb(*pair)[1].matrix for pair in zip(a, b, strict=True)],
    )
    mine, parks = (
        np.sqrt((se3_log(se3_inverse(z) @ one).reshape(-1, 2, 3) ** 2).sum((0, 2)))
        for one in (found, theirs[1])
    )
    translation, rotation = mine / parks
    return Gate(
        bool(rotation <= MOST_ROTATION and translation <= MOST_TRANSLATION),
        f"rotation {rotation:.3f} <= {MOST_ROTATION}, translation "
        f"{translation:.3f} <= {MOST_TRANSLATION} of Park's over {SEEDS} seeds",
    )


def against_park(n: int, bar: float) -> Row:
    def theirs(peers: Peers) -> Measured:
        return peers.elsewhere(
            "bench_park",
            "park",
            (*draw(0, n)[:2], *sets()[:2]),
            needs="'opencv-python-headless==4.14.*'",
        )

    return Row(
        number=6,
        work=f"hand-eye, {n} poses",
        peer="cv2 Park",
        bar=bar,
        ours=partial(solving, n),
        theirs=theirs,
        gate=as_good_as_park,
    )


def solving(n: int) -> Callable[[], Any]:
    a, b, _ = draw(0, n)
    return partial(solve_axzb, a, b)


def rows() -> list[Row]:
    return [
        *(against_park(n, bar) for n, bar in BARS.items()),
        Row(
            number=6,
            work=f"hand-eye, a pose of {VERY_MANY}",
            peer=f"itself, a pose of {MANY}",
            bar=1.2,
            at_most=True,
            ours=partial(solving, VERY_MANY),
            theirs=lambda _peers: here(solving(MANY)),
            units=(VERY_MANY, MANY),
        ),
    ]
