"""Starts for AX = ZB where the turns do not span space: 4-axis robots and the like.

With all turns about one direction n (in the base; m in B's frame), the rotation
equations only say that Z carries m to n: one angle is free. Positions may tell it: with
Z = (cos f) P + (sin f) Q + n n'... they are linear in (cos f, sin f, t_X, t_Z). Where
nothing turns, positions alone give Z's rotation (Procrustes). What stays undetermined
is the least-squares solution's shortest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.se3 import hat, nearest_rotation, so3_exp, so3_log

Floats = NDArray[np.float64]

# Poses that turn by less than this do not turn, radians.
NO_TURN = np.radians(1.0)


def turns_are_few(a: Floats, b: Floats, x: Floats, z: Floats) -> bool:
    """Whether a pose's turns are all about one direction, as far as noise lets see.

    Args:
        a: Shape (n, 4, 4).
        b: Shape (n, 4, 4).
        x: Some solution that fits the rotations, shape (4, 4).
        z: Shape (4, 4).
    """
    vectors, _ = _turns(a, b)
    spread = np.linalg.svd(vectors, compute_uv=False) / np.sqrt(len(a))
    misfit = so3_log(
        np.swapaxes(a[:, :3, :3] @ x[:3, :3], 1, 2) @ z[:3, :3] @ b[:, :3, :3]
    )
    # Median over poses: one wrong pose must not make parallel axes of good ones.
    noise = np.median(np.linalg.norm(misfit, axis=1))
    return bool(spread[1] < max(4 * noise, 0.5 * NO_TURN))


def start_from_few_axes(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """X and Z, shape (4, 4) each, of poses that turn about one direction or not at all.

    Args:
        a: Shape (n, 4, 4), metres.
        b: Shape (n, 4, 4), metres.
    """
    ra, rb = a[:, :3, :3], b[:, :3, :3]
    ta, tb = a[:, :3, 3], b[:, :3, 3]
    turns_a, turns_b = _turns(a, b)
    if np.linalg.norm(turns_a, axis=1).max() < NO_TURN:
        moment = (ta - ta.mean(axis=0)).T @ (tb - tb.mean(axis=0))
        rotation = nearest_rotation(moment)
    else:
        n = np.linalg.svd(turns_a)[2][0]
        # Opposite signs of both turns' axes belong together.
        m = turns_b.T @ (turns_a @ n)
        rotation = _angle_from_positions(a, b, n, _carry(m / np.linalg.norm(m), n))
    x, z = np.tile(np.eye(4), (2, 1, 1))
    z[:3, :3] = rotation
    x[:3, :3] = nearest_rotation((np.swapaxes(ra, 1, 2) @ rotation @ rb).mean(axis=0))
    rows = np.concatenate([ra, np.broadcast_to(-np.eye(3), ra.shape)], axis=2)
    right = tb @ rotation.T - ta
    solution = np.linalg.lstsq(rows.reshape(-1, 6), right.ravel(), rcond=1e-6)[0]
    x[:3, 3], z[:3, 3] = solution[:3], solution[3:]
    return x, z


def _turns(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Rotation vectors from the first pose, in the base and in B's frame, (n, 3)."""
    return (
        so3_log(a[:, :3, :3] @ a[0, :3, :3].T),
        so3_log(b[:, :3, :3] @ b[0, :3, :3].T),
    )


def _carry(m: Floats, n: Floats) -> Floats:
    """Some rotation that carries unit vector m to n, shape (3, 3)."""
    axis = np.cross(m, n)
    sine, cosine = np.linalg.norm(axis), m @ n
    if sine < 1e-9:
        axis = np.linalg.svd(m[None])[2][1]
        return so3_exp(axis * (0.0 if cosine > 0 else np.pi))
    return so3_exp(axis / sine * np.arctan2(sine, cosine))


def _angle_from_positions(a: Floats, b: Floats, n: Floats, carry: Floats) -> Floats:
    """Turn about n, after ``carry``, that the positions ask for."""
    ra, ta = a[:, :3, :3], a[:, :3, 3]
    turned = b[:, :3, 3] @ carry.T
    along = np.outer(turned @ n, n)
    across, third = turned - along, turned @ hat(n).T
    # R_A t_X - t_Z - cos f across - sin f third = along - t_A.
    rows = np.concatenate(
        [
            ra,
            np.broadcast_to(-np.eye(3), ra.shape),
            -across[:, :, None],
            -third[:, :, None],
        ],
        axis=2,
    )
    right = (along - ta).ravel()
    solution = np.linalg.lstsq(rows.reshape(-1, 8), right, rcond=1e-6)[0]
    angle = np.arctan2(solution[7], solution[6])
    return np.asarray(so3_exp(angle * n) @ carry)
