"""Any flat target before one camera: its poses, and hand-eye that models both noises.

A target's pose from one view is known well across the sight and badly along and about
it; its covariance says so. Weighing it against the robot's noise is the adjustment of
all pixels and all robot poses together, to first order in the corrections, since every
station's pixels speak of that station's pose alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.camera import PinholeCamera
from handeye_tri.errors import ConvergenceError, InputError
from handeye_tri.hand_eye.absolute import solve_axzb
from handeye_tri.hand_eye.pose_noise import score_step
from handeye_tri.hand_eye.refine import Refinement, refine_axzb
from handeye_tri.records import Mounting
from handeye_tri.se3 import (
    SE3,
    hat,
    nearest_rotation,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    so3_exp,
)

Floats = NDArray[np.float64]

_LEAST_POINTS = 4
_MAX_ITERATIONS = 50
# A view has settled when no step exceeds this many standard deviations.
_TOLERANCE = 1e-6
_NOISE_ITERATIONS = 60
_NOISE_SETTLED = 1e-2
# Where the robot's noise starts: 1 mm and 0.1 degrees.
_START_LOG = 2 * np.log(np.array([1e-3, np.radians(0.1), 1.0]))


@dataclass(frozen=True, slots=True, eq=False)
class TargetViews:
    """A flat target in one camera's views.

    Attributes:
        camera: The calibrated camera.
        points: Of the target, shape (p, 3), metres, all z = 0.
        pixels: Shape (n, p, 2); NaN where unseen.
        camera_from_target: Fitted poses, shape (n, 4, 4).
        covariance: Of their right tangents, from the pixels alone, (n, 6, 6).
        sigma_px: Standard deviation of a pixel coordinate, stated or pooled.
    """

    camera: PinholeCamera
    points: Floats
    pixels: Floats
    camera_from_target: Floats
    covariance: Floats
    sigma_px: float

    def residuals(self, camera_from_target: Floats) -> Floats:
        """Root mean square distance of pixels and projection, shape (n,), px.

        Args:
            camera_from_target: Poses to project with, shape (n, 4, 4).
        """
        local = _local(camera_from_target, self.points)
        off = self.camera.project(local) - self.pixels
        return np.asarray(np.sqrt(np.nanmean((off**2).sum(axis=2), axis=1)))


@dataclass(frozen=True, slots=True, eq=False)
class TargetAdjustment:
    """X and Z from a target's views and robot poses, both with their noise.

    Attributes:
        x: flange_from_camera, or flange_from_target.
        z: base_from_target, or base_from_camera.
        covariance: Of the right tangents of X and Z, shape (12, 12), m and rad.
        robot_translation: The robot's noise per axis, metres.
        robot_rotation: The robot's noise per axis, radians.
        pixel_factor: Estimated over stated (or pooled) standard deviation of pixels.
        robot_corrections: Right tangents on the reported poses, shape (n, 6).
        camera_from_target: Adjusted poses, shape (n, 4, 4).
        predicted: camera_from_target by the robot alone, shape (n, 4, 4).
    """

    x: SE3
    z: SE3
    covariance: Floats
    robot_translation: float
    robot_rotation: float
    pixel_factor: float
    robot_corrections: Floats
    camera_from_target: Floats
    predicted: Floats


def target_views(
    camera: PinholeCamera,
    points: ArrayLike,
    pixels: ArrayLike,
    sigma_px: float | None = None,
) -> TargetViews:
    """Maximum-likelihood pose of a flat target in each view.

    Starts from the plane's homography (Zhang 2000, doi:10.1109/34.888718, Sec. 3.1) and
    from the pose whose normal is mirrored at the line of sight, which fits nearly as
    well (Schweighofer and Pinz 2006, doi:10.1109/TPAMI.2006.252); the better one stays.

    Args:
        camera: The calibrated camera.
        points: Shape (p, 3), metres, all z = 0, p >= 4, not on a line.
        pixels: Shape (n, p, 2); NaN where unseen.
        sigma_px: Of a pixel coordinate; None pools it from the residuals.

    Raises:
        InputError: shapes do not fit, the target is not flat, or a view shows fewer
            than four points.
        ConvergenceError: a view did not settle.
    """
    target = np.array(points, dtype=float)
    observed = np.array(pixels, dtype=float)
    if target.ndim != 2 or target.shape[1] != 3 or len(target) < _LEAST_POINTS:
        raise InputError(f"points must have shape (p, 3), p >= 4, got {target.shape}")
    if np.abs(target[:, 2]).max() > 0:
        raise InputError(
            "points must all have z = 0 (a flat target), the largest is "
            f"{np.abs(target[:, 2]).max():g} m"
        )
    if observed.ndim != 3 or observed.shape[1:] != (len(target), 2):
        raise InputError(
            f"pixels must have shape (n, {len(target)}, 2), got {observed.shape}"
        )
    seen = np.isfinite(observed).all(axis=2)
    few = seen.sum(axis=1) < _LEAST_POINTS
    if few.any():
        raise InputError(
            f"view {int(np.argmax(few))} shows {int(seen[np.argmax(few)].sum())} of "
            f"{len(target)} points; at least {_LEAST_POINTS} are needed: drop it"
        )
    start = _from_homographies(camera, target, observed, seen)
    candidates = [
        _refine(camera, target, observed, seen, poses)
        for poses in (start, _mirrored(start, target))
    ]
    better = candidates[1][2] < candidates[0][2]
    poses, normal, squares = (
        np.where(better.reshape(-1, *(1,) * (one.ndim - 1)), other, one)
        for one, other in zip(*candidates, strict=True)
    )
    if not np.isfinite(squares).all():
        raise ConvergenceError(
            f"the target's pose in view {int(np.argmin(np.isfinite(squares)))} did not "
            "settle; are its points in order, and is the camera the right one?"
        )
    if sigma_px is None:
        freedom = 2 * seen.sum() - 6 * len(observed)
        sigma_px = float(np.sqrt(squares.sum() / max(freedom, 1)))
    return TargetViews(
        camera, target, observed, poses, sigma_px**2 * _inverse(normal), sigma_px
    )


def adjust_target_views(
    views: TargetViews,
    base_from_flange: ArrayLike,
    mounting: Mounting,
    robot_noise: tuple[float, float] | None = None,
) -> TargetAdjustment:
    """Hand-eye and robot-world from views and robot poses, both noises modelled.

    Args:
        views: The target's views.
        base_from_flange: The robot's poses, shape (n, 4, 4), metres.
        mounting: "eye_in_hand" or "eye_to_hand".
        robot_noise: Stated, metres and radians per axis; None estimates it together
            with a factor on the pixels' noise by restricted maximum likelihood.

    Raises:
        InputError: counts differ or a pose is none.
        DegenerateMotionError: the poses do not determine the motions.
        ConvergenceError: the fit did not settle.
    """
    a = np.array(base_from_flange, dtype=float)
    camera = views.camera_from_target
    eye_in_hand = mounting == "eye_in_hand"
    if eye_in_hand:
        # (C exp(d))^-1 = C^-1 exp(-Ad(C) d).
        b, carry = se3_inverse(camera), -se3_adjoint(camera)
    else:
        b, carry = camera, np.tile(np.eye(6), (len(camera), 1, 1))
    covariance = carry @ views.covariance @ np.swapaxes(carry, 1, 2)
    x, z = solve_axzb(a, b)
    logs = np.array(_START_LOG)
    if robot_noise is not None:
        logs[:2] = 2 * np.log(robot_noise)
    last, share = np.zeros(3), 1.0
    for _ in range(_NOISE_ITERATIONS):
        found = _fit(a, b, x, z, logs, covariance)
        if robot_noise is not None:
            break
        x, z = found.x, found.z
        step = _noise_step(found, logs, covariance)
        share = max(0.5 * share, 0.1) if step @ last < 0 else min(1.5 * share, 1.0)
        last = step
        logs = logs + share * step
        if np.abs(share * step).max() < _NOISE_SETTLED:
            break
    # What the residual says of each side's error: Cov(side) J' W e.
    adjoint = se3_adjoint(se3_inverse(found.x.matrix))
    of_robot = np.diag(np.repeat(np.exp(logs[:2]), 3))
    pulled = np.einsum("nij,nj->ni", found.precision, found.residuals)
    robot = pulled @ adjoint @ of_robot
    of_b = np.einsum("nij,nj->ni", np.exp(logs[2]) * covariance, pulled)
    adjusted = b @ se3_exp(-of_b)
    predicted = se3_inverse(found.z.matrix) @ a @ found.x.matrix
    if eye_in_hand:
        adjusted, predicted = se3_inverse(adjusted), se3_inverse(predicted)
    sigma = np.exp(0.5 * logs)
    return TargetAdjustment(
        found.x,
        found.z,
        found.covariance,
        float(sigma[0]),
        float(sigma[1]),
        float(sigma[2]),
        robot,
        adjusted,
        predicted,
    )


def _fit(
    a: Floats, b: Floats, x: SE3, z: SE3, logs: Floats, covariance: Floats
) -> Refinement:
    of_robot = np.diag(np.repeat(np.exp(logs[:2]), 3))
    return refine_axzb(a, b, (x,), z, of_robot, np.exp(logs[2]) * covariance)


def _noise_step(found: Refinement, logs: Floats, covariance: Floats) -> Floats:
    """Fisher scoring of the robot's two variances and the factor on the pixels'."""
    adjoint = se3_adjoint(se3_inverse(found.x.matrix))
    shapes = np.empty((3, *covariance.shape))
    for k, columns in enumerate((adjoint[:, :3], adjoint[:, 3:])):
        shapes[k] = columns @ columns.T
    shapes[2] = covariance
    e, by = found.residuals, found.gradient
    taken = by @ found.covariance @ np.swapaxes(by, 1, 2)
    squares = e[:, :, None] * e[:, None, :] + taken
    return score_step(logs, _START_LOG, shapes, found.precision, squares)


def _local(poses: Floats, points: Floats) -> Floats:
    """Points in the camera frame, shape (n, p, 3)."""
    return np.asarray(
        points @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    )


def _from_homographies(
    camera: PinholeCamera, points: Floats, pixels: Floats, seen: NDArray[np.bool_]
) -> Floats:
    """Poses from each view's linear homography, shape (n, 4, 4)."""
    centre, size = points[:, :2].mean(axis=0), points[:, :2].std()
    plane = np.column_stack([(points[:, :2] - centre) / size, np.ones(len(points))])
    poses = np.tile(np.eye(4), (len(pixels), 1, 1))
    for pose, image, valid in zip(poses, pixels, seen, strict=True):
        ray = camera.normalised(image[valid])
        rows = np.zeros((2 * len(ray), 9))
        rows[::2, :3] = rows[1::2, 3:6] = plane[valid]
        rows[::2, 6:] = -ray[:, :1] * plane[valid]
        rows[1::2, 6:] = -ray[:, 1:] * plane[valid]
        h = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3)
        # The target's centre is in front of the camera.
        h = h * np.sign(h[2, 2])
        lengths = np.linalg.norm(h[:, :2], axis=0)
        first, second = h[:, 0] / lengths[0], h[:, 1] / lengths[1]
        rotation = nearest_rotation(
            np.column_stack([first, second, np.cross(first, second)])
        )
        pose[:3, :3] = rotation
        pose[:3, 3] = h[:, 2] * size / lengths.mean()
        pose[:3, 3] -= rotation[:, :2] @ centre
    return poses


def _mirrored(poses: Floats, points: Floats) -> Floats:
    """Poses with their normals mirrored at the line of sight to the centre."""
    centre = points.mean(axis=0)
    sight = poses[:, :3, :3] @ centre + poses[:, :3, 3]
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    normal = poses[:, :3, 2]
    # Towards the camera or away from it, so that the turn stays below 180 degrees.
    along = (normal * sight).sum(axis=1, keepdims=True)
    axis = np.cross(normal, sight)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, np.abs(along)) * np.sign(along)
    turn = so3_exp(angle * axis / np.maximum(sine, 1e-12))
    result = np.array(poses)
    result[:, :3, :3] = turn @ poses[:, :3, :3]
    moved = poses[:, :3, :3] @ centre - result[:, :3, :3] @ centre
    result[:, :3, 3] += moved
    return result


def _refine(
    camera: PinholeCamera,
    points: Floats,
    pixels: Floats,
    seen: NDArray[np.bool_],
    poses: Floats,
) -> tuple[Floats, Floats, Floats]:
    """Gauss-Newton on all views: poses, J'J, and squares, infinite where it failed."""
    observed = np.where(seen[..., None], pixels, 0.0)
    last = np.full(len(poses), np.inf)
    for _ in range(_MAX_ITERATIONS):
        local = _local(poses, points)
        ahead = np.maximum(local[..., 2:], 1e-6)
        local = np.concatenate([local[..., :2], ahead], axis=2)
        projected, by_point, _, _ = camera.project_jacobians(local)
        off = (projected - observed) * seen[..., None]
        # p = R exp(d_r) q + R d_t: dp = R (d_t - q x d_r).
        by_tangent = np.concatenate(
            [np.broadcast_to(np.eye(3), (len(points), 3, 3)), -hat(points)], axis=2
        )
        jacobian = by_point @ poses[:, None, :3, :3] @ by_tangent
        jacobian = jacobian * seen[..., None, None]
        normal = np.einsum("npab,npac->nbc", jacobian, jacobian)
        gradient = np.einsum("npab,npa->nb", jacobian, off)
        squares = (off**2).sum(axis=(1, 2))
        inverse = _inverse(normal)
        step = -np.einsum("nbc,nc->nb", inverse, gradient)
        std = np.sqrt(np.diagonal(inverse, axis1=1, axis2=2))
        sigma = np.sqrt(np.maximum(squares / (2 * seen.sum(axis=1)), 1e-20))
        last = np.abs(step / (std * sigma[:, None])).max(axis=1)
        # Far from the optimum a full step can leave the view.
        turned = np.linalg.norm(step[:, 3:], axis=1, keepdims=True)
        poses = poses @ se3_exp(step * np.minimum(1.0, 0.3 / np.maximum(turned, 0.3)))
        if last.max() < _TOLERANCE:
            break
    failed = (last > 1e-2) | (_local(poses, points)[..., 2] <= 0).any(axis=1)
    return poses, normal, np.where(failed, np.inf, squares)


def _inverse(normal: Floats) -> Floats:
    """Inverses of normal matrices in mixed units, shape (n, 6, 6)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-300))
    scale = scale[:, :, None] * scale[:, None, :]
    return np.asarray(scale * np.linalg.pinv(normal * scale, hermitian=True))
