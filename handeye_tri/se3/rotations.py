"""Rotations as matrices, vectors and quaternions, in batches.

Formulas: T. Barfoot, State Estimation for Robotics, Cambridge 2017, Sec. 7.1
(doi:10.1017/9781316671528).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.errors import InputError

Floats = NDArray[np.float64]

# Below this angle (t - sin t) / t^3 and the like lose digits to cancellation; the
# first terms left out of their series there are 2e-15 of the result.
_SMALL_ANGLE = 0.1
_EYE = np.eye(3)


def hat(vector: ArrayLike) -> Floats:
    """Cross-product matrices of vectors: ``hat(a) @ b == cross(a, b)``.

    Args:
        vector: Shape (..., 3).

    Returns:
        Shape (..., 3, 3).
    """
    v = np.asarray(vector, dtype=float)
    matrix = np.zeros((*v.shape[:-1], 3, 3))
    matrix[..., 0, 1] = -v[..., 2]
    matrix[..., 0, 2] = v[..., 1]
    matrix[..., 1, 0] = v[..., 2]
    matrix[..., 1, 2] = -v[..., 0]
    matrix[..., 2, 0] = -v[..., 1]
    matrix[..., 2, 1] = v[..., 0]
    return matrix


def _first_coefficients(angle: Floats) -> tuple[Floats, Floats]:
    """Return sin(t)/t and (1-cos t)/t^2 of angles t >= 0, shape (...)."""
    # As good as nothing, and 1 and 1/2 come out exactly.
    safe = np.maximum(angle, 1e-150)
    half = np.sin(0.5 * safe) / safe
    # (1 - cos t) / t^2 without its cancellation.
    return np.sin(safe) / safe, 2.0 * half * half


def angle_coefficients(angle: Floats) -> tuple[Floats, Floats, Floats]:
    """Return sin(t)/t, (1-cos t)/t^2, (t-sin t)/t^3 of angles t >= 0, shape (...)."""
    first, second = _first_coefficients(angle)
    square = angle * angle
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    third = np.where(
        small,
        1 / 6 - square / 120 * (1 - square / 42 * (1 - square / 72)),
        (safe - np.sin(safe)) / safe**3,
    )
    return first, second, third


def so3_exp(rotation_vector: ArrayLike) -> Floats:
    """Rotation matrices of rotation vectors (Rodrigues).

    Args:
        rotation_vector: Shape (..., 3), radians.

    Returns:
        Shape (..., 3, 3).
    """
    w = np.asarray(rotation_vector, dtype=float)
    sine, cosine = _first_coefficients(np.sqrt((w * w).sum(axis=-1)))
    skew = hat(w)
    result: Floats = cosine[..., None, None] * (skew @ skew)
    result += sine[..., None, None] * skew
    result += _EYE
    return result


def so3_left_jacobian(rotation_vector: ArrayLike) -> Floats:
    """Left Jacobian of SO(3): ``exp(w + dw) ~ exp(J dw) exp(w)``.

    Args:
        rotation_vector: Shape (..., 3), radians.

    Returns:
        Shape (..., 3, 3).
    """
    w = np.asarray(rotation_vector, dtype=float)
    _, cosine, third = angle_coefficients(np.linalg.norm(w, axis=-1))
    skew = hat(w)
    result: Floats = (
        np.eye(3)
        + cosine[..., None, None] * skew
        + third[..., None, None] * (skew @ skew)
    )
    return result


def so3_left_jacobian_inverse(rotation_vector: ArrayLike) -> Floats:
    """Inverse of :func:`so3_left_jacobian`; regular up to and including pi.

    Args:
        rotation_vector: Shape (..., 3), radians, norm below 2 pi.

    Returns:
        Shape (..., 3, 3).
    """
    w = np.asarray(rotation_vector, dtype=float)
    angle = np.linalg.norm(w, axis=-1)
    square = angle * angle
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    closed = (1 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2
    factor = np.where(
        small, 1 / 12 + square / 720 * (1 + square / 42 * (1 + square / 40)), closed
    )
    skew = hat(w)
    result: Floats = np.eye(3) - 0.5 * skew + factor[..., None, None] * (skew @ skew)
    return result


def quaternion_wxyz(rotation: ArrayLike) -> Floats:
    """Unit quaternions (w, x, y, z), w >= 0, of rotation matrices.

    The largest of the four components is the divisor (Shepperd 1978,
    doi:10.2514/3.55767b), so that w = 0, a half-turn, keeps all its digits.

    Args:
        rotation: Shape (..., 3, 3).

    Returns:
        Shape (..., 4).
    """
    r = np.asarray(rotation, dtype=float)
    trace = np.trace(r, axis1=-2, axis2=-1)
    # Outer product 4 q q' of the quaternion: the best-conditioned row is used.
    outer = np.empty((*r.shape[:-2], 4, 4))
    outer[..., 0, 0] = 1 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[..., i + 1, i + 1] = 1 + 2 * r[..., i, i] - trace
        outer[..., 0, i + 1] = outer[..., i + 1, 0] = r[..., k, j] - r[..., j, k]
        outer[..., i + 1, j + 1] = r[..., i, j] + r[..., j, i]
        outer[..., j + 1, i + 1] = outer[..., i + 1, j + 1]
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    row = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    row /= np.linalg.norm(row, axis=-1, keepdims=True)
    sign = np.where(row[..., :1] < 0, -1.0, 1.0)
    return np.asarray(sign * row)


def rotation_from_quaternion_wxyz(quaternion: ArrayLike) -> Floats:
    """Rotation matrices of quaternions (w, x, y, z), normalised here.

    Args:
        quaternion: Shape (..., 4), any non-zero length.

    Returns:
        Shape (..., 3, 3).

    Raises:
        InputError: a quaternion is zero or not finite.
    """
    q = np.asarray(quaternion, dtype=float)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    if not (np.isfinite(length) & (length > 0)).all():
        raise InputError(
            f"a quaternion must be finite and not zero, got {q.tolist()}; "
            "no rotation is (w, x, y, z) = (1, 0, 0, 0)"
        )
    q = q / length
    skew = hat(q[..., 1:])
    result: Floats = np.eye(3) + 2 * (q[..., :1, None] * skew + skew @ skew)
    return result


def so3_log(rotation: ArrayLike) -> Floats:
    """Rotation vectors of rotation matrices, norm in [0, pi].

    At pi both signs of the axis are right, and rounding chooses; where the
    quaternion's w is exactly 0, the axis' largest component is positive.

    Args:
        rotation: Shape (..., 3, 3).

    Returns:
        Shape (..., 3), radians.
    """
    q = quaternion_wxyz(rotation)
    w, v = q[..., 0], q[..., 1:]
    sine = np.linalg.norm(v, axis=-1)
    small = sine < 1e-8
    scale = np.where(small, 2.0, 2.0 * np.arctan2(sine, w) / np.where(small, 1.0, sine))
    return np.asarray(scale[..., None] * v)


def nearest_rotation(matrix: ArrayLike) -> Floats:
    """Rotations closest in the Frobenius norm (orthogonal Procrustes).

    Args:
        matrix: Shape (..., 3, 3).

    Returns:
        Shape (..., 3, 3), determinant +1.
    """
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=float))
    u[..., 2] *= np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)[..., None]
    return np.asarray(u @ vt)
