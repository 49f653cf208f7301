"""Which views a person sees, where, and from which side: one tab per purpose."""

from __future__ import annotations

from typing import Any

from handeye_tri.records import HandEyeCalibration
from handeye_tri.replay.engine import only_views, rr, rrb
from handeye_tri.replay.paths import STATION, camera_path
from handeye_tri.replay.shapes import Eye, eye_on_cameras, eye_on_cell, eye_on_track
from handeye_tri.replay.story import Story
from handeye_tri.se3 import SE3

# Names of the tabs; the first is open.
BLUEPRINTS = ("overview", "cameras", "track")


def layout(
    calibration: HandEyeCalibration, story: Story, base_from_world: SE3
) -> rrb.Blueprint:
    """All tabs of a recording."""
    # Frusta alone: by default a camera shows its axes too, as long as itself.
    frusta = {
        f"cell/base/{source}/{camera.name}": rr.Pinhole.from_fields()
        for camera in calibration.cameras
        for source in ("estimate", "truth")
    }
    near = f"95 % ellipsoids x {story.magnification_ellipsoid}"
    gaps = f"gaps x {story.magnification}"
    whole = space(
        "cell",
        f"Cell: arrows from robot to cameras, {gaps}; {near}",
        eye_on_cell(calibration.base_from_camera, story.reported, base_from_world),
        overrides=frusta,
    )
    cameras = space(
        "cell",
        f"Where the cameras are: {near}",
        eye_on_cameras(calibration, base_from_world),
        overrides=frusta,
    )
    track = space(
        "track",
        f"Held-out track, robot and cameras: {gaps}; numbers are true mm",
        eye_on_track(calibration, story),
    )
    tabs = (
        rrb.Horizontal(
            rrb.Vertical(whole, _errors(story), row_shares=[7, 3]),
            _images(calibration, story, columns=1 if len(story.turns) < 3 else 2),
            rrb.Vertical(_text("verdict", "Verdict"), _log(), row_shares=[13, 7]),
            column_shares=[9, 6.5, 4.5],
            name="Overview",
        ),
        rrb.Vertical(
            _images(calibration, story, columns=2),
            rrb.Horizontal(
                cameras,
                _text("cameras", "Cameras, px and mm"),
                _text("steps", "How the calibration got there"),
                column_shares=[7, 8, 5],
            ),
            row_shares=[11, 9],
            name="Cameras",
        ),
        rrb.Horizontal(
            rrb.Vertical(track, _errors(story), row_shares=[7, 3]),
            _text("track_table", "Held-out track, mm"),
            column_shares=[12, 8],
            name="Track",
        ),
    )
    return only_views(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.TimePanel(
            state="collapsed", timeline=STATION, play_state="following", fps=2.0
        ),
    )


def space(origin: str, name: str, eye: Eye, **more: Any) -> rrb.Spatial3DView:
    """A view in space, dark, without a grid."""
    return rrb.Spatial3DView(
        origin=origin,
        name=name,
        background=[24, 26, 30],
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            position=eye.position, look_target=eye.target, eye_up=[0, 0, 1]
        ),
        **more,
    )


def _images(calibration: HandEyeCalibration, story: Story, *, columns: int) -> rrb.Grid:
    views = [
        rrb.Spatial2DView(
            origin=camera_path(camera.name),
            name=f"{camera.name}: o seen, + predicted, arrows x "
            f"{story.magnification_px}",
        )
        for camera in calibration.cameras
    ]
    return rrb.Grid(*views, grid_columns=min(columns, len(views)))


def _errors(story: Story) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="error_mm",
        name="Robot against cameras, mm: A ●, B ■, C ◆; used blue, held out orange",
        axis_x=rrb.TimeAxis(
            view_range=rr.TimeRange(
                start=rr.TimeRangeBoundary.absolute(seq=-1),
                end=rr.TimeRangeBoundary.absolute(seq=len(story.held_out)),
            )
        ),
        axis_y=rrb.ScalarAxis(range=(0.0, 1.15 * story.largest_mm)),
        plot_legend=rrb.PlotLegend(visible=False),
    )


def _text(origin: str, name: str) -> rrb.TextDocumentView:
    return rrb.TextDocumentView(origin=origin, name=name)


def _log() -> rrb.TextLogView:
    columns = [
        rrb.encodings.TextLogColumn(kind, visible=kind != "entitypath")
        for kind in ("loglevel", "entitypath", "body")
    ]
    return rrb.TextLogView(
        origin="log",
        name="Findings, station by station",
        columns=rrb.TextLogColumns(text_log_columns=columns),
    )
