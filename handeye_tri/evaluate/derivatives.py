"""Observed and reported positions by the parameters of a calibrated cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.hand_eye.camera_parameters import project_with_parameters
from handeye_tri.records import (
    HandEyeCalibration,
    marker_labels,
    motion_labels,
    triangle_name,
)
from handeye_tri.se3 import hat

Floats = NDArray[np.float64]


def by_tangent(points: Floats) -> Floats:
    """Derivative of exp(d) X by d at 0, shape (..., 3, 6), of points (..., 3)."""
    eye = np.broadcast_to(np.eye(3), (*points.shape, 3))
    return np.concatenate([eye, -hat(points)], axis=-1)


def rig_labels(calibration: HandEyeCalibration, mount: int) -> tuple[str, ...]:
    """Labels of the parameters that place the markers of a mount, from 0.

    The markers themselves where the calibration estimated them, else the motion of the
    rigid triangle.
    """
    free = marker_labels(mount)
    if set(free) <= set(calibration.covariance.labels):
        return free
    return motion_labels(triangle_name(mount))


def markers_by_parameters(calibration: HandEyeCalibration) -> Floats:
    """Derivative of A, B, C in the flange by the labelled parameters.

    Returns:
        Shape (k, 3, 3, p) for k mounts; see :func:`rig_labels`.
    """
    labels = calibration.covariance.labels
    result = np.zeros((len(calibration.mounts), 3, 3, len(labels)))
    for number, mount in enumerate(calibration.mounts):
        names = rig_labels(calibration, number)
        columns = [labels.index(name) for name in names]
        if names == marker_labels(number):
            result[number][..., columns] = np.eye(9).reshape(3, 3, 9)
        else:
            frame = mount.flange_from_triangle
            points = frame.inverse().apply(mount.markers)
            result[number][..., columns] = frame.rotation @ by_tangent(points)
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
