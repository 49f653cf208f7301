"""Where markers are, in the base, in a camera, behind its lens; with derivatives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import distort_jacobians
from handeye_tri.se3 import hat

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def marker_points(executed: Floats, markers: Floats) -> Floats:
    """Markers in the base, shape (3, c, w, 3): x, y, z of each; metres."""
    rotation = executed[..., :3, :3]
    turned = (rotation.reshape(-1, 3) @ markers.T).reshape(rotation.shape)
    return np.moveaxis(turned + executed[..., :3, 3:], -2, 0)


def in_camera(camera: Floats, points: Floats, seen: Bools) -> Floats:
    """Points (3, c, w, 3) in a camera's frame; on its axis where unseen."""
    local = camera[:3, :3].T @ points.reshape(3, -1)
    local -= (camera[:3, :3].T @ camera[:3, 3])[:, None]
    local = local.reshape(points.shape)
    if not seen.all():
        local = np.where(seen, local, np.reshape((0.0, 0.0, 1.0), (3, 1, 1, 1)))
    return local


def bent_rays(
    lens: Floats, xy: Floats, free: list[int]
) -> tuple[Floats, Floats, Floats | None]:
    """What a lens makes of rays (2, ...).

    Returns:
        Rays (2, ...); derivative by the rays (2, 2, ...), by the free coefficients
        (2, f, ...), None where there are none.
    """
    if not (free or lens.any()):
        return xy, np.eye(2).reshape(2, 2, *(1,) * (xy.ndim - 1)), None
    bent, slope, by_lens = distort_jacobians(lens, np.moveaxis(xy, 0, -1))
    return (
        np.moveaxis(bent, -1, 0),
        np.moveaxis(slope, (-2, -1), (0, 1)),
        np.moveaxis(by_lens[..., free], (-2, -1), (0, 1)),
    )


def by_unknowns(
    executed: Floats, markers: Floats, tangents: Floats, own: int, exact: bool
) -> Floats:
    """Derivative of the markers in the base by all but the cameras.

    Args:
        executed: base_from_flange, (c, w, 4, 4).
        markers: In the flange, (3, 3).
        tangents: Derivative of the flange's right tangent by l own unknowns and p
            parameters of the robot, (c, w, 6, l + p).
        own: The number l.
        exact: Whether the markers can only move together: r = 6, else 9.

    Returns:
        By own unknowns, the rig's, the robot's: shape (c, w, 3, 3, l + r + p).
    """
    rotation = executed[..., :3, :3]
    turning = hat(markers).reshape(9, 3) @ tangents[..., 3:, :]
    turning = turning.reshape(*rotation.shape, tangents.shape[-1])
    moved = rotation[..., None, :, :] @ (tangents[..., None, :3, :] - turning)
    rig = 6 if exact else 9
    result = np.zeros((*rotation.shape, tangents.shape[-1] + rig))
    result[..., :own] = moved[..., :own]
    result[..., own + rig :] = moved[..., own:]
    for k in range(3):
        if exact:
            result[..., k, :, own : own + 3] = rotation
            result[..., k, :, own + 3 : own + 6] = -rotation @ hat(markers[k])
        else:
            result[..., k, :, own + 3 * k : own + 3 * k + 3] = rotation
    return result
