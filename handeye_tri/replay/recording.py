"""Writes a session and its result as a rerun recording with its layout inside."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import InputError, StorageError
from handeye_tri.mechanism import Mechanism
from handeye_tri.records import (
    DroppedHalfTurn,
    GroundTruth,
    HandEyeCalibration,
    Session,
    TrackEvaluation,
)
from handeye_tri.replay.drawing import (
    body_path,
    log_cameras,
    log_cell,
    log_gaps,
    log_mount,
    log_places,
    log_tracks,
)
from handeye_tri.replay.engine import RrdReader, recorded, rr, transform
from handeye_tri.replay.layout import layout
from handeye_tri.replay.overlay import log_predicted, log_view
from handeye_tri.replay.paths import NUMBERS, camera_path
from handeye_tri.replay.shapes import ESTIMATE, HELD_OUT
from handeye_tri.replay.steps import SolverStep
from handeye_tri.replay.story import Story, tell
from handeye_tri.replay.words import (
    cameras_markdown,
    log_lines,
    numbers,
    step_words,
    steps_markdown,
    track_markdown,
    verdict_markdown,
)
from handeye_tri.se3 import SE3
from handeye_tri.triangle import VERTICES

Floats = NDArray[np.float64]
Photograph = Callable[[str, int], NDArray[np.uint8]]

_JPEG_QUALITY = 90


def write_recording(
    path: Path,
    *,
    name: str,
    mechanisms: Sequence[Mechanism],
    world_from_body: Floats,
    base_from_world: SE3,
    session: Session,
    photograph: Photograph,
    calibration: HandEyeCalibration,
    track: TrackEvaluation,
    truth: GroundTruth | None,
    evaluation: Mapping[str, Any],
    steps: Sequence[SolverStep] = (),
    dropped: Sequence[DroppedHalfTurn] = (),
) -> None:
    """Write the recording of a calibrated session, whole or not at all.

    The same input gives the same recording; only the identities that rerun gives
    to rows differ.

    Args:
        path: The file, ``.rrd``.
        name: Names the recording in the viewer.
        mechanisms: The compiled cell with each mount; their bodies are the same.
        world_from_body: Poses of its bodies at the n stations, (n, bodies, 4, 4), m.
        base_from_world: Where the world is, seen from the robot's base.
        session: What was observed.
        photograph: Image of a camera (name) at a station (index): RGB uint8,
            shape (h, w, 3), or grey, shape (h, w).
        calibration: The session's calibrated cell.
        track: Its held-out track; read back, the numbers are the same.
        truth: Of a simulated session.
        evaluation: The content of ``evaluation.json``.
        steps: By which the calibration was reached, without the last one.
        dropped: Half-turns that it left out.

    Raises:
        InputError: poses, stations and track do not fit each other.
        StorageError: the file cannot be written.
    """
    n, mechanism = len(session.stations), mechanisms[0]
    if world_from_body.shape != (n, len(mechanism.bodies), 4, 4):
        raise InputError(
            f"world_from_body must have shape ({n}, {len(mechanism.bodies)}, 4, 4) "
            f"for these stations and bodies, got {world_from_body.shape}"
        )
    first = next(iter(evaluation["findings"]), {"stations": ()})
    story = tell(
        *(session, calibration, track, truth, steps),
        dropped=dropped,
        about=first["stations"],
    )
    look = layout(calibration, story, base_from_world)
    tracked = {int(j): k for k, j in enumerate(np.flatnonzero(story.held_out))}
    with recorded(path, name, look) as recording:
        log_cell(recording, mechanisms, base_from_world)
        log_cameras(recording, calibration, story, truth)
        log_tracks(recording, story)
        _log_words(recording, story, track, evaluation)
        # What the cameras' places begin at, on every timeline.
        _at(recording, station=0, step=len(story.slides) - 1, track=0)
        log_places(recording, calibration, story, len(story.slides) - 1)
        for j in range(n):
            place = {"station": j, "track": tracked.get(j)}
            _at(recording, **place)
            log_gaps(recording, story, j, story.reported[j], story.observed[j])
            # Solver steps are shown at the station that is shown first.
            _at(recording, **place, step=0 if j == story.shown else None)
            for body, pose in enumerate(world_from_body[j][1:], 1):
                recording.log(body_path(mechanism, body), transform(pose))
            if len(mechanisms) > 1:
                log_mount(recording, mechanisms, session.stations[j].mount)
            if story.held_out[j]:
                recording.log(
                    "error_mm/predicted", rr.Scalars(1e3 * track.predicted_rms)
                )
            for i, camera in enumerate(calibration.cameras):
                log_view(recording, session, story, i, camera, j)
                image = rr.Image(photograph(camera.name, j))
                recording.log(
                    f"{camera_path(camera.name)}/image",
                    image.compress(jpeg_quality=_JPEG_QUALITY),
                )
        for step in range(len(story.slides)):
            _at(recording, step=step)
            _log_step(recording, session, calibration, story, step)


def _at(recording: rr.RecordingStream, **sequence: int | None) -> None:
    """Log what follows at these places of the timelines and on no other."""
    recording.reset_time()
    for timeline, place in sequence.items():
        if place is not None:
            recording.set_time(timeline, sequence=place)


def _log_step(
    recording: rr.RecordingStream,
    session: Session,
    calibration: HandEyeCalibration,
    story: Story,
    step: int,
) -> None:
    """The cell at a solver step, at the station that is shown first."""
    slide, j = story.slides[step], story.shown
    log_places(recording, calibration, story, step)
    log_gaps(recording, story, j, slide.reported, slide.observed)
    recording.log("log", rr.TextLog(step_words(slide), level="INFO"))
    colour = HELD_OUT if story.held_out[j] else ESTIMATE
    for i, camera in enumerate(calibration.cameras):
        log_predicted(
            *(recording, story, camera.name, session.pixels[i, j]),
            *(slide.predicted[i], colour),
        )


def _log_words(
    recording: rr.RecordingStream,
    story: Story,
    track: TrackEvaluation,
    evaluation: Mapping[str, Any],
) -> None:
    for path, text in (
        ("verdict", verdict_markdown(evaluation, story, track)),
        ("cameras", cameras_markdown(evaluation)),
        ("steps", steps_markdown(story)),
        ("track_table", track_markdown(track, evaluation)),
    ):
        markdown = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        recording.log(path, markdown, static=True)
    # Python's JSON of a 64-bit number reads back as that number.
    data = rr.TextDocument(json.dumps(numbers(story, track)))
    recording.log(NUMBERS, data, static=True)
    for group, colour, word in (
        ("used", ESTIMATE, "used"),
        ("held_out", HELD_OUT, "held out"),
    ):
        marks = rr.SeriesPoints(
            colors=[colour] * 3,
            names=[f"{word} {letter}" for letter in VERTICES],
            markers=["circle", "square", "diamond"],
            marker_sizes=[5.0] * 3,
        )
        recording.log(f"error_mm/{group}", marks, static=True)
    line = rr.SeriesLines(colors=[HELD_OUT], names=["predicted rms"], widths=[1.0])
    recording.log("error_mm/predicted", line, static=True)
    for line_ in log_lines(story, evaluation):
        _at(recording, station=line_.station)
        recording.log("log", rr.TextLog(line_.text, level=line_.level))


def read_numbers(path: Path) -> dict[str, Any]:
    """Read back the numbers of a recording by :func:`write_recording`.

    Returns:
        The held-out track, field by field as in TrackEvaluation, with the unit in
        the key; "station_count", and "worst_station" of those held out.

    Raises:
        StorageError: the file is missing, damaged, or another's.
    """
    if not path.is_file():
        raise StorageError(f"{path}: this file is missing; run: handeye-tri report")
    try:
        chunks = RrdReader(path).stream().filter(content=f"/{NUMBERS}").to_chunks()
        text = chunks[0].to_record_batch().column("TextDocument:text")[0].as_py()[0]
        return dict(json.loads(text))
    except (ValueError, RuntimeError, OSError, IndexError, KeyError) as error:
        raise StorageError(
            f"{path}: not a recording of ours, or damaged ({error}); write it again: "
            "handeye-tri report"
        ) from None
