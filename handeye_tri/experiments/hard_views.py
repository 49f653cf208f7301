"""Rendered views that make it hard to tell the markers from other things."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.mechanism import Geometry
from handeye_tri.se3 import SE3, so3_exp

if TYPE_CHECKING:
    from handeye_tri.arm import Arm
    from handeye_tri.camera import PinholeCamera
    from handeye_tri.config import Cell
    from handeye_tri.detect import MarkerSpec
    from handeye_tri.simulate import Prop

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Rng = np.random.Generator

SCENES = {
    "dots, coloured": "flat dots in three colours on a white plate",
    "dots, dark on light": "black dots of three sizes on a white plate, grey images",
    "dots, light on dark": "white dots of three sizes on a black plate, grey images",
    "clutter": "balls before a wall of coloured patches, round things beside them",
    "clutter, grey": "white balls before a wall of grey patches, round things beside",
    "coloured robot": "balls on an orange and blue arm",
    "decoy": "a second ball of one marker's colour and size in the cell",
    "glare": "a highlight that washes out a part of one marker",
    "half hidden": "something before a third to two thirds of one marker",
}
_MONO = ("dots, dark on light", "dots, light on dark", "clutter, grey")
# Where flat dots lie before the triangle's plane, metres; the plate is behind them.
_DOTS_AHEAD, _PLATE_AHEAD = 0.0065, 0.0060
# A paint of this level is near black, or near white, in the image.
_DARK, _LIGHT = 0.04, 0.75
_DOT_RADII = {"colour": (0.008, 0.008, 0.008), "radius": (0.0065, 0.008, 0.010)}
_CIRCLE = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
_ORANGE, _BLUE = (0.95, 0.42, 0.05), (0.08, 0.25, 0.80)


@dataclass(frozen=True, slots=True, eq=False)
class HardView:
    """One view and what a detection should find in it.

    Attributes:
        image: RGB, shape (h, w, 3), or grey, (h, w).
        spec: What the markers look like.
        centres: Of the markers' outlines, shape (3, 2), pixels.
        whole: Which markers nothing spoils, shape (3,): these should be found.
    """

    image: Image
    spec: MarkerSpec
    centres: Floats
    whole: NDArray[np.bool_]


def hard_views(scene: str, count: int, seed: int) -> Iterator[HardView]:
    """Views of planned stations of ``hp3_stereo``, made hard.

    Args:
        scene: One of SCENES.
        count: How many views.
        seed: Of the plan, the things beside the markers, and the noise.

    Raises:
        MissingDependencyError: OpenGL is missing.
    """
    from handeye_tri import storage
    from handeye_tri.arm import Arm
    from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
    from handeye_tri.detect import MarkerSpec
    from handeye_tri.plan import plan_motions
    from handeye_tri.simulate import compile_mechanism, render_views

    rng = np.random.default_rng([seed, list(SCENES).index(scene)])
    path = storage.find_cell("hp3_stereo_mono" if scene in _MONO else "hp3_stereo")
    cell = storage.read_cell(path)
    model = storage.find_model(cell, path)
    arm = Arm(compile_mechanism(cell, model))
    turns = min(cell.plan.half_turns, max(2, count))
    stations = plan_motions(cell, arm, seed, half_turns=turns).stations
    every = [(i, j) for i in range(len(cell.cameras)) for j in range(len(stations))]
    views = [every[k] for k in rng.permutation(len(every))[:count]]
    joints = np.array([station.joints for station in stations])
    dots = scene.startswith("dots")
    spec = MarkerSpec.from_rig(cell.rig)
    props = _props(scene, cell, arm, joints, rng)
    if dots:
        # Balls too small to be seen, behind the plate.
        rig = cell.rig.model_copy(update={"marker_radii_mm": (0.01, 0.012, 0.014)})
        cell = cell.model_copy(update={"rig": rig})
        colours = spec.colours if scene == "dots, coloured" else spec.colours * _LIGHT
        radii = np.array(_DOT_RADII[spec.identity])
        spec = MarkerSpec(spec.identity, colours, radii, spec.points)
    with tempfile.TemporaryDirectory(prefix="handeye-tri-") as folder:
        if scene == "coloured robot":
            model = _painted(model, Path(folder))
        for i, j, image in render_views(cell, model, joints, seed, views, props):
            camera = cell.cameras[i].camera
            from_world = cell.cameras[i].world_from_camera.inverse()
            world = arm.base_from_world.inverse().apply(arm.marker_positions(joints[j]))
            points = from_world.apply(world)
            if dots:
                centres = _dot_centres(camera, points, spec.radii)
            else:
                centres = camera.project(points)
                centres = centres + sphere_shift(camera, points, spec.radii)
            whole = np.ones(3, dtype=bool)
            spoil = _SPOILERS.get(scene)
            if spoil is not None:
                k = int(rng.integers(3))
                radius = float(camera.intrinsics.fx * spec.radii[k] / points[k, 2])
                image = spoil(image, centres[k], radius, rng)
                whole[k] = False
            yield HardView(image, spec, centres, whole)


def _painted(model: Path, folder: Path) -> Path:
    """The arm's model with links of orange and joints of blue."""
    text = model.read_text()
    for material, colour in (("shell", _ORANGE), ("joint", _BLUE)):
        start = text.index(f'name="{material}" rgba="') + len(
            f'name="{material}" rgba="'
        )
        end = text.index('"', start)
        text = f"{text[:start]}{' '.join(map(str, colour))} 1{text[end:]}"
    painted = folder / model.name
    painted.write_text(text)
    return painted


def _props(
    scene: str, cell: Cell, arm: Arm, joints: Floats, rng: Rng
) -> tuple[Prop, ...]:
    """What a scene adds to the cell."""
    from handeye_tri.simulate import Prop

    count = len(joints)
    still = np.tile(np.eye(4), (count, 1, 1))
    if scene.startswith("dots"):
        light = scene == "dots, light on dark"
        plate, ink = (_DARK, _LIGHT) if light else (_LIGHT, _DARK)
        colours = np.full((3, 3), ink)
        if scene == "dots, coloured":
            colours = np.array(cell.rig.marker_colours)
        identity = cell.rig.identity
        moved = (
            arm.base_from_world.inverse().matrix
            @ np.array([arm.forward(q) for q in joints])
            @ cell.rig.flange_from_triangle.matrix
        )
        points = cell.rig.triangle.points
        solids = [_plate(points, plate)]
        for k, letter in enumerate("ABC"):
            at = points[k] + [0.0, 0.0, _DOTS_AHEAD]
            circle = _disc(at, _DOT_RADII[identity][k])
            solids.append(_mesh(f"dot {letter}", *circle, colours[k]))
        return (Prop("plate", tuple(solids), moved),)
    if scene.startswith("clutter"):
        grey = scene == "clutter, grey"
        wall = still.copy()
        wall[:, :3, 3] = [-0.7, 0.0, 0.0]
        return (
            Prop("wall", tuple(_patches(rng, grey=grey)), wall),
            Prop("things", tuple(_round_things(rng, grey=grey)), still),
        )
    if scene == "decoy":
        places = still.copy()
        places[:, :3, 3] = rng.uniform((0.2, -0.3, 0.15), (0.5, 0.3, 0.6), (count, 3))
        k = int(rng.integers(3))
        ball = _ball("ball", np.zeros(3), 0.008, np.array(cell.rig.marker_colours[k]))
        return (Prop("decoy", (ball,), places),)
    return ()


def _mesh(
    name: str, vertices: Floats, faces: NDArray[np.intp], rgb: Floats
) -> Geometry:
    return Geometry(
        name,
        0,
        "mesh",
        np.empty(0),
        SE3.identity(),
        vertices,
        faces,
        np.append(rgb, 1.0),
        False,
    )


def _plate(points: Floats, level: float) -> Geometry:
    """A square plate about the triangle, facing along z."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    half = 0.5 * float(np.ptp(points, axis=0).max()) + 0.025
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], dtype=float)
    vertices = middle + half * corners + [0.0, 0.0, _PLATE_AHEAD]
    faces = np.array([(0, 1, 2), (0, 2, 3), (0, 2, 1), (0, 3, 2)])
    return _mesh("plate", vertices, faces, np.full(3, level))


def _disc(centre: Floats, radius: float) -> tuple[Floats, NDArray[np.intp]]:
    """Vertices and faces of a disc in the plane z = 0, moved to its centre."""
    turn = _CIRCLE[::4]
    rim = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    vertices = np.vstack([centre, centre + radius * rim])
    k = np.arange(len(turn))
    faces = np.column_stack([0 * k, 1 + k, 1 + (k + 1) % len(turn)])
    return vertices, faces


def _ball(name: str, centre: Floats, radius: float, rgb: Floats) -> Geometry:
    """A ball of 24 x 48 faces."""
    down, round_ = np.meshgrid(
        np.linspace(0, np.pi, 25), np.linspace(0, 2 * np.pi, 48, endpoint=False)
    )
    unit = np.stack(
        [np.sin(down) * np.cos(round_), np.sin(down) * np.sin(round_), np.cos(down)],
        axis=-1,
    )
    vertices = centre + radius * unit.reshape(-1, 3)
    a, b = np.meshgrid(np.arange(24), np.arange(48))
    here, beside = 25 * b + a, 25 * ((b + 1) % 48) + a
    faces = np.concatenate(
        [
            np.stack([here, here + 1, beside], axis=-1).reshape(-1, 3),
            np.stack([beside, here + 1, beside + 1], axis=-1).reshape(-1, 3),
        ]
    )
    # Faces without area, at the poles, are none.
    p = vertices[faces]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    return _mesh(name, vertices, faces[area > 1e-12], rgb)


def _patches(rng: Rng, *, grey: bool) -> Iterator[Geometry]:
    """A wall of patches in the plane x = 0, each nearer by a hair than the last."""
    for k in range(160):
        y, z = rng.uniform((-0.8, -0.1), (0.8, 1.4))
        width, height = rng.uniform(0.02, 0.25, 2)
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * [width, height] / 2
        vertices = np.column_stack([np.full(4, 1e-4 * k), corners + [y, z]])
        rgb = np.full(3, rng.uniform(0.05, 0.9)) if grey else rng.uniform(0.05, 0.9, 3)
        yield _mesh(f"patch {k}", vertices, np.array([(0, 1, 2), (0, 2, 3)]), rgb)


def _round_things(rng: Rng, *, grey: bool) -> Iterator[Geometry]:
    """Balls and knobs of other colours and sizes behind the rig."""
    for k in range(14):
        centre = rng.uniform((-0.4, -0.5, 0.05), (0.15, 0.5, 0.8))
        rgb = np.full(3, rng.uniform(0.1, 0.7))
        if not grey:
            # Yellow, cyan, magenta and what lies between: no marker has these hues.
            rgb = np.array([1.0, 1.0, 0.0])[rng.permutation(3)] * rng.uniform(0.4, 1.0)
        yield _ball(f"thing {k}", centre, rng.uniform(0.006, 0.03), rgb)


def _dot_centres(camera: PinholeCamera, points: Floats, radii: Floats) -> Floats:
    """Centroids of the images of dots about markers (3, 3), in the camera's frame."""
    x, normal = (
        points[1] - points[0],
        np.cross(points[1] - points[0], points[2] - points[0]),
    )
    x, normal = x / np.linalg.norm(x), normal / np.linalg.norm(normal)
    y = np.cross(normal, x)
    ahead = _DOTS_AHEAD * normal
    centres = []
    for point, radius in zip(points, radii, strict=True):
        rim = (
            point
            + ahead
            + radius * (np.cos(_CIRCLE)[:, None] * x + np.sin(_CIRCLE)[:, None] * y)
        )
        u, v = (camera.project(rim) - camera.project(point)).T
        nu, nv = np.roll(u, -1), np.roll(v, -1)
        cross = u * nv - nu * v
        area = 3.0 * cross.sum()
        middle = np.array([((u + nu) * cross).sum(), ((v + nv) * cross).sum()]) / area
        centres.append(camera.project(point) + middle)
    return np.array(centres)


def _glare(image: Image, centre: Floats, radius: float, rng: Rng) -> Image:
    """Light added about a point at the marker's edge."""
    turn = rng.uniform(0, 2 * np.pi)
    away = radius * rng.uniform(0.3, 1.2) * np.array([np.cos(turn), np.sin(turn)])
    d = _from(image, centre + away)
    width = radius * rng.uniform(0.4, 1.0)
    light = 400.0 * np.exp(-0.5 * (d**2).sum(axis=-1) / width**2)
    return _eight_bits(image + light[..., None])


def _cover(image: Image, centre: Floats, radius: float, rng: Rng) -> Image:
    """A bar before one side of the marker, up to a third or two thirds of it."""
    normal = so3_exp([0.0, 0.0, rng.uniform(0, 2 * np.pi)])[:2, :2]
    d = _from(image, centre) @ normal
    edge = radius * rng.uniform(-0.35, 0.35)
    inside = np.minimum(d[..., 0] - edge, edge + 4 * radius - d[..., 0])
    inside = np.minimum(inside, 3 * radius - np.abs(d[..., 1]))
    cover = np.clip(inside + 0.5, 0.0, 1.0)[..., None]
    level = rng.uniform(20, 220)
    return _eight_bits(image + cover * (level - image))


def _from(image: Image, point: Floats) -> Floats:
    """Pixels less a point, shape (h, w, 2)."""
    v, u = np.indices(image.shape[:2])
    return np.stack([u, v], axis=-1) - point


def _eight_bits(levels: NDArray[Any]) -> Image:
    return np.asarray(np.clip(np.rint(levels), 0, 255).astype(np.uint8))


_SPOILERS: dict[str, Callable[[Image, Floats, float, Rng], Image]] = {
    "glare": _glare,
    "half hidden": _cover,
}
