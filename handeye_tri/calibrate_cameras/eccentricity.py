"""Where a sphere's outline has its centre, against where the sphere's centre is.

The cone of tangents from the camera to a sphere cuts the normalised plane in an
ellipse whose centre lies farther from the principal point than the image of the
sphere's centre; a lens then bends that ellipse.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.camera import PinholeCamera, distort_jacobians
from handeye_tri.errors import InputError

Floats = NDArray[np.float64]

# Four points of equal weight that integrate cubics over the unit disc exactly
# (Stroud, Approximate Calculation of Multiple Integrals, 1971, S2 3-1).
_DISC = 0.5 * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])


def sphere_shift(
    camera: PinholeCamera, points_in_camera: ArrayLike, radii: ArrayLike
) -> Floats:
    """Centre of a sphere's outline less the projection of its centre.

    A ray d meets the sphere of centre P = (X, Y, Z) and radius r tangentially where
    (d.P)^2 = (P.P - r^2) d.d. On the plane d = (x, y, 1) that is an ellipse with its
    centre at (X, Y) Z / (Z^2 - r^2), the semi-axis r / sqrt(Z^2 - r^2) across the
    direction of (X, Y), and sqrt(1 + (X^2 + Y^2) / (Z^2 - r^2)) times that along it.
    An affine map such as K keeps the centre, so this is exact for a pinhole. A lens
    bends the outline: its centre is then the centroid of the area inside, which
    is also where a least-squares ellipse lies, to first order in the bending. The
    centroid is integrated to fourth order in the outline's half-width (left out:
    below 1e-4 px for a radius of 15 px at f 1720 px and k1 = 0.2; without the
    integral, by mapping the ellipse's centre, it would be 0.03 px).

    Args:
        camera: The camera with its lens.
        points_in_camera: Centres of the spheres, shape (..., 3), camera frame, metres.
        radii: Radii, broadcast against shape (...), metres; 0 gives no shift.

    Returns:
        Shape (..., 2), pixels; NaN where the centre is NaN or the camera is not in
        front of the whole sphere (Z <= r).

    Raises:
        InputError: a radius is negative or not finite.
    """
    points = np.asarray(points_in_camera, dtype=float)
    radius = np.asarray(radii, dtype=float)
    if not (np.isfinite(radius) & (radius >= 0)).all():
        raise InputError(
            f"radii must be lengths in metres, 0 or more, got {radius.tolist()}"
        )
    depth = np.where(points[..., 2] > radius, points[..., 2], np.nan)
    square = (depth - radius) * (depth + radius)
    lateral = points[..., :2]
    stretch = np.sqrt(1.0 + (lateral * lateral).sum(axis=-1) / square)
    along = (_DISC @ lateral[..., None])[..., 0] / (square * (stretch + 1.0))[..., None]
    spread = _DISC + along[..., None] * lateral[..., None, :]
    half_width = radius / np.sqrt(square)
    middle = lateral * (depth / square)[..., None]
    nodes = middle[..., None, :] + half_width[..., None, None] * spread
    bent, by_point, _ = distort_jacobians(camera.lens.coefficients, nodes)
    area = (
        by_point[..., :1, 0] * by_point[..., 1:, 1]
        - by_point[..., :1, 1] * by_point[..., 1:, 0]
    )
    offset = bent - camera.lens.distort(lateral / depth[..., None])[..., None, :]
    shift = (area * offset).sum(axis=-2) / area.sum(axis=-2)
    return np.asarray(shift @ camera.intrinsics.matrix[:2, :2].T)
