"""Where spheres appear in an image, by integrals over their outlines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera.pinhole import PinholeCamera

Floats = NDArray[np.float64]

# Points on an outline; sums over a period converge exponentially, here to rounding.
_OUTLINE_POINTS = 48


def outline_centroids(camera: PinholeCamera, points: Floats, radii: Floats) -> Floats:
    """Centroids of the areas that spheres cover, (..., 2); points where r is 0.

    Tangents from the camera touch a sphere of radius r at distance d on a circle
    around P (1 - r^2 / d^2) of radius r sqrt(1 - r^2 / d^2); the circle is projected
    point by point, lens included. With the outline p(t), area and moment are the
    integrals of (p x p') / 2 and p (p x p') / 3 (Green's theorem).

    Args:
        camera: What sees them.
        points: Centres in its frame, shape (..., 3, 3), metres.
        radii: Shape (3,), metres.
    """
    centre = camera.project(points)
    if not radii.any():
        return centre
    distance = np.linalg.norm(points, axis=-1, keepdims=True)
    toward = points / distance
    across = np.cross(toward, (0.0, 1.0, 0.0))
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    up = np.cross(toward, across)
    inside = 1.0 - (radii[:, None] / distance) ** 2
    reach = (radii[:, None] * np.sqrt(inside))[..., None, :]
    angle = np.linspace(0.0, 2 * np.pi, _OUTLINE_POINTS, endpoint=False)[:, None]
    circle = (points * inside)[..., None, :] + reach * (
        np.cos(angle) * across[..., None, :] + np.sin(angle) * up[..., None, :]
    )
    turning = reach * (
        np.cos(angle) * up[..., None, :] - np.sin(angle) * across[..., None, :]
    )
    outline, by_point, _, _ = camera.project_jacobians(circle)
    # Relative to the projected centre, so that small areas keep their digits.
    outline = outline - centre[..., None, :]
    tangent = (by_point @ turning[..., None])[..., 0]
    sector = (outline[..., 0] * tangent[..., 1] - outline[..., 1] * tangent[..., 0])[
        ..., None
    ]
    moment = (sector * outline).sum(axis=-2)
    with np.errstate(invalid="ignore"):
        shift = moment / (1.5 * sector.sum(axis=-2))
    return np.where(radii[:, None] > 0, centre + shift, centre)
