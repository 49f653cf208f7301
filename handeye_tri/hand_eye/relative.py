"""AX = XB in closed form, from relative motions: five methods of the literature.

All are safe at half-turns. The rotation equation ``R_A R = R R_B`` itself does not
care about the sign of a half-turn's axis; methods that work with axes, rotation
vectors or quaternions do. Their signs are settled against the sign-free linear
solution first (:func:`handeye_tri.hand_eye.motions.matched_quaternions`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri import arguments
from handeye_tri.hand_eye.degeneracy import require_determined
from handeye_tri.hand_eye.motions import (
    check_pairs,
    matched_quaternions,
    rotation_vectors,
)
from handeye_tri.se3 import (
    SE3,
    hat,
    nearest_rotation,
    rotation_from_quaternion_wxyz,
)

Floats = NDArray[np.float64]
RelativeMethod = Literal[
    "tsai_lenz", "park_martin", "horaud_dornaika", "andreff", "daniilidis"
]
RELATIVE_METHODS: tuple[RelativeMethod, ...] = get_args(RelativeMethod)

# Turns below this have no axis to speak of, radians.
_NO_AXIS = 1e-8


def solve_axxb(
    a: ArrayLike, b: ArrayLike, *, method: RelativeMethod = "park_martin"
) -> SE3:
    """Solve ``a_k X = X b_k`` for the one rigid motion X; cost linear in k.

    Args:
        a: Relative motions, shape (n, 4, 4), metres, n >= 2.
        b: The same motions seen from the other side, shape (n, 4, 4).
        method: "tsai_lenz" (1989, doi:10.1109/70.34770), "park_martin" (1994,
            doi:10.1109/70.326576), "horaud_dornaika" (1995,
            doi:10.1177/027836499501400301), "andreff" (2001,
            doi:10.1177/02783640122067372) or "daniilidis" (1999,
            doi:10.1177/02783649922066213).

    Returns:
        X, which maps b's frame to a's.

    Raises:
        InputError: unequal counts, fewer than two, NaN, or not rotations.
        DegenerateMotionError: parallel axes, or ambiguous half-turns.
    """
    arguments.check_one_of("method", method, RELATIVE_METHODS)
    left, right = check_pairs(a, b, 2)
    start = _linear_rotation(left, right)
    if method == "andreff":
        return _with_translation(left, right, start)
    qa, qb = matched_quaternions(left[:, :3, :3], right[:, :3, :3], start)
    if method == "daniilidis":
        return _daniilidis(left, right, qa, qb)
    return _with_translation(left, right, _BY_AXES[method](qa, qb, start))


def _linear_rotation(a: Floats, b: Floats) -> Floats:
    """Rotation of Andreff et al. 2001, Sec. 4: linear in the nine entries of R.

    ``R_A R R_B' = R`` is ``(R_A kron R_B) vec R = vec R`` with rows stacked; the
    sum of squared residuals is ``2 n |R|^2 - 2 vec R' S vec R`` with S the symmetric
    part of the sum of Kronecker products: the best unit vector is S's largest
    eigenvector, a 9x9 problem for any number of motions.
    """
    n = len(a)
    kronecker = (a[:, :3, :3].reshape(n, 9).T @ b[:, :3, :3].reshape(n, 9)).reshape(
        3, 3, 3, 3
    )
    total = kronecker.transpose(0, 2, 1, 3).reshape(9, 9) / n
    values, vectors = np.linalg.eigh(0.5 * (total + total.T))
    require_determined(values[-1], values[-2], np.eye(3)[None], a[:, :3, :3])
    entries = vectors[:, -1].reshape(3, 3)
    return nearest_rotation(entries * np.sign(np.linalg.det(entries)))


def _with_translation(a: Floats, b: Floats, rotation: Floats) -> SE3:
    """Least-squares t of ``(R_A - I) t = R t_B - t_A`` beside a known R."""
    matrix = (a[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (b[:, :3, 3] @ rotation.T - a[:, :3, 3]).reshape(-1)
    translation = np.linalg.lstsq(matrix, right, rcond=None)[0]
    return SE3.from_parts(rotation, translation)


def _tsai_lenz(qa: Floats, qb: Floats, start: Floats) -> Floats:
    """Rotation of Tsai and Lenz 1989, Eq. 12: linear in the Gibbs vector g.

    ``a = R b`` gives ``(a + b) x g = b - a`` with g = tan(angle / 2) axis, and
    a, b the vectors 2 sin(angle / 2) axis. g is infinite where R is a half-turn,
    so b is turned first by the one of identity and three half-turns about the
    coordinate axes that leaves R nearest to the identity (at most 120 degrees).
    """
    quarters = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
    turn = np.diag(quarters[np.argmax(quarters @ np.diagonal(start))].astype(float))
    a, b = 2 * qa[:, 1:], 2 * qb[:, 1:] @ turn
    g = np.linalg.lstsq(hat(a + b).reshape(-1, 3), (b - a).reshape(-1), rcond=None)[0]
    return rotation_from_quaternion_wxyz(np.append(1.0, g)) @ turn


def _park_martin(qa: Floats, qb: Floats, start: Floats) -> Floats:
    """Rotation of Park and Martin 1994, Eq. 20: Procrustes on rotation vectors."""
    del start
    return nearest_rotation(rotation_vectors(qa).T @ rotation_vectors(qb))


def _horaud_dornaika(qa: Floats, qb: Floats, start: Floats) -> Floats:
    """Rotation of Horaud and Dornaika 1995, Sec. 4.1: quaternion of unit axes.

    Minimises the sum of |n_a q - q n_b|^2 over unit quaternions q: the smallest
    eigenvector of a 4x4 matrix. Turns without an axis are left out.
    """
    del start
    sine_a, sine_b = (np.linalg.norm(q[:, 1:], axis=1) for q in (qa, qb))
    used = np.minimum(sine_a, sine_b) > _NO_AXIS
    n_a = qa[used, 1:] / sine_a[used, None]
    n_b = qb[used, 1:] / sine_b[used, None]
    difference = np.zeros((used.sum(), 4, 4))
    difference[:, 0, 1:] = n_b - n_a
    difference[:, 1:, 0] = n_a - n_b
    difference[:, 1:, 1:] = hat(n_a + n_b)
    _, vectors = np.linalg.eigh(np.einsum("nab,nac->bc", difference, difference))
    return rotation_from_quaternion_wxyz(vectors[:, 0])


def _daniilidis(a: Floats, b: Floats, qa: Floats, qb: Floats) -> SE3:
    """Rotation and translation of Daniilidis 1999, Eq. 31-35: dual quaternions.

    The dual part of a motion is ``(0, t) q / 2``. Vector parts of ``q_a q = q q_b``
    give six rows per motion in the eight numbers of the unknown; its two smallest
    singular vectors (u, v) are combined so that |u| = 1 and u'v = 0.
    """
    rows = np.zeros((len(a), 6, 8))
    dual_a, dual_b = _dual_vector(a, qa), _dual_vector(b, qb)
    rows[:, :3, 0] = rows[:, 3:, 4] = qa[:, 1:] - qb[:, 1:]
    rows[:, :3, 1:4] = rows[:, 3:, 5:] = hat(qa[:, 1:] + qb[:, 1:])
    rows[:, 3:, 0] = dual_a - dual_b
    rows[:, 3:, 1:4] = hat(dual_a + dual_b)
    triangular = np.linalg.qr(rows.reshape(-1, 8), mode="r")
    u, v = np.linalg.svd(triangular)[2][-2:].reshape(2, 2, 4).transpose(1, 0, 2)
    # lambda' Q lambda = 0 with Q symmetric: the two roots from its eigenvectors.
    product = u @ v.T
    values, vectors = np.linalg.eigh(0.5 * (product + product.T))
    root = np.sqrt(np.maximum([values[1], -values[0]], 0.0))
    candidates = (vectors @ np.array([[root[0], root[0]], [root[1], -root[1]]])).T
    lengths = np.linalg.norm(candidates @ u, axis=1) / np.maximum(
        np.linalg.norm(candidates, axis=1), 1e-300
    )
    weights = candidates[np.argmax(lengths)]
    real, dual = weights @ u, weights @ v
    scale = np.linalg.norm(real)
    real, dual = real / scale, dual / scale
    # t = 2 dual conj(real), vector part.
    translation = 2 * (
        real[0] * dual[1:] - dual[0] * real[1:] - np.cross(dual[1:], real[1:])
    )
    return SE3.from_parts(rotation_from_quaternion_wxyz(real), translation)


def _dual_vector(motions: Floats, quaternions: Floats) -> Floats:
    """Vector part of (0, t) q / 2, shape (n, 3)."""
    t = motions[:, :3, 3]
    return np.asarray(0.5 * (quaternions[:, :1] * t + np.cross(t, quaternions[:, 1:])))


_BY_AXES: dict[str, Callable[[Floats, Floats, Floats], Floats]] = {
    "tsai_lenz": _tsai_lenz,
    "park_martin": _park_martin,
    "horaud_dornaika": _horaud_dornaika,
}
