"""Observed and reported positions by the parameters of a calibrated cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.hand_eye.camera_parameters import project_with_parameters
from handeye_tri.records import MARKER_LABELS, HandEyeCalibration, motion_labels
from handeye_tri.se3 import hat

Floats = NDArray[np.float64]


def by_tangent(points: Floats) -> Floats:
    """Derivative of exp(d) X by d at 0, shape (r, 3, 6), of points (r, 3)."""
    eye = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    return np.concatenate([eye, -hat(points)], axis=-1)


def markers_by_parameters(calibration: HandEyeCalibration) -> Floats:
    """Derivative of A, B, C in the flange by the labelled parameters, (3, 3, p).

    By the markers themselves where the calibration estimated them, else by the
    motion of the rigid triangle.
    """
    labels = calibration.covariance.labels
    result = np.zeros((3, 3, len(labels)))
    if set(MARKER_LABELS) <= set(labels):
        columns = [labels.index(name) for name in MARKER_LABELS]
        result[..., columns] = np.eye(9).reshape(3, 3, 9)
        return result
    columns = [labels.index(name) for name in motion_labels("flange_from_triangle")]
    frame = calibration.flange_from_triangle
    points = frame.inverse().apply(calibration.markers)
    result[..., columns] = frame.rotation @ by_tangent(points)
    return result


def observed_by_parameters(
    calibration: HandEyeCalibration,
    points: Floats,
    covariance: Floats,
    noise: Floats,
) -> Floats:
    """Derivative of triangulated points by the calibration's parameters.

    At the optimum ``J' W (pixels - predicted(x, c)) = 0``, so that
    ``dx = -(J' W J)^-1 J' W (d predicted / dc) dc``.

    Args:
        calibration: Cameras in the base.
        points: In the base, shape (r, 3), metres.
        covariance: ``(J' W J)^-1`` of each, shape (r, 3, 3).
        noise: ``W^-1`` of each camera, shape (m, r, 2, 2), px^2; NaN where unseen.

    Returns:
        Shape (r, 3, p).
    """
    labels = calibration.covariance.labels
    total = np.zeros((len(points), 3, len(labels)))
    for i, camera in enumerate(calibration.cameras):
        motion = calibration.base_from_camera[i]
        seen = np.isfinite(noise[i]).all(axis=(1, 2))
        _, by_point, by_parameters = project_with_parameters(
            camera, motion.inverse().apply(points[seen]), labels, "base"
        )
        jacobian = by_point @ motion.rotation.T
        total[seen] += jacobian.mT @ np.linalg.solve(noise[i, seen], by_parameters)
    return np.asarray(-covariance @ total)
