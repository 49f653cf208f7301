"""How much a calibration would change if it were done again, by resampling it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.adjustment import RobotParameters
from handeye_tri.errors import (
    ConvergenceError,
    DegenerateMotionError,
    InputError,
)
from handeye_tri.evaluate.change import as_reference
from handeye_tri.evaluate.resampling import (
    Progress,
    Recalibrate,
    drawn,
    held_out,
    station_groups,
)
from handeye_tri.evaluate.track import track_budget
from handeye_tri.evaluate.truth import compare_with_truth
from handeye_tri.evaluate.views import predicted_pixels
from handeye_tri.records import Covariance, HandEyeCalibration, Session
from handeye_tri.se3 import SE3
from handeye_tri.triangle import EDGES

Floats = NDArray[np.float64]

# So many times as many half-turns are drawn as there are.
_DRAWN = 2


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """What resampling says of a calibration's spread.

    Attributes:
        covariance: Of the quantities that resampling covers, in their own units.
        replicates: How many calibrations it comes from.
        failed: How many more did not determine the cell; they are left out.
        units: How many independent things were drawn from: groups of stations, or
            0 where noise was drawn instead.
    """

    covariance: Covariance
    replicates: int
    failed: int
    units: int

    @property
    def relative_error(self) -> float:
        """One standard deviation of a sigma, as a part of it.

        A variance of normal numbers from k of them is off by sqrt(2 / (k - 1)); both
        the replicates and what they draw from are finite.
        """
        square = 0.5 / max(self.replicates - 1, 1)
        if self.units:
            square += 0.5 / max(self.units - 1, 1)
        return float(np.sqrt(square))


def bootstrap(
    session: Session,
    calibration: HandEyeCalibration,
    recalibrate: Recalibrate,
    rng: np.random.Generator,
    *,
    replicates: int = 200,
    progress: Progress | None = None,
) -> Spread:
    """Calibrate again from half-turns drawn with replacement (Efron 1979).

    Half-turns, and stations that belong to none, are drawn whole
    (doi:10.1214/aos/1176344552), so that whatever their two stations share stays
    shared. This takes nothing about the noise for granted: sigmas that are larger
    than the covariance's speak of more noise than was stated, or of a wrong model.
    With n half-turns a sigma itself is only known to 1 / sqrt(2 (n - 1)) of it.

    Twice as many are drawn as there are, and the covariance of the results is doubled:
    to first order that is the same, but samples of n out of n lack a third of the
    half-turns, and where these are few what is left hardly determines the cell, which
    doubles sigmas that are right (scripts/check_resampling.py measures it).

    Args:
        session: Its calibration stations are used.
        calibration: Of the whole session.
        recalibrate: Calibrates a session as that was made.
        rng: Draws.
        replicates: How many calibrations.
        progress: Told after each.

    Raises:
        InputError: fewer than three half-turns or lone stations, fewer than two with
            one of several mounts, or too few replicates determined the cell.
    """
    groups = station_groups(session)
    if len(groups) < 3:
        raise InputError(
            f"repeatability needs 3 half-turns or lone stations, got {len(groups)}"
        )
    by_mount: dict[int, list[tuple[int, ...]]] = {}
    for group in groups:
        by_mount.setdefault(session.stations[group[0]].mount, []).append(group)
    for mount, own in by_mount.items():
        if len(own) < 2:
            raise InputError(
                f"repeatability needs 2 half-turns or lone stations with each mount, "
                f"got 1 with mount {mount + 1}"
            )

    def draw() -> tuple[Session, NDArray[np.intp]]:
        # As many with each mount as there are: a programme fixes their number.
        chosen = [
            own[k]
            for own in by_mount.values()
            for k in rng.choice(len(own), _DRAWN * len(own))
        ]
        return drawn(session, chosen)

    spread = _spread(calibration, draw, recalibrate, replicates, len(groups), progress)
    covariance = spread.covariance
    return replace(
        spread, covariance=Covariance(covariance.labels, _DRAWN * covariance.matrix)
    )


def parametric_bootstrap(
    session: Session,
    calibration: HandEyeCalibration,
    recalibrate: Recalibrate,
    rng: np.random.Generator,
    *,
    replicates: int = 100,
    on_axis_correlation: float = 0.0,
    progress: Progress | None = None,
) -> Spread:
    """Calibrate again from measurements simulated with the stated noise.

    The calibrated cell is taken for the truth, the robot executes its reported poses
    within its repeatability, and pixels get noise of their covariance. This tests the
    covariance's linearisation, not the noise.

    Args:
        session: Its calibration stations are used.
        calibration: Of the whole session, without systematic errors of the robot.
        recalibrate: Calibrates a session as that was made.
        rng: Draws.
        replicates: How many calibrations.
        on_axis_correlation: Of detection errors of a marker on a half-turn's axis,
            before and after.
        progress: Told after each.

    Raises:
        InputError: the calibration estimated errors of the robot, or too few replicates
            determined the cell.
    """
    if calibration.robot:
        raise InputError(
            "a parametric bootstrap takes the robot's reported poses for the truth; "
            "calibrate without parameters of the robot"
        )
    groups = station_groups(session)
    used, index = drawn(session, groups)
    sigma = np.repeat(
        [session.repeatability.translation, session.repeatability.rotation], 3
    )
    seen = np.asarray(np.isfinite(used.pixels).all(axis=-1))
    covariance = np.where(seen[..., None, None], used.pixel_covariance, np.eye(2))
    root = np.linalg.cholesky(covariance)

    def draw() -> tuple[Session, NDArray[np.intp]]:
        moved = replace(
            used,
            stations=tuple(
                replace(
                    station,
                    base_from_flange=station.base_from_flange
                    @ SE3.exp(sigma * rng.standard_normal(6)),
                )
                for station in used.stations
            ),
        )
        noise = rng.standard_normal(used.pixels.shape)
        for turn in used.half_turns:
            if turn.axis != "normal":
                edge = list(EDGES[turn.axis])
                same, other = noise[:, turn.before], noise[:, turn.after]
                other[:, edge] *= np.sqrt(1.0 - on_axis_correlation**2)
                other[:, edge] += on_axis_correlation * same[:, edge]
        pixels = (
            predicted_pixels(calibration, moved) + (root @ noise[..., None])[..., 0]
        )
        pixels[~seen] = np.nan
        return replace(used, pixels=pixels), index

    return _spread(calibration, draw, recalibrate, replicates, 0, progress)


def _spread(
    calibration: HandEyeCalibration,
    draw: Callable[[], tuple[Session, NDArray[np.intp]]],
    recalibrate: Recalibrate,
    replicates: int,
    units: int,
    progress: Progress | None,
) -> Spread:
    """Covariance of the changes that recalibrating drawn sessions makes."""
    if replicates < 2:
        raise InputError(f"repeatability needs 2 replicates or more, got {replicates}")
    changes: list[dict[str, float]] = []
    for number in range(1, replicates + 1):
        part, index = draw()
        with contextlib.suppress(DegenerateMotionError, ConvergenceError):
            changes.append(_change(calibration, recalibrate(part, index)))
        if progress is not None:
            progress(number, replicates)
    if len(changes) < max(2, replicates // 2):
        raise InputError(
            f"repeatability: only {len(changes)} of {replicates} replicates determined "
            "the cell; add half-turns"
        )
    labels = tuple(changes[0])
    rows = np.array([[change[label] for label in labels] for change in changes])
    return Spread(
        Covariance(labels, np.cov(rows, rowvar=False)),
        len(changes),
        replicates - len(changes),
        units,
    )


def _change(whole: HandEyeCalibration, other: HandEyeCalibration) -> dict[str, float]:
    """From the whole's to another calibration of the cell, by label.

    Labels are those of the whole's covariance, and "baseline.<camera>"; motions change
    by the right tangent, as in the covariance.
    """
    rows = compare_with_truth(other, as_reference(whole))
    change = {row.quantity: row.error for row in rows}
    for label, value in whole.robot.items():
        # What another part of the data cannot determine is left at zero there.
        change[label] = other.robot.get(label, 0.0) - value
    return change


def track_part(
    calibration: HandEyeCalibration,
    session: Session,
    spread: Spread | None = None,
    robot_parameters: RobotParameters | None = None,
) -> float:
    """The calibration's part of the track error, RMS in metres.

    Places are the session's held-out stations, or all its stations where it has none.

    Args:
        calibration: Of the session.
        session: Where the track is.
        spread: Takes the place of the calibration's own covariance.
        robot_parameters: Those with which the calibration was made.
    """
    places = session
    if len(session.indices("evaluation")) == 0:
        places = held_out(session, session.indices("calibration").tolist())
    if spread is not None:
        labels = calibration.covariance.labels
        covariance = Covariance(labels, spread.covariance.block(labels))
        calibration = replace(calibration, covariance=covariance)
    return track_budget(calibration, places, robot_parameters).calibration
