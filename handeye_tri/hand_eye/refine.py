"""Maximum-likelihood AX = ZB with stated covariances of both sides.

Residual of station i: ``e = log((A X)^-1 Z B)``, six numbers, metres and radians. X is
that of the mount which the station has; Z is common to all.
With ``A_true = A exp(a)`` and ``B_true = B exp(b)``, a and b small and random, it is
``Ad(X^-1) a - b`` to first order, so that its covariance is
``Ad(X^-1) Cov(a) Ad(X^-1)' + Cov(b)``: rotation and translation, robot and camera
are weighed by what is known of them and no hand-chosen factor is left. Since each
station has six residuals for six numbers of noise, minimising them is maximum
likelihood over X, Z and all true poses (Strobl and Hirzinger 2006,
doi:10.1109/IROS.2006.282250, choose the weights; here they are given).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import ConvergenceError, InputError
from handeye_tri.se3 import (
    SE3,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_left_jacobian_inverse,
    se3_log,
)

Floats = NDArray[np.float64]

_MAX_ITERATIONS = 50
# Steps below this many standard deviations change nothing that can be seen; steps
# below rounding, relative to the scene, cannot become smaller.
_STEP_TOLERANCE = 1e-8
_ROUNDING = 1e-13


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """X and Z of ``a_i X = Z b_i`` with what is known about their errors.

    Attributes:
        xs: The motion on the moving side with each of k mounts.
        z: The motion on the standing side.
        covariance: Of the right tangents of each X, then of Z, 6 (k + 1) = q numbers,
            shape (q, q), m and rad.
        residuals: ``log((A X)^-1 Z B)``, shape (n, 6), m and rad.
        chi2: Sum of squared whitened residuals.
        by_b: Derivative of these tangents by the tangents of b_i, (q, n, 6).
        gradient: Derivative of the residuals by these tangents, (n, 6, q).
        residuals_by_b: Derivative of the residuals by the tangents of b_i, (n, 6, 6).
        precision: Inverse covariances of the residuals, shape (n, 6, 6).
    """

    xs: tuple[SE3, ...]
    z: SE3
    covariance: Floats
    residuals: Floats
    chi2: float
    by_b: Floats
    gradient: Floats
    residuals_by_b: Floats
    precision: Floats

    @property
    def x(self) -> SE3:
        """The motion on the moving side, where there is one mount."""
        (x,) = self.xs
        return x


def residuals_axzb(
    a: Floats, b: Floats, x: Floats, z: Floats
) -> tuple[Floats, Floats, Floats]:
    """Residuals of ``a_i X = Z b_i`` with derivatives.

    From ``(A X exp(dx))^-1 Z exp(dz) B exp(db)`` with E = exp(e):
    ``exp(-dx) E exp(Ad(B^-1) dz) exp(db)``.

    Args:
        a: Shape (n, 4, 4), metres.
        b: Shape (n, 4, 4), metres.
        x: Shape (4, 4), or (n, 4, 4) for one of each station.
        z: Shape (4, 4).

    Returns:
        ``e = log((A X)^-1 Z B)``, shape (n, 6); its derivative by the right
        tangents of X and Z, (n, 6, 12); by the right tangents of b_i, (n, 6, 6).
    """
    e = se3_log(se3_inverse(a @ x) @ (z @ b))
    by_x = -se3_left_jacobian_inverse(e)
    by_b = se3_left_jacobian_inverse(-e)
    by_z = by_b @ se3_adjoint(se3_inverse(b))
    return e, np.concatenate([by_x, by_z], axis=-1), by_b


def refine_axzb(
    a: Floats,
    b: Floats,
    xs: Sequence[SE3],
    z: SE3,
    covariance_a: Floats,
    covariance_b: Floats,
    mounts: NDArray[np.intp] | None = None,
) -> Refinement:
    """Gauss-Newton from a closed form; cost linear in the number of stations.

    Args:
        a: Poses, shape (n, 4, 4), metres.
        b: Poses, shape (n, 4, 4), metres.
        xs: Start for the X of each mount.
        z: Start for Z.
        covariance_a: Of a_i's right tangents, (6, 6) or (n, 6, 6).
        covariance_b: Of b_i's right tangents, (6, 6) or (n, 6, 6).
        mounts: Which X each station has, shape (n,); None for the only one.

    Raises:
        InputError: the covariances leave a direction without noise.
        ConvergenceError: 50 iterations did not suffice.
    """
    x_matrices, z_matrix = np.array([x.matrix for x in xs]), np.array(z.matrix)
    of_station = 0 if mounts is None else mounts
    rounding = _ROUNDING * max(
        1.0, np.abs(a[:, :3, 3]).max(), np.abs(b[:, :3, 3]).max()
    )
    for _ in range(_MAX_ITERATIONS):
        x_matrix = x_matrices[of_station]
        adjoint = se3_adjoint(se3_inverse(x_matrix))
        noise = adjoint @ covariance_a @ np.swapaxes(adjoint, -1, -2) + covariance_b
        precision = _inverse(np.broadcast_to(noise, (len(a), 6, 6)))
        e, gradient, by_b = residuals_axzb(a, b, x_matrix, z_matrix)
        gradient = _by_mounts(gradient, len(xs), of_station)
        weighted = np.swapaxes(gradient, 1, 2) @ precision
        normal = np.einsum("nij,njk->ik", weighted, gradient)
        scale = 1.0 / np.sqrt(np.diagonal(normal))
        covariance = (
            scale[:, None] * scale * np.linalg.inv(normal * scale[:, None] * scale)
        )
        step = -covariance @ np.einsum("nij,nj->i", weighted, e)
        x_matrices = x_matrices @ se3_exp(step[:-6].reshape(-1, 6))
        z_matrix = z_matrix @ se3_exp(step[-6:])
        small = np.maximum(_STEP_TOLERANCE * np.sqrt(np.diagonal(covariance)), rounding)
        if (np.abs(step) < small).all():
            break
    else:
        raise ConvergenceError(
            f"the hand-eye refinement did not settle in {_MAX_ITERATIONS} iterations "
            f"(last step {np.abs(step).max():.2g}); check that a[i] and b[i] belong "
            "together and that the covariances are in metres and radians"
        )
    e, gradient, by_b = residuals_axzb(a, b, x_matrices[of_station], z_matrix)
    gradient = _by_mounts(gradient, len(xs), of_station)
    return Refinement(
        tuple(SE3(x_matrix) for x_matrix in x_matrices),
        SE3(z_matrix),
        covariance,
        e,
        float(np.einsum("ni,nij,nj->", e, precision, e)),
        -np.einsum("pi,nij->pnj", covariance, weighted @ by_b),
        gradient,
        by_b,
        precision,
    )


def _by_mounts(gradient: Floats, k: int, mounts: int | NDArray[np.intp]) -> Floats:
    """Derivatives by the station's X and Z, (n, 6, 12), as by each X and Z."""
    n = len(gradient)
    spread = np.zeros((n, 6, k + 1, 6))
    spread[np.arange(n), :, mounts] = gradient[..., :6]
    spread[:, :, k] = gradient[..., 6:]
    return spread.reshape(n, 6, -1)


def _inverse(covariance: Floats) -> Floats:
    """Inverses that mixed units (m, rad) do not spoil."""
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    if not (np.isfinite(std).all() and (std > 0).all()):
        raise InputError(
            "covariance_a and covariance_b leave a direction without noise; "
            "give every axis a standard deviation above zero"
        )
    scale = 1.0 / (std[:, :, None] * std[:, None, :])
    return np.asarray(scale * np.linalg.inv(covariance * scale))
