"""Rigid motions, safe at rotation 0 and at rotation pi.

The batched functions on arrays serve the estimators; :class:`SE3` is the one
motion that records carry. Tangent vectors are (translation, rotation), in
metres and radians. Formulas: T. Barfoot, State Estimation for Robotics,
Cambridge 2017, Sec. 7.1 (doi:10.1017/9781316671528).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.errors import InputError

Floats = NDArray[np.float64]

# Below this angle the closed-form coefficients lose digits to cancellation; the
# first term left out of the series, angle^8 / 9!, is 3e-14 of the last one there.
_SMALL_ANGLE = 0.1
# The same for coefficients that divide by angle^5.
_SMALL_ANGLE_Q = 0.4
# A matrix whose R'R is farther than this from the identity is no rotation.
_ROTATION_TOLERANCE = 1e-6


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


def _series(angle: Floats) -> tuple[Floats, Floats, Floats]:
    """Return sin(t)/t, (1-cos t)/t^2 and (t-sin t)/t^3, accurate near t = 0."""
    square = angle * angle
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    half = np.sin(0.5 * safe) / safe
    first = np.where(
        small,
        1 - square / 6 * (1 - square / 20 * (1 - square / 42)),
        np.sin(safe) / safe,
    )
    second = np.where(
        small,
        0.5 - square / 24 * (1 - square / 30 * (1 - square / 56)),
        2.0 * half * half,
    )
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
    sine, cosine, _ = _series(np.linalg.norm(w, axis=-1))
    skew = hat(w)
    result: Floats = (
        np.eye(3)
        + sine[..., None, None] * skew
        + cosine[..., None, None] * (skew @ skew)
    )
    return result


def so3_left_jacobian(rotation_vector: ArrayLike) -> Floats:
    """Left Jacobian of SO(3): ``exp(w + dw) ~ exp(J dw) exp(w)``.

    Args:
        rotation_vector: Shape (..., 3), radians.

    Returns:
        Shape (..., 3, 3).
    """
    w = np.asarray(rotation_vector, dtype=float)
    _, cosine, third = _series(np.linalg.norm(w, axis=-1))
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
    """
    q = np.asarray(quaternion, dtype=float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    skew = hat(q[..., 1:])
    result: Floats = np.eye(3) + 2 * (q[..., :1, None] * skew + skew @ skew)
    return result


def so3_log(rotation: ArrayLike) -> Floats:
    """Rotation vectors of rotation matrices, norm in [0, pi].

    At exactly pi the axis has two signs; the first non-zero component of the
    quaternion's vector keeps the sign that :func:`quaternion_wxyz` gives it.

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
    sign = np.linalg.det(u @ vt)
    u = u * np.stack([np.ones_like(sign), np.ones_like(sign), sign], -1)[..., None, :]
    return np.asarray(u @ vt)


def se3_exp(tangent: ArrayLike) -> Floats:
    """Matrices of tangent vectors (translation, rotation).

    Args:
        tangent: Shape (..., 6), metres and radians.

    Returns:
        Shape (..., 4, 4).
    """
    xi = np.asarray(tangent, dtype=float)
    result = np.zeros((*xi.shape[:-1], 4, 4))
    result[..., :3, :3] = so3_exp(xi[..., 3:])
    left = so3_left_jacobian(xi[..., 3:])
    result[..., :3, 3] = (left @ xi[..., :3, None])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def se3_log(matrix: ArrayLike) -> Floats:
    """Tangent vectors (translation, rotation) of rigid-motion matrices.

    Args:
        matrix: Shape (..., 4, 4).

    Returns:
        Shape (..., 6), metres and radians.
    """
    m = np.asarray(matrix, dtype=float)
    w = so3_log(m[..., :3, :3])
    v = (so3_left_jacobian_inverse(w) @ m[..., :3, 3:])[..., 0]
    return np.concatenate([v, w], axis=-1)


def se3_inverse(matrix: ArrayLike) -> Floats:
    """Inverses of rigid-motion matrices.

    Args:
        matrix: Shape (..., 4, 4).

    Returns:
        Shape (..., 4, 4).
    """
    m = np.asarray(matrix, dtype=float)
    result = np.zeros_like(m)
    transposed = np.swapaxes(m[..., :3, :3], -1, -2)
    result[..., :3, :3] = transposed
    result[..., :3, 3:] = -transposed @ m[..., :3, 3:]
    result[..., 3, 3] = 1.0
    return result


def se3_left_jacobian_inverse(tangent: ArrayLike) -> Floats:
    """Inverse of the left Jacobian of SE(3).

    ``log(exp(d) exp(x)) ~ x + J^-1 d``; the right one is this at ``-x``. Formulas:
    Barfoot 2017, Eq. 7.86 and 7.95, for tangents (translation, rotation).

    Args:
        tangent: Shape (..., 6), metres and radians, rotation below 2 pi.

    Returns:
        Shape (..., 6, 6).
    """
    xi = np.asarray(tangent, dtype=float)
    rho, phi = hat(xi[..., :3]), hat(xi[..., 3:])
    angle = np.linalg.norm(xi[..., 3:], axis=-1)
    square = angle * angle
    small = angle < _SMALL_ANGLE_Q
    safe = np.where(small, 1.0, angle)
    _, _, first = _series(angle)
    second = np.where(
        small,
        1 / 24 - square / 720 * (1 - square / 56 * (1 - square / 90)),
        (safe**2 + 2 * np.cos(safe) - 2) / (2 * safe**4),
    )
    third = np.where(
        small,
        1 / 120 - square / 2520 * (1 - square / 48 * (1 - square * 2 / 165)),
        (2 * safe - 3 * np.sin(safe) + safe * np.cos(safe)) / (2 * safe**5),
    )
    phi_rho, rho_phi = phi @ rho, rho @ phi
    phi_rho_phi = phi_rho @ phi
    coupling = (
        0.5 * rho
        + first[..., None, None] * (phi_rho + rho_phi + phi_rho_phi)
        + second[..., None, None] * (phi @ phi_rho + rho_phi @ phi - 3 * phi_rho_phi)
        + third[..., None, None] * (phi_rho_phi @ phi + phi @ phi_rho_phi)
    )
    inverse = so3_left_jacobian_inverse(xi[..., 3:])
    result = np.zeros((*xi.shape[:-1], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = inverse
    result[..., :3, 3:] = -inverse @ coupling @ inverse
    return result


def se3_adjoint(matrix: ArrayLike) -> Floats:
    """Adjoints of rigid-motion matrices: ``T exp(x) T^-1 == exp(adjoint @ x)``.

    Args:
        matrix: Shape (..., 4, 4).

    Returns:
        Shape (..., 6, 6), for tangents (translation, rotation).
    """
    m = np.asarray(matrix, dtype=float)
    rotation = m[..., :3, :3]
    result = np.zeros((*m.shape[:-2], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = rotation
    result[..., :3, 3:] = hat(m[..., :3, 3]) @ rotation
    return result


class SE3:
    """An immutable rigid motion, named ``a_from_b`` where it is used.

    Attributes:
        matrix: Shape (4, 4), locked; maps coordinates in b to a; metres.
    """

    __slots__ = ("matrix",)
    matrix: Floats

    def __init__(self, matrix: ArrayLike) -> None:
        """Check and store a homogeneous matrix.

        Args:
            matrix: Shape (4, 4), rotation orthonormal to 1e-6.

        Raises:
            InputError: wrong shape, NaN, wrong last row, or not a rotation.
        """
        m = np.array(matrix, dtype=float)
        if m.shape != (4, 4):
            raise InputError(f"a rigid motion has shape (4, 4), got {m.shape}")
        if not np.isfinite(m).all():
            raise InputError("a rigid motion must be finite, got NaN or infinity")
        if np.abs(m[3] - (0, 0, 0, 1)).max() > 1e-9:
            raise InputError(f"the last row must be (0, 0, 0, 1), got {m[3]}")
        r = m[:3, :3]
        defect = np.abs(r.T @ r - np.eye(3)).max()
        if defect > _ROTATION_TOLERANCE or np.linalg.det(r) < 0:
            raise InputError(
                f"not a rotation: R'R differs from I by {defect:.2g}, determinant "
                f"{np.linalg.det(r):+.6f}; orthonormalise it first "
                "(handeye_tri.se3.nearest_rotation)"
            )
        m[3] = (0, 0, 0, 1)
        m.setflags(write=False)
        object.__setattr__(self, "matrix", m)

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"SE3 is immutable; cannot set {name!r}")

    def __reduce__(self) -> tuple[type[SE3], tuple[Floats]]:
        return (SE3, (np.array(self.matrix),))

    @classmethod
    def identity(cls) -> SE3:
        """The motion that moves nothing."""
        return cls(np.eye(4))

    @classmethod
    def from_parts(cls, rotation: ArrayLike, translation: ArrayLike) -> SE3:
        """Join a rotation, shape (3, 3), and a translation, shape (3,), metres."""
        m = np.eye(4)
        m[:3, :3] = np.asarray(rotation, dtype=float)
        m[:3, 3] = np.asarray(translation, dtype=float)
        return cls(m)

    @classmethod
    def exp(cls, tangent: ArrayLike) -> SE3:
        """Motion of a tangent vector, shape (6,): translation m, rotation rad."""
        return cls(se3_exp(tangent))

    @classmethod
    def mean(cls, motions: Iterable[SE3], iterations: int = 20) -> SE3:
        """Fréchet mean: the motion whose mean tangent to all others is zero.

        Rotation by the intrinsic mean of SO(3) (Moakher 2002,
        doi:10.1137/S0895479801383877), translation by the arithmetic mean.

        Raises:
            InputError: no motion was given.
        """
        matrices = np.array([motion.matrix for motion in motions])
        if len(matrices) == 0:
            raise InputError("the mean of no motions is undefined; give at least one")
        rotation = nearest_rotation(matrices[:, :3, :3].mean(axis=0))
        for _ in range(iterations):
            step = so3_log(rotation.T @ matrices[:, :3, :3]).mean(axis=0)
            rotation = rotation @ so3_exp(step)
            if np.linalg.norm(step) < 1e-15:
                break
        return cls.from_parts(rotation, matrices[:, :3, 3].mean(axis=0))

    @property
    def rotation(self) -> Floats:
        """Rotation matrix, shape (3, 3)."""
        return self.matrix[:3, :3]

    @property
    def translation(self) -> Floats:
        """Translation, shape (3,), metres."""
        return self.matrix[:3, 3]

    @property
    def angle(self) -> float:
        """Rotation angle in [0, pi], radians."""
        return float(np.linalg.norm(so3_log(self.rotation)))

    def log(self) -> Floats:
        """Tangent vector, shape (6,): translation in metres, rotation in radians."""
        return se3_log(self.matrix)

    def inverse(self) -> SE3:
        """The motion back: ``b_from_a`` of ``a_from_b``."""
        return SE3(se3_inverse(self.matrix))

    def adjoint(self) -> Floats:
        """Shape (6, 6): ``T exp(x) T^-1 == exp(adjoint @ x)``."""
        return se3_adjoint(self.matrix)

    def apply(self, points: ArrayLike) -> Floats:
        """Map points, shape (..., 3), metres, from b to a."""
        p = np.asarray(points, dtype=float)
        return np.asarray(p @ self.rotation.T + self.translation)

    def __matmul__(self, other: SE3) -> SE3:
        """Chain: ``a_from_b @ b_from_c == a_from_c``."""
        if not isinstance(other, SE3):
            return NotImplemented
        product = self.matrix @ other.matrix
        product[:3, :3] = _reorthonormalise(product[:3, :3])
        return SE3(product)

    def __repr__(self) -> str:
        t = ", ".join(f"{1e3 * x:.3f}" for x in self.translation)
        w = ", ".join(f"{x:.4f}" for x in np.degrees(so3_log(self.rotation)))
        return f"SE3(translation_mm=[{t}], rotation_deg=[{w}])"


def _reorthonormalise(rotation: Floats) -> Floats:
    """One Newton step of the polar decomposition: keeps long chains on SO(3)."""
    return np.asarray(1.5 * rotation - 0.5 * rotation @ rotation.T @ rotation)
