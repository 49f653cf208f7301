"""Two cameras: focal lengths by trial, the rest in closed form.

Two views do not fix both focal lengths and a free plane at infinity linearly, and
nothing else bounds them from afar. But given (f1, f2), with principal points at the
images' middles, the essential matrix gives the relative pose and the markers' places,
and the triangle's sides say how good the two guesses are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.special_motion import homogeneous

Floats = NDArray[np.float64]

# Focal lengths over the images' scale: from 120 degrees of view to 8.
FOCALS = np.geomspace(0.3, 7.0, 17)
# A side that is this far from its place (as a logarithm) counts half.
_ROBUST = 0.1
_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class PairStart:
    """A guess at two cameras.

    Attributes:
        focals: f1 and f2 over the images' scale.
        second_from_first: Shape (4, 4), metres.
        score: Mean robust misfit of the sides, 0 to 1.
    """

    focals: tuple[float, float]
    second_from_first: Floats
    score: float


def sweep_focals(
    first: Floats,
    second: Floats,
    matrix: Floats,
    edges: NDArray[np.intp],
    lengths: Floats,
) -> list[PairStart]:
    """The best guesses at two cameras, best first.

    Args:
        first: Points of the first camera, middle at zero, shape (n, 2).
        second: The same in the second, shape (n, 2).
        matrix: Their fundamental matrix, shape (3, 3).
        edges: Indices of the two ends of each side seen, shape (e, 2).
        lengths: Their lengths, shape (e,), metres.

    Returns:
        One for each local minimum of the score on the grid; empty where nothing has
        most points in front of both cameras.
    """
    grid = np.stack(np.meshgrid(FOCALS, FOCALS, indexing="ij"), -1).reshape(-1, 2)
    g = len(grid)
    left = np.stack([grid[:, 1], grid[:, 1], np.ones(g)], axis=-1)
    right = np.stack([grid[:, 0], grid[:, 0], np.ones(g)], axis=-1)
    u, _, vt = np.linalg.svd(left[:, :, None] * matrix * right[:, None, :])
    u[..., 2] *= np.sign(np.linalg.det(u))[:, None]
    vt[:, 2] *= np.sign(np.linalg.det(vt))[:, None]
    rays = homogeneous(first) / right[:, None]
    others = homogeneous(second) / left[:, None]
    score = np.full(g, np.inf)
    poses = np.tile(np.eye(4), (g, 1, 1))
    for twist in (_QUARTER_TURN, _QUARTER_TURN.T):
        rotation = u @ twist @ vt
        turned = rays @ np.swapaxes(rotation, 1, 2)
        along = u[..., 2]
        depth, other = _depths(turned, others, along)
        for sign in (1.0, -1.0):
            front = ((sign * depth > 0) & (sign * other > 0)).mean(axis=1)
            points = sign * depth[..., None] * rays
            misfit, scale = _side_misfit(points, edges, lengths)
            misfit = np.where(front > 0.9, misfit + (1.0 - front), np.inf)
            better = misfit < score
            score = np.where(better, misfit, score)
            poses[better, :3, :3] = rotation[better]
            poses[better, :3, 3] = (sign * scale[:, None] * along)[better]
    size = len(FOCALS)
    table = np.pad(score.reshape(size, size), 1, constant_values=np.inf)
    around = np.min(
        [
            table[1 + i : size + 1 + i, 1 + j : size + 1 + j]
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
            if (i, j) != (0, 0)
        ],
        axis=0,
    ).ravel()
    minima = np.flatnonzero(np.isfinite(score) & (score <= around))
    return [
        PairStart(
            (float(grid[index, 0]), float(grid[index, 1])),
            poses[index],
            float(score[index]),
        )
        for index in minima[np.argsort(score[minima])]
    ]


def _depths(turned: Floats, others: Floats, along: Floats) -> tuple[Floats, Floats]:
    """Depths (g, n) that bring z1 turned + along and z2 others nearest together."""
    aa = (turned * turned).sum(axis=-1)
    bb = (others * others).sum(axis=-1)
    ab = (turned * others).sum(axis=-1)
    at = (turned * along[:, None]).sum(axis=-1)
    bt = (others * along[:, None]).sum(axis=-1)
    determinant = np.maximum(aa * bb - ab * ab, 1e-12 * aa * bb)
    return (ab * bt - bb * at) / determinant, (aa * bt - ab * at) / determinant


def _side_misfit(
    points: Floats, edges: NDArray[np.intp], lengths: Floats
) -> tuple[Floats, Floats]:
    """Mean robust misfit of the sides, and the scale that fits best; shapes (g,)."""
    found = np.linalg.norm(points[:, edges[:, 0]] - points[:, edges[:, 1]], axis=-1)
    logarithm = np.log(np.maximum(found, np.finfo(float).tiny) / lengths)
    middle = np.median(logarithm, axis=1, keepdims=True)
    square = ((logarithm - middle) / _ROBUST) ** 2
    return (square / (1.0 + square)).mean(axis=1), np.exp(-middle[:, 0])
