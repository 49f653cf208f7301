"""Rendering where the analytic projection says, the same every time."""

from __future__ import annotations

import numpy as np
import pytest
from small_cell import GANTRY, HP3, facing, shipped, small_cell

from handeye_tri.arm import Arm
from handeye_tri.camera import PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.se3 import SE3
from handeye_tri.simulate import compile_mechanism, render_views
from handeye_tri.simulate.imaging import Image


def outline_centre(
    camera: PinholeCamera, centre: np.ndarray, radius: float
) -> np.ndarray:
    """Centroid of the area that a sphere covers in the image, exactly.

    The cone of tangents touches the sphere in a circle; its image is a polygon of
    2000 corners here, whose centroid is that of the shoelace formula.
    """
    distance = np.linalg.norm(centre)
    sine = radius / distance
    axes = np.linalg.svd(centre[None])[2][1:]
    angle = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    circle = centre * (1 - sine**2) + radius * np.sqrt(1 - sine**2) * (
        np.cos(angle)[:, None] * axes[0] + np.sin(angle)[:, None] * axes[1]
    )
    p = camera.project(circle)
    middle = p.mean(axis=0)
    p = p - middle
    q = np.roll(p, -1, axis=0)
    cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    return np.asarray(
        middle + ((p + q) * cross[:, None]).sum(axis=0) / (3 * cross.sum())
    )


def own_colour_centroid(image: Image, channel: int, near: np.ndarray) -> np.ndarray:
    """Centroid of how much one channel exceeds the others: grey counts nothing."""
    u, v = (int(round(x)) for x in near)
    top, left = max(v - 16, 0), max(u - 16, 0)
    part = image[top : v + 17, left : u + 17].astype(float)
    others = np.delete(part, channel, axis=2).max(axis=2)
    weight = np.clip(part[..., channel] - others, 0, None)
    rows, columns = np.indices(weight.shape)
    return np.array(
        [
            left + (weight * columns).sum() / weight.sum(),
            top + (weight * rows).sum() / weight.sum(),
        ]
    )


LENS = {"model": "radtan", "coefficients": {"k1": -0.2, "k2": 0.1, "p1": 8e-4}}


@pytest.mark.parametrize("distorted", [False, True], ids=["pinhole", "lens and skew"])
def test_pixels_are_where_the_projection_says(distorted: bool) -> None:
    """Bias far below 0.02 px, with off-centre principal points and fx != fy."""
    cell = small_cell()
    if distorted:
        cameras = [
            {**c.model_dump(), "lens": LENS, "skew_px": 2.5} for c in cell.cameras
        ]
        cell = small_cell(cameras=cameras)
    joints = facing(cell, 14)
    model = GANTRY
    arm = Arm(compile_mechanism(cell, model))
    world = arm.base_from_world.inverse().apply(arm.marker_positions(joints))
    errors, shifts = [], []
    views = [(i, j) for j in range(len(joints)) for i in range(2)]
    for i, j, image in render_views(cell, model, joints, 0, views):
        config = cell.cameras[i]
        points = config.world_from_camera.inverse().apply(world[j])
        for k, point in enumerate(points):
            expected = outline_centre(config.camera, point, 0.008)
            found = own_colour_centroid(image, k, expected)
            errors.append(found - expected)
            shifts.append(config.camera.project(point) - expected)
            if not distorted:
                # The ellipse's centre in closed form, (X, Y) Z / (Z^2 - r^2); the
                # polygon of 2000 corners differs by 1e-6 of the radius.
                factor = point[2] / (point[2] ** 2 - 0.008**2)
                ellipse = config.camera.pixels(point[:2] * factor)
                np.testing.assert_allclose(ellipse, expected, atol=1e-5)
    error = np.array(errors)
    assert len(error) == 84
    # One 2x supersampled sphere of 5 px radius misses by 0.02-0.03 px at random.
    assert np.abs(error.mean(axis=0)).max() < 0.01
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.03
    assert np.abs(error).max() < 0.1
    assert np.abs(shifts).max() > 0.001


def test_views_do_not_depend_on_order_or_company() -> None:
    imaging = {"noise_percent": 2, "blur_px": 0.8}
    cell = small_cell(imaging=imaging)
    model = GANTRY
    joints = facing(cell, 3)
    views = [(1, 2), (0, 0), (1, 0)]
    all_views = {
        (i, j): image for i, j, image in render_views(cell, model, joints, 4, views)
    }
    assert list(all_views) == views
    ((i, j, alone),) = render_views(cell, model, joints, 4, [(1, 0)])
    assert (i, j) == (1, 0)
    np.testing.assert_array_equal(alone, all_views[1, 0])
    ((_, _, other),) = render_views(cell, model, joints, 5, [(1, 0)])
    difference = other.astype(float) - alone
    # Same picture, other noise: sqrt(2) of 2 % of full scale.
    assert abs(difference.mean()) < 0.1
    assert difference.std() == pytest.approx(np.sqrt(2) * 5.1, rel=0.05)


def test_each_station_shows_its_own_mount() -> None:
    cell = small_cell(second_mount={"axis": "BC", "ahead_mm": 90, "turn_deg": 40})
    joints = np.concatenate([facing(alone, 1) for alone in cell.mounted])
    views = [(0, 1), (0, 0), (1, 1)]
    drawn = [
        ((i, j), image)
        for i, j, image in render_views(cell, GANTRY, joints, 4, views, mounts=[0, 1])
    ]
    assert [view for view, _ in drawn] == [(0, 0), (0, 1), (1, 1)]
    for view, image in drawn:
        alone = cell.mounted[view[1]]
        ((_, _, expected),) = render_views(alone, GANTRY, joints, 4, [view])
        np.testing.assert_array_equal(image, expected)
    with pytest.raises(InputError, match="mounts must be below 2, .* so many, got 2"):
        next(render_views(cell, GANTRY, joints, 4, views, mounts=[0, 2]))


def test_two_renderings_at_once_do_not_mix() -> None:
    cell = small_cell()
    model = GANTRY
    joints = facing(cell, 2)
    views = [(0, 0), (1, 1)]
    apart = [image for _, _, image in render_views(cell, model, joints, 0, views)]
    first = render_views(cell, model, joints, 0, views)
    second = render_views(cell, model, joints, 0, views[::-1])
    together = [next(first)[2], next(second)[2], next(first)[2], next(second)[2]]
    for image, k in zip(together, (0, 1, 1, 0), strict=True):
        np.testing.assert_array_equal(image, apart[k])
    first.close()
    second.close()


@pytest.mark.parametrize(
    "name", ["hp3_stereo", "hp3_stereo_edge", "hp3_stereo_lens", "hp3_stereo_mono"]
)
def test_the_shipped_cells_show_three_markers_and_a_grey_cell(name: str) -> None:
    cell = shipped(name)
    arm = Arm(compile_mechanism(cell, HP3))
    # The triangle faces the middle of the cameras.
    toward = np.mean([c.position_m for c in cell.cameras], axis=0) - (0.45, 0.0, 0.42)
    toward /= np.linalg.norm(toward)
    side = np.cross((0.0, 0.0, 1.0), toward)
    side /= np.linalg.norm(side)
    up = np.cross(toward, side)
    rotation = np.stack([side, up, toward], axis=1)
    if cell.rig.axis != "normal":
        # Flange down, markers' plane towards the cameras.
        rotation = np.stack([side, toward, -up], axis=1)
    markers = cell.rig.flange_from_triangle.apply(cell.rig.triangle.points)
    centre = np.array([0.45, 0.0, 0.42]) - rotation @ markers.mean(axis=0)
    target = SE3.from_parts(rotation, centre).matrix
    solutions = arm.inverse(target[None], np.random.default_rng(0)).joints[0]
    joints = next(q for q in solutions if arm.collision(q) is None)
    for i, _, image in render_views(cell, HP3, joints[None], 1, [(0, 0), (1, 0)]):
        assert image.shape == (768, 1024) + (() if cell.imaging.grey else (3,))
        config = cell.cameras[i]
        seen = config.camera.project(
            config.world_from_camera.inverse().apply(
                arm.base_from_world.inverse().apply(arm.marker_positions(joints))
            )
        )
        colours = np.array(cell.rig.marker_colours)
        whole = np.ones(image.shape[:2], dtype=bool)
        for (u, v), colour in zip(np.round(seen).astype(int), colours, strict=True):
            expected = 255 * (colour.mean() if cell.imaging.grey else colour)
            patch = image[v - 3 : v + 4, u - 3 : u + 4].astype(float)
            noise = 2.55 * cell.imaging.noise_percent
            assert np.abs(patch.mean(axis=(0, 1)) - expected).max() < 1 + noise
            whole[v - 26 : v + 27, u - 26 : u + 27] = False
        rest = image[whole].astype(float)
        # Neutral grey, and darker than any marker.
        if not cell.imaging.grey:
            assert np.abs(rest.mean(axis=0) - rest.mean()).max() < 0.5
            assert np.ptp(rest, axis=1).mean() <= 10 * cell.imaging.noise_percent
        assert rest.max() < 225
        assert rest.std() > 15


def test_joints_must_fit_the_arm() -> None:
    with pytest.raises(InputError, match=r"\(stations, 6\).*\(2, 5\)"):
        next(render_views(shipped("hp3_stereo"), HP3, np.zeros((2, 5)), 0, [(0, 0)]))
