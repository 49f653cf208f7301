"""Held-out stations: the robot's track against the cameras'."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.adjustment import RobotParameters
from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
from handeye_tri.camera import triangulate
from handeye_tri.errors import InputError
from handeye_tri.evaluate.budget import TrackBudget, calibration_parts
from handeye_tri.evaluate.derivatives import (
    by_tangent,
    markers_by_parameters,
    observed_by_parameters,
)
from handeye_tri.records import HandEyeCalibration, Session, TrackEvaluation

Floats = NDArray[np.float64]

# The shift of a sphere's outline depends on its depth, which the raw pixels give to
# 1e-3: once more leaves less than 1e-11 m.
_CORRECTIONS = 2


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
    calibration: HandEyeCalibration,
    session: Session,
    robot_parameters: RobotParameters | None = None,
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
        robot_parameters: Those with which the calibration was made, where it
            estimated systematic errors of the robot; reported poses are then
            corrected by them.

    Raises:
        InputError: the cameras do not fit, nothing was seen by two of them, or
            robot_parameters are missing.
    """
    return _evaluate(calibration, session, robot_parameters)[0]


def track_budget(
    calibration: HandEyeCalibration,
    session: Session,
    robot_parameters: RobotParameters | None = None,
) -> TrackBudget:
    """Split the predicted track error, see :func:`evaluate_track`."""
    _, parts, by_parameters = _evaluate(calibration, session, robot_parameters)
    rms = np.sqrt(np.trace(parts, axis1=2, axis2=3).mean(axis=1)).tolist()
    shares = calibration_parts(calibration, by_parameters)
    return TrackBudget(rms[0], rms[1], rms[2], shares)


def _evaluate(
    calibration: HandEyeCalibration,
    session: Session,
    robot_parameters: RobotParameters | None,
) -> tuple[TrackEvaluation, Floats, Floats]:
    """The track; its covariance in parts (3, r, 3, 3): calibration, pixels, robot.

    Last the derivative of observed less reported by the calibration's parameters,
    (r, 3, p).
    """
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
    points, covariance = _observe(
        calibration, pixels, noise, np.tile(session.marker_radii, n)
    )
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    station, marker = np.repeat(stations, 3)[rows], np.tile(np.arange(3), n)[rows]
    poses, by_robot = _reported_poses(calibration, session, robot_parameters)
    rotation = poses[station, :3, :3]
    markers = calibration.markers[marker]
    reported = np.einsum("rab,rb->ra", rotation, markers) + poses[station, :3, 3]
    moved = rotation @ by_tangent(markers)
    by_parameters = observed_by_parameters(
        calibration, points[rows], covariance[rows], noise[:, rows]
    )
    by_parameters -= rotation @ markers_by_parameters(calibration)[marker]
    by_parameters -= moved @ by_robot[station]
    parts = np.stack(
        [
            by_parameters @ calibration.covariance.matrix @ by_parameters.mT,
            covariance[rows],
            moved @ session.repeatability.covariance @ moved.mT,
        ]
    )
    track = TrackEvaluation(station, marker, reported, points[rows], parts.sum(axis=0))
    return track, parts, by_parameters


def _reported_poses(
    calibration: HandEyeCalibration,
    session: Session,
    parameters: RobotParameters | None,
) -> tuple[Floats, Floats]:
    """base_from_flange (n, 4, 4), and its right tangent by the parameters (n, 6, p)."""
    reported = session.base_from_flange
    labels = calibration.covariance.labels
    by_parameters = np.zeros((len(reported), 6, len(labels)))
    if not calibration.robot:
        return reported, by_parameters
    if parameters is None or len(parameters.jacobian) != len(reported):
        raise InputError(
            f"the calibration estimated {', '.join(calibration.robot)}: give "
            f"robot_parameters of all {len(reported)} stations, so that the reported "
            "poses can be corrected by them"
        )
    chosen = parameters.select(tuple(calibration.robot))
    values = np.array(list(calibration.robot.values()))
    poses, jacobian = chosen.poses(reported, values)
    columns = [labels.index(label) for label in chosen.labels]
    by_parameters[..., columns] = jacobian
    return poses, by_parameters


def _observe(
    calibration: HandEyeCalibration, pixels: Floats, noise: Floats, radii: Floats
) -> tuple[Floats, Floats]:
    """Triangulate in the base, spheres corrected: (k, 3), (k, 3, 3)."""
    cameras, motions = calibration.cameras, calibration.base_from_camera
    points, covariance = triangulate(cameras, motions, pixels, noise)
    for _ in range(_CORRECTIONS if radii.any() else 0):
        corrected = pixels.copy()
        for i, camera in enumerate(cameras):
            local = motions[i].inverse().apply(points)
            corrected[i] -= sphere_shift(camera, local, radii)
        points, covariance = triangulate(cameras, motions, corrected, noise)
    return points, covariance
