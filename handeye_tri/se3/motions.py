"""Rigid motions in batches, and the one motion that records carry.

Formulas: T. Barfoot, State Estimation for Robotics, Cambridge 2017, Sec. 7.1
(doi:10.1017/9781316671528).
"""

from __future__ import annotations

from collections.abc import Iterable
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.errors import ConvergenceError, InputError
from handeye_tri.se3.rotations import (
    angle_coefficients,
    hat,
    nearest_rotation,
    so3_exp,
    so3_left_jacobian,
    so3_left_jacobian_inverse,
    so3_log,
)

Floats = NDArray[np.float64]

# Below this angle, coefficients that divide by angle^5 lose digits to cancellation.
_SMALL_ANGLE = 0.4
# A matrix whose R'R is farther than this from the identity is no rotation.
_ROTATION_TOLERANCE = 1e-6
_LAST_ROW = [0.0, 0.0, 0.0, 1.0]


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


def se3_left_jacobian(tangent: ArrayLike) -> Floats:
    """Left Jacobian of SE(3): ``exp(x + d) ~ exp(J d) exp(x)``.

    The right one, ``exp(x + d) ~ exp(x) exp(J d)``, is this at ``-x``. Formulas:
    Barfoot 2017, Eq. 7.85 and 7.86, for tangents (translation, rotation).

    Args:
        tangent: Shape (..., 6), metres and radians.

    Returns:
        Shape (..., 6, 6).
    """
    xi = np.asarray(tangent, dtype=float)
    result = np.zeros((*xi.shape[:-1], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = so3_left_jacobian(xi[..., 3:])
    result[..., :3, 3:] = _coupling(xi)
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
    inverse = so3_left_jacobian_inverse(xi[..., 3:])
    result = np.zeros((*xi.shape[:-1], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = inverse
    result[..., :3, 3:] = -inverse @ _coupling(xi) @ inverse
    return result


def _coupling(xi: Floats) -> Floats:
    """How rotation moves translation in the left Jacobian, shape (..., 3, 3)."""
    rho, phi = hat(xi[..., :3]), hat(xi[..., 3:])
    angle = np.linalg.norm(xi[..., 3:], axis=-1)
    square = angle * angle
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    _, _, first = angle_coefficients(angle)
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
    return np.asarray(
        0.5 * rho
        + first[..., None, None] * (phi_rho + rho_phi + phi_rho_phi)
        + second[..., None, None] * (phi @ phi_rho + rho_phi @ phi - 3 * phi_rho_phi)
        + third[..., None, None] * (phi_rho_phi @ phi + phi @ phi_rho_phi)
    )


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
        # Plain floats: a dozen numpy calls on nine numbers take ten times as long.
        rows = m.tolist()
        if not isfinite(sum(map(sum, rows))):
            raise InputError("a rigid motion must be finite, got NaN or infinity")
        if rows[3] != _LAST_ROW and np.abs(m[3] - _LAST_ROW).max() > 1e-9:
            raise InputError(f"the last row must be (0, 0, 0, 1), got {m[3]}")
        defect, determinant = _rotation_defect(rows)
        if defect > _ROTATION_TOLERANCE or determinant < 0:
            raise InputError(
                f"not a rotation: R'R differs from I by {defect:.2g}, determinant "
                f"{determinant:+.6f}; orthonormalise it first "
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
        """Join a rotation, shape (3, 3), and a translation, shape (3,), metres.

        Raises:
            InputError: wrong shape, NaN, or not a rotation.
        """
        r, t = np.asarray(rotation, dtype=float), np.asarray(translation, dtype=float)
        if r.shape != (3, 3) or t.shape != (3,):
            raise InputError(
                "a rigid motion has a rotation of shape (3, 3) and a translation of "
                f"shape (3,), got {r.shape} and {t.shape}"
            )
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = r, t
        return cls(m)

    @classmethod
    def exp(cls, tangent: ArrayLike) -> SE3:
        """Motion of a tangent vector, shape (6,): translation m, rotation rad."""
        return cls(se3_exp(tangent))

    @classmethod
    def mean(cls, motions: Iterable[SE3], iterations: int = 100) -> SE3:
        """Mean of rotations and mean of translations, each in its own space.

        Rotation by the intrinsic mean of SO(3), about which the mean rotation
        vector is zero (Moakher 2002, doi:10.1137/S0895479801383877); translation by
        the arithmetic mean, so that it does not depend on the rotations.

        Raises:
            InputError: no motion was given.
            ConvergenceError: the rotations are spread too far to have one mean.
        """
        matrices = np.array([motion.matrix for motion in motions])
        if len(matrices) == 0:
            raise InputError("the mean of no motions is undefined; give at least one")
        rotation = nearest_rotation(matrices[:, :3, :3].mean(axis=0))
        for _ in range(iterations):
            step = so3_log(rotation.T @ matrices[:, :3, :3]).mean(axis=0)
            rotation = rotation @ so3_exp(step)
            if np.linalg.norm(step) < 1e-14:
                break
        else:
            raise ConvergenceError(
                f"the mean of {len(matrices)} rotations still moves by "
                f"{np.linalg.norm(step):.1e} rad after {iterations} steps: they are "
                "spread too far to have one mean; average those near each other"
            )
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


def _rotation_defect(rows: list[list[float]]) -> tuple[float, float]:
    """Largest entry of |R'R - I| and determinant of the first three columns."""
    (a, b, c, _), (d, e, f, _), (g, h, i, _) = rows[:3]
    defect = max(
        abs(a * a + d * d + g * g - 1.0),
        abs(b * b + e * e + h * h - 1.0),
        abs(c * c + f * f + i * i - 1.0),
        abs(a * b + d * e + g * h),
        abs(b * c + e * f + h * i),
        abs(c * a + f * d + i * g),
    )
    return defect, a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def _reorthonormalise(rotation: Floats) -> Floats:
    """One Newton step of the polar decomposition: keeps long chains on SO(3)."""
    return np.asarray(1.5 * rotation - 0.5 * rotation @ rotation.T @ rotation)
