"""Where a single camera sees the calibrated triangle: three points, one pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
from handeye_tri.evaluate.derivatives import by_tangent, markers_by_parameters
from handeye_tri.hand_eye.camera_parameters import project_with_parameters
from handeye_tri.records import HandEyeCalibration
from handeye_tri.se3 import se3_exp

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Indices = NDArray[np.intp]

# Gauss-Newton doubles its digits; the shift of a sphere's outline, held in a step,
# adds three digits a step.
_ITERATIONS = 20
# A pose has settled when it moves by less (m and rad).
_TOLERANCE = 1e-12
# Where the camera stands on the cylinder over the triangle's circumcircle, three points
# fix no pose; where the six equations (scaled; 20 to 40 usually) are worse conditioned
# than this, it stands too near for an uncertainty to first order.
_MAX_CONDITION = 300.0


@dataclass(frozen=True, slots=True, eq=False)
class SeenMarkers:
    """Markers as the camera sees them, at the s stations where that fixes a pose.

    Attributes:
        views: Which of the given views, shape (s,).
        points: In the base, shape (s, 3, 3), metres.
        by_parameters: Their derivative by the calibration's parameters,
            (s, 3, 3, p).
        by_pixels: And by the view's six coordinates, whitened, (s, 3, 3, 6).
    """

    views: NDArray[np.intp]
    points: Floats
    by_parameters: Floats
    by_pixels: Floats


def seen_by_one(
    calibration: HandEyeCalibration,
    pixels: Floats,
    noise: Floats,
    radii: Floats,
    reported: Floats,
    mounts: Indices,
) -> SeenMarkers:
    """Place the calibrated triangle by the one camera of a cell.

    Three points are seen from up to four places (Grunert 1841; Haralick et al. 1994,
    doi:10.1007/BF02028352): the robot's reported pose only says which of them is
    meant, and the result is that of the pixels alone.

    Args:
        calibration: A cell of one camera.
        pixels: Shape (n, 3, 2); NaN where unseen.
        noise: Their covariances, shape (n, 3, 2, 2), px^2.
        radii: Of the markers, shape (3,), metres.
        reported: base_from_flange, shape (n, 4, 4), metres.
        mounts: Which mount holds the triangle in each view, shape (n,).
    """
    views = np.flatnonzero(np.isfinite(pixels).all(axis=(1, 2)))
    seen, poses = pixels[views], np.array(reported[views], dtype=float)
    held = mounts[views]
    for _ in range(_ITERATIONS):
        predicted, by_pose, _ = _predicted(calibration, poses, radii, held)
        residual = (seen - predicted).reshape(-1, 6, 1)
        fixed = np.isfinite(residual).all(axis=(1, 2)) & _fixed(by_pose)
        views, seen = views[fixed], seen[fixed]
        poses, held = poses[fixed], held[fixed]
        step = np.linalg.solve(by_pose[fixed], residual[fixed])[..., 0]
        poses = poses @ se3_exp(step)
        settled = np.abs(step).max(axis=1, initial=0.0) < _TOLERANCE
        if settled.all():
            break
    views, poses, held = views[settled], poses[settled], held[settled]
    by_parameters, by_pixels = markers_by_view(calibration, poses, held)
    root = np.zeros((len(views), 6, 6))
    for k in range(3):
        block = slice(2 * k, 2 * k + 2)
        root[:, block, block] = np.linalg.cholesky(noise[views, k])
    markers = calibration.markers_at(held)
    points = markers @ poses[:, :3, :3].mT + poses[:, None, :3, 3]
    return SeenMarkers(views, points, by_parameters, by_pixels @ root[:, None])


def markers_by_view(
    calibration: HandEyeCalibration, base_from_flange: Floats, mounts: Indices
) -> tuple[Floats, Floats]:
    """How markers move in the base that the one camera's fixed view places.

    With six coordinates for six of a pose T, ``dT = J^-1 (dpixels - dpredicted)``.

    Args:
        calibration: A cell of one camera.
        base_from_flange: Where the view places the flange, shape (n, 4, 4), metres.
        mounts: Which mount holds the triangle there, shape (n,).

    Returns:
        By the calibration's parameters (n, 3, 3, p), by the pixels (n, 3, 3, 6).
    """
    _, by_pose, by_parameters = _predicted(
        calibration, base_from_flange, np.zeros(3), mounts
    )
    rotation = base_from_flange[:, None, :3, :3]
    moved = rotation @ by_tangent(calibration.markers_at(mounts))
    by_pixels = moved @ np.linalg.inv(by_pose)[:, None]
    by_markers = rotation @ markers_by_parameters(calibration)[mounts]
    return by_markers - by_pixels @ by_parameters[:, None], by_pixels


def fixed_by_view(
    calibration: HandEyeCalibration, poses: Floats, mounts: Indices
) -> Bools:
    """Whether a view of all three markers from poses (n, 4, 4) fixes the pose, (n,).

    All must lie in the image, and the camera not near the cylinder over the triangle's
    circumcircle.
    """
    predicted, by_pose, _ = _predicted(calibration, poses, np.zeros(3), mounts)
    limit = np.array(calibration.cameras[0].image_size, dtype=float) - 0.5
    inside = ((predicted > -0.5) & (predicted < limit)).all(axis=(1, 2))
    return np.asarray(inside & _fixed(by_pose))


def _fixed(by_pose: Floats) -> Bools:
    """Whether six equations (n, 6, 6) are well enough conditioned, (n,)."""
    usable = np.asarray(np.isfinite(by_pose).all(axis=(1, 2)))
    scale = np.linalg.norm(by_pose, axis=1, keepdims=True)
    scaled = np.where(usable[:, None, None], by_pose / scale, np.eye(6))
    return np.asarray(usable & (np.linalg.cond(scaled) < _MAX_CONDITION))


def _predicted(
    calibration: HandEyeCalibration, poses: Floats, radii: Floats, mounts: Indices
) -> tuple[Floats, Floats, Floats]:
    """Pixels (n, 3, 2), by the pose's tangent (n, 6, 6), by parameters (n, 6, p)."""
    camera, place = calibration.cameras[0], calibration.base_from_camera[0]
    markers = calibration.markers_at(mounts)
    local = place.inverse().apply(markers @ poses[:, :3, :3].mT + poses[:, None, :3, 3])
    pixels, by_point, by_camera = project_with_parameters(
        camera, local, calibration.covariance.labels, "base"
    )
    by_marker = by_point @ (place.rotation.T @ poses[:, None, :3, :3])
    by_parameters = by_camera + by_marker @ markers_by_parameters(calibration)[mounts]
    n, p = len(poses), len(calibration.covariance.labels)
    return (
        pixels + sphere_shift(camera, local, radii),
        (by_marker @ by_tangent(markers)).reshape(n, 6, 6),
        by_parameters.reshape(n, 6, p),
    )
