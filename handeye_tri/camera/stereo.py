"""Triangulation by two or more cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.camera.pinhole import PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]

# Determinant of two rays' normal equations, twice their squared angle, below which
# they are as good as parallel (0.7e-6 rad: at a baseline of 0.25 m, 350 km away).
_PARALLEL = 1e-12
# Gauss-Newton ends at steps this short beside the point's distance from the origin.
_STEP_TOLERANCE = 1e-13


def triangulate(
    cameras: Sequence[PinholeCamera],
    world_from_camera: Sequence[SE3],
    pixels: ArrayLike,
    covariance: ArrayLike,
    iterations: int = 20,
) -> tuple[Floats, Floats]:
    """Maximum-likelihood points from two or more views.

    Starts at the point nearest to all rays, then Gauss-Newton on the whitened
    reprojection error (Hartley and Zisserman, Multiple View Geometry, Sec. 12.3).

    Args:
        cameras: m cameras.
        world_from_camera: m motions.
        pixels: Shape (m, n, 2); NaN where a camera did not see the point.
        covariance: Pixel covariances, shape (m, n, 2, 2), px^2.
        iterations: Upper limit of Gauss-Newton steps.

    Returns:
        Points in the world frame (n, 3), metres; their covariances (n, 3, 3), m^2.
        Both are NaN where fewer than two cameras saw the point, where its rays are
        parallel or meet behind a camera, and where the iteration did not settle.

    Raises:
        InputError: the shapes do not fit each other, or the covariance of a pixel
            that was seen is not positive definite.
    """
    seen_pixels = np.asarray(pixels, dtype=float)
    cov = np.asarray(covariance, dtype=float)
    m = len(cameras)
    if seen_pixels.ndim != 3 or seen_pixels.shape[0] != m or seen_pixels.shape[2] != 2:
        raise InputError(
            f"pixels must have shape ({m}, n, 2) for {m} cameras, "
            f"got {seen_pixels.shape}"
        )
    if cov.shape != (*seen_pixels.shape, 2) or len(world_from_camera) != m:
        raise InputError(
            f"covariance must have shape {(*seen_pixels.shape, 2)} and there must be "
            f"{m} motions; got {cov.shape} and {len(world_from_camera)}"
        )
    n = seen_pixels.shape[1]
    points = np.full((n, 3), np.nan)
    result_cov = np.full((n, 3, 3), np.nan)
    seen = np.isfinite(seen_pixels).all(axis=-1)
    weight = _weights(cov, seen)
    rotation = np.array([motion.rotation for motion in world_from_camera])
    centre = np.array([motion.translation for motion in world_from_camera])

    used = np.flatnonzero(seen.sum(axis=0) >= 2)
    x, crossing = _nearest_to_rays(
        cameras, rotation, centre, seen_pixels[:, used], seen[:, used]
    )
    used, x = used[crossing], x[crossing]
    if len(used) == 0:
        return points, result_cov
    settled = np.zeros(len(used), dtype=bool)
    for _ in range(iterations):
        normal = np.zeros((len(used), 3, 3))
        gradient = np.zeros((len(used), 3))
        ahead = np.ones(len(used), dtype=bool)
        for i, camera in enumerate(cameras):
            visible = seen[i, used]
            local = (x[visible] - centre[i]) @ rotation[i]
            ahead[visible] &= local[:, 2] > 0
            predicted, by_point, _, _ = camera.project_jacobians(local)
            jacobian = by_point @ rotation[i].T
            residual = seen_pixels[i, used[visible]] - predicted
            weighted = np.swapaxes(jacobian, -1, -2) @ weight[i, used[visible]]
            normal[visible] += weighted @ jacobian
            gradient[visible] += (weighted @ residual[..., None])[..., 0]
        used, x = used[ahead], x[ahead]
        normal, gradient = normal[ahead], gradient[ahead]
        step = np.linalg.solve(normal, gradient[..., None])[..., 0]
        x = x + step
        limit = _STEP_TOLERANCE * (1 + np.linalg.norm(x, axis=-1))
        settled = np.linalg.norm(step, axis=-1) < limit
        if settled.all():
            break
    points[used[settled]] = x[settled]
    result_cov[used[settled]] = np.linalg.inv(normal[settled])
    return points, result_cov


def _weights(covariance: Floats, seen: NDArray[np.bool_]) -> Floats:
    """Inverse covariances, shape (m, n, 2, 2), zero where not seen."""
    used = covariance[seen]
    determinant = used[:, 0, 0] * used[:, 1, 1] - used[:, 0, 1] * used[:, 1, 0]
    good = (determinant > 0) & (used[:, 0, 0] > 0)
    if not good.all():
        i, j = np.argwhere(seen)[np.flatnonzero(~good)[0]]
        raise InputError(
            f"the covariance of point {j} in camera {i} is not positive definite: "
            f"{covariance[i, j].tolist()} px^2"
        )
    weight = np.zeros_like(covariance)
    weight[seen] = np.linalg.inv(used)
    return weight


def _nearest_to_rays(
    cameras: Sequence[PinholeCamera],
    rotation: Floats,
    centre: Floats,
    pixels: Floats,
    seen: NDArray[np.bool_],
) -> tuple[Floats, NDArray[np.bool_]]:
    """Points nearest to their rays (n, 3), and whether those are not parallel."""
    across = np.zeros((*seen.shape, 3, 3))
    for i, camera in enumerate(cameras):
        xy = camera.normalised(pixels[i, seen[i]])
        ray = np.concatenate([xy, np.ones((len(xy), 1))], axis=-1) @ rotation[i].T
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        across[i, seen[i]] = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    normal = across.sum(axis=0)
    crossing = np.linalg.det(normal) > _PARALLEL
    normal[~crossing] = np.eye(3)
    right = np.einsum("ikab,ib->ka", across, centre)[..., None]
    return np.linalg.solve(normal, right)[..., 0], crossing


@dataclass(frozen=True, slots=True, eq=False)
class StereoRig:
    """Two cameras that stand fixed to each other.

    Attributes:
        left: First camera; its frame is the rig's frame.
        right: Second camera.
        left_from_right: Where the right camera is in the left frame.
    """

    left: PinholeCamera
    right: PinholeCamera
    left_from_right: SE3

    @property
    def baseline(self) -> float:
        """Distance of the two centres, metres."""
        return float(np.linalg.norm(self.left_from_right.translation))

    def triangulate(
        self, pixels: ArrayLike, covariance: ArrayLike
    ) -> tuple[Floats, Floats]:
        """Points in the left frame, shape (n, 3), and their covariances.

        Args:
            pixels: Shape (2, n, 2), left then right; NaN where not seen.
            covariance: Shape (2, n, 2, 2), px^2.

        Returns:
            As :func:`triangulate`, which also says what is raised.
        """
        return triangulate(
            (self.left, self.right),
            (SE3.identity(), self.left_from_right),
            pixels,
            covariance,
        )
