"""Where the triangle is, once K is known (paper, Sec. III-D).

Zhao, Liu and Zhang 2008, doi:10.1109/TIP.2008.2005562.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.homography import Homographies
from handeye_tri.calibrate_cameras.special_motion import homogeneous
from handeye_tri.se3 import nearest_rotation
from handeye_tri.triangle import TriangleRig

Floats = NDArray[np.float64]


def poses_from_depths(
    k: Floats, images: Floats, depths: Floats, triangle: TriangleRig
) -> Floats:
    """Triangle poses from depths that are known up to a factor per view.

    X = z K^-1 m for A, B, C; the factor follows from the triangle's size and from the
    triangle being in front of the camera; then the rigid motion that fits best
    (orthogonal Procrustes; the columns r1, r2 of a homography are not orthonormal).

    Args:
        k: Shape (3, 3), in the unit of the images.
        images: Homogeneous images of A, B, C, shape (n, 3, 3).
        depths: Shape (n, 3), up to a factor per row, of one sign in each row.
        triangle: The rig.

    Returns:
        camera_from_triangle, shape (n, 4, 4), metres.
    """
    local = (depths[..., None] * images) @ np.linalg.inv(k).T
    local *= np.sign(local[..., 2].sum(axis=1))[:, None, None]
    centre = local.mean(axis=1)
    spread = local - centre[:, None]
    points = triangle.points
    middle = points.mean(axis=0)
    wanted = points - middle
    scale = np.sqrt((wanted**2).sum() / (spread**2).sum(axis=(1, 2)))
    rotation = nearest_rotation(np.swapaxes(spread, -1, -2) @ wanted)
    poses = np.zeros((len(local), 4, 4))
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = scale[:, None] * centre - rotation @ middle
    poses[:, 3, 3] = 1.0
    return poses


def poses_from_homographies(
    k: Floats, homographies: Homographies, triangle: TriangleRig
) -> Floats:
    """Triangle poses before each half-turn, shape (n, 4, 4), metres.

    Args:
        k: Shape (3, 3), pixels.
        homographies: One per half-turn; they give image and depth of A, B, C.
        triangle: The rig.
    """
    points = (triangle.points[:, :2] - homographies.origin) / homographies.size
    mapped = homogeneous(points) @ np.swapaxes(homographies.matrix, -1, -2)
    depths = mapped[..., 2]
    images = (mapped / depths[..., None]) @ homographies.image.matrix.T
    return poses_from_depths(k, images, depths, triangle)
