"""The paper's closed form: constraints on w from half-turns of three points.

Zhao, Liu and Zhang 2008 (doi:10.1109/TIP.2008.2005562), Sec. III-A (axis along a
normal of the triangle), III-B (axis along an edge) and III-C (solution for K).
With m = K [R t] M / s and the image of the absolute conic w = K^-T K^-1, the six
numbers b = (w11, w12, w22, w13, w23, w33) satisfy h' w g = v(h, g)' b.

All functions take n half-turns at once and homogeneous image points (n, 3, 3):
half-turn, marker A B C, coordinate. They work in any affine image coordinates;
the caller normalises.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import DegenerateMotionError
from handeye_tri.se3 import hat
from handeye_tri.triangle import EDGES, VERTICES, Axis, TriangleRig

Floats = NDArray[np.float64]

# Where a marker moves by less than this part of the distance to the origin of
# the coordinates, the depth formulas of Sec. III-A are 0 / 0.
_VANISHED_DIAGONAL = 1e-9


def homogeneous(points: Floats) -> Floats:
    """Append a one: shape (..., 2) to (..., 3)."""
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)


def conic_row(h: Floats, g: Floats) -> Floats:
    """The paper's v(h, g), shape (..., 6): ``h' w g == v(h, g) @ b``."""
    return np.stack(
        [
            h[..., 0] * g[..., 0],
            h[..., 0] * g[..., 1] + h[..., 1] * g[..., 0],
            h[..., 1] * g[..., 1],
            h[..., 0] * g[..., 2] + h[..., 2] * g[..., 0],
            h[..., 1] * g[..., 2] + h[..., 2] * g[..., 1],
            h[..., 2] * g[..., 2],
        ],
        axis=-1,
    )


def conic_matrix(b: Floats) -> Floats:
    """The symmetric w, shape (3, 3), of b, shape (6,)."""
    return np.asarray(b[np.array([[0, 1, 3], [1, 2, 4], [3, 4, 5]])])


def diagonals_meet(before: Floats, after: Floats) -> tuple[Floats, Floats]:
    """Least-squares common point of the lines AA', BB' and CC' (Eq. (3)).

    Each line is weighted by the length of its diagonal, since the direction of
    a diagonal that nearly vanishes (the axis goes through that marker) is noise.

    Args:
        before: Shape (n, 3, 2), images of A, B, C before the half-turn.
        after: Shape (n, 3, 2), after it.

    Returns:
        The common points o (n, 2); the weighted root mean square distance of each
        o from its three lines (n,), in the unit of the coordinates.
    """
    along = after - before
    length = np.linalg.norm(along, axis=-1)
    total = np.maximum(length.sum(axis=-1), np.finfo(float).tiny)
    weight = length / total[:, None]
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    normal /= np.maximum(length, np.finfo(float).tiny)[..., None]
    middle = 0.5 * (before + after)
    centre = middle.mean(axis=1, keepdims=True)
    height = ((middle - centre) * normal).sum(axis=-1)
    matrix = np.einsum("nk,nki,nkj->nij", weight, normal, normal)
    right = np.einsum("nk,nki,nk->ni", weight, normal, height)
    # The pseudo-inverse keeps three coincident lines finite: no motion at all.
    local = (np.linalg.pinv(matrix, hermitian=True) @ right[..., None])[..., 0]
    distance = (normal @ local[..., None])[..., 0] - height
    return centre[:, 0] + local, np.sqrt((weight * distance**2).sum(axis=-1))


def _mirrored_depth(m: Floats, mirrored: Floats, middle: Floats) -> Floats:
    """Depth of M over depth of the midpoint of M and M', by Eqs. (5) to (8)."""
    line = np.cross(m, mirrored)
    return np.asarray(
        2
        * (np.cross(middle, mirrored) * line).sum(axis=-1)
        / (line * line).sum(axis=-1)
    )


def normal_depths(before: Floats, after: Floats, o: Floats) -> Floats:
    """Depths of A, B, C over that of O, for an axis along a normal (Sec. III-A).

    O is the midpoint of AA', BB' and CC'; zA / zO = 2 (o x a').(a x a') / |a x a'|^2.

    Args:
        before: Homogeneous images before the half-turn, shape (n, 3, 3).
        after: After it, shape (n, 3, 3).
        o: Homogeneous image of O, shape (n, 3).

    Returns:
        Shape (n, 3).

    Raises:
        DegenerateMotionError: a marker lies on the axis: the formula is 0 / 0.
    """
    moved = np.linalg.norm(np.cross(before, after), axis=-1)
    size = np.linalg.norm(before, axis=-1) * np.linalg.norm(after, axis=-1)
    still = np.argwhere(moved < _VANISHED_DIAGONAL * size)
    if len(still):
        i, k = still[0]
        raise DegenerateMotionError(
            f"half-turn {i}: marker {VERTICES[k]} does not move, so the axis goes "
            "through it and the depth formula of Sec. III-A is 0 / 0; "
            'use method="whitened", which does not divide by it'
        )
    return _mirrored_depth(before, after, o[:, None])


def edge_depths(
    before: Floats, after: Floats, triangle: TriangleRig, axis: Axis
) -> Floats:
    """Depths of A, B, C over that of D, for an axis along an edge (Sec. III-B).

    Written for axis AC: A' = A and C' = C, so the mean of both observations stands
    for each; D = A + k (C - A) is the midpoint of BB' and lies on AC, hence
    d = (a x c) x (b x b'), zA / zD = (c x d).(c x a) / ((1 - k) |c x a|^2) and
    zC / zD = (d x a).(c x a) / (k |c x a|^2). Other edges by renaming.

    Args:
        before: Homogeneous images before the half-turn, shape (n, 3, 3).
        after: After it, shape (n, 3, 3).
        triangle: The rig.
        axis: "AB", "BC" or "CA".

    Returns:
        Shape (n, 3), in the order A, B, C.
    """
    first, second = EDGES[axis]
    third = 3 - first - second
    k = foot_fraction(triangle, axis)
    a = 0.5 * (before[:, first] + after[:, first])
    c = 0.5 * (before[:, second] + after[:, second])
    b, mirrored = before[:, third], after[:, third]
    d = np.cross(np.cross(a, c), np.cross(b, mirrored))
    d = d / d[:, 2:]
    across = np.cross(c, a)
    square = (across * across).sum(axis=-1)
    depths = np.empty((len(before), 3))
    depths[:, first] = (np.cross(c, d) * across).sum(axis=-1) / ((1 - k) * square)
    depths[:, second] = (np.cross(d, a) * across).sum(axis=-1) / (k * square)
    depths[:, third] = _mirrored_depth(b, mirrored, d)
    return depths


def foot_fraction(triangle: TriangleRig, axis: Axis) -> float:
    """The k of D = first + k (second - first), D the third vertex' foot on an edge.

    It is 0 or 1 where the angle at an end of the axis is right, below 0 or above 1
    where it is obtuse.
    """
    start, end = triangle.points[list(EDGES[axis]), :2]
    along = end - start
    return float((triangle.foot(axis) - start) @ along / (along @ along))


def depths(
    before: Floats, after: Floats, triangle: TriangleRig, axes: Sequence[Axis]
) -> Floats:
    """Depths of A, B, C up to one factor per half-turn, shape (n, 3).

    Args:
        before: Homogeneous images before each half-turn, shape (n, 3, 3).
        after: After it, shape (n, 3, 3).
        triangle: The rig.
        axes: The axis of each half-turn.

    Raises:
        DegenerateMotionError: an axis along a normal goes through a marker.
    """
    result = np.empty((len(before), 3))
    kinds = np.array(axes)
    for axis in dict.fromkeys(axes):
        rows = np.flatnonzero(kinds == axis)
        if axis == "normal":
            o, _ = diagonals_meet(before[rows, :, :2], after[rows, :, :2])
            result[rows] = normal_depths(before[rows], after[rows], homogeneous(o))
        else:
            result[rows] = edge_depths(before[rows], after[rows], triangle, axis)
    return result


def constraint_rows(
    before: Floats, after: Floats, triangle: TriangleRig, axes: Sequence[Axis]
) -> Floats:
    """The paper's rows [L]x V of each half-turn (Eqs. (22), (23)), times b is zero.

    h_AB = alphaA a - alphaB b has zO^2 h_AB' w h_AB = |AB|^2 and so on, whence
    zO^2 V b = L with L = (|AB|^2, |AC|^2, AB.AC); the cross product with L removes
    the unknown zO. L is scaled to length one.

    Returns:
        Shape (n, 3, 6), rank 2 each.
    """
    scaled = depths(before, after, triangle, axes)[..., None] * before
    h_ab, h_ac = scaled[:, 0] - scaled[:, 1], scaled[:, 0] - scaled[:, 2]
    v = np.stack(
        [conic_row(h_ab, h_ab), conic_row(h_ac, h_ac), conic_row(h_ab, h_ac)], axis=1
    )
    ab, ac = triangle.points[1:]
    lengths = np.array([ab @ ab, ac @ ac, ab @ ac])
    return np.asarray(hat(lengths / np.linalg.norm(lengths)) @ v)


def solve_conic(rows: Floats, basis: Floats) -> tuple[Floats, Floats, Floats]:
    """The b of unit length that makes rows @ b least (Sec. III-C).

    Args:
        rows: Shape (r, 6).
        basis: Orthonormal columns that b is a sum of, shape (6, k): the unit matrix,
            or less where something of K is known, as w12 = 0 for zero skew.

    Returns:
        b (6,) with w11 >= 0; singular values (k,), descending; the
        pseudo-inverse of the rows without the direction of b, shape (6, r), which
        maps errors of rows @ b to errors of -b.
    """
    size = basis.shape[1]
    u, s, vt = np.linalg.svd(rows @ basis, full_matrices=len(rows) < size)
    s = np.append(s, np.zeros(size - len(s)))
    b = basis @ vt[-1]
    rank = size - 1
    floor = np.finfo(float).eps * s[0]
    inverse = basis @ (vt[:rank].T / np.maximum(s[:rank], floor)) @ u[:, :rank].T
    return (-b if b[0] < 0 else b), s, inverse


def intrinsics_from_conic(b: Floats) -> Floats:
    """K, shape (3, 3), upper triangular with K33 = 1, from b, shape (6,).

    Cholesky's factorisation of w = K^-T K^-1 (Sec. III-C).

    Raises:
        DegenerateMotionError: w is not positive definite; carries its eigenvalues.
    """
    w = conic_matrix(b)
    eigenvalues = np.linalg.eigvalsh(w)
    if eigenvalues[0] <= 0:
        raise DegenerateMotionError(
            "the image of the absolute conic is not positive definite (eigenvalues "
            f"{', '.join(f'{e:.3g}' for e in eigenvalues)}): no camera fits these "
            "half-turns in closed form; add half-turns whose planes differ by at "
            "least 20 degrees, bring the triangle nearer, or reduce the noise"
        )
    k = np.linalg.inv(np.linalg.cholesky(w).T)
    return np.asarray(k / k[2, 2])
