"""Writes a session and its result as a rerun recording with its layout inside."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import InputError, StorageError
from handeye_tri.mechanism import Mechanism
from handeye_tri.records import (
    GroundTruth,
    HandEyeCalibration,
    Session,
    TrackEvaluation,
)
from handeye_tri.replay.engine import (
    RrdReader,
    only_views,
    recorded,
    rr,
    rrb,
    solid,
    transform,
)
from handeye_tri.replay.shapes import (
    crosses,
    eye_on_cell,
    eye_on_track,
    rings,
)
from handeye_tri.replay.story import Story, legend, numbers, tell
from handeye_tri.se3 import SE3, se3_inverse

Floats = NDArray[np.float64]
Photograph = Callable[[str, int], NDArray[np.uint8]]
Colour = tuple[int, int, int]

TIMELINE = "station"
_NUMBERS = "numbers/track"
# One colour each, in every view: what was estimated, what was held out, the truth.
ESTIMATE: Colour = (64, 156, 255)
HELD_OUT: Colour = (255, 149, 0)
TRUTH: Colour = (165, 165, 165)
WHITE: Colour = (255, 255, 255)
_JPEG_QUALITY = 90
# Our pixel (0, 0) is the first pixel's centre, rerun's is its outer corner.
_CORNER = 0.5
# How far before a camera its image is drawn, metres, and the truth's outline.
_IMAGE_DISTANCE, _TRUTH_DISTANCE = 0.25, 0.29


def write_recording(
    path: Path,
    *,
    name: str,
    mechanism: Mechanism,
    world_from_body: Floats,
    base_from_world: SE3,
    session: Session,
    photograph: Photograph,
    calibration: HandEyeCalibration,
    track: TrackEvaluation,
    truth: GroundTruth | None,
    verdict: str,
) -> None:
    """Write the recording of a calibrated session, whole or not at all.

    The same input gives the same recording; only the identities that rerun gives
    to rows differ.

    Args:
        path: The file, ``.rrd``.
        name: Names the recording in the viewer.
        mechanism: The compiled cell.
        world_from_body: Poses of its bodies at the n stations, (n, bodies, 4, 4), m.
        base_from_world: Where the world is, seen from the robot's base.
        session: What was observed.
        photograph: Image of a camera (name) at a station (index): RGB uint8,
            shape (h, w, 3), or grey, shape (h, w).
        calibration: The session's calibrated cell.
        track: Its held-out track; read back, the numbers are the same.
        truth: Of a simulated session.
        verdict: The verdict in Markdown.

    Raises:
        InputError: poses, stations and track do not fit each other.
        StorageError: the file cannot be written.
    """
    n = len(session.stations)
    if world_from_body.shape != (n, len(mechanism.bodies), 4, 4):
        raise InputError(
            f"world_from_body must have shape ({n}, {len(mechanism.bodies)}, 4, 4) "
            f"for these stations and bodies, got {world_from_body.shape}"
        )
    story = tell(session, calibration, track, truth)
    layout = _layout(calibration, story, base_from_world)
    with recorded(path, name, layout) as recording:
        _log_cell(recording, mechanism, base_from_world)
        _log_cameras(recording, calibration, truth)
        _log_numbers(recording, story, track, verdict)
        for j in range(n):
            recording.set_time(TIMELINE, sequence=j)
            for body, pose in enumerate(world_from_body[j][1:], 1):
                recording.log(_body_path(mechanism, body), transform(pose))
            _log_gaps(recording, story, j)
            if story.held_out[j]:
                recording.log(
                    "error_mm/predicted", rr.Scalars(1e3 * track.predicted_rms)
                )
            for i, camera in enumerate(calibration.cameras):
                _log_view(recording, session, story, i, camera.name, j)
                image = rr.Image(photograph(camera.name, j))
                recording.log(
                    f"{_camera_path(camera.name)}/image",
                    image.compress(jpeg_quality=_JPEG_QUALITY),
                )


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
        chunks = RrdReader(path).stream().filter(content=f"/{_NUMBERS}").to_chunks()
        text = chunks[0].to_record_batch().column("TextDocument:text")[0].as_py()[0]
        return dict(json.loads(text))
    except (ValueError, RuntimeError, OSError, IndexError, KeyError) as error:
        raise StorageError(
            f"{path}: not a recording of ours, or damaged ({error}); write it again: "
            "handeye-tri report"
        ) from None


def _camera_path(name: str) -> str:
    return f"cell/base/estimate/{name}"


def _body_path(mechanism: Mechanism, body: int) -> str:
    if body == 0:
        return "cell/surroundings"
    name = mechanism.bodies[body].name
    return f"cell/robot/{rr.escape_entity_path_part(name)}"


def _log_cell(
    recording: rr.RecordingStream, mechanism: Mechanism, base_from_world: SE3
) -> None:
    recording.log("cell", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    world_from_base = se3_inverse(base_from_world.matrix)
    recording.log("cell/base", transform(world_from_base), static=True)
    recording.log("track", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for geometry in mechanism.geometries:
        body = _body_path(mechanism, geometry.body)
        path = f"{body}/{rr.escape_entity_path_part(geometry.name)}"
        recording.log(path, transform(geometry.body_from_geometry.matrix), static=True)
        recording.log(path, solid(geometry), static=True)


def _log_cameras(
    recording: rr.RecordingStream,
    calibration: HandEyeCalibration,
    truth: GroundTruth | None,
) -> None:
    sources: list[tuple[str, Any, Colour, float, float]] = [
        ("estimate", calibration, ESTIMATE, _IMAGE_DISTANCE, 0.002)
    ]
    if truth is not None:
        sources.append(("truth", truth, TRUTH, _TRUTH_DISTANCE, 0.001))
    views = [
        (source, camera, motion, *look)
        for source, owner, *look in sources
        for camera, motion in zip(owner.cameras, owner.base_from_camera, strict=True)
    ]
    to_corner = np.array([[0.0, 0.0, _CORNER], [0.0, 0.0, _CORNER], [0.0, 0.0, 0.0]])
    for source, camera, motion, colour, distance, width in views:
        path = f"cell/base/{source}/{camera.name}"
        recording.log(path, transform(motion.matrix), static=True)
        recording.log(
            path,
            rr.Pinhole(
                image_from_camera=camera.intrinsics.matrix + to_corner,
                resolution=camera.image_size,
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=distance,
                color=colour,
                line_width=width,
            ),
            static=True,
        )
        # The lowest layer over an image can sink into it by rounding of depths, so
        # that layer is one point that nobody sees.
        recording.log(
            f"{path}/nothing",
            rr.Points2D([[0.0, 0.0]], colors=[(0, 0, 0, 0)], radii=[0.0], draw_order=1),
            static=True,
        )


def _log_view(
    recording: rr.RecordingStream,
    session: Session,
    story: Story,
    i: int,
    camera: str,
    j: int,
) -> None:
    """What camera i saw at station j, over its image."""
    path = _camera_path(camera)
    colour = HELD_OUT if story.held_out[j] else ESTIMATE
    seen = session.pixels[i, j] + _CORNER
    predicted = story.predicted[i, j] + _CORNER
    turn = story.turns[i][j]
    found, known = (np.isfinite(p).all(axis=1) for p in (seen, predicted))
    plus = crosses(predicted[known])
    # Negative radii are widths on the screen, however large the image is shown.
    for name, strips, paint, width, order in (
        ("half_turn", [line + _CORNER for line in turn.lines], WHITE, -0.5, 30),
        ("seen", rings(seen[found]), colour, -1.2, 20),
        # White on dark, and with a dark edge on white.
        ("predicted/edge", plus, (0, 0, 0), -1.6, 21),
        ("predicted", plus, WHITE, -0.7, 22),
    ):
        recording.log(
            f"{path}/{name}",
            rr.LineStrips2D(strips, colors=[paint], radii=[width], draw_order=order),
        )
    both = found & known
    recording.log(
        f"{path}/gap",
        rr.Arrows2D(
            origins=predicted[both],
            vectors=story.magnification_px * (seen - predicted)[both],
            colors=[colour],
            radii=[-1.2],
            draw_order=23,
        ),
    )
    visible = np.isfinite(turn.centre).all()
    recording.log(
        f"{path}/O",
        rr.Points2D(
            [turn.centre + _CORNER] if visible else [],
            colors=[WHITE],
            radii=[-2.5],
            labels=["O"] if visible else None,
            draw_order=31,
        ),
    )


def _log_gaps(recording: rr.RecordingStream, story: Story, j: int) -> None:
    """Robot against cameras at station j, in the cell and beside it."""
    colour = HELD_OUT if story.held_out[j] else ESTIMATE
    gaps = story.observed[j] - story.reported[j]
    seen = np.isfinite(gaps).all(axis=1)
    millimetres = 1e3 * np.linalg.norm(gaps, axis=1)
    for path, width in (("cell/base/gap", 0.004), ("track/gap", 0.002)):
        recording.log(
            path,
            rr.Arrows3D(
                origins=story.reported[j][seen],
                vectors=story.magnification * gaps[seen],
                colors=[colour],
                radii=[width],
            ),
        )
    worst = f"{np.nanmax(millimetres):.2f} mm" if seen.any() else "not seen"
    recording.log(
        "cell/base/gap/size",
        rr.Points3D(
            [story.reported[j].mean(axis=0) + [0.0, 0.0, 0.15]],
            colors=[colour],
            radii=[0.0],
            labels=[f"station {j}: {worst}"],
        ),
    )
    far = [story.far(story.observed)[j, [0, 1, 2, 0]]] if seen.all() else []
    for source, strips, paint in (
        ("robot", [story.reported[j, [0, 1, 2, 0]]], ESTIMATE),
        ("cameras", far, colour),
    ):
        recording.log(
            f"track/now/{source}",
            rr.LineStrips3D(strips, colors=[paint], radii=[0.0012]),
        )
    # Scalars are 64-bit: what is read back is what was evaluated.
    group = "held_out" if story.held_out[j] else "used"
    recording.log(f"error_mm/{group}", rr.Scalars(millimetres))


def _log_numbers(
    recording: rr.RecordingStream, story: Story, track: TrackEvaluation, verdict: str
) -> None:
    text = f"{verdict}\n\n---\n{legend(story)}"
    markdown = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
    recording.log("verdict", markdown, static=True)
    # Python's JSON of a 64-bit number reads back as that number.
    data = rr.TextDocument(json.dumps(numbers(story, track)))
    recording.log(_NUMBERS, data, static=True)
    for group, colour, word in (
        ("used", ESTIMATE, "used"),
        ("held_out", HELD_OUT, "held out"),
    ):
        marks = rr.SeriesPoints(
            colors=[colour] * 3,
            names=[f"{word} {letter}" for letter in "ABC"],
            markers=["circle", "square", "diamond"],
            marker_sizes=[5.0] * 3,
        )
        recording.log(f"error_mm/{group}", marks, static=True)
    line = rr.SeriesLines(colors=[HELD_OUT], names=["predicted rms"], widths=[1.0])
    recording.log("error_mm/predicted", line, static=True)
    colours = {"robot": ESTIMATE, "cameras": HELD_OUT, "truth": TRUTH}
    for source, places in story.tracks().items():
        look = {"colors": [colours[source]], "radii": [0.001]}
        recording.log(f"track/{source}", rr.LineStrips3D([places], **look), static=True)
        points = rr.Points3D(places, colors=[colours[source]], radii=[0.004])
        recording.log(f"track/{source}/stations", points, static=True)


def _layout(
    calibration: HandEyeCalibration, story: Story, base_from_world: SE3
) -> rrb.Blueprint:
    """Which views a person sees, where, and from which side."""
    images = [
        rrb.Spatial2DView(
            origin=_camera_path(camera.name),
            name=f"{camera.name}: o seen, + predicted, gap x {story.magnification_px}",
        )
        for camera in calibration.cameras
    ]
    # Frusta alone: by default a camera shows its axes too, as long as itself.
    frusta = {
        f"cell/base/{source}/{camera.name}": rr.Pinhole.from_fields()
        for camera in calibration.cameras
        for source in ("estimate", "truth")
    }
    gap = f"gap x {story.magnification}"
    cell, track = (
        rrb.Spatial3DView(
            origin=origin,
            name=f"{name}, {gap}",
            background=[24, 26, 30],
            line_grid=rrb.LineGrid3D(visible=False),
            overrides=frusta if origin == "cell" else None,
            eye_controls=rrb.EyeControls3D(
                position=eye.position, look_target=eye.target, eye_up=[0, 0, 1]
            ),
        )
        for origin, name, eye in (
            (
                "cell",
                "Cell; arrows from robot to cameras",
                eye_on_cell(calibration, story, base_from_world),
            ),
            ("track", "Held-out track", eye_on_track(calibration, story)),
        )
    )
    n = len(story.held_out)
    errors = rrb.TimeSeriesView(
        origin="error_mm",
        name="Robot against cameras at each station, mm; orange was held out",
        axis_x=rrb.TimeAxis(
            view_range=rr.TimeRange(
                start=rr.TimeRangeBoundary.absolute(seq=-1),
                end=rr.TimeRangeBoundary.absolute(seq=n),
            )
        ),
        axis_y=rrb.ScalarAxis(range=(0.0, 1.15 * story.largest_mm)),
        plot_legend=rrb.PlotLegend(visible=False),
    )
    text = rrb.TextDocumentView(origin="verdict", name="Verdict")
    layout = rrb.Horizontal(
        rrb.Vertical(cell, errors, row_shares=[7, 3]),
        rrb.Grid(*images, grid_columns=1 if len(images) < 3 else 2),
        rrb.Vertical(text, track, row_shares=[12, 8]),
        column_shares=[9.5, 6.5, 4],
    )
    return only_views(
        layout,
        rrb.TimePanel(
            state="collapsed", timeline=TIMELINE, play_state="following", fps=2.0
        ),
    )
