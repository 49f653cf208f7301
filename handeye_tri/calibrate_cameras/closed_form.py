"""K in closed form from all half-turns, with its covariance.

Two methods. "paper": the rows of Sec. III-A and III-B of Zhao, Liu and Zhang 2008
(doi:10.1109/TIP.2008.2005562) in normalised image coordinates, every row counting
the same. "whitened": the two rows of each half-turn's maximum-likelihood homography,
divided by the spread that the pixel noise gives them; that spread depends on K, so a
nominal K weights the first solution and the first solution weights the second.

Rows and weights taken from noisy homographies are noisy themselves, and noise that
makes a weak view look strong gives it weight: errors with heavy tails from about 0.5 px
on. Two scoring steps follow, therefore, each one linear solution: the homographies are
moved onto the constraints, as little as their covariance allows, and rows and weights
are those there (adjustment with conditions and unknowns, Gauss and Helmert; a step of
Fisher's scoring from a consistent start is efficient, Le Cam 1956). Nothing is
iterated until it settles: the number of linear solutions is fixed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.extrinsics import (
    poses_from_depths,
    poses_from_homographies,
)
from handeye_tri.calibrate_cameras.half_turns import HalfTurnData
from handeye_tri.calibrate_cameras.homography import (
    Homographies,
    conic_constraints,
    constraint_covariance,
    constraint_derivative,
)
from handeye_tri.calibrate_cameras.special_motion import (
    constraint_rows,
    depths,
    homogeneous,
    intrinsics_from_conic,
    solve_conic,
)

Floats = NDArray[np.float64]
ClosedFormMethod = Literal["whitened", "paper"]

# Focal length of the nominal camera over the image's longer side.
NOMINAL_FOCAL = 1.5
# Scoring steps after the reweighted solution.
_SCORING_STEPS = 2


@dataclass(frozen=True, slots=True, eq=False)
class ClosedForm:
    """A camera without lens and the triangle's poses.

    Attributes:
        k: Shape (3, 3), pixels.
        covariance: Of (fx, fy, skew, cx, cy), to first order, shape (5, 5), px^2,
            for pixel noise as the half-turn data whiten it.
        poses: camera_from_triangle before each half-turn, shape (n, 4, 4), metres.
    """

    k: Floats
    covariance: Floats
    poses: Floats


def closed_form(
    data: HalfTurnData,
    homographies: Homographies,
    basis: Floats,
    method: ClosedFormMethod,
) -> ClosedForm:
    """Solve for K, then for the poses (Sec. III-D).

    Args:
        data: The half-turns.
        homographies: Their homographies.
        basis: Of the b to choose from, shape (6, k); see :func:`solve_conic`.
        method: "whitened" or "paper".

    Raises:
        DegenerateMotionError: w is not positive definite, or, for "paper", an axis
            goes through a marker.
    """
    image = homographies.image
    if method == "paper":
        seen = homogeneous(image.normalised(data.pixels))
        args = (data.triangle, data.axes)
        rows = constraint_rows(seen[:, 0], seen[:, 1], *args)
        b, _, inverse = solve_conic(rows.reshape(-1, 6), basis)
        spread = _paper_row_covariance(data, homographies, b)
        blocks = inverse.reshape(6, -1, 3).swapaxes(0, 1)
        of_b = (blocks @ spread @ blocks.swapaxes(-1, -2)).sum(axis=0)
        z = depths(seen[:, 0], seen[:, 1], *args)
    else:
        b = _reweighted(homographies, basis)
        homographies, b, of_b = _scored(homographies, b, basis)
    unit_k = intrinsics_from_conic(b)
    k = image.matrix @ unit_k
    to_k = _intrinsics_by_conic(unit_k, b) * image.scale
    covariance = to_k @ of_b @ to_k.T
    if method == "paper":
        poses = poses_from_depths(k, homogeneous(data.pixels[:, 0]), z, data.triangle)
    else:
        poses = poses_from_homographies(k, homographies, data.triangle)
    return ClosedForm(k, covariance, poses)


def _reweighted(homographies: Homographies, basis: Floats) -> Floats:
    """The conic by whitened rows, weighted by a nominal K, then by the first one."""
    rows = conic_constraints(homographies.matrix)
    b = _nominal_conic()
    for _ in range(2):
        factor = np.linalg.cholesky(constraint_covariance(homographies, b))
        whitened = np.linalg.solve(factor, rows)
        b, _, _ = solve_conic(whitened.reshape(-1, 6), basis)
    return b


def _scored(
    homographies: Homographies, b: Floats, basis: Floats
) -> tuple[Homographies, Floats, Floats]:
    """Two steps of Gauss and Helmert's adjustment of homographies and conic.

    Args:
        homographies: Of the half-turns, as measured.
        b: The conic to start from, shape (6,), of unit length.
        basis: Of the b to choose from, shape (6, k).

    Returns:
        Homographies moved onto the constraints; the conic; its covariance, (6, 6).
    """
    measured = homographies.matrix
    spread = homographies.covariance
    moved: Floats = measured
    of_b: Floats = np.zeros((6, 6))
    for _ in range(_SCORING_STEPS):
        missed, _, shared = _condition(measured, moved, spread, b)
        step = np.einsum("nr,nri->ni", missed, shared)
        moved = measured - np.pad(step, ((0, 0), (0, 1))).reshape(-1, 3, 3)
        missed, root, _ = _condition(measured, moved, spread, b)
        # What changes b and neither its length nor what is known of it.
        tangent = basis @ np.linalg.svd((basis.T @ b)[None])[2][1:].T
        rows = np.linalg.solve(root, conic_constraints(moved)).reshape(-1, 6)
        u, s, vt = np.linalg.svd(rows @ tangent, full_matrices=False)
        s = np.maximum(s, np.finfo(float).eps * s.max(initial=0.0))
        gain = tangent @ (vt.T / s)
        b = b - gain @ (u.T @ missed.ravel())
        b = np.asarray(b / np.linalg.norm(b))
        of_b = np.asarray(gain @ gain.T)
    return replace(homographies, matrix=moved), b, of_b


def _condition(
    measured: Floats, moved: Floats, spread: Floats, b: Floats
) -> tuple[Floats, Floats, Floats]:
    """The constraints linearised where the homographies were moved to.

    Args:
        measured: Homographies, shape (n, 3, 3).
        moved: Where to linearise, shape (n, 3, 3).
        spread: Covariance of the measured ones' first eight elements, (n, 8, 8).
        b: The conic, shape (6,).

    Returns:
        By how much the measured ones miss, whitened, (n, 2); the root of its covariance
        before that, (n, 2, 2); its covariance with the homography, (n, 2, 8).
    """
    derivative = constraint_derivative(moved, b)
    change = (measured - moved).reshape(-1, 9)[:, :8, None]
    missed = conic_constraints(moved) @ b + (derivative @ change)[..., 0]
    shared = derivative @ spread
    root = np.linalg.cholesky(shared @ np.swapaxes(derivative, -1, -2))
    whitened = np.asarray(np.linalg.solve(root, missed[..., None])[..., 0])
    return whitened, np.asarray(root), np.asarray(np.linalg.solve(root, shared))


def _nominal_conic() -> Floats:
    w = 1.0 / NOMINAL_FOCAL**2
    return np.array([w, 0.0, w, 0.0, 0.0, 1.0])


def _paper_row_covariance(
    data: HalfTurnData, homographies: Homographies, b: Floats
) -> Floats:
    """Covariance of the paper's three rows times b, shape (n, 3, 3).

    By central differences over the twelve pixel coordinates of a half-turn, all
    half-turns at once; the residual is smooth, and a step of 1e-4 px leaves eight
    digits.
    """
    step = 1e-4
    spread = np.linalg.inv(data.whitener)
    derivative = np.empty((len(data), 3, 2, 3, 2))
    for index in np.ndindex(2, 3, 2):
        values = []
        for sign in (1.0, -1.0):
            pixels = data.pixels.copy()
            pixels[(slice(None), *index)] += sign * step
            seen = homogeneous(homographies.image.normalised(pixels))
            rows = constraint_rows(seen[:, 0], seen[:, 1], data.triangle, data.axes)
            values.append(rows @ b)
        derivative[(slice(None), slice(None), *index)] = (values[0] - values[1]) / (
            2 * step
        )
    by_noise = np.einsum("nrvkc,nvkcd->nrvkd", derivative, spread)
    by_noise = by_noise.reshape(len(data), 3, 12)
    return np.asarray(by_noise @ np.swapaxes(by_noise, -1, -2))


def _intrinsics_by_conic(k: Floats, b: Floats) -> Floats:
    """Derivative of (fx, fy, skew, cx, cy) by b, shape (5, 6).

    From dw = -(dK K^-1)' w - w (dK K^-1), with the scale of b as sixth unknown.
    """
    inverse = np.linalg.inv(k)
    w = inverse.T @ inverse
    forward = np.empty((6, 6))
    for column, (i, j) in enumerate([(0, 0), (1, 1), (0, 1), (0, 2), (1, 2)]):
        change = np.zeros((3, 3))
        change[i] = inverse[j]
        dw = -change.T @ w - w @ change
        forward[:, column] = dw[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    forward[:, 5] = w[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    scale = float(w[2, 2] / b[5])
    return np.asarray(np.linalg.inv(forward)[:5] * scale)
