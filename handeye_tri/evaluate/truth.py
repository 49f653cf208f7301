"""Estimates against the truth, where a simulation knows it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handeye_tri.errors import InputError
from handeye_tri.records import (
    MOTION_QUANTITIES,
    CameraCalibration,
    GroundTruth,
    HandEyeCalibration,
    Mount,
    marker_labels,
    motion_labels,
    triangle_name,
)
from handeye_tri.se3 import SE3, so3_log


@dataclass(frozen=True, slots=True)
class Comparison:
    """One estimated quantity against the truth.

    Attributes:
        quantity: Label, as in the covariance, or "baseline.<camera>".
        estimate: Its value: px or bare number; of a motion, the component of its
            translation (m) or rotation vector (rad).
        truth: The same of the truth.
        error: Estimate less truth. Of a motion: the component of the right tangent
            of ``truth^-1 @ estimate``, which is not estimate less truth above, since
            it is along the axes of the frame that moves.
        sigma: Predicted standard deviation of the error.
    """

    quantity: str
    estimate: float
    truth: float
    error: float
    sigma: float


def compare_with_truth(
    calibration: HandEyeCalibration | CameraCalibration, truth: GroundTruth
) -> tuple[Comparison, ...]:
    """Set every estimated quantity against the truth.

    Args:
        calibration: Of a simulated session.
        truth: The same session's.

    Returns:
        A row per label of the calibration's covariance of which the truth is known, in
        its order, then "baseline.<camera>", the distance of each later camera from
        the first.

    Raises:
        InputError: the cameras are not the truth's.
    """
    names = tuple(camera.name for camera in calibration.cameras)
    expected = tuple(camera.name for camera in truth.cameras)
    if names != expected:
        raise InputError(
            f"the calibration has cameras ({', '.join(names)}), the truth "
            f"({', '.join(expected)})"
        )
    if isinstance(calibration, HandEyeCalibration):
        estimated = _motions(names, calibration.base_from_camera)
        for number, mount in enumerate(calibration.mounts):
            estimated[triangle_name(number)] = mount.flange_from_triangle
    else:
        estimated = {
            f"reference_from_{name}": motion
            for name, motion in zip(
                names, calibration.reference_from_camera, strict=True
            )
        }
    true = _motions(names, truth.base_from_camera)
    true[triangle_name()] = truth.flange_from_triangle
    for number, mount in enumerate(truth.other_mounts, 1):
        true[triangle_name(number)] = mount.flange_from_triangle
    markers = _markers(calibration, truth)
    rows = []
    for label in calibration.covariance.labels:
        owner, quantity = label.rsplit(".", 1)
        if owner in names:
            i = names.index(owner)
            estimate = calibration.cameras[i].parameter(quantity)
            value = truth.cameras[i].parameter(quantity)
            error = estimate - value
        elif label in markers:
            estimate, value = markers[label]
            error = estimate - value
        elif owner in true:
            k = MOTION_QUANTITIES.index(quantity)
            estimate = _components(estimated[owner], true[owner])[k]
            value = _components(true[owner], true[owner])[k]
            error = float((true[owner].inverse() @ estimated[owner]).log()[k])
        else:
            continue
        sigma = calibration.covariance.std(label)
        rows.append(Comparison(label, estimate, value, error, sigma))
    for name in names[1:]:
        rows.append(_baseline(calibration, name, estimated, true))
    return tuple(rows)


def _markers(
    calibration: HandEyeCalibration | CameraCalibration, truth: GroundTruth
) -> dict[str, tuple[float, float]]:
    """Estimate and truth of each marker coordinate, where both are known."""
    if truth.markers is None or not isinstance(calibration, HandEyeCalibration):
        return {}
    true = (Mount(truth.flange_from_triangle, truth.markers), *truth.other_mounts)
    values: dict[str, tuple[float, float]] = {}
    # What has a mount more is not compared there.
    for number, (one, other) in enumerate(zip(calibration.mounts, true, strict=False)):
        both = zip(
            one.markers.ravel().tolist(), other.markers.ravel().tolist(), strict=True
        )
        values |= zip(marker_labels(number), both, strict=True)
    return values


def _motions(
    names: tuple[str, ...], base_from_camera: tuple[SE3, ...]
) -> dict[str, SE3]:
    """All camera motions by the name that covariance labels give them."""
    first = base_from_camera[0].inverse()
    motions = dict(
        zip((f"base_from_{n}" for n in names), base_from_camera, strict=True)
    )
    for name, motion in zip(names, base_from_camera, strict=True):
        motions[f"reference_from_{name}"] = first @ motion
    return motions


def _components(motion: SE3, near: SE3) -> list[float]:
    """Translation (m) and rotation vector (rad), in MOTION_QUANTITIES' order.

    A turn near pi has two rotation vectors, opposite and 2 pi apart: the one on the
    side of the other motion's is taken.
    """
    vector, other = so3_log(motion.rotation), so3_log(near.rotation)
    if np.linalg.norm(vector - other) > np.pi:
        vector = vector * (1.0 - 2.0 * np.pi / np.linalg.norm(vector))
    return [*motion.translation.tolist(), *vector.tolist()]


def _baseline(
    calibration: HandEyeCalibration | CameraCalibration,
    name: str,
    estimated: dict[str, SE3],
    true: dict[str, SE3],
) -> Comparison:
    """Distance between the first camera and another, with its sigma."""
    motion = f"reference_from_{name}"
    length = float(np.linalg.norm(estimated[motion].translation))
    truth = float(np.linalg.norm(true[motion].translation))
    # A centre t moves by R d_t under its motion's right tangent.
    ends = {motion: estimated[motion].translation}
    if isinstance(calibration, HandEyeCalibration):
        first = f"base_from_{calibration.cameras[0].name}"
        other = f"base_from_{name}"
        between = estimated[other].translation - estimated[first].translation
        ends = {first: -between, other: between}
    labels = [label for end in ends for label in motion_labels(end)[:3]]
    slope = np.concatenate(
        [vector @ estimated[end].rotation / length for end, vector in ends.items()]
    )
    sigma = float(np.sqrt(slope @ calibration.covariance.block(labels) @ slope))
    return Comparison(f"baseline.{name}", length, truth, length - truth, sigma)
