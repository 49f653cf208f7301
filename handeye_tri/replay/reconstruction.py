"""A reconstructed thing beside the true one, as a recording to look at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import StereoRig
from handeye_tri.mechanism import Geometry
from handeye_tri.replay.engine import (
    only_views,
    recorded,
    rr,
    rrb,
    solid,
    transform,
)
from handeye_tri.replay.shapes import vertex_normals
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]

_TRUTH, _ESTIMATE, _CORNER = (165, 165, 165), (64, 156, 255), (255, 149, 0)
_JPEG_QUALITY = 92
# Our pixel (0, 0) is the first pixel's centre, rerun's is its outer corner.
_HALF_PIXEL = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Thing:
    """A thing whose shape is known.

    Attributes:
        solids: What it is made of, in its own frame.
        left_from_thing: Where it truly is before the left camera.
        corners: Its true corners in the left camera's frame, shape (k, 3), metres.
    """

    solids: tuple[Geometry, ...]
    left_from_thing: SE3
    corners: Floats


def write_reconstruction(
    path: Path,
    *,
    name: str,
    cameras: StereoRig,
    images: Sequence[NDArray[np.uint8]],
    pixels: Floats,
    thing: Thing,
    points: Floats,
    faces: NDArray[np.intp],
    up: Floats,
    verdict: str,
) -> None:
    """Write what two cameras made of a thing, whole or not at all.

    Everything is in the left camera's frame. "true" is the thing with its corners;
    "reconstructed" is the surface through the points, beside it by once and a half its
    width; "over_truth" has the points where they were found.

    Args:
        path: The file, ``.rrd``.
        name: Names the recording in the viewer.
        cameras: The calibrated pair.
        images: Of the left and the right camera, RGB, shape (h, w, 3), 8 bits.
        pixels: Corners in both images, shape (2, n, 2).
        thing: The truth.
        points: Reconstructed corners, shape (n, 3), metres.
        faces: Triangles of points, shape (f, 3).
        up: Which way is up, unit vector, shape (3,).
        verdict: In Markdown.

    Raises:
        StorageError: the file cannot be written.
    """
    width = float(np.ptp(thing.corners, axis=0).max())
    # The camera's x axis is level and points to its right.
    aside = np.array([1.5 * width, 0.0, 0.0])
    with recorded(path, name, _layout(thing, aside, up)) as recording:
        recording.log("cup", rr.ViewCoordinates.RDF, static=True)
        recording.log("cup/true", transform(thing.left_from_thing.matrix), static=True)
        for part in thing.solids:
            part_path = rr.escape_entity_path_part(part.name)
            recording.log(f"cup/true/{part_path}", solid(part), static=True)
        for group, shift in (("reconstructed", aside), ("over_truth", 0 * aside)):
            dots = rr.Points3D(points + shift, colors=[_CORNER], radii=[0.0012])
            recording.log(f"cup/{group}/corners", dots, static=True)
        true = rr.Points3D(thing.corners + aside, colors=[_TRUTH], radii=[0.0006])
        recording.log("cup/reconstructed/true_corners", true, static=True)
        recording.log(
            "cup/reconstructed/surface", _surface(points, faces, aside), static=True
        )
        for label, at in (("true", 0 * aside), ("reconstructed", aside)):
            place = thing.corners.mean(axis=0) + at + 0.75 * width * up
            sign = rr.Points3D([place], radii=[0.0], labels=[label], colors=[_TRUTH])
            recording.log(f"cup/names/{label}", sign, static=True)
        for camera, image, seen in zip(
            (cameras.left, cameras.right), images, pixels, strict=True
        ):
            recording.log(
                f"images/{camera.name}",
                rr.Image(image).compress(jpeg_quality=_JPEG_QUALITY),
                static=True,
            )
            recording.log(
                f"images/{camera.name}/corners",
                rr.Points2D(seen + _HALF_PIXEL, colors=[_CORNER], radii=[-3.0]),
                static=True,
            )
        text = rr.TextDocument(verdict, media_type=rr.MediaType.MARKDOWN)
        recording.log("verdict", text, static=True)


def _surface(points: Floats, faces: NDArray[np.intp], aside: Floats) -> rr.Mesh3D:
    """The surface through points, seen from both sides."""
    both = np.concatenate([faces, faces[:, ::-1]])
    return rr.Mesh3D(
        vertex_positions=points + aside,
        triangle_indices=both,
        vertex_normals=vertex_normals(points, faces),
        albedo_factor=[*_ESTIMATE, 255],
    )


def _layout(thing: Thing, aside: Floats, up: Floats) -> rrb.Blueprint:
    target = thing.corners.mean(axis=0) + 0.5 * aside
    away = -target / np.linalg.norm(target)
    eye = target + 1.9 * np.linalg.norm(aside) * (away + 0.35 * up)
    cup = rrb.Spatial3DView(
        origin="cup",
        name="The true cup, and beside it the reconstructed one",
        background=[24, 26, 30],
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=up),
    )
    images = [
        rrb.Spatial2DView(
            origin=f"images/{name}", name=f"{name}: corners found in both images"
        )
        for name in ("left", "right")
    ]
    text = rrb.TextDocumentView(origin="verdict", name="Verdict")
    return only_views(
        rrb.Horizontal(
            rrb.Vertical(cup, text, row_shares=[8, 2]),
            rrb.Vertical(*images),
            column_shares=[6, 4],
        ),
        rrb.TimePanel(state="hidden"),
    )
