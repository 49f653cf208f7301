"""Small problems side by side: one in every place of the last axis."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Some = TypeVar("Some", NDArray[np.float64], NDArray[np.float32])


def columns_of(poses: Floats) -> Floats:
    """Columns of poses (n, 4, 4), shape (4, 3, n)."""
    return np.ascontiguousarray(poses[:, :3].transpose(2, 1, 0))


def turn_between(first: Some, second: Some) -> Some:
    """Rotation vectors in the base from frames to frames, shape (3, n).

    Args:
        first: Columns of rotations, shape (3 columns, 3, n).
        second: Likewise.
    """
    # second times first transposed, of which the turn is the antisymmetric part.
    both = np.einsum("kbn,kan->ban", second, first)
    turn = 0.5 * (both[(2, 0, 1), (1, 2, 0)] - both[(1, 2, 0), (2, 0, 1)])
    sine = np.sqrt(np.einsum("an,an->n", turn, turn))
    angle = np.arctan2(sine, 0.5 * (both[0, 0] + both[1, 1] + both[2, 2] - 1.0))
    # At a half-turn the sine vanishes and any axis leads away from there.
    opposite = (sine < 1e-7) & (angle > 1.0)
    if opposite.any():
        turn[:, opposite], sine[opposite] = first[0][:, opposite], 1.0
    return np.asarray(turn * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1))


def solve_positive(matrix: Floats, right: Floats) -> Floats:
    """Solutions of positive definite systems, by Cholesky.

    Ten times as fast as a batched LAPACK call for six unknowns.

    Args:
        matrix: Shape (p, p, n), overwritten.
        right: Shape (p, n).

    Returns:
        Shape (p, n).
    """
    size = len(matrix)
    x = right.copy()
    scale = np.empty_like(x)
    for i in range(size):
        np.sqrt(matrix[i, i], out=scale[i])
        np.divide(1.0, scale[i], out=scale[i])
        x[i] *= scale[i]
        if i + 1 == size:
            break
        below = matrix[i + 1 :, i]
        below *= scale[i]
        x[i + 1 :] -= below * x[i]
        # The lower triangle is enough, but whole squares take fewer calls.
        matrix[i + 1 :, i + 1 :] -= below[:, None] * below
    for i in reversed(range(size)):
        x[i] *= scale[i]
        if i:
            x[:i] -= matrix[i, :i] * x[i]
    return x
