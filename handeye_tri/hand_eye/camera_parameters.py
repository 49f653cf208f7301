"""Pixels by the labelled parameters of calibrated cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import INTRINSIC_NAMES, PinholeCamera
from handeye_tri.records import motion_labels
from handeye_tri.se3 import hat

Floats = NDArray[np.float64]


def project_with_parameters(
    camera: PinholeCamera, points: Floats, labels: Sequence[str], frame: str
) -> tuple[Floats, Floats, Floats]:
    """Project points and differentiate by whatever a covariance is about.

    Args:
        camera: The camera.
        points: Shape (..., 3), camera frame, metres, z > 0.
        labels: Labels of a covariance; "<camera>.fx", "<camera>.k1" and
            "<frame>_from_<camera>.x" and their like get derivatives, all others zero.
        frame: The frame in which the points stand still when the camera moves.

    Returns:
        Pixels (..., 2); derivative by the points in the camera frame (..., 2, 3);
        by the p labelled parameters (..., 2, p), motions by their right tangents.
    """
    pixels, by_point, by_intrinsics, by_lens = camera.project_jacobians(points)
    # A point p stays in the frame: p = (F exp(d))^-1 q moves by -d_t + p x d_r.
    by_motion = by_point @ np.concatenate(
        [np.broadcast_to(-np.eye(3), (*points.shape[:-1], 3, 3)), hat(points)], axis=-1
    )
    names = (
        *(f"{camera.name}.{name}" for name in INTRINSIC_NAMES),
        *(f"{camera.name}.{name}" for name in camera.lens.names),
        *motion_labels(f"{frame}_from_{camera.name}"),
    )
    columns = np.concatenate([by_intrinsics, by_lens, by_motion], axis=-1)
    position = {label: column for column, label in enumerate(labels)}
    known = [k for k, name in enumerate(names) if name in position]
    result = np.zeros((*points.shape[:-1], 2, len(labels)))
    result[..., [position[names[k]] for k in known]] = columns[..., known]
    return pixels, by_point, result
