"""Held-out stations: the robot's track against the cameras', and truth where known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
from handeye_tri.camera import INTRINSIC_NAMES, PinholeCamera, triangulate
from handeye_tri.errors import InputError
from handeye_tri.hand_eye.camera_parameters import project_with_parameters
from handeye_tri.records import (
    MOTION_QUANTITIES,
    CameraCalibration,
    GroundTruth,
    HandEyeCalibration,
    Session,
    TrackEvaluation,
    motion_labels,
)
from handeye_tri.se3 import SE3, hat, so3_log

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TrackBudget:
    """Where the predicted track error comes from; RMS of the 3-D distance, metres.

    Attributes:
        calibration: From the calibration's covariance.
        pixels: From the noise of the held-out views.
        robot: From the robot's repeatability at the held-out stations.
    """

    calibration: float
    pixels: float
    robot: float

    @property
    def total(self) -> float:
        """All three together, metres; they are independent."""
        return float(np.hypot(np.hypot(self.calibration, self.pixels), self.robot))


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


@dataclass(frozen=True, slots=True)
class LoopResiduals:
    """How well the loop base-camera-triangle-flange closes at the stations used.

    Attributes:
        translation_rms: Metres.
        translation_max: Metres.
        rotation_rms: Radians.
        rotation_max: Radians.
    """

    translation_rms: float
    translation_max: float
    rotation_rms: float
    rotation_max: float


def loop_residuals(calibration: HandEyeCalibration) -> LoopResiduals:
    """Lengths of the hand-eye residuals, translation and rotation apart."""
    lengths = np.linalg.norm(calibration.residuals.reshape(-1, 2, 3), axis=2)
    rms = np.sqrt((lengths**2).mean(axis=0))
    return LoopResiduals(
        float(rms[0]),
        float(lengths[:, 0].max()),
        float(rms[1]),
        float(lengths[:, 1].max()),
    )


def evaluate_track(
    calibration: HandEyeCalibration, session: Session
) -> TrackEvaluation:
    """Compare both tracks at the session's evaluation stations.

    The robot's track is its reported pose applied to the calibrated markers; the
    cameras' track is the maximum-likelihood triangulation, corrected for sphere
    eccentricity (as Fig. 12 of Zhao, Liu and Zhang 2008). The predicted covariance
    of observed less reported holds the calibration's covariance, the pixels' and
    the robot's repeatability; rows of the same calibration are correlated, and the
    covariances of single rows do not show it.

    Args:
        calibration: Cameras in the base, and the rig on the flange.
        session: Its evaluation stations are used; calibration must not have.

    Raises:
        InputError: the cameras do not fit, or nothing was seen by two of them.
    """
    return _evaluate(calibration, session)[0]


def track_budget(calibration: HandEyeCalibration, session: Session) -> TrackBudget:
    """Split the predicted track error, see :func:`evaluate_track`."""
    _, parts = _evaluate(calibration, session)
    rms = np.sqrt(np.trace(parts, axis1=2, axis2=3).mean(axis=1))
    return TrackBudget(*(float(value) for value in rms))


def _evaluate(
    calibration: HandEyeCalibration, session: Session
) -> tuple[TrackEvaluation, Floats]:
    """The track, and its covariance in parts (3, r, 3, 3): see TrackBudget."""
    names = [camera.name for camera in calibration.cameras]
    expected = [info.name for info in session.cameras]
    if names != expected:
        raise InputError(
            f"the calibration has cameras ({', '.join(names)}), the session "
            f"({', '.join(expected)}); evaluate with the session it was made from"
        )
    stations = session.indices("evaluation")
    m, n = len(names), len(stations)
    pixels = session.pixels[:, stations].reshape(m, 3 * n, 2)
    noise = session.pixel_covariance[:, stations].reshape(m, 3 * n, 2, 2)
    points, covariance, pixels = _observe(
        calibration, pixels, noise, np.tile(session.marker_radii, n)
    )
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    station, marker = np.repeat(stations, 3)[rows], np.tile(np.arange(3), n)[rows]
    base_from_flange = session.base_from_flange[station]
    rotation = base_from_flange[:, :3, :3]
    markers = calibration.markers[marker]
    reported = np.einsum("rab,rb->ra", rotation, markers) + base_from_flange[:, :3, 3]
    by_parameters = _observed_by_parameters(
        calibration, points[rows], covariance[rows], noise[:, rows]
    )
    labels = calibration.covariance.labels
    # Markers move with the triangle by R_ft (d_t - X x d_r), reported by R times that.
    triangle = session.triangle.points[marker]
    by_rig = calibration.flange_from_triangle.rotation @ _by_tangent(triangle)
    columns = [labels.index(name) for name in motion_labels("flange_from_triangle")]
    by_parameters[:, :, columns] -= rotation @ by_rig
    by_robot = rotation @ _by_tangent(markers)
    parts = np.stack(
        [
            by_parameters @ calibration.covariance.matrix @ by_parameters.mT,
            covariance[rows],
            by_robot @ session.repeatability.covariance @ by_robot.mT,
        ]
    )
    track = TrackEvaluation(station, marker, reported, points[rows], parts.sum(axis=0))
    return track, parts


def _by_tangent(points: Floats) -> Floats:
    """Derivative of exp(d) X by d at 0, shape (r, 3, 6)."""
    eye = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    return np.concatenate([eye, -hat(points)], axis=-1)


def _observe(
    calibration: HandEyeCalibration, pixels: Floats, noise: Floats, radii: Floats
) -> tuple[Floats, Floats, Floats]:
    """Triangulate in the base, spheres corrected: (k, 3), (k, 3, 3), pixels used."""
    cameras, motions = calibration.cameras, calibration.base_from_camera
    points, covariance = triangulate(cameras, motions, pixels, noise)
    if radii.any():
        pixels = pixels.copy()
        for i, camera in enumerate(cameras):
            local = motions[i].inverse().apply(points)
            pixels[i] -= sphere_shift(camera, local, radii)
        points, covariance = triangulate(cameras, motions, pixels, noise)
    return points, covariance, pixels


def _observed_by_parameters(
    calibration: HandEyeCalibration,
    points: Floats,
    covariance: Floats,
    noise: Floats,
) -> Floats:
    """Derivative of triangulated points by the calibration's parameters, (r, 3, p).

    At the optimum ``J' W (pixels - predicted(x, c)) = 0``, so that
    ``dx = -(J' W J)^-1 J' W (d predicted / dc) dc``.
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


def compare_with_truth(
    calibration: HandEyeCalibration | CameraCalibration, truth: GroundTruth
) -> tuple[Comparison, ...]:
    """Set every estimated quantity against the truth.

    Args:
        calibration: Of a simulated session.
        truth: The same session's.

    Returns:
        A row per label of the calibration's covariance, in its order, then
        "baseline.<camera>", the distance of each later camera from the first.

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
        estimated["flange_from_triangle"] = calibration.flange_from_triangle
    else:
        estimated = {
            f"reference_from_{name}": motion
            for name, motion in zip(
                names, calibration.reference_from_camera, strict=True
            )
        }
    true = _motions(names, truth.base_from_camera)
    true["flange_from_triangle"] = truth.flange_from_triangle
    rows = []
    for label in calibration.covariance.labels:
        owner, quantity = label.rsplit(".", 1)
        if owner in names:
            i = names.index(owner)
            estimate = _camera_value(calibration.cameras[i], quantity)
            value = _camera_value(truth.cameras[i], quantity)
            error = estimate - value
        else:
            k = MOTION_QUANTITIES.index(quantity)
            estimate = _components(estimated[owner], true[owner])[k]
            value = _components(true[owner], true[owner])[k]
            error = float((true[owner].inverse() @ estimated[owner]).log()[k])
        sigma = calibration.covariance.std(label)
        rows.append(Comparison(label, estimate, value, error, sigma))
    for name in names[1:]:
        rows.append(_baseline(calibration, name, estimated, true))
    return tuple(rows)


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


def _camera_value(camera: PinholeCamera, quantity: str) -> float:
    """A camera's parameter by name; a coefficient that its lens lacks is zero."""
    if quantity in INTRINSIC_NAMES:
        return float(getattr(camera.intrinsics, quantity))
    if quantity in camera.lens.names:
        return float(camera.lens.coefficients[camera.lens.names.index(quantity)])
    return 0.0


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
