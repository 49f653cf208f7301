"""AX = ZB from absolute poses: closed forms and the weighted refinement by name."""

from __future__ import annotations

from math import copysign
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri import arguments
from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.hand_eye.consensus import find_consensus
from handeye_tri.hand_eye.degeneracy import require_determined
from handeye_tri.hand_eye.motions import check_pairs
from handeye_tri.hand_eye.refine import Refinement, refine_axzb
from handeye_tri.records import numeric
from handeye_tri.se3 import SE3, nearest_rotation

Floats = NDArray[np.float64]
AbsoluteMethod = Literal["shah", "li", "refined"]
ABSOLUTE_METHODS: tuple[AbsoluteMethod, ...] = get_args(AbsoluteMethod)

# Rows of the joint linear system that are factorised at once: bounds the memory.
_CHUNK = 4096
# Rounds of estimating the two noise levels from the residuals; they settle in 3-4.
_ROUNDS = 8
_EYE = np.eye(3)


def solve_axzb(
    a: ArrayLike,
    b: ArrayLike,
    *,
    method: AbsoluteMethod = "shah",
    covariance_a: ArrayLike | None = None,
    covariance_b: ArrayLike | None = None,
    robust: bool = False,
    seed: int = 0,
) -> tuple[SE3, SE3]:
    """Solve ``a_i X = Z b_i`` for the two rigid motions; cost linear in i.

    For a standing camera and a target on the flange: a_i = base_from_flange,
    b_i = camera_from_target, X = flange_from_target, Z = base_from_camera. For a
    camera on the flange and a standing target: a_i = base_from_flange,
    b_i = target_from_camera, X = flange_from_camera, Z = base_from_target.

    Args:
        a: Poses, shape (n, 4, 4), metres, n >= 3.
        b: Poses, shape (n, 4, 4), metres.
        method: "shah" (2013, doi:10.1115/1.4024473): rotations from one 9x9
            matrix, translations after; it uses the information of all pairs.
            "li" (Li, Wang and Wu 2010, Int. J. Phys. Sci. 5(10), the Kronecker
            method): rotations and translations from one linear system. "refined":
            Shah, then maximum likelihood with the covariances given.
        covariance_a: Of the right tangent of each a_i, (6, 6) or (n, 6, 6), m and
            rad; only for "refined". Without any covariance, one translational and
            one rotational noise level are estimated from the residuals.
        covariance_b: The same for b_i.
        robust: Whether poses that most others contradict are left out first
            (consensus of random samples; up to half may be wrong). Which ones, and
            everything else about the solution: :func:`solve_pose_pairs`.
        seed: Of the random samples; the same seed gives the same result.

    Returns:
        X and Z.

    Raises:
        InputError: unequal counts, fewer than three, NaN, or not rotations; a
            covariance with another method than "refined", or of a wrong shape.
        DegenerateMotionError: parallel axes, or ambiguous half-turns.
        ConvergenceError: the refinement did not converge.
    """
    arguments.check_one_of("method", method, ABSOLUTE_METHODS)
    arguments.flag("robust", robust)
    arguments.seed("seed", seed)
    left, right = check_pairs(a, b, 3)
    given = covariance_a is not None or covariance_b is not None
    if given and method != "refined":
        raise InputError(
            f'method "{method}" takes no covariance; use method="refined" or drop it'
        )
    n = len(left)
    kept: slice | NDArray[np.bool_] = slice(None)
    if robust:
        kept = find_consensus(left, right, seed=seed).agreeing
        left, right = left[kept], right[kept]
    x, z = _shah(left, right)
    if method == "li":
        x, z = _li(left, right)
    if method == "refined":
        refinement = (
            refine_axzb(
                left,
                right,
                (x,),
                z,
                _covariances("covariance_a", covariance_a, n)[kept],
                _covariances("covariance_b", covariance_b, n)[kept],
            )
            if given
            else _refine_unknown_noise(left, right, x, z)
        )
        x, z = refinement.x, refinement.z
    return x, z


def _covariances(name: str, value: ArrayLike | None, n: int) -> Floats:
    if value is None:
        return np.zeros((n, 6, 6))
    covariance = numeric(name, value)
    if covariance.shape not in {(6, 6), (n, 6, 6)}:
        raise InputError(
            f"{name} must have shape (6, 6) or ({n}, 6, 6), got {covariance.shape}"
        )
    if not np.isfinite(covariance).all():
        raise InputError(f"{name} must be finite, got NaN or infinity")
    least = np.linalg.eigvalsh(covariance).min()
    if least < -1e-9 * np.abs(covariance).max():
        raise InputError(
            f"{name} must not be negative in any direction, got variance {least:.3g}"
        )
    return np.broadcast_to(covariance, (n, 6, 6))


def _shah(a: Floats, b: Floats) -> tuple[SE3, SE3]:
    """Separable solution of Shah 2013, Sec. 3.

    The sum over i of ``R_A X R_B'`` is n Z, so that with rows stacked
    ``K vec X = n vec Z``, K the sum of Kronecker products: X and Z are K's singular
    vectors of the largest singular value. Eliminating the free 3x3 matrix Z from
    sum |R_A X - Z R_B|^2 leaves 1/n of the same sum over all pairs' relative
    motions, so no pair's information is lost although the cost is linear.
    """
    n = len(a)
    # Every sum over poses of an entry of A times one of B, ones included: all that is
    # needed but the sum of R_A't_A.
    sums = (a.reshape(n, 16).T @ b.reshape(n, 16) / n).reshape(4, 4, 4, 4)
    total = sums[:3, :3, :3, :3].transpose(0, 2, 1, 3).reshape(9, 9)
    u, values, vt = np.linalg.svd(total)
    ra = a[:, :3, :3]
    require_determined(values[0], values[1], ra[:-1], ra[1:])
    # Procrustes of matrices with positive determinants needs no mirror taken out.
    entries = [copysign(1.0, _determinant(one)) * one for one in (vt[0], u[:, 0])]
    left, _, right = np.linalg.svd(np.array(entries).reshape(2, 3, 3))
    both = left @ right
    # R_A t_X - t_Z = R_Z t_B - t_A =: r. Its normal equations need means alone, since
    # R_A'R_A = I: t_Z = M t_X - mean r, (I - M'M) t_X = mean R_A'r - M' mean r.
    mean_ra = sums[:3, :3, 3, 3]
    mean_rest = both[1] @ sums[3, 3, :3, 3] - sums[:3, 3, 3, 3]
    turned = np.einsum("jik,jk->i", sums[:3, :3, :3, 3], both[1])
    turned -= np.einsum("nji,nj->i", ra, a[:, :3, 3]) / n
    t_x = _solve_three(_EYE - mean_ra.T @ mean_ra, turned - mean_ra.T @ mean_rest)
    result = np.zeros((2, 4, 4))
    result[:, :3, :3] = both
    result[0, :3, 3], result[1, :3, 3] = t_x, mean_ra @ t_x - mean_rest
    result[:, 3, 3] = 1.0
    return SE3(result[0]), SE3(result[1])


def _determinant(entries: Floats) -> float:
    """Of nine entries; plain floats, since numpy's takes ten times as long."""
    a, b, c, d, e, f, g, h, i = entries.tolist()
    return float(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))


def _solve_three(matrix: Floats, right: Floats) -> Floats:
    """Three equations by Cramer's rule, in plain floats for the same reason."""
    a, b, c, d, e, f, g, h, i = matrix.ravel().tolist()
    x, y, z = right.tolist()
    first, second, third = e * i - f * h, c * h - b * i, b * f - c * e
    determinant = a * first + d * second + g * third
    return (
        np.array(
            [
                first * x + second * y + third * z,
                (f * g - d * i) * x + (a * i - c * g) * y + (c * d - a * f) * z,
                (d * h - e * g) * x + (b * g - a * h) * y + (a * e - b * d) * z,
            ]
        )
        / determinant
    )


def _li(a: Floats, b: Floats) -> tuple[SE3, SE3]:
    """Joint linear solution of Li, Wang and Wu 2010.

    Twelve rows per pose in the 24 entries (vec R_X, vec R_Z, t_X, t_Z):
    ``R_A R_X - R_Z R_B = 0`` and ``R_Z t_B - R_A t_X + t_Z = t_A``. The triangular
    factor is accumulated in chunks, so that memory does not grow with n.
    """
    factor: Floats = np.zeros((0, 25))
    eye = np.eye(3)
    for begin in range(0, len(a), _CHUNK):
        ra, rb = (m[begin : begin + _CHUNK, :3, :3] for m in (a, b))
        ta, tb = (m[begin : begin + _CHUNK, :3, 3] for m in (a, b))
        rows = np.zeros((len(ra), 12, 25))
        rows[:, :9, :9] = np.einsum("nab,cd->nacbd", ra, eye).reshape(-1, 9, 9)
        rows[:, :9, 9:18] = -np.einsum("ab,ndc->nacbd", eye, rb).reshape(-1, 9, 9)
        rows[:, 9:, 9:18] = np.einsum("ab,nd->nabd", eye, tb).reshape(-1, 3, 9)
        rows[:, 9:, 18:21] = -ra
        rows[:, 9:, 21:24] = eye
        rows[:, 9:, 24] = ta
        factor = np.asarray(
            np.linalg.qr(np.vstack([factor, rows.reshape(-1, 25)]), mode="r")
        )
    solution = np.linalg.lstsq(factor[:, :24], factor[:, 24], rcond=None)[0]
    x_entries, z_entries = solution[:18].reshape(2, 3, 3)
    if min(np.linalg.det(x_entries), np.linalg.det(z_entries)) < 1e-6:
        raise DegenerateMotionError(
            "Li's linear system does not determine the scale of the rotations "
            f"(determinants {np.linalg.det(x_entries):.2g}, "
            f"{np.linalg.det(z_entries):.2g} instead of 1), as when a_i all have "
            'the same translation; use method="shah"'
        )
    return (
        SE3.from_parts(nearest_rotation(x_entries), solution[18:21]),
        SE3.from_parts(nearest_rotation(z_entries), solution[21:]),
    )


def _refine_unknown_noise(a: Floats, b: Floats, x: SE3, z: SE3) -> Refinement:
    """Refine with two noise levels, translational and rotational, from residuals.

    Iterative variance components: each round sets both to the RMS of the residuals
    of the last. A floor at 1e-12 of the scene keeps exact data solvable.
    """
    floor = 1e-12 * max(1.0, float(np.abs(b[:, :3, 3]).max()))
    sigma = np.array([1e-3, 1e-3])
    for _ in range(_ROUNDS):
        covariance = np.diag(np.repeat(sigma**2, 3))
        refinement = refine_axzb(a, b, (x,), z, np.zeros((6, 6)), covariance)
        parts = refinement.residuals.reshape(-1, 2, 3)
        # Of 6 n residuals 12 degrees of freedom went into X and Z.
        share = max(len(a) - 2, 1)
        updated = np.maximum(np.sqrt((parts**2).sum(axis=(0, 2)) / (3 * share)), floor)
        settled = np.abs(np.log(updated / sigma)).max() < 1e-3
        sigma = updated
        x, z = refinement.x, refinement.z
        if settled:
            break
    return refinement
