"""What is drawn in space: the cell, its cameras, gaps and tracks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import PinholeCamera
from handeye_tri.mechanism import Geometry, Mechanism
from handeye_tri.records import GroundTruth, HandEyeCalibration
from handeye_tri.replay.engine import rr, solid, transform
from handeye_tri.replay.overlay import CORNER
from handeye_tri.replay.paths import camera_path
from handeye_tri.replay.shapes import ESTIMATE, HELD_OUT, TRUTH, WHITE, Colour
from handeye_tri.replay.story import Story
from handeye_tri.se3 import SE3, se3_inverse

Floats = NDArray[np.float64]

# How far before a camera its image is drawn, metres, and the truth's outline.
IMAGE_DISTANCE, _TRUTH_DISTANCE = 0.25, 0.29
# Labels stand this far above what they name, metres.
_ABOVE = np.array([0.0, 0.0, 0.15])


def body_path(mechanism: Mechanism, body: int) -> str:
    """Where a body of the cell is in the recording."""
    if body == 0:
        return "cell/surroundings"
    name = mechanism.bodies[body].name
    return f"cell/robot/{rr.escape_entity_path_part(name)}"


def log_cell(
    recording: rr.RecordingStream,
    mechanisms: Sequence[Mechanism],
    base_from_world: SE3,
) -> None:
    """The cell's solids, at all times; where there are several mounts, without them.

    Args:
        recording: To log to.
        mechanisms: The cell with each mount.
        base_from_world: Where the world is, seen from the robot's base.
    """
    recording.log("cell", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    world_from_base = se3_inverse(base_from_world.matrix)
    recording.log("cell/base", transform(world_from_base), static=True)
    recording.log("track", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    first = mechanisms[0]
    for geometry in first.geometries:
        if len(mechanisms) == 1 or geometry.body != first.marker_body:
            _log_solid(recording, body_path(first, geometry.body), geometry)


def log_mount(
    recording: rr.RecordingStream, mechanisms: Sequence[Mechanism], mount: int
) -> None:
    """What holds the triangle from here on, where there are several mounts.

    Args:
        recording: To log to, at the places of the timelines that are set.
        mechanisms: The cell with each mount.
        mount: Which of them, from 0.
    """
    for number, mechanism in enumerate(mechanisms):
        path = f"{body_path(mechanism, mechanism.marker_body)}/mount_{number + 1}"
        if number != mount:
            recording.log(path, rr.Clear(recursive=True))
            continue
        for geometry in mechanism.geometries:
            if geometry.body == mechanism.marker_body:
                _log_solid(recording, path, geometry, static=False)


def _log_solid(
    recording: rr.RecordingStream, body: str, geometry: Geometry, *, static: bool = True
) -> None:
    path = f"{body}/{rr.escape_entity_path_part(geometry.name)}"
    place = transform(geometry.body_from_geometry.matrix)
    recording.log(path, place, static=static)
    recording.log(path, solid(geometry), static=static)


def log_cameras(
    recording: rr.RecordingStream,
    calibration: HandEyeCalibration,
    story: Story,
    truth: GroundTruth | None,
) -> None:
    """Frusta and ellipsoids; where the estimated ones stand is logged by step."""
    for camera in calibration.cameras:
        path = camera_path(camera.name)
        log_pinhole(recording, path, camera, ESTIMATE, IMAGE_DISTANCE, 0.002)
    if truth is not None:
        for camera, motion in zip(truth.cameras, truth.base_from_camera, strict=True):
            path = f"cell/base/truth/{camera.name}"
            recording.log(path, transform(motion.matrix), static=True)
            log_pinhole(recording, path, camera, TRUTH, _TRUTH_DISTANCE, 0.001)
    for camera, motion, ellipsoid in zip(
        calibration.cameras,
        calibration.base_from_camera,
        story.ellipsoids,
        strict=True,
    ):
        path = f"cell/base/uncertainty/{camera.name}"
        recording.log(path, transform(motion.matrix), static=True)
        turned = np.eye(4)
        turned[:3, :3] = ellipsoid.rotation
        recording.log(f"{path}/ellipsoid", transform(turned), static=True)
        recording.log(
            f"{path}/ellipsoid",
            rr.Ellipsoids3D(
                half_sizes=[ellipsoid.half_sizes],
                colors=[ESTIMATE],
                line_radii=[-0.5],
                fill_mode="densewireframe",
            ),
            static=True,
        )
        if ellipsoid.truth is not None:
            recording.log(
                f"{path}/truth",
                rr.Points3D([ellipsoid.truth], colors=[TRUTH], radii=[-5.0]),
                static=True,
            )


def log_pinhole(
    recording: rr.RecordingStream,
    path: str,
    camera: PinholeCamera,
    colour: Colour,
    distance: float,
    width: float,
) -> None:
    """A camera's frustum, under which its image is drawn, at all times."""
    to_corner = np.array([[0.0, 0.0, CORNER], [0.0, 0.0, CORNER], [0.0, 0.0, 0.0]])
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
    # The lowest layer over an image can sink into it by rounding of depths, so that
    # that layer is one point that nobody sees.
    recording.log(
        f"{path}/nothing",
        rr.Points2D([[0.0, 0.0]], colors=[(0, 0, 0, 0)], radii=[0.0], draw_order=1),
        static=True,
    )


def log_places(
    recording: rr.RecordingStream,
    calibration: HandEyeCalibration,
    story: Story,
    step: int,
) -> None:
    """Where the cameras are drawn at a solver step, and what the step did."""
    slide = story.slides[step]
    for camera, motion in zip(calibration.cameras, slide.base_from_camera, strict=True):
        recording.log(camera_path(camera.name), transform(motion.matrix))
    centres = np.array([m.translation for m in calibration.base_from_camera])
    label = f"step {step}, cameras' way x {story.magnification_slide}"
    last = step == len(story.slides) - 1
    recording.log(
        "cell/base/step",
        rr.Points3D(
            [] if last else [centres.mean(axis=0) + 2.5 * _ABOVE],
            colors=[WHITE],
            radii=[0.0],
            labels=None if last else [label],
        ),
    )


def log_gaps(
    recording: rr.RecordingStream,
    story: Story,
    j: int,
    reported: Floats,
    observed: Floats,
) -> None:
    """Robot against cameras at station j, in the cell and beside it.

    Args:
        recording: To log to.
        story: For the magnification.
        j: Index of the station.
        reported: Markers by the robot, shape (3, 3), metres, base.
        observed: By the cameras, shape (3, 3), NaN where not seen by two.
    """
    colour = HELD_OUT if story.held_out[j] else ESTIMATE
    gaps = observed - reported
    seen = np.isfinite(gaps).all(axis=1)
    millimetres = 1e3 * np.linalg.norm(gaps, axis=1)
    for path, width, shown in (
        ("cell/base/gap", 0.006, seen),
        ("track/gap", 0.002, seen & story.held_out[j]),
    ):
        recording.log(
            path,
            rr.Arrows3D(
                origins=reported[shown],
                vectors=story.magnification * gaps[shown],
                colors=[colour],
                radii=[width],
            ),
        )
    words = "no gap"
    if seen.any():
        k = int(np.nanargmax(millimetres))
        words = f"{'ABC'[k]} {millimetres[k]:.3f} mm"
    known = np.isfinite(reported).all(axis=1)
    place = reported[known].mean(axis=0) if known.any() else story.reported[j].mean(0)
    recording.log(
        "cell/base/gap/size",
        rr.Points3D(
            [place + _ABOVE],
            colors=[colour],
            radii=[0.0],
            labels=[f"station {j}: {words}"],
        ),
    )
    far = reported + story.magnification * gaps
    strips: dict[str, list[Floats]] = {"robot": [], "cameras": []}
    if story.held_out[j] and seen.all():
        strips = {"robot": [reported[[0, 1, 2, 0]]], "cameras": [far[[0, 1, 2, 0]]]}
    for source, paint in (("robot", ESTIMATE), ("cameras", colour)):
        recording.log(
            f"track/now/{source}",
            rr.LineStrips3D(strips[source], colors=[paint], radii=[0.0012]),
        )
    # Scalars are 64-bit: what is read back is what was evaluated.
    group = "held_out" if story.held_out[j] else "used"
    recording.log(f"error_mm/{group}", rr.Scalars(millimetres))


def log_tracks(recording: rr.RecordingStream, story: Story) -> None:
    """Both held-out tracks with each station's number, at all times."""
    colours: dict[str, Colour] = {
        "robot": ESTIMATE,
        "cameras": HELD_OUT,
        "truth": TRUTH,
    }
    for source, places in story.tracks().items():
        look: dict[str, Any] = {"colors": [colours[source]], "radii": [0.001]}
        recording.log(f"track/{source}", rr.LineStrips3D([places], **look), static=True)
        points = rr.Points3D(places, colors=[colours[source]], radii=[0.004])
        recording.log(f"track/{source}/stations", points, static=True)
    stations = np.flatnonzero(story.held_out).tolist()
    recording.log(
        "track/numbers",
        rr.Points3D(
            story.reported[stations].mean(axis=1),
            colors=[HELD_OUT],
            radii=[0.0],
            labels=[f"{j}: {story.worst(j)[1]:.3f} mm" for j in stations],
            show_labels=True,
        ),
        static=True,
    )
