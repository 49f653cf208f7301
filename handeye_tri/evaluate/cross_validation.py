"""Every calibration station tested by a calibration that never saw it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handeye_tri.adjustment import RobotParameters
from handeye_tri.errors import ConvergenceError, DegenerateMotionError, InputError
from handeye_tri.evaluate.budget import TrackBudget
from handeye_tri.evaluate.resampling import (
    Progress,
    Recalibrate,
    held_out,
    split,
    station_groups,
)
from handeye_tri.evaluate.track import evaluate_track, track_budget
from handeye_tri.records import HandEyeCalibration, Session, TrackEvaluation

# Up to so many groups each is left out alone; beyond, there are so many folds.
_LEAVE_ONE_OUT = 20
_FOLDS = 10


@dataclass(frozen=True, slots=True, eq=False)
class CrossValidation:
    """The track at stations that were held out in turn.

    Each row's calibration and prediction are those of its fold, made of somewhat
    fewer stations than the whole: errors are, if anything, larger than those of the
    whole. Calibrations of two folds share most of their stations, so that errors of
    different folds are correlated: the mean over n rows is known far less well than
    by a factor of sqrt(n). A systematic error that all stations share is seen by no
    fold.

    Attributes:
        track: Rows of all folds, station by station.
        folds: Station indices that were held out together.
        undetermined: Folds that could not be tested, since the remaining stations
            do not determine the cell.
        budget: Where the predicted error comes from, mean square over the folds.
    """

    track: TrackEvaluation
    folds: tuple[tuple[int, ...], ...]
    undetermined: tuple[tuple[int, ...], ...]
    budget: TrackBudget


def cross_validate(
    session: Session,
    recalibrate: Recalibrate,
    *,
    folds: int | None = None,
    robot_parameters: RobotParameters | None = None,
    rng: np.random.Generator | None = None,
    progress: Progress | None = None,
) -> CrossValidation:
    """Hold out parts of the calibration stations in turn; calibrate with the others.

    The two stations of a half-turn stay together: each would give away the other.
    Stations that the session itself holds out are not used at all.

    Args:
        session: Its calibration stations are used.
        recalibrate: Calibrates a session the way that is to be tested.
        folds: Into how many parts; None leaves out one half-turn (or lone station) at
            a time, and makes ten parts where there are more than twenty of them.
        robot_parameters: Those that recalibrate estimates, of the session's stations.
        rng: Deals stations to folds; None is for one half-turn at a time, or seed 0.
        progress: Told after each fold.

    Raises:
        InputError: fewer than two parts, or no part could be tested.
    """
    groups = station_groups(session)
    if folds is None:
        folds = len(groups) if len(groups) <= _LEAVE_ONE_OUT else _FOLDS
    if not 2 <= folds <= len(groups):
        raise InputError(
            f"cross-validation needs between 2 and {len(groups)} folds for "
            f"{len(groups)} half-turns or lone stations, got {folds}"
        )
    rng = np.random.default_rng(0) if rng is None else rng
    done: list[tuple[int, ...]] = []
    undetermined: list[tuple[int, ...]] = []
    tracks: list[TrackEvaluation] = []
    budgets: list[TrackBudget] = []
    parts = split(groups, session.mounts, folds, rng)
    for number, fold in enumerate(parts, 1):
        part = held_out(session, fold)
        calibration = _calibrated(part, recalibrate)
        if calibration is None:
            undetermined.append(fold)
        else:
            tracks.append(evaluate_track(calibration, part, robot_parameters))
            budgets.append(track_budget(calibration, part, robot_parameters))
            done.append(fold)
        if progress is not None:
            progress(number, len(parts))
    if not done:
        raise InputError(
            f"cross-validation: without any one of {len(parts)} parts the remaining "
            "stations do not determine the cell; add half-turns"
        )
    return CrossValidation(
        _joined(tracks), tuple(done), tuple(undetermined), _mean_budget(tracks, budgets)
    )


def _calibrated(part: Session, recalibrate: Recalibrate) -> HandEyeCalibration | None:
    """None where the stations that are left do not determine the cell."""
    left = part.mounts[part.indices("calibration")]
    if set(left.tolist()) != set(part.mounts.tolist()):
        return None
    try:
        return recalibrate(part, np.arange(len(part.stations)))
    except (DegenerateMotionError, ConvergenceError):
        return None


def _joined(tracks: list[TrackEvaluation]) -> TrackEvaluation:
    """All rows, station by station."""
    columns = {
        name: np.concatenate([getattr(track, name) for track in tracks])
        for name in (
            *("stations", "markers", "reported", "observed"),
            "predicted_covariance",
        )
    }
    order = np.lexsort((columns["markers"], columns["stations"]))
    return TrackEvaluation(**{name: rows[order] for name, rows in columns.items()})


def _mean_budget(
    tracks: list[TrackEvaluation], budgets: list[TrackBudget]
) -> TrackBudget:
    """Root mean square over rows of every part."""
    weights = np.array([len(track.stations) for track in tracks], dtype=float)
    weights /= weights.sum()

    def mean(values: list[float]) -> float:
        return float(np.sqrt(weights @ np.square(values)))

    return TrackBudget(
        mean([budget.calibration for budget in budgets]),
        mean([budget.pixels for budget in budgets]),
        mean([budget.robot for budget in budgets]),
        {
            name: mean([budget.calibration_parts.get(name, 0.0) for budget in budgets])
            for name in dict.fromkeys(
                name for budget in budgets for name in budget.calibration_parts
            )
        },
    )
