"""Held-out stations: the robot's track against the cameras'."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from handeye_tri import arguments
from handeye_tri.adjustment import RobotParameters
from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
from handeye_tri.camera import triangulate
from handeye_tri.counting import counted
from handeye_tri.errors import InputError
from handeye_tri.evaluate.budget import TrackBudget, calibration_parts
from handeye_tri.evaluate.derivatives import (
    by_tangent,
    markers_by_parameters,
    observed_by_parameters,
)
from handeye_tri.evaluate.one_view import seen_by_one
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


Outcome = Literal["consistent", "better", "worse"]


@dataclass(frozen=True, slots=True)
class AgainstPrediction:
    """The held-out track error against the one that was predicted before the test.

    Attributes:
        outcome: "consistent" where the RMS lies in the range; else "better" or "worse"
            than predicted.
        low: Lower end of the range that holds 95 % of such tests, metres.
        high: Its upper end.
    """

    outcome: Outcome
    low: float
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """The rows of a track and what their errors come from.

    Attributes:
        track: The r rows.
        parts: Covariance by calibration, pixels, robot, shape (3, r, 3, 3), m^2.
        seen: Root of the pixels' part: of two rows of a station, ``seen_i seen_j'``
            is their common covariance, shape (r, 3, 9), m.
        by_parameters: Derivative of observed less reported by the calibration's
            parameters, shape (r, 3, p).
        moved: Derivative of reported by the flange's right tangent, (r, 3, 6).
    """

    track: TrackEvaluation
    parts: Floats
    seen: Floats
    by_parameters: Floats
    moved: Floats


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
    eccentricity (as Fig. 12 of Zhao, Liu and Zhang 2008); a cell's only camera places
    the calibrated triangle as a whole, by its three points. The predicted covariance
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
        InputError: cameras or mounts do not fit, nothing was seen by two of them (or by
            the only one), or robot_parameters are missing.
    """
    return _evaluate(calibration, session, robot_parameters).track


def track_budget(
    calibration: HandEyeCalibration,
    session: Session,
    robot_parameters: RobotParameters | None = None,
) -> TrackBudget:
    """Split the predicted track error, see :func:`evaluate_track`."""
    rows = _evaluate(calibration, session, robot_parameters)
    rms = np.sqrt(np.trace(rows.parts, axis1=2, axis2=3).mean(axis=1)).tolist()
    shares = calibration_parts(calibration, rows.by_parameters)
    return TrackBudget(rms[0], rms[1], rms[2], shares)


def against_prediction(
    calibration: HandEyeCalibration,
    session: Session,
    robot_parameters: RobotParameters | None = None,
) -> AgainstPrediction:
    """Is the track as accurate as predicted? See :func:`evaluate_track`.

    The sum of squared distances is a weighted sum of chi-squares, taken for a scaled
    chi-square of the same mean and variance (Patnaik 1949,
    doi:10.1093/biomet/36.1-2.202). Its variance, 2 tr(S^2), knows that all rows share
    the calibration and the markers of a station share the robot's error; S, of all
    rows, is never formed.
    """
    rows = _evaluate(calibration, session, robot_parameters)
    track = rows.track
    covariance = calibration.covariance.matrix
    p = len(covariance)
    # S = G C G' + D: G all derivatives, D the blocks of the stations.
    every, weighed = np.zeros((p, p)), np.zeros((p, p))
    square = 0.0
    for station in np.unique(track.stations):
        mine = np.flatnonzero(track.stations == station)
        by_parameters = rows.by_parameters[mine].reshape(-1, p)
        moved = rows.moved[mine].reshape(-1, 6)
        seen = rows.seen[mine].reshape(-1, 9)
        own = moved @ session.repeatability.covariance @ moved.T + seen @ seen.T
        every += by_parameters.T @ by_parameters
        weighed += by_parameters.T @ own @ by_parameters
        square += float((own * own).sum())
    spread = covariance @ every
    square += float((spread * spread.T).sum() + 2.0 * (covariance * weighed).sum())
    mean = float(np.trace(rows.parts.sum(axis=0), axis1=1, axis2=2).sum())
    half_dof = mean**2 / (2.0 * square)
    # scipy.stats has the same quantiles but takes a second to import.
    from scipy.special import gammaincinv

    ends = mean / half_dof * gammaincinv(half_dof, [0.025, 0.975])
    low, high = np.sqrt(ends / len(track.stations)).tolist()
    outcome: Outcome = "consistent"
    if not low <= track.rms <= high:
        outcome = "better" if track.rms < low else "worse"
    return AgainstPrediction(outcome, low, high)


def _evaluate(
    calibration: HandEyeCalibration,
    session: Session,
    robot_parameters: RobotParameters | None,
) -> _Rows:
    arguments.record("calibration", calibration, HandEyeCalibration)
    arguments.record("session", session, Session)
    names = [camera.name for camera in calibration.cameras]
    expected = [info.name for info in session.cameras]
    if names != expected:
        raise InputError(
            f"the calibration has cameras ({', '.join(names)}), the session "
            f"({', '.join(expected)}); evaluate with the session it was made from"
        )
    if session.mounts.max(initial=0) >= len(calibration.mounts):
        raise InputError(
            f"the session has stations with mount {session.mounts.max() + 1} of the "
            f"rig, the calibration knows {counted(len(calibration.mounts), 'mount')}; "
            "evaluate with the session it was made from"
        )
    poses, by_robot = _reported_poses(calibration, session, robot_parameters)
    observed = (
        _triangulated(calibration, session)
        if len(names) > 1
        else _from_one_view(calibration, session, poses)
    )
    station, marker = observed.station, observed.marker
    rotation, mount = poses[station, :3, :3], session.mounts[station]
    markers = calibration.markers_at(mount)[np.arange(len(marker)), marker]
    reported = np.einsum("rab,rb->ra", rotation, markers) + poses[station, :3, 3]
    moved = rotation @ by_tangent(markers)
    by_parameters = observed.by_parameters
    by_parameters -= rotation @ markers_by_parameters(calibration)[mount, marker]
    by_parameters -= moved @ by_robot[station]
    parts = np.stack(
        [
            by_parameters @ calibration.covariance.matrix @ by_parameters.mT,
            observed.seen @ observed.seen.mT,
            moved @ session.repeatability.covariance @ moved.mT,
        ]
    )
    track = TrackEvaluation(
        station, marker, reported, observed.points, parts.sum(axis=0)
    )
    return _Rows(track, parts, observed.seen, by_parameters, moved)


@dataclass(frozen=True, slots=True, eq=False)
class _Observed:
    """The cameras' track: rows of station and marker, see :class:`_Rows`."""

    station: NDArray[np.intp]
    marker: NDArray[np.intp]
    points: Floats
    by_parameters: Floats
    seen: Floats


def _triangulated(calibration: HandEyeCalibration, session: Session) -> _Observed:
    """Each marker by itself, where two cameras see it."""
    stations = session.indices("evaluation")
    m, n = len(session.cameras), len(stations)
    pixels = session.pixels[:, stations].reshape(m, 3 * n, 2)
    noise = session.pixel_covariance[:, stations].reshape(m, 3 * n, 2, 2)
    points, covariance = _observe(
        calibration, pixels, noise, np.tile(session.marker_radii, n)
    )
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    station, marker = np.repeat(stations, 3)[rows], np.tile(np.arange(3), n)[rows]
    seen = np.zeros((len(rows), 3, 3, 3))
    seen[np.arange(len(rows)), :, marker] = np.linalg.cholesky(covariance[rows])
    return _Observed(
        station,
        marker,
        points[rows],
        observed_by_parameters(
            calibration, points[rows], covariance[rows], noise[:, rows]
        ),
        seen.reshape(len(rows), 3, 9),
    )


def _from_one_view(
    calibration: HandEyeCalibration, session: Session, poses: Floats
) -> _Observed:
    """The triangle as a whole, where the only camera sees all of it."""
    stations = session.indices("evaluation")
    found = seen_by_one(
        calibration,
        session.pixels[0, stations],
        session.pixel_covariance[0, stations],
        session.marker_radii,
        poses[stations],
        session.mounts[stations],
    )
    s, p = len(found.views), found.by_parameters.shape[-1]
    seen = np.zeros((3 * s, 3, 9))
    seen[..., :6] = found.by_pixels.reshape(-1, 3, 6)
    return _Observed(
        np.repeat(stations[found.views], 3),
        np.tile(np.arange(3), s),
        found.points.reshape(-1, 3),
        found.by_parameters.reshape(-1, 3, p),
        seen,
    )


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
