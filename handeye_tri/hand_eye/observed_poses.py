"""Where the cameras see the triangle: one maximum-likelihood pose per station."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
from handeye_tri.camera import triangulate
from handeye_tri.errors import ConvergenceError, InputError
from handeye_tri.hand_eye.camera_parameters import project_with_parameters
from handeye_tri.records import CameraCalibration
from handeye_tri.se3 import hat, nearest_rotation, se3_exp
from handeye_tri.triangle import TriangleRig

Floats = NDArray[np.float64]

# Gauss-Newton needs 4 or 5; where the cameras' errors leave residuals of many sigmas
# it converges linearly, by a factor of 2 to 5 a step.
_MAX_ITERATIONS = 60
# A view has converged when no step exceeds this many standard deviations.
_TOLERANCE = 1e-6
# A scaled normal matrix whose least eigenvalue is smaller is singular but for rounding.
_MIN_EIGENVALUE = 1e-13
# The sphere shift is 0.1 px at most and depends on the depth alone, which the raw
# pixels give to 1e-3: the second correction changes 1e-4 px, a third nothing.
_CORRECTIONS = 2


@dataclass(frozen=True, slots=True, eq=False)
class ObservedPoses:
    """The triangle in the reference camera's frame.

    Attributes:
        views: Which of the given views had all three markers in two cameras (or in
            the only one), shape (s,).
        reference_from_triangle: Shape (s, 4, 4), metres.
        covariance: Of the right tangents, from the pixels alone, (s, 6, 6).
        by_cameras: Derivative of the right tangents by the calibration's parameters
            in the order of its covariance's labels, shape (s, 6, p).
        chi2: Sum of squared whitened pixel residuals of each view, shape (s,).
    """

    views: NDArray[np.intp]
    reference_from_triangle: Floats
    covariance: Floats
    by_cameras: Floats
    chi2: Floats


def triangle_poses(
    triangle: TriangleRig,
    cameras: CameraCalibration,
    pixels: ArrayLike,
    covariance: ArrayLike,
    marker_radii: ArrayLike = (0.0, 0.0, 0.0),
    start: ArrayLike | None = None,
) -> ObservedPoses:
    """Pose of the known triangle at every view, from all cameras at once.

    The start is the rigid Procrustes fit of the triangle to its triangulated points
    (Zhao, Liu and Zhang 2008, Sec. III-D); Gauss-Newton on the whitened pixels
    follows. Six numbers from twelve pixel coordinates of two cameras. The three
    points of a single camera leave several poses (P3P): ``start`` says which is meant.

    The derivative by the cameras' parameters c comes from the optimum's condition
    ``J' W (pixels - predicted(T, c)) = 0``: ``dT = -(J' W J)^-1 J' W (d predicted /
    dc) dc``, up to terms in the residuals (implicit function theorem).

    Args:
        triangle: The rig.
        cameras: The m calibrated cameras.
        pixels: Shape (m, n, 3, 2); NaN where unseen.
        covariance: Shape (m, n, 3, 2, 2), px^2.
        marker_radii: Shape (3,), metres; the shift of a sphere's outline against
            its centre is taken off the pixels.
        start: With a single camera: reference_from_triangle roughly, shape (n, 4, 4),
            NaN where it is not known and the view is left out. Left out, too, are views
            whose pose does not settle: where the camera stands near the cylinder over
            the triangle's circumcircle, two poses merge and noise may leave none.

    Raises:
        InputError: the shapes do not fit, no view has all three markers in two
            cameras, or a single camera has no start.
        ConvergenceError: a view of several cameras did not converge, or no view did.
    """
    observed = np.array(pixels, dtype=float)
    m = len(cameras.cameras)
    if observed.ndim != 4 or observed.shape[0] != m or observed.shape[2:] != (3, 2):
        raise InputError(
            f"pixels must have shape ({m}, n, 3, 2) for {m} cameras, "
            f"got {observed.shape}"
        )
    noise = np.asarray(covariance, dtype=float)
    if noise.shape != (*observed.shape, 2):
        raise InputError(
            f"covariance must have shape {(*observed.shape, 2)}, got {noise.shape}"
        )
    seen = np.isfinite(observed).all(axis=-1)
    usable = np.asarray((seen.sum(axis=0) >= min(2, m)).all(axis=1))
    if m == 1:
        if start is None:
            raise InputError(
                "the three points of a single camera leave several poses of the "
                "triangle; give start, which says roughly where it is"
            )
        rough = np.asarray(start, dtype=float)
        usable &= np.isfinite(rough).all(axis=(1, 2))
    views = np.flatnonzero(usable)
    if len(views) == 0:
        raise InputError(
            f"none of the {observed.shape[1]} views shows all three markers to two "
            "cameras (or to the only one, at a station whose pose is known roughly)"
        )
    observed, seen = observed[:, views], seen[:, views]
    weight = np.zeros((m, len(views), 3, 2, 2))
    weight[seen] = np.linalg.inv(noise[:, views][seen])
    radii = np.asarray(marker_radii, dtype=float)
    poses = (
        rough[views]
        if m == 1
        else _procrustes(triangle, cameras, observed, noise[:, views])
    )
    for correction in range(1 + (_CORRECTIONS if radii.any() else 0)):
        final = observed.copy()
        for i, camera in enumerate(cameras.cameras if correction else ()):
            local = _camera_points(triangle, cameras, poses, i)
            final[i] -= sphere_shift(camera, local, radii)
        poses, settled = _refine(triangle, cameras, poses, final, weight, views)
        views, poses = views[settled], poses[settled]
        observed, final, weight = (x[:, settled] for x in (observed, final, weight))
    normal, _, by_cameras, chi2 = _linearise(triangle, cameras, poses, final, weight)
    inverse = _inverse(normal)
    return ObservedPoses(views, poses, inverse, -inverse @ by_cameras, chi2)


def _procrustes(
    triangle: TriangleRig, cameras: CameraCalibration, pixels: Floats, noise: Floats
) -> Floats:
    """Fit the triangle to its triangulated points, shape (s, 4, 4)."""
    m, s = pixels.shape[:2]
    points, _ = triangulate(
        cameras.cameras,
        cameras.reference_from_camera,
        pixels.reshape(m, 3 * s, 2),
        noise.reshape(m, 3 * s, 2, 2),
    )
    points = points.reshape(s, 3, 3)
    model = triangle.points
    centre = points.mean(axis=1)
    moment = np.swapaxes(points - centre[:, None], 1, 2) @ (model - model.mean(axis=0))
    poses = np.tile(np.eye(4), (s, 1, 1))
    poses[:, :3, :3] = nearest_rotation(moment)
    poses[:, :3, 3] = centre - poses[:, :3, :3] @ model.mean(axis=0)
    return poses


def _camera_points(
    triangle: TriangleRig, cameras: CameraCalibration, poses: Floats, i: int
) -> Floats:
    """The markers in the frame of camera i, shape (s, 3, 3), metres."""
    points = (
        triangle.points @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    )
    return cameras.reference_from_camera[i].inverse().apply(points)


def _linearise(
    triangle: TriangleRig,
    cameras: CameraCalibration,
    poses: Floats,
    pixels: Floats,
    weight: Floats,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Normal matrices (s, 6, 6), J'Wr (s, 6), J'W d/dc (s, 6, p) and chi2 (s,)."""
    s, labels = len(poses), cameras.covariance.labels
    normal, gradient = np.zeros((s, 6, 6)), np.zeros((s, 6))
    by_cameras, chi2 = np.zeros((s, 6, len(labels))), np.zeros(s)
    # A marker X moves by R (d_t - X x d_r) under the pose's right tangent.
    by_tangent = np.concatenate(
        [np.broadcast_to(np.eye(3), (3, 3, 3)), -hat(triangle.points)], axis=-1
    )
    for i, camera in enumerate(cameras.cameras):
        local = _camera_points(triangle, cameras, poses, i)
        predicted, by_point, by_parameters = project_with_parameters(
            camera, local, labels, "reference"
        )
        rotation = cameras.reference_from_camera[i].rotation.T @ poses[:, :3, :3]
        jacobian = by_point @ rotation[:, None] @ by_tangent
        residual = np.where(np.isfinite(pixels[i]), pixels[i] - predicted, 0.0)
        weighted = np.swapaxes(jacobian, -1, -2) @ weight[i]
        normal += (weighted @ jacobian).sum(axis=1)
        gradient += (weighted @ residual[..., None])[..., 0].sum(axis=1)
        by_cameras += (weighted @ by_parameters).sum(axis=1)
        chi2 += np.einsum("ska,skab,skb->s", residual, weight[i], residual)
    return normal, gradient, by_cameras, chi2


def _refine(
    triangle: TriangleRig,
    cameras: CameraCalibration,
    poses: Floats,
    pixels: Floats,
    weight: Floats,
    views: NDArray[np.intp],
) -> tuple[Floats, NDArray[np.bool_]]:
    """Gauss-Newton on all views at once.

    Returns:
        Poses, shape (s, 4, 4); which of them settled, which those of several cameras
        must, shape (s,).
    """
    alone = len(cameras.cameras) == 1
    lost = np.zeros(len(poses), dtype=bool)
    for _ in range(_MAX_ITERATIONS):
        normal, gradient, _, _ = _linearise(triangle, cameras, poses, pixels, weight)
        if alone:
            lost |= _singular(normal)
            normal[lost], gradient[lost] = np.eye(6), 0.0
        covariance = _inverse(normal)
        step = (covariance @ gradient[..., None])[..., 0]
        poses = poses @ se3_exp(step)
        std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        largest = np.where(lost, np.inf, np.abs(step / std).max(axis=1))
        settled = np.asarray(largest < _TOLERANCE)
        if (settled | lost).all():
            break
    if alone:
        settled &= (_camera_points(triangle, cameras, poses, 0)[..., 2] > 0).all(axis=1)
    if settled.all() or (alone and settled.any()):
        return poses, settled
    worst = int(np.argmax(np.where(settled, -np.inf, largest)))
    raise ConvergenceError(
        f"the triangle's pose at view {views[worst]} did not settle in "
        f"{_MAX_ITERATIONS} iterations (last step {largest[worst]:.2g} sigmas); its "
        "pixels do not fit the triangle, are A, B and C mixed up there?"
    )


def _singular(normal: Floats) -> NDArray[np.bool_]:
    """Normal matrices that do not determine a pose, (s, 6, 6) to (s,)."""
    diagonal = np.diagonal(normal, axis1=1, axis2=2)
    fine = np.asarray(np.isfinite(normal).all(axis=(1, 2)) & (diagonal > 0).all(axis=1))
    scale = 1.0 / np.sqrt(diagonal[fine])
    scaled = normal[fine] * scale[:, :, None] * scale[:, None, :]
    fine[fine] = np.linalg.eigvalsh(scaled)[:, 0] > _MIN_EIGENVALUE
    return ~fine


def _inverse(normal: Floats) -> Floats:
    """Inverses of normal matrices in mixed units (m, rad), shape (s, 6, 6)."""
    scale = 1.0 / np.sqrt(np.diagonal(normal, axis1=1, axis2=2))
    scale = scale[:, :, None] * scale[:, None, :]
    return np.asarray(scale * np.linalg.inv(normal * scale))
