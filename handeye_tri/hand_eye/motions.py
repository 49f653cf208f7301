"""Poses as input: checks, relative motions, and rotation vectors that match at pi."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri import arguments
from handeye_tri.counting import counted
from handeye_tri.errors import InputError
from handeye_tri.records import numeric
from handeye_tri.se3 import quaternion_wxyz, se3_inverse

Floats = NDArray[np.float64]

# A matrix whose R'R is farther than this from the identity is no rotation.
_ROTATION_TOLERANCE = 1e-6
# Farther from a rotation than this is no rounding.
_ROUNDED = 0.02
# Poses checked at once: a cache full.
_CHUNK = 1024
_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])


def _rigid_conditions() -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Six numbers that vanish for a rotation with columns x, y, z, as sums of products.

    They are x cross y - z, x'x - 1, y'y - 1 and x'y; the ones are the matrix' last
    entry.

    Returns:
        Which of the 16 entries the first and the second factor of each product is,
        and the products' signs, shape (products, 6).
    """
    one = 15
    terms = []
    for k in range(3):
        after, last = (k + 1) % 3, (k + 2) % 3
        terms += [
            (4 * after, 4 * last + 1, k, 1.0),
            (4 * last, 4 * after + 1, k, -1.0),
            (4 * k + 2, one, k, -1.0),
            (4 * k, 4 * k, 3, 1.0),
            (4 * k + 1, 4 * k + 1, 4, 1.0),
            (4 * k, 4 * k + 1, 5, 1.0),
        ]
    terms += [(one, one, 3, -1.0), (one, one, 4, -1.0)]
    first, second, condition, sign = (
        np.array(part) for part in zip(*terms, strict=True)
    )
    signs = np.zeros((len(terms), 6))
    signs[np.arange(len(terms)), condition] = sign
    return first, second, signs


_FIRST, _SECOND, _CONDITIONS = _rigid_conditions()


def check_motions(name: str, motions: ArrayLike, least: int) -> Floats:
    """Read rigid motions and refuse what is none.

    Args:
        name: What the message calls them.
        motions: Shape (n, 4, 4), metres.
        least: The smallest n that can be used.

    Returns:
        Shape (n, 4, 4), a copy.

    Raises:
        InputError: wrong shape, too few, not finite, or not rigid; the message
            names the first bad index and says how far off it is.
    """
    m = numeric(name, motions)
    if m.ndim != 3 or m.shape[1:] != (4, 4):
        raise InputError(f"{name} must have shape (n, 4, 4), got {m.shape}")
    if len(m) < least:
        raise InputError(
            f"{name} holds {counted(len(m), 'motion')}; at least {least} are needed: "
            "record more poses"
        )
    # A sum is finite only if all its terms are.
    if not np.isfinite(m.sum()) and not np.isfinite(m).all():
        bad = ~np.isfinite(m).all(axis=(1, 2))
        raise InputError(
            f"{name}[{np.argmax(bad)}] holds NaN or infinity "
            f"({bad.sum()} of {len(m)} do); drop those pairs first"
        )
    last = np.abs(m[:, 3] - _LAST_ROW)
    if last.max() > 1e-9:
        i = int(np.argmax(last.max(axis=1)))
        raise InputError(
            f"{name}[{i}]: the last row must be (0, 0, 0, 1), got {m[i, 3].tolist()}; "
            "matrices are row-major with the translation in the last column"
        )
    defect, determinant = _rotation_defect(m)
    if defect.max() > _ROTATION_TOLERANCE or determinant.min() < 0:
        i = int(np.argmax(np.where(determinant < 0, np.inf, defect)))
        if determinant[i] < 0:
            raise InputError(
                f"{name}[{i}] is not a rotation but a mirror image (determinant "
                f"{determinant[i]:+.6f}); one axis has the wrong sign, or a frame is "
                "left-handed"
            )
        raise InputError(
            f"{name}[{i}] is not a rotation: R'R differs from I by {defect[i]:.2g} "
            f"(allowed {_ROTATION_TOLERANCE:g}), determinant {determinant[i]:+.6f}; "
            + (
                "orthonormalise it first (handeye_tri.se3.nearest_rotation)"
                if defect[i] < _ROUNDED
                else "that is too far for rounding: check how it was written"
            )
        )
    return m


def _rotation_defect(motions: Floats) -> tuple[Floats, Floats]:
    """Largest entry of |R'R - I| and determinant, shape (n,) each.

    By columns as arrays of length n: a batched 3x3 product and determinant cost more
    than the whole closed form.
    """
    columns = np.ascontiguousarray(motions[:, :3, :3].transpose(2, 1, 0))
    product = np.einsum("ain,bin->abn", columns, columns)
    product[(0, 1, 2), (0, 1, 2)] -= 1.0
    x, y, z = columns
    cross = y[[1, 2, 0]] * z[[2, 0, 1]] - y[[2, 0, 1]] * z[[1, 2, 0]]
    return np.abs(product).reshape(9, -1).max(axis=0), (x * cross).sum(axis=0)


def check_pairs(a: ArrayLike, b: ArrayLike, least: int) -> tuple[Floats, Floats]:
    """Read two lists of motions that belong together, see :func:`check_motions`.

    Args:
        a: Shape (n, 4, 4), metres.
        b: Shape (n, 4, 4), metres.
        least: The smallest n that can be used.

    Raises:
        InputError: a list is unusable, or their lengths differ.
    """
    first, second = _numbers("a", a), _numbers("b", b)
    if first.shape == second.shape and first.shape[1:] == (4, 4):
        # Both at once, and only whether all is well: what is wrong is asked below.
        n = len(first)
        if n >= least and all(
            _all_rigid(np.concatenate([first[i : i + _CHUNK], second[i : i + _CHUNK]]))
            for i in range(0, n, _CHUNK)
        ):
            return first, second
    first, second = check_motions("a", a, least), check_motions("b", b, least)
    if len(first) != len(second):
        raise InputError(
            f"a holds {counted(len(first), 'motion')} and b {len(second)}; "
            "a[i] and b[i] must belong together"
        )
    return first, second


def _numbers(name: str, given: ArrayLike) -> Floats:
    """Not copied where they are numbers already: a copy costs as much as a solver."""
    if isinstance(given, np.ndarray) and given.dtype == np.float64:
        return given
    return numeric(name, given)


def _all_rigid(motions: Floats) -> bool:
    """Whether the third column is the others' cross product, and they are unit."""
    entries = motions.reshape(-1, 16)
    if not (entries[:, 12:] == _LAST_ROW).all():
        return False
    products = entries.take(_FIRST, axis=1) * entries.take(_SECOND, axis=1)
    off = np.abs(products @ _CONDITIONS).max()
    # Comparisons are False for NaN; the translations are asked for it.
    return bool(off <= _ROTATION_TOLERANCE / 2 and np.isfinite(entries.sum()))


def relative_motions(
    poses: ArrayLike,
    *,
    pairs: Literal["all", "successive"] = "all",
    side: Literal["left", "right"] = "left",
) -> Floats:
    """Motions between stations, from absolute poses.

    With ``a_i x = z b_i``, left motions ``a_j a_i^-1`` and ``b_j b_i^-1`` satisfy
    AX = XB with ``z`` for X; right motions ``a_i^-1 a_j`` and ``b_i^-1 b_j`` with
    ``x`` for X. So a standing camera (z = base_from_camera) takes the left ones.

    Args:
        poses: Shape (n, 4, 4), metres.
        pairs: Every pair i < j, n (n - 1) / 2 of them, or n - 1 successive pairs.
        side: Which of the two.

    Returns:
        Shape (number of pairs, 4, 4); pairs in lexical order.

    Raises:
        InputError: a word is not known, or poses are unusable.
    """
    arguments.check_one_of("pairs", pairs, ("all", "successive"))
    arguments.check_one_of("side", side, ("left", "right"))
    m = check_motions("poses", poses, 2)
    i, j = (
        np.triu_indices(len(m), 1)
        if pairs == "all"
        else (np.arange(len(m) - 1), np.arange(1, len(m)))
    )
    inverse = se3_inverse(m)
    result = m[j] @ inverse[i] if side == "left" else inverse[i] @ m[j]
    return np.asarray(result)


def matched_quaternions(
    a: Floats, b: Floats, rotation: Floats
) -> tuple[Floats, Floats]:
    """Unit quaternions of paired rotations, with the sign at pi settled.

    A quaternion and its negative are the same rotation. The habit w >= 0 makes the
    choice unique except near a half-turn, where noise decides for each of a and b
    alone and every second pair comes out with opposite axes. Here a's sign is the
    one whose axis is on the side of R b's axis wherever the turn exceeds a right
    angle; below that, w >= 0 is safe.

    Args:
        a: Rotations, shape (n, 3, 3).
        b: Rotations, shape (n, 3, 3).
        rotation: An estimate of the R in ``a = R b R'``, shape (3, 3).

    Returns:
        Quaternions (w, x, y, z) of a and of b, shape (n, 4) each.
    """
    qa, qb = quaternion_wxyz(a), quaternion_wxyz(b)
    opposite = (qa[:, 1:] * (qb[:, 1:] @ rotation.T)).sum(axis=1) < 0
    qa[opposite & (qb[:, 0] < np.sqrt(0.5))] *= -1.0
    return qa, qb


def rotation_vectors(quaternions: Floats) -> Floats:
    """Rotation vectors, shape (n, 3), of quaternions that may have w < 0.

    The norm is in [0, 2 pi): a quaternion with w < 0 stands for a turn beyond pi,
    so that vectors vary smoothly through a half-turn.
    """
    w, v = quaternions[:, 0], quaternions[:, 1:]
    sine = np.linalg.norm(v, axis=1)
    small = sine < 1e-8
    safe = np.where(small, 1.0, sine)
    factor = np.where(small, 2.0, 2.0 * np.arctan2(safe, w) / safe)
    return np.asarray(factor[:, None] * v)
