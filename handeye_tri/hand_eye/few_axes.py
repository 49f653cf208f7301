"""AX = ZB where the turns do not span space: 4-axis robots and the like.

With all turns about one direction n (in the base; m in B's base frame), the rotation
equations only say that Z carries m to n: one angle is free. Across n everything is
plane and complex: turns are unit numbers a_k, and positions obey
``a_k u - w - g q_k = -p_k`` with unknown u (of t_X), w (of t_Z) and g, whose argument
is the angle and whose size is the scale. Where nothing turns, positions alone give Z's
rotation (Procrustes). What stays undetermined is the least-squares solution's shortest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.se3 import nearest_rotation, so3_log

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Poses that turn by less than this do not turn, radians.
_NO_TURN = np.radians(1.0)
# Unknowns told by less than this share of the best told one are left at zero.
_LEAST_TOLD = 1e-9


def turns_are_few(a: Floats, b: Floats, x: Floats, z: Floats) -> bool:
    """Whether a pose's turns are all about one direction, as far as noise lets see.

    Args:
        a: Shape (n, 4, 4).
        b: Shape (n, 4, 4).
        x: Some solution that fits the rotations, shape (4, 4).
        z: Shape (4, 4).
    """
    vectors = so3_log(a[:, :3, :3] @ a[0, :3, :3].T)
    spread = np.linalg.svd(vectors, compute_uv=False) / np.sqrt(len(a))
    misfit = so3_log(
        np.swapaxes(a[:, :3, :3] @ x[:3, :3], 1, 2) @ z[:3, :3] @ b[:, :3, :3]
    )
    # Median over poses: one wrong pose must not make parallel axes of good ones.
    noise = np.median(np.linalg.norm(misfit, axis=1))
    return bool(spread[1] < max(4 * noise, 0.5 * _NO_TURN))


def rotations_of_few_axes(
    a: Floats, b: Floats, weights: Floats
) -> tuple[Floats, Floats]:
    """X's and Z's rotations of samples that turn about one direction or not at all.

    Args:
        a: Shape (h, k, 4, 4): k poses for each of h samples.
        b: Shape (h, k, 4, 4), translations in any unit.
        weights: Shape (h, k), not negative.

    Returns:
        Shape (h, 3, 3) each.
    """
    share = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
    base_a, flange_a, turning = _axes(a, share)
    base_b, flange_b, _ = _axes(b, share)
    turns_a, turns_b = _turns(a, base_a, flange_a), _turns(b, base_b, flange_b)
    # The axis of b may point either way: of the turns one sense agrees.
    same = np.abs((share * turns_a * turns_b.conj()).sum(axis=1))
    other = np.abs((share * turns_a * turns_b).sum(axis=1))
    base_b[..., 1:] *= np.where(other > same, -1.0, 1.0)[:, None, None]
    # Across the axis, one number each; unknowns u, w, g in the head's words.
    places = [
        np.einsum("hkj,hj->hk", poses[..., :3, 3], base[..., 0])
        + 1j * np.einsum("hkj,hj->hk", poses[..., :3, 3], base[..., 1])
        for poses, base in ((a, base_a), (b, base_b))
    ]
    size = np.sqrt((share * np.abs(places[1]) ** 2).sum(axis=1))[:, None]
    rows = np.stack(
        [turns_a, -np.ones_like(turns_a), -places[1] / np.maximum(size, 1e-300)], axis=2
    )
    adjoint = np.swapaxes(share[..., None] * rows, 1, 2).conj()
    told = np.linalg.pinv(adjoint @ rows, rcond=_LEAST_TOLD, hermitian=True)
    unknowns = told @ adjoint @ -places[0][..., None]
    angle = np.angle(unknowns[:, 2, 0])
    z = base_a @ _about_third(angle) @ np.swapaxes(base_b, 1, 2)
    still = _procrustes(a, b, share)
    z = np.where(turning[:, None, None], z, still)
    turned = np.swapaxes(a[..., :3, :3], 2, 3) @ z[:, None] @ b[..., :3, :3]
    return nearest_rotation(np.einsum("hk,hkij->hij", share, turned)), z


def _axes(poses: Floats, share: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Frames whose third axis is the turns', on both sides, and whether any turns.

    A mean of rotations about one axis keeps that axis' length and shortens what is
    across it: its first singular vectors are the axis on either side.

    Returns:
        In the base (h, 3, 3), in the flange (h, 3, 3), and (h,).
    """
    mean = np.einsum("hk,hkij->hij", share, poses[..., :3, :3])
    u, values, vt = np.linalg.svd(mean)
    base, flange = u[..., [1, 2, 0]], np.swapaxes(vt, 1, 2)[..., [1, 2, 0]]
    for frame in (base, flange):
        frame[..., 1] *= np.sign(np.linalg.det(frame))[:, None]
    return base, flange, values[:, 1] < np.cos(_NO_TURN)


def _turns(poses: Floats, base: Floats, flange: Floats) -> Complexes:
    """Unit numbers by which poses turn the flange's frame into the base's, (h, k)."""
    first = poses[..., :3, :3] @ flange[:, None, :, :1]
    across = (np.swapaxes(base[..., :2], 1, 2)[:, None] @ first)[..., 0]
    turns = across[..., 0] + 1j * across[..., 1]
    return np.asarray(turns / np.maximum(np.abs(turns), 1e-300))


def _about_third(angle: Floats) -> Floats:
    """Turns about the third axis, shape (h, 3, 3)."""
    turn = np.zeros((len(angle), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
    turn[:, 1, 0] = np.sin(angle)
    turn[:, 0, 1] = -turn[:, 1, 0]
    turn[:, 2, 2] = 1.0
    return turn


def _procrustes(a: Floats, b: Floats, share: Floats) -> Floats:
    """Z's rotation where nothing turns, from positions alone, shape (h, 3, 3)."""
    left, right = (
        poses[..., :3, 3] - np.einsum("hk,hki->hi", share, poses[..., :3, 3])[:, None]
        for poses in (a, b)
    )
    return nearest_rotation(np.einsum("hk,hki,hkj->hij", share, left, right))
