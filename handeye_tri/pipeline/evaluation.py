"""How good a calibrated session is: its track, cross-checks, gates and verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri import storage
from handeye_tri.errors import InputError
from handeye_tri.pipeline.run import EVALUATION_SCHEMA, Run
from handeye_tri.records import HandEyeCalibration, Session, TrackEvaluation
from handeye_tri.summary import result_rows

if TYPE_CHECKING:
    from handeye_tri.adjustment import RobotParameters
    from handeye_tri.diagnose import Verdict
    from handeye_tri.evaluate import (
        AgainstPrediction,
        CrossValidation,
        Spread,
        TrackBudget,
    )
    from handeye_tri.evaluate.resampling import Recalibrate

# Calibrations from half-turns drawn again, and from noise drawn again. Each takes some
# 20 ms jointly and ten times that in separate steps; a sigma of n of them is off by
# 1 / sqrt(2 n), which for half-turns drawn again adds little to what their own small
# number leaves open.
_REPLICATES = {"joint": (60, 40), "separate": (20, 12)}
# Names of the random streams.
_FOLDS_STREAM, _BOOTSTRAP_STREAM, _NOISE_STREAM = 201, 202, 203
TRACKS = ("track_reported.tum", "track_observed.tum")


@dataclass(frozen=True, slots=True, eq=False)
class JudgedTrack:
    """The track that a calibration is judged by.

    Attributes:
        track: Its rows.
        budget: Where its predicted error comes from.
        cross_validation: Where the session has no held-out stations, what held them
            out in turn.
        against_prediction: Whether the track is as good as predicted; None for
            cross-validation, whose folds share most of their stations.
    """

    track: TrackEvaluation
    budget: TrackBudget
    cross_validation: CrossValidation | None
    against_prediction: AgainstPrediction | None = None


def judged_track(
    run: Run,
    session: Session,
    hand_eye: HandEyeCalibration,
    progress: Callable[[int, int], None] | None = None,
) -> JudgedTrack:
    """The track at held-out stations; without any, cross-validation holds them out."""
    from handeye_tri.evaluate import against_prediction, evaluate_track, track_budget
    from handeye_tri.pipeline.robot import robot_parameters

    if len(session.indices("evaluation")):
        parameters = robot_parameters(run)
        return JudgedTrack(
            evaluate_track(hand_eye, session, parameters),
            track_budget(hand_eye, session, parameters),
            None,
            against_prediction(hand_eye, session, parameters),
        )
    result = _cross_validation(run, session, hand_eye, progress)
    return JudgedTrack(result.track, result.budget, result)


def _cross_validation(
    run: Run,
    session: Session,
    hand_eye: HandEyeCalibration,
    progress: Callable[[int, int], None] | None,
) -> CrossValidation:
    from handeye_tri.evaluate import cross_validate
    from handeye_tri.pipeline.robot import robot_parameters

    return cross_validate(
        session,
        _recalibrate(run, hand_eye),
        robot_parameters=robot_parameters(run),
        rng=np.random.default_rng([run.seed, _FOLDS_STREAM]),
        progress=progress,
    )


def _recalibrate(
    run: Run, hand_eye: HandEyeCalibration, on_axis_correlation: float | None = None
) -> Recalibrate:
    """Calibrates a part of a session as the whole was; jointly it starts from there."""
    from handeye_tri.adjustment import adjust
    from handeye_tri.calibrate_cameras import calibrate_session_cameras
    from handeye_tri.hand_eye import calibrate_hand_eye
    from handeye_tri.pipeline.robot import robot_parameters

    parameters = robot_parameters(run)

    def jointly(part: Session, index: NDArray[np.intp]) -> HandEyeCalibration:
        return adjust(
            part,
            hand_eye,
            robot_parameters=None if parameters is None else parameters.at(index),
            on_axis_correlation=on_axis_correlation,
        )

    def in_steps(part: Session, _index: NDArray[np.intp]) -> HandEyeCalibration:
        return calibrate_hand_eye(part, calibrate_session_cameras(part))

    return jointly if run.method == "joint" else in_steps


def judge_session(run: Run, judged: JudgedTrack) -> Verdict:
    """Run every gate on the session's files, and name what is wrong."""
    from handeye_tri.diagnose import Evidence, assess, session_causes, with_causes
    from handeye_tri.pipeline.robot import turning_offsets, with_robot_applied

    cameras = run.cameras()
    session, hand_eye = with_robot_applied(run, run.observed(), run.hand_eye())
    dropped = cameras.details["dropped"]
    verdict = assess(
        session.without(dropped),
        cameras,
        hand_eye,
        judged.track,
        track_limit=1e-3 * run.cell.track_limit_mm,
        min_plane_spread=float(np.radians(run.cell.plan.min_plane_spread_deg)),
    )
    joints = turning_offsets(run) if run.has_robot else None
    evidence = Evidence(session, hand_eye, dropped, joints, run.edges())
    return with_causes(verdict, session_causes(evidence))


def verdict_json(verdict: Verdict) -> dict[str, Any]:
    """A verdict as it stands in evaluation.json."""
    return {
        "verdict": verdict.outcome,
        "sentence": verdict.sentence,
        "nearest": verdict.nearest,
        "gates": [asdict(gate) for gate in verdict.gates],
        "findings": [asdict(finding) for finding in verdict.findings],
    }


def evaluate(run: Run) -> tuple[list[str], str]:
    """The stage: writes evaluation.json and both tracks."""
    from handeye_tri.evaluate import compare_with_truth, track_poses

    session, cameras, hand_eye = run.session(), run.cameras(), run.hand_eye()
    judged = judged_track(run, session, hand_eye, run.progress.advance)
    checks = _cross_checks(run, session, hand_eye, judged)
    verdict = judge_session(run, judged)
    truth = run.truth()
    rows = compare_with_truth(hand_eye, truth[0]) if truth else ()
    poses = track_poses(hand_eye, judged.track, session.mounts)
    for name, who, motions in zip(
        TRACKS,
        ("as the robot reports it", "as the cameras observe it"),
        (poses.reported, poses.observed),
        strict=True,
    ):
        storage.write_tum(
            run.folder.file(name),
            poses.times,
            motions,
            f"each marker in the robot base (m), {who}, with the triangle's "
            "orientation; t is the station, and 0.1 for B, 0.2 for C",
        )
    data = {
        "schema": EVALUATION_SCHEMA,
        **verdict_json(verdict),
        "simulated": session.simulated,
        "cameras_chi2_per_dof": cameras.chi2 / cameras.dof,
        "hand_eye_chi2_per_dof": hand_eye.chi2 / hand_eye.dof,
        "robot": _robot_json(run, hand_eye),
        "track": {
            **track_json(judged),
            "orientation": _orientation_json(np.degrees(poses.rotation_errors)),
        },
        "cross_checks": checks,
        "result": result_rows(hand_eye, truth[0] if truth else None),
        "truth": {
            row.quantity: {
                "estimate": row.estimate,
                "truth": row.truth,
                "error": row.error,
                "sigma": row.sigma,
            }
            for row in rows
        },
    }
    storage.write_json(run.folder.file("evaluation.json"), data)
    return ["evaluation.json", *TRACKS], (
        f"held-out track {1e3 * judged.track.mean:.3f} mm mean, "
        f"{1e3 * judged.track.max:.3f} worst; "
        f"predicted {1e3 * judged.track.predicted_rms:.3f} rms; {verdict.outcome}"
    )


def _robot_json(run: Run, hand_eye: HandEyeCalibration) -> dict[str, Any]:
    """Which errors of the robot were asked for, found, and left at zero."""
    from handeye_tri.pipeline.robot import robot_parameters

    parameters = robot_parameters(run)
    labels = () if parameters is None else parameters.labels
    return {
        "asked": list(run.robot_errors),
        "estimated": list(hand_eye.robot),
        "undetermined": [label for label in labels if label not in hand_eye.robot],
    }


def track_json(judged: JudgedTrack) -> dict[str, Any]:
    """The judged track as it stands in evaluation.json."""
    track = judged.track
    worst = int(np.argmax(track.distances))
    return {
        "source": "held-out stations"
        if judged.cross_validation is None
        else "cross-validation",
        "stations": len(set(track.stations.tolist())),
        "mean_mm": 1e3 * track.mean,
        "rms_mm": 1e3 * track.rms,
        "max_mm": 1e3 * track.max,
        "worst_station": int(track.stations[worst]),
        "worst_marker": "ABC"[track.markers[worst]],
        "predicted_rms_mm": 1e3 * track.predicted_rms,
        "against_prediction": None
        if judged.against_prediction is None
        else {
            "outcome": judged.against_prediction.outcome,
            "low_mm": 1e3 * judged.against_prediction.low,
            "high_mm": 1e3 * judged.against_prediction.high,
        },
        "predicted_parts_mm": {
            name: 1e3 * value for name, value in judged.budget.parts().items()
        },
        "positions": [
            {
                "station": int(track.stations[r]),
                "marker": "ABC"[track.markers[r]],
                "reported_m": track.reported[r].tolist(),
                "observed_m": track.observed[r].tolist(),
                "error_mm": 1e3 * float(track.distances[r]),
            }
            for r in range(len(track.stations))
        ],
    }


def _orientation_json(errors_deg: NDArray[np.float64]) -> dict[str, Any]:
    """Angles between the reported and the observed orientation of the triangle."""
    if errors_deg.size == 0:
        return {"stations": 0, "mean_deg": None, "rms_deg": None, "max_deg": None}
    return {
        "stations": len(errors_deg),
        "mean_deg": float(errors_deg.mean()),
        "rms_deg": float(np.sqrt(np.mean(errors_deg**2))),
        "max_deg": float(errors_deg.max()),
    }


def _cross_checks(
    run: Run, session: Session, hand_eye: HandEyeCalibration, judged: JudgedTrack
) -> dict[str, Any]:
    """Cross-validation and repeatability; one that cannot be had says why."""
    from handeye_tri.evaluate import bootstrap, parametric_bootstrap
    from handeye_tri.evaluate.resampling import station_groups
    from handeye_tri.pipeline.robot import robot_parameters

    groups = len(station_groups(session))
    again, with_noise = _REPLICATES[run.method]
    total = groups + again + with_noise
    correlation = 0.0
    if run.method == "joint" and any(t.axis != "normal" for t in session.half_turns):
        # Estimated once more, and held: it varies little from part to part.
        again_whole = _recalibrate(run, hand_eye)
        whole = again_whole(session, np.arange(len(session.stations)))
        correlation = whole.details["on_axis_correlation"]
    recalibrate = _recalibrate(run, hand_eye, correlation)

    def advance(before: int) -> Callable[[int, int], None]:
        return lambda done, _of: run.progress.advance(before + done, total)

    def spread(name: str, draw: Callable[[], Spread]) -> dict[str, Any]:
        try:
            return _spread_json(draw(), session, hand_eye, robot_parameters(run))
        except InputError as error:
            return {"not_run": str(error)}

    try:
        validation = judged.cross_validation or _cross_validation(
            run, session, hand_eye, advance(0)
        )
        validated = _validation_json(validation, groups)
    except InputError as error:
        validated = {"not_run": str(error)}
    return {
        "cross_validation": validated,
        "bootstrap": spread(
            "bootstrap",
            lambda: bootstrap(
                session,
                hand_eye,
                recalibrate,
                np.random.default_rng([run.seed, _BOOTSTRAP_STREAM]),
                replicates=again,
                progress=advance(groups),
            ),
        ),
        "parametric_bootstrap": spread(
            "parametric_bootstrap",
            lambda: parametric_bootstrap(
                session,
                hand_eye,
                recalibrate,
                np.random.default_rng([run.seed, _NOISE_STREAM]),
                replicates=with_noise,
                on_axis_correlation=correlation,
                progress=advance(groups + again),
            ),
        ),
    }


def _validation_json(result: CrossValidation, groups: int) -> dict[str, Any]:
    track = result.track
    return {
        "folds": len(result.folds),
        "groups": groups,
        "stations": len(set(track.stations.tolist())),
        "mean_mm": 1e3 * track.mean,
        "rms_mm": 1e3 * track.rms,
        "max_mm": 1e3 * track.max,
        "predicted_rms_mm": 1e3 * track.predicted_rms,
        "undetermined": [list(fold) for fold in result.undetermined],
    }


def _spread_json(
    spread: Spread,
    session: Session,
    hand_eye: HandEyeCalibration,
    parameters: RobotParameters | None,
) -> dict[str, Any]:
    """Sigmas by resampling beside the covariance's; m, rad, px by label."""
    from handeye_tri.evaluate import track_part

    labels = [n for n in hand_eye.covariance.labels if hand_eye.covariance.std(n) > 0]
    found = np.array([spread.covariance.std(label) for label in labels])
    stated = np.array([hand_eye.covariance.std(label) for label in labels])
    return {
        "replicates": spread.replicates,
        "failed": spread.failed,
        "drawn_from": spread.units,
        "relative_error": spread.relative_error,
        "track_calibration_mm": 1e3 * track_part(hand_eye, session, spread, parameters),
        "track_calibration_by_covariance_mm": 1e3
        * track_part(hand_eye, session, None, parameters),
        "rms_ratio_to_covariance": float(np.sqrt(np.mean((found / stated) ** 2))),
        "sigma": dict(zip(labels, found.tolist(), strict=True)),
        "sigma_by_covariance": dict(zip(labels, stated.tolist(), strict=True)),
    }
