"""Ways in which a half-turn goes wrong; each says what the reason may read."""

from __future__ import annotations

import numpy as np
from half_turn_scene import IMAGE_SIZE, Scene, half_turn, project
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SIGMA = 0.2


def wrong_point(
    scene: Scene,
    before: Floats,
    after: Floats,
    i: int,
    rng: np.random.Generator,
    sigma: float = SIGMA,
) -> str:
    del scene, sigma
    view, angle = (before, after)[rng.integers(2)], rng.uniform(0, 2 * np.pi)
    shift = rng.uniform(8, 60) * np.array([np.cos(angle), np.sin(angle)])
    view[i, rng.integers(3)] += shift
    view[i] = np.clip(view[i], 0, np.array(IMAGE_SIZE) - 1)
    return "px off|degrees|explains it"


def swapped(
    scene: Scene,
    before: Floats,
    after: Floats,
    i: int,
    rng: np.random.Generator,
    sigma: float = SIGMA,
) -> str:
    del scene, before, sigma
    after[i] = after[i][[[1, 0, 2], [2, 1, 0], [0, 2, 1]][rng.integers(3)]]
    return "labels exchanged"


def repeated(
    scene: Scene,
    before: Floats,
    after: Floats,
    i: int,
    rng: np.random.Generator,
    sigma: float = SIGMA,
) -> str:
    del scene
    after[i] = before[i] + sigma * rng.integers(2) * rng.standard_normal((3, 2))
    return "same image|triangle unturned"


def turned_by_170(
    scene: Scene,
    before: Floats,
    after: Floats,
    i: int,
    rng: np.random.Generator,
    sigma: float = SIGMA,
) -> str:
    del before
    motion = half_turn(scene.triangle, scene.axes[i], scene.foot, 170.0)
    after[i] = project(scene.camera, scene.triangle, scene.poses[i] @ motion)
    after[i] += sigma * rng.standard_normal((3, 2))
    # Where several angles are possible it must be among them.
    return r"a turn of .*\b1(6[5-9]|7[0-5])\.|outside the"
