"""What a recording tells, as plain arrays: everything that needs a formula."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import InputError
from handeye_tri.evaluate.views import ViewCheck, check_views, predicted_pixels
from handeye_tri.records import (
    DroppedHalfTurn,
    GroundTruth,
    HandEyeCalibration,
    Session,
    TrackEvaluation,
    motion_labels,
)
from handeye_tri.replay.half_turns import HalfTurnView, half_turn_views
from handeye_tri.replay.steps import (
    Slide,
    SolverStep,
    magnification,
    slides_of,
    used_track,
)
from handeye_tri.summary import round_magnification
from handeye_tri.triangle import VERTICES

Floats = NDArray[np.float64]

# A gap is drawn as long as this at most, metres; the eye reads it beside the rig.
_LONGEST_ARROW = 0.25
# An arrow in an image is as long as this at most, pixels.
_LONGEST_ARROW_PX = 100.0
# Half an axis of an ellipsoid about a camera is as long as this at most, metres.
_LARGEST_ELLIPSOID = 0.09
# 95 % of three normal errors lie within so many sigmas of each: chi-square, 3 degrees.
_SIGMAS_95 = 2.7955


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoid:
    """Where 95 % of a camera's position errors lie, magnified; axes of the camera.

    Attributes:
        half_sizes: Shape (3,), metres, magnified.
        rotation: From the ellipsoid's axes to the camera's, shape (3, 3).
        truth: The true position in the camera's frame, magnified alike, (3,), metres;
            None without truth.
    """

    half_sizes: Floats
    rotation: Floats
    truth: Floats | None


@dataclass(frozen=True, slots=True, eq=False)
class Story:
    """The calibrated session, station by station, in the base frame.

    Attributes:
        held_out: Whether the calibration never saw the station, shape (n,).
        reported: Markers where the robot says that they are, shape (n, 3, 3), m.
        observed: Markers where the cameras see them, shape (n, 3, 3), m; NaN =
            seen by fewer than two cameras, or by less than all of the only one.
        actual: Markers where they truly were, (n, 3, 3), m; None without truth.
        mounts: What the mount that holds the triangle is called, by station.
        predicted: Markers in the images by calibration and robot, their outline's
            centre, shape (m, n, 3, 2), pixels.
        turns: Per camera and station, the half-turn that the station belongs to;
            without lines where it belongs to none.
        shown: The station that is shown first: one that the first finding is about, or
            the used one with the largest gap.
        checks: Every view against what is predicted for it, most unlikely first.
        slides: Solver steps, the last one as calibrated.
        ellipsoids: One per camera.
        magnification: How much longer than true the gaps in space are drawn.
        magnification_px: How much longer the gaps in the images are drawn.
        magnification_slide: The same of the cameras between solver steps.
        magnification_ellipsoid: The same of the ellipsoids.
    """

    held_out: NDArray[np.bool_]
    reported: Floats
    observed: Floats
    actual: Floats | None
    mounts: tuple[str, ...]
    predicted: Floats
    turns: tuple[tuple[HalfTurnView, ...], ...]
    shown: int
    checks: tuple[ViewCheck, ...]
    slides: tuple[Slide, ...]
    ellipsoids: tuple[Ellipsoid, ...]
    magnification: int
    magnification_px: int
    magnification_slide: int
    magnification_ellipsoid: int

    @property
    def distances_mm(self) -> Floats:
        """Gap of robot and cameras, shape (n, 3), mm; NaN = not seen by two cameras."""
        return np.asarray(1e3 * np.linalg.norm(self.observed - self.reported, axis=-1))

    def worst(self, j: int) -> tuple[str, float]:
        """The marker with the largest gap at station j, and that gap, mm.

        The letter is empty where no marker was seen by two cameras.
        """
        gaps = self.distances_mm[j]
        if not np.isfinite(gaps).any():
            return "", float("nan")
        k = int(np.nanargmax(gaps))
        return VERTICES[k], float(gaps[k])

    def far(self, points: Floats) -> Floats:
        """Put markers, (n, 3, 3), so many times farther from where the robot says."""
        return np.asarray(self.reported + self.magnification * (points - self.reported))

    def tracks(self) -> dict[str, Floats]:
        """Held-out tracks with their gaps magnified, each of shape (k, 3), metres.

        One place per station, the middle of its markers: by "robot", by "cameras",
        and by "truth" where it is known. What was not seen is left out.
        """
        sources = {"robot": self.reported, "cameras": self.far(self.observed)}
        if self.actual is not None:
            sources["truth"] = self.far(self.actual)
        places = {
            name: points[self.held_out].mean(axis=1) for name, points in sources.items()
        }
        return {
            name: line[np.isfinite(line).all(axis=1)] for name, line in places.items()
        }

    @property
    def largest_mm(self) -> float:
        """Largest gap of robot and cameras at any station, mm."""
        return float(np.nanmax(self.distances_mm))


def tell(
    session: Session,
    calibration: HandEyeCalibration,
    track: TrackEvaluation,
    truth: GroundTruth | None,
    steps: Sequence[SolverStep] = (),
    *,
    dropped: Sequence[DroppedHalfTurn] = (),
    about: Sequence[int] = (),
) -> Story:
    """Prepare a session for drawing.

    Args:
        session: What was observed.
        calibration: Its calibrated cell.
        track: Its held-out track; these very positions are drawn.
        truth: Of a simulated session.
        steps: By which the calibration was reached, without the last one.
        dropped: Half-turns that it left out.
        about: Stations that the first finding is about, none where it is about all.

    Raises:
        InputError: the track is not of this session.
    """
    n = len(session.stations)
    tested = session.indices("evaluation")
    if len(tested) == 0:
        # Each was held out of the calibration that its part of the track is by.
        tested = np.unique(track.stations)
    held_out = np.isin(np.arange(n), tested)
    if track.stations.max() >= n or not held_out[track.stations].all():
        raise InputError(
            "the track has stations that this session does not hold out; "
            "evaluate this session first"
        )
    mounts = session.mounts
    reported = _move(session.base_from_flange, calibration.markers_at(mounts))
    observed = np.full((n, 3, 3), np.nan)
    for rows in (used_track(session, calibration), track):
        if rows is not None:
            observed[rows.stations, rows.markers] = rows.observed
            reported[rows.stations, rows.markers] = rows.reported
    actual = None
    if truth is not None:
        markers = truth.markers
        if markers is None:
            markers = truth.flange_from_triangle.apply(session.triangle.points)
        others = [mount.markers for mount in truth.other_mounts]
        actual = _move(truth.base_from_flange, np.array([markers, *others])[mounts])
    predicted = predicted_pixels(calibration, session)
    gaps = observed - reported
    shown = _worst_of(gaps, about)
    if shown is None:
        shown = _worst_used(gaps, held_out, worst_station(track))
    slides, slide = slides_of(session, calibration, steps, shown)
    ellipsoids, larger = _ellipsoids(calibration, truth)
    return Story(
        held_out=held_out,
        reported=reported,
        observed=observed,
        actual=actual,
        mounts=tuple(session.mount_name(mount) for mount in mounts.tolist()),
        predicted=predicted,
        turns=tuple(
            half_turn_views(session, i, camera)
            for i, camera in enumerate(calibration.cameras)
        ),
        shown=shown,
        checks=check_views(calibration, session, dropped),
        slides=slides,
        ellipsoids=ellipsoids,
        magnification=magnification(gaps, _LONGEST_ARROW),
        magnification_px=magnification(session.pixels - predicted, _LONGEST_ARROW_PX),
        magnification_slide=slide,
        magnification_ellipsoid=larger,
    )


def _worst_of(gaps: Floats, stations: Sequence[int]) -> int | None:
    """The first of these stations with the largest gap; None of none."""
    lengths = np.linalg.norm(gaps, axis=-1)
    sizes = [float(np.nanmax(lengths[j], initial=-1.0)) for j in stations]
    return int(stations[int(np.argmax(sizes))]) if sizes else None


def _worst_used(gaps: Floats, held_out: NDArray[np.bool_], otherwise: int) -> int:
    """The used station with the largest gap, (n, 3, 3); otherwise where none has one.

    Without held-out stations each was held out in turn: then it is the worst of all.
    """
    used = ~held_out if not held_out.all() else held_out
    lengths = np.linalg.norm(gaps, axis=-1)
    lengths[~used | ~np.isfinite(lengths).any(axis=1)] = np.nan
    if not np.isfinite(lengths).any():
        return otherwise
    return int(np.nanargmax(lengths) // 3)


def _ellipsoids(
    calibration: HandEyeCalibration, truth: GroundTruth | None
) -> tuple[tuple[Ellipsoid, ...], int]:
    """The cameras' 95 % ellipsoids and how many times too large they are."""
    values, axes, errors = [], [], []
    for i, camera in enumerate(calibration.cameras):
        labels = motion_labels(f"base_from_{camera.name}")[:3]
        value, axis = np.linalg.eigh(calibration.covariance.block(labels))
        values.append(_SIGMAS_95 * np.sqrt(np.maximum(value, 0.0)))
        # A rotation: its axes are right-handed.
        axes.append(axis * np.sign(np.linalg.det(axis)))
        if truth is not None:
            motion = calibration.base_from_camera[i]
            errors.append(motion.inverse().apply(truth.base_from_camera[i].translation))
    factor = round_magnification(float(np.max(values)), _LARGEST_ELLIPSOID)
    return tuple(
        Ellipsoid(
            factor * value, axis, factor * errors[i] if truth is not None else None
        )
        for i, (value, axis) in enumerate(zip(values, axes, strict=True))
    ), factor


def _move(base_from_flange: Floats, markers: Floats) -> Floats:
    """Markers (n, 3, 3) in the flange at poses (n, 4, 4): in the base, (n, 3, 3)."""
    turned = np.einsum("nab,nkb->nka", base_from_flange[:, :3, :3], markers)
    return np.asarray(turned + base_from_flange[:, None, :3, 3])


def worst_station(track: TrackEvaluation) -> int:
    """The held-out station with the largest error."""
    return int(track.stations[np.argmax(track.distances)])
