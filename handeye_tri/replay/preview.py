"""Writes a plan as a recording: the arm on its way, and what the cameras will see."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.mechanism import Mechanism
from handeye_tri.records import Plan
from handeye_tri.replay.drawing import (
    IMAGE_DISTANCE,
    body_path,
    log_cell,
    log_mount,
    log_pinhole,
)
from handeye_tri.replay.engine import only_views, recorded, rr, rrb, transform
from handeye_tri.replay.layout import space
from handeye_tri.replay.overlay import CORNER
from handeye_tri.replay.paths import NUMBERS, STATION, TIME, camera_path
from handeye_tri.replay.shapes import (
    ESTIMATE,
    HELD_OUT,
    TRUTH,
    WHITE,
    Colour,
    eye_on_cell,
    rings,
)
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]

# A marker's disc where no image shows it, pixels of the image.
_DISC_PX = 4.5
_JPEG_QUALITY = 80
# Camera, moment, and what is seen: RGB, shape (h, w, 3), or grey, (h, w).
View = tuple[int, int, NDArray[np.uint8]]
_CLOSED = [0, 1, 2, 0]


@dataclass(frozen=True, slots=True, eq=False)
class PlannedMotion:
    """A programme in time, at t moments.

    Attributes:
        plan: The programme.
        times: Seconds since its start, shape (t,), ascending.
        station: Where the robot stands then, -1 on the way, shape (t,).
        mounts: Which mount holds the triangle then, from 0, shape (t,).
        mount_names: What the mounts are called.
        world_from_body: Poses of the mechanism's bodies, (t, bodies, 4, 4), metres.
        markers: A, B, C in the base, shape (t, 3, 3), metres.
        cameras: The m cameras as the cell describes them.
        base_from_camera: Where they stand.
        marker_colours: Of A, B, C, red green blue 0-1, shape (3, 3).
    """

    plan: Plan
    times: Floats
    station: NDArray[np.intp]
    mounts: NDArray[np.intp]
    mount_names: tuple[str, ...]
    world_from_body: Floats
    markers: Floats
    cameras: tuple[PinholeCamera, ...]
    base_from_camera: tuple[SE3, ...]
    marker_colours: Floats

    def __post_init__(self) -> None:
        """Raise InputError unless each station is stood at."""
        missing = set(range(len(self.plan.stations))) - set(self.station.tolist())
        if missing:
            raise InputError(
                f"the motion never stands at station {min(missing)} of its plan"
            )

    def images(self) -> Floats:
        """Markers in the images, shape (m, t, 3, 2), pixels; NaN outside of them."""
        seen = []
        for camera, place in zip(self.cameras, self.base_from_camera, strict=True):
            local = place.inverse().apply(self.markers)
            ahead = local[..., 2:] > 0
            pixels = camera.project(np.where(ahead, local, [0.0, 0.0, 1.0]))
            limit = np.array(camera.image_size, dtype=float) - 0.5
            inside = ((pixels > -0.5) & (pixels < limit)).all(axis=-1, keepdims=True)
            seen.append(np.where(ahead & inside, pixels, np.nan))
        return np.array(seen)

    def arrivals(self) -> NDArray[np.intp]:
        """The first moment at each station, shape (n,)."""
        count = len(self.plan.stations)
        return np.array([np.argmax(self.station == j) for j in range(count)])


def write_preview(
    path: Path,
    *,
    name: str,
    mechanisms: Sequence[Mechanism],
    base_from_world: SE3,
    motion: PlannedMotion,
    certificate: str,
    views: Iterable[View] = (),
) -> None:
    """Write a plan's recording, whole or not at all.

    Timelines: "time", the arm moving as it will, and "station", the stops alone.

    Args:
        path: The file, ``.rrd``.
        name: Names the recording in the viewer.
        mechanisms: The compiled cell with each mount; their bodies are the same.
        base_from_world: Where the world is, seen from the robot's base.
        motion: What the arm does.
        certificate: What the plan promises, plain text.
        views: What the cameras see, by moment, and by camera at each; the last is
            shown while the robot stands, and outlines alone where there is none.

    Raises:
        StorageError: the file cannot be written.
    """
    images, arrivals = motion.images(), motion.arrivals()
    rendered = iter(views)
    view = next(rendered, None)
    pictured = [False] * len(motion.cameras)
    with recorded(path, name, _layout(motion, base_from_world)) as recording:
        log_cell(recording, mechanisms, base_from_world)
        _log_still(recording, motion, images, arrivals, certificate)
        for k, time in enumerate(motion.times):
            recording.reset_time()
            recording.set_time(TIME, duration=float(time))
            j = int(motion.station[k])
            if j >= 0 and k == arrivals[j]:
                recording.set_time(STATION, sequence=j)
                recording.log("log", rr.TextLog(_words(motion.plan, j), level="INFO"))
            if len(mechanisms) > 1:
                _log_change(recording, mechanisms, motion, k)
            for body, pose in enumerate(motion.world_from_body[k][1:], 1):
                recording.log(body_path(mechanisms[0], body), transform(pose))
            seen = dict[int, NDArray[np.uint8]]()
            while view is not None and view[1] == k:
                seen[view[0]] = view[2]
                view = next(rendered, None)
            for i, camera in enumerate(motion.cameras):
                image = f"{camera_path(camera.name)}/image"
                if i in seen:
                    picture = rr.Image(seen[i]).compress(jpeg_quality=_JPEG_QUALITY)
                    recording.log(image, picture)
                    pictured[i] = True
                elif pictured[i] and j < 0:
                    # What was seen at the last station is not what is seen now.
                    recording.log(image, rr.Clear(recursive=False))
                    pictured[i] = False
                _log_outline(
                    recording, motion, camera.name, images[i, k], j, not pictured[i]
                )


def _log_change(
    recording: rr.RecordingStream,
    mechanisms: Sequence[Mechanism],
    motion: PlannedMotion,
    moment: int,
) -> None:
    """The holder where it is new, by time and at the station that comes next."""
    mount = int(motion.mounts[moment])
    if moment > 0 and mount == motion.mounts[moment - 1]:
        return
    ahead = motion.station[moment:]
    recording.set_time(STATION, sequence=int(ahead[ahead >= 0][0]))
    if moment > 0:
        words = f"tool change: {motion.mount_names[mount]}"
        recording.log("log", rr.TextLog(words, level="INFO"))
    log_mount(recording, mechanisms, mount)
    recording.reset_time()
    recording.set_time(TIME, duration=float(motion.times[moment]))


def _colour(plan: Plan, station: int) -> Colour:
    """What was used blue, held out orange, on the way grey; as everywhere."""
    if station < 0:
        return TRUTH
    held_out = plan.stations[station].kind == "evaluation"
    return HELD_OUT if held_out else ESTIMATE


def _words(plan: Plan, station: int) -> str:
    """What happens at a station."""
    for number, turn in enumerate(plan.half_turns, 1):
        if station in (turn.before, turn.after):
            side = "before" if station == turn.before else "after"
            count = len(plan.half_turns)
            return f"station {station}: half-turn {number} of {count}, {side}"
    held_out = plan.stations[station].kind == "evaluation"
    return f"station {station}: " + ("held out" if held_out else "no half-turn")


def _log_still(
    recording: rr.RecordingStream,
    motion: PlannedMotion,
    images: Floats,
    arrivals: NDArray[np.intp],
    certificate: str,
) -> None:
    """Cameras, the way as a whole, all stations, and the words, at all times."""
    kinds = [_colour(motion.plan, j) for j in range(len(arrivals))]
    middles = motion.markers.mean(axis=1)
    recording.log(
        "cell/base/way",
        rr.LineStrips3D([middles], colors=[TRUTH], radii=[0.0012]),
        static=True,
    )
    recording.log(
        "cell/base/stations",
        rr.Points3D(middles[arrivals], colors=kinds, radii=[0.008]),
        static=True,
    )
    for camera, place, seen in zip(
        motion.cameras, motion.base_from_camera, images, strict=True
    ):
        path = camera_path(camera.name)
        recording.log(path, transform(place.matrix), static=True)
        log_pinhole(recording, path, camera, ESTIMATE, IMAGE_DISTANCE, 0.002)
        width, height = camera.image_size
        corners = [[0, 0], [width, 0], [width, height], [0, height], [0, 0]]
        recording.log(
            f"{path}/border",
            rr.LineStrips2D([corners], colors=[TRUTH], radii=[-0.6], draw_order=2),
            static=True,
        )
        all_seen = seen[arrivals] + CORNER
        recording.log(
            f"{path}/all_stations",
            rr.Points2D(
                all_seen.reshape(-1, 2),
                colors=np.repeat([(*kind, 200) for kind in kinds], 3, axis=0),
                radii=[-2.0],
                draw_order=10,
            ),
            static=True,
        )
    text = f"```text\n{certificate}\n```"
    recording.log(
        "verdict",
        rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN),
        static=True,
    )
    # No station is shown first: the arm moves.
    numbers = {"station_count": len(arrivals), "shown_station": None, "step_count": 0}
    recording.log(NUMBERS, rr.TextDocument(json.dumps(numbers)), static=True)


def _log_outline(
    recording: rr.RecordingStream,
    motion: PlannedMotion,
    camera: str,
    pixels: Floats,
    station: int,
    discs: bool,
) -> None:
    """The triangle (3, 2) in an image; ringed where the robot stands.

    Args:
        recording: Where to.
        motion: What the arm does.
        camera: Whose image.
        pixels: A, B, C, shape (3, 2); NaN outside.
        station: Where the robot stands, -1 on the way.
        discs: Whether to draw discs for the markers: no image shows them.
    """
    path = camera_path(camera)
    whole = bool(np.isfinite(pixels).all())
    colour = _colour(motion.plan, station)
    recording.log(
        f"{path}/triangle",
        rr.LineStrips2D(
            [pixels[_CLOSED] + CORNER] if whole else [],
            colors=[WHITE if station >= 0 else TRUTH],
            radii=[-1.0],
            draw_order=20,
        ),
    )
    seen = np.isfinite(pixels).all(axis=1)
    drawn = seen & discs
    colours = np.round(255 * motion.marker_colours[drawn]).astype(np.uint8)
    recording.log(
        f"{path}/markers",
        rr.Points2D(
            pixels[drawn] + CORNER, colors=colours, radii=[_DISC_PX], draw_order=21
        ),
    )
    ringed = pixels[seen] + CORNER if station >= 0 else np.zeros((0, 2))
    recording.log(
        f"{path}/rings",
        rr.LineStrips2D(rings(ringed), colors=[colour], radii=[-1.2], draw_order=22),
    )


def _layout(motion: PlannedMotion, base_from_world: SE3) -> rrb.Blueprint:
    cell = space(
        "cell",
        "Cell: the arm on its planned way; stations used blue, held out orange",
        eye_on_cell(motion.base_from_camera, motion.markers, base_from_world),
        overrides={
            camera_path(camera.name): rr.Pinhole.from_fields()
            for camera in motion.cameras
        },
    )
    views = [
        rrb.Spatial2DView(
            origin=camera_path(camera.name),
            name=f"{camera.name}: what it will see; dots: all stations",
        )
        for camera in motion.cameras
    ]
    columns = 1 if len(views) < 3 else 2
    text = rrb.TextDocumentView(origin="verdict", name="What the plan promises")
    log = rrb.TextLogView(origin="log", name="Stations")
    return only_views(
        rrb.Horizontal(
            cell,
            rrb.Grid(*views, grid_columns=columns),
            rrb.Vertical(text, log, row_shares=[14, 6]),
            column_shares=[8, 6, 7],
        ),
        rrb.TimePanel(
            state="collapsed", timeline=TIME, play_state="playing", loop_mode="all"
        ),
    )
