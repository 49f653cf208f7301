"""What a recording tells, as plain arrays: everything that needs a formula."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.evaluate import evaluate_track
from handeye_tri.evaluate.views import predicted_pixels
from handeye_tri.records import (
    GroundTruth,
    HandEyeCalibration,
    Session,
    TrackEvaluation,
)
from handeye_tri.summary import round_magnification
from handeye_tri.triangle import EDGES, Axis

Floats = NDArray[np.float64]

# A gap is drawn as long as this at most, metres; the eye reads it beside the rig.
_LONGEST_ARROW = 0.12
# An arrow in an image is as long as this at most, pixels.
_LONGEST_ARROW_PX = 60.0
# Points per drawn half-turn line: enough to show what a lens bends.
_LINE_POINTS = 17
# Two places of one marker closer than this lie on the axis, pixels.
_STANDS_STILL = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class HalfTurnView:
    """What one camera saw of a half-turn.

    Attributes:
        lines: From each moving marker before to the same after, as curves that the
            lens bends; each of shape (p, 2), pixels.
        centre: O, where the lines meet the axis, shape (2,), pixels; NaN where the
            view does not show it.
    """

    lines: tuple[Floats, ...]
    centre: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Story:
    """The calibrated session, station by station, in the base frame.

    Attributes:
        held_out: Whether the calibration never saw the station, shape (n,).
        reported: Markers where the robot says that they are, shape (n, 3, 3), m.
        observed: Markers where the cameras see them, shape (n, 3, 3), m; NaN =
            seen by fewer than two cameras.
        actual: Markers where they truly were, (n, 3, 3), m; None without truth.
        predicted: Markers in the images by calibration and robot, their outline's
            centre, shape (m, n, 3, 2), pixels.
        turns: Per camera and station, the half-turn that the station belongs to;
            without lines where it belongs to none.
        magnification: How much longer than true the gaps in space are drawn.
        magnification_px: How much longer the gaps in the images are drawn.
    """

    held_out: NDArray[np.bool_]
    reported: Floats
    observed: Floats
    actual: Floats | None
    predicted: Floats
    turns: tuple[tuple[HalfTurnView, ...], ...]
    magnification: int
    magnification_px: int

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
        gaps = np.linalg.norm(self.observed - self.reported, axis=-1)
        return 1e3 * float(np.nanmax(gaps))


def tell(
    session: Session,
    calibration: HandEyeCalibration,
    track: TrackEvaluation,
    truth: GroundTruth | None,
) -> Story:
    """Prepare a session for drawing.

    Args:
        session: What was observed.
        calibration: Its calibrated cell.
        track: Its held-out track; these very positions are drawn.
        truth: Of a simulated session.

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
    reported = _move(session.base_from_flange, calibration.markers)
    observed = np.full((n, 3, 3), np.nan)
    for rows in (_used_track(session, calibration), track):
        if rows is not None:
            observed[rows.stations, rows.markers] = rows.observed
            reported[rows.stations, rows.markers] = rows.reported
    actual = None
    if truth is not None:
        markers = truth.markers
        if markers is None:
            markers = truth.flange_from_triangle.apply(session.triangle.points)
        actual = _move(truth.base_from_flange, markers)
    predicted = predicted_pixels(calibration, session)
    return Story(
        held_out=held_out,
        reported=reported,
        observed=observed,
        actual=actual,
        predicted=predicted,
        turns=tuple(
            _half_turns(session, i, camera)
            for i, camera in enumerate(calibration.cameras)
        ),
        magnification=_magnification(observed - reported, _LONGEST_ARROW),
        magnification_px=_magnification(session.pixels - predicted, _LONGEST_ARROW_PX),
    )


def _move(base_from_flange: Floats, markers: Floats) -> Floats:
    """Markers (3, 3) in the flange at poses (n, 4, 4): in the base, (n, 3, 3)."""
    turned = np.einsum("nab,kb->nka", base_from_flange[:, :3, :3], markers)
    return np.asarray(turned + base_from_flange[:, None, :3, 3])


def _used_track(
    session: Session, calibration: HandEyeCalibration
) -> TrackEvaluation | None:
    """Both tracks at the stations that the calibration used."""
    kinds = {"calibration": "evaluation", "evaluation": "calibration"}
    stations = tuple(
        replace(station, kind=kinds[station.kind])  # type: ignore[arg-type]
        for station in session.stations
    )
    seen = np.isfinite(session.pixels).all(axis=-1).sum(axis=0) >= 2
    if not seen[session.indices("calibration")].any():
        return None
    swapped = replace(session, stations=stations, half_turns=())
    return evaluate_track(calibration, swapped)


def _half_turns(
    session: Session, i: int, camera: PinholeCamera
) -> tuple[HalfTurnView, ...]:
    views = [HalfTurnView((), np.full(2, np.nan)) for _ in session.stations]
    for turn in session.half_turns:
        seen = _half_turn(
            camera,
            session.pixels[i, turn.before],
            session.pixels[i, turn.after],
            turn.axis,
        )
        views[turn.before] = views[turn.after] = seen
    return tuple(views)


def _half_turn(
    camera: PinholeCamera, before: Floats, after: Floats, axis: Axis
) -> HalfTurnView:
    """Lines from each marker to its twin, and O where they meet the axis.

    About the normal all three lines pass through O (Zhao, Liu and Zhang 2008,
    Sec. III-A); about an edge the third vertex' line meets that edge in the foot of
    its perpendicular (Sec. III-B).
    """
    moved = np.linalg.norm(after - before, axis=1) > _STANDS_STILL
    # Lines are straight where there is no lens.
    start, end = camera.normalised(before[moved]), camera.normalised(after[moved])
    along = np.linspace(0.0, 1.0, _LINE_POINTS)[:, None, None]
    curves = camera.pixels(start + along * (end - start))
    pairs = list(zip(start, end, strict=True))
    if axis in EDGES:
        on_axis = camera.normalised(before[list(EDGES[axis])])
        if np.isfinite(on_axis).all():
            pairs.append((on_axis[0], on_axis[1]))
    centre = np.full(2, np.nan)
    if len(pairs) >= 2:
        centre = camera.pixels(_meeting_point(np.array(pairs)))
    return HalfTurnView(tuple(np.moveaxis(curves, 1, 0)), centre)


def _meeting_point(pairs: Floats) -> Floats:
    """Point nearest to lines through pairs of points, (k, 2, 2) -> (2,)."""
    along = pairs[:, 1] - pairs[:, 0]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    offset = (normal * pairs[:, 0]).sum(axis=1)
    return np.asarray(np.linalg.lstsq(normal, offset)[0])


def _magnification(gaps: Floats, longest: float) -> int:
    """By how much gaps, shape (..., d) with NaN left out, are drawn too long."""
    lengths = np.linalg.norm(gaps, axis=-1)
    return round_magnification(float(np.nanmax(lengths, initial=0.0)), longest)


def worst_station(track: TrackEvaluation) -> int:
    """The held-out station with the largest error."""
    return int(track.stations[np.argmax(track.distances)])


def numbers(story: Story, track: TrackEvaluation) -> dict[str, Any]:
    """What a recording carries to be read back, with the units in the keys."""
    return {
        "station_count": len(story.held_out),
        "worst_station": worst_station(track),
        "stations": track.stations.tolist(),
        "markers": track.markers.tolist(),
        "reported_m": track.reported.tolist(),
        "observed_m": track.observed.tolist(),
        "predicted_covariance_m2": track.predicted_covariance.tolist(),
        "mean_mm": 1e3 * track.mean,
        "rms_mm": 1e3 * track.rms,
        "max_mm": 1e3 * track.max,
        "predicted_rms_mm": 1e3 * track.predicted_rms,
    }


def legend(story: Story) -> str:
    """How to read the pictures."""
    truth = " **Grey**: the truth." if story.actual is not None else ""
    return (
        "**Blue**: what was calibrated, and the stations it used. **Orange**: held "
        f"out.{truth}\n\nImages: o where a marker is seen, + where calibration and "
        f"robot put it, the arrow between them {story.magnification_px} times too "
        "long. White lines join a marker before and after a half-turn and meet in "
        f"O.\n\nIn space: from robot to cameras, {story.magnification} times too long."
    )


def verdict_markdown(evaluation: Mapping[str, Any]) -> str:
    """The verdict for the recording, from ``evaluation.json``.

    Args:
        evaluation: The content of ``evaluation.json``.
    """
    track = evaluation["track"]
    ran = [gate for gate in evaluation["gates"] if gate["verdict"] != "not run"]
    met = sum(gate["verdict"] != "bad" for gate in ran)
    source = (
        "SIMULATED: truth known, used only to score"
        if evaluation["simulated"]
        else "REAL robot"
    )
    lines = [
        f"# {evaluation['verdict']}",
        f"{met} of {len(ran)} gates met, {len(evaluation['gates']) - len(ran)} not "
        f"run. {source}.",
        "",
        evaluation["sentence"],
        "",
        f"**Look at station {track['worst_station']}**, the worst that was held out: "
        f"marker {track['worst_marker']} is {track['max_mm']:.3f} mm off.",
        "",
        f"Held-out track: {track['mean_mm']:.3f} mm mean, {track['rms_mm']:.3f} rms "
        f"(predicted {track['predicted_rms_mm']:.3f}).",
        "",
        f"Nearest to failing: {evaluation['nearest']}.",
    ]
    for finding in evaluation["findings"]:
        lines += [
            "",
            f"**{finding['code']}** {finding['cause']} ({finding['evidence']}). "
            f"Do: {finding['remedy']}.",
        ]
    return "\n".join(lines)
