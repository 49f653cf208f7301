"""How the calibration got where it ended, step by step; numpy only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.evaluate import evaluate_track
from handeye_tri.evaluate.views import predicted_pixels
from handeye_tri.records import HandEyeCalibration, Session, TrackEvaluation
from handeye_tri.se3 import SE3
from handeye_tri.summary import round_magnification

Floats = NDArray[np.float64]

# A camera slides as far as this at most between solver steps, metres.
_LONGEST_SLIDE = 0.12
# And turns as far as this at most, radians.
_LARGEST_TURN = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class SolverStep:
    """The cell as a step of the calibration left it.

    Attributes:
        words: What the step did.
        calibration: The cell after it; its covariance and residuals are not its own.
    """

    words: str
    calibration: HandEyeCalibration


@dataclass(frozen=True, slots=True, eq=False)
class Slide:
    """A solver step as it is drawn.

    Attributes:
        words: What the step did.
        base_from_camera: Where each camera is drawn: its distance from the end is
            magnified.
        predicted: Markers in the images at the shown station, (m, 3, 2), pixels.
        observed: Markers there by the cameras, in the base, (3, 3), metres.
        reported: Markers there by the robot, (3, 3), metres.
        rms_px: Of seen less predicted over all used views.
        moved_mm: How far the cameras are from where they end, largest, mm.
    """

    words: str
    base_from_camera: tuple[SE3, ...]
    predicted: Floats
    observed: Floats
    reported: Floats
    rms_px: float
    moved_mm: float


def slides_of(
    session: Session,
    calibration: HandEyeCalibration,
    steps: Sequence[SolverStep],
    shown: int,
) -> tuple[tuple[Slide, ...], int]:
    """Solver steps with the cameras' ways magnified, and by how much."""
    end = calibration.base_from_camera
    every = (*steps, SolverStep("the result", calibration))
    ways = np.array(
        [
            [
                (own.inverse() @ motion).log()
                for own, motion in zip(end, s.calibration.base_from_camera, strict=True)
            ]
            for s in every
        ]
    )
    factor = magnification(ways[..., :3], _LONGEST_SLIDE)
    # A magnified turn stays one that the eye can follow.
    turned = float(np.linalg.norm(ways[..., 3:], axis=-1).max())
    factor = min(factor, round_magnification(turned, _LARGEST_TURN))
    used = np.ones(len(session.stations), dtype=bool)
    used[session.indices("evaluation")] = False
    slides = []
    for step, way in zip(every, ways, strict=True):
        predicted = predicted_pixels(step.calibration, session)
        residuals = (session.pixels - predicted)[:, used]
        rows = used_track(session, step.calibration)
        places = np.full((2, 3, 3), np.nan)
        if rows is not None:
            at = rows.stations == shown
            places[0, rows.markers[at]] = rows.observed[at]
            places[1, rows.markers[at]] = rows.reported[at]
        slides.append(
            Slide(
                words=step.words,
                base_from_camera=tuple(
                    own @ SE3.exp(factor * tangent)
                    for own, tangent in zip(end, way, strict=True)
                ),
                predicted=predicted[:, shown],
                observed=places[0],
                reported=places[1],
                rms_px=float(np.sqrt(2.0 * np.nanmean(residuals**2))),
                moved_mm=1e3 * float(np.linalg.norm(way[:, :3], axis=1).max()),
            )
        )
    return tuple(slides), factor


def used_track(
    session: Session, calibration: HandEyeCalibration
) -> TrackEvaluation | None:
    """Both tracks at the stations that the calibration used."""
    kinds = {"calibration": "evaluation", "evaluation": "calibration"}
    stations = tuple(
        replace(station, kind=kinds[station.kind])  # type: ignore[arg-type]
        for station in session.stations
    )
    enough = min(2, len(session.cameras))
    seen = np.isfinite(session.pixels).all(axis=-1).sum(axis=0) >= enough
    if not seen[session.indices("calibration")].any():
        return None
    swapped = replace(session, stations=stations, half_turns=())
    return evaluate_track(calibration, swapped)


def magnification(gaps: Floats, longest: float) -> int:
    """By how much gaps, shape (..., d) with NaN left out, are drawn too long."""
    lengths = np.linalg.norm(gaps, axis=-1)
    return round_magnification(float(np.nanmax(lengths, initial=0.0)), longest)
