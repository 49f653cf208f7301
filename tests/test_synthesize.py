"""Synthetic sessions: exact projection, stated noise, the promised geometry."""

import numpy as np
import pytest

from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
from handeye_tri.camera import Lens
from handeye_tri.errors import InputError, NoPlanError
from handeye_tri.records import Repeatability
from handeye_tri.se3 import se3_inverse, se3_log
from handeye_tri.synthesize import (
    reference_geometry,
    synthesize,
    two_mount_geometry,
)


@pytest.mark.parametrize("axis", ["normal", "AB", "BC", "CA"])
def test_half_turns_map_the_triangle_as_its_axis_says(axis):
    geometry = reference_geometry(np.random.default_rng(3), axis=axis)
    assert len(geometry.stations) == 28
    assert [s.kind for s in geometry.stations].count("evaluation") == 6
    base_from_triangle = np.array(
        [
            (s.base_from_flange @ geometry.flange_from_triangle).matrix
            for s in geometry.stations
        ]
    )
    o = geometry.triangle.circumcentre if axis == "normal" else None
    expected = geometry.triangle.half_turn(axis, o).matrix
    for turn in geometry.half_turns:
        relative = (
            se3_inverse(base_from_triangle[turn.before])
            @ base_from_triangle[turn.after]
        )
        np.testing.assert_allclose(relative, expected, atol=1e-14)
        assert turn.axis == axis


def test_successive_planes_are_twenty_degrees_apart():
    for seed in range(5):
        geometry = reference_geometry(np.random.default_rng(seed))
        normals = np.array(
            [
                (s.base_from_flange @ geometry.flange_from_triangle).rotation[:, 2]
                for s in geometry.stations[:22:2]
            ]
        )
        cosines = np.abs((normals[1:] * normals[:-1]).sum(axis=1))
        assert np.degrees(np.arccos(cosines.max())) >= 20


def test_exact_pixels_are_the_projection_of_the_chain():
    lens = Lens("radtan", np.array([-0.1, 0.05, 1e-3, -5e-4, 0.0]))
    geometry = reference_geometry(np.random.default_rng(0), skew=1.5, lens=lens)
    session, truth = synthesize(
        geometry,
        np.random.default_rng(1),
        sigma_px=0.0,
        repeatability=Repeatability(1e-4, 1e-3),
    )
    for i, camera in enumerate(geometry.cameras):
        for j in (0, 7, 27):
            chain = (
                se3_inverse(geometry.base_from_camera[i].matrix)
                @ truth.base_from_flange[j]
                @ geometry.flange_from_triangle.matrix
            )
            points = geometry.triangle.points @ chain[:3, :3].T + chain[:3, 3]
            np.testing.assert_allclose(
                session.pixels[i, j], camera.project(points), atol=1e-10
            )
    assert session.cameras[0].lens == ("k1", "k2", "p1", "p2")


LENS = Lens("radtan", np.array([-0.2, 0.1, 2e-3, -1e-3, 0.0]))


@pytest.mark.parametrize("lens", [None, LENS], ids=["pinhole", "lens"])
def test_spheres_are_seen_where_their_area_is(lens):
    geometry = reference_geometry(np.random.default_rng(0), lens=lens)
    radii = (8e-3, 0.0, 12e-3)
    session, truth = synthesize(
        geometry, np.random.default_rng(1), sigma_px=0.0, marker_radii=radii
    )
    for i, camera in enumerate(geometry.cameras):
        chain = (
            se3_inverse(geometry.base_from_camera[i].matrix)
            @ truth.base_from_flange
            @ geometry.flange_from_triangle.matrix
        )
        points = (
            geometry.triangle.points @ np.swapaxes(chain[:, :3, :3], 1, 2)
            + chain[:, None, :3, 3]
        )
        shift = session.pixels[i] - camera.project(points)
        # The closed formula leaves out what a lens does beyond fourth order.
        np.testing.assert_allclose(
            shift,
            sphere_shift(camera, points, radii),
            atol=1e-8 if lens is None else 2e-4,
        )
        assert np.abs(shift[:, 1]).max() < 1e-12
        assert np.abs(shift[:, 2]).max() > 0.02


def test_a_lens_bends_the_outline_as_counting_pixels_says():
    geometry = reference_geometry(np.random.default_rng(0), lens=LENS)
    session, truth = synthesize(
        geometry, np.random.default_rng(1), sigma_px=0.0, marker_radii=(12e-3,) * 3
    )
    camera = geometry.cameras[0]
    chain = (
        se3_inverse(geometry.base_from_camera[0].matrix)
        @ truth.base_from_flange[4]
        @ geometry.flange_from_triangle.matrix
    )
    x = geometry.triangle.points[1] @ chain[:3, :3].T + chain[:3, 3]
    seen = session.pixels[0, 4, 1]
    # Rays through a grid of 0.1 px that hit the sphere: (d.x)^2 > (x.x - r^2) d.d.
    side = np.arange(-35, 35, 0.1)
    grid = np.stack(np.meshgrid(side, side), axis=-1) + np.floor(seen)
    ray = np.concatenate([camera.normalised(grid), np.ones((*grid.shape[:2], 1))], -1)
    hit = (ray @ x) ** 2 > (x @ x - 12e-3**2) * (ray * ray).sum(axis=-1)
    np.testing.assert_allclose(grid[hit].mean(axis=0), seen, atol=3e-3)


def test_noise_has_the_stated_size_and_does_not_move_with_the_sigma():
    geometry = reference_geometry(
        np.random.default_rng(0), half_turns=40, evaluation_stations=40
    )
    rng = np.random.default_rng
    repeat = Repeatability(3e-5, 1e-4)
    exact, _ = synthesize(geometry, rng(5), sigma_px=0.0, repeatability=repeat)
    noisy, truth = synthesize(geometry, rng(5), sigma_px=0.1, repeatability=repeat)
    difference = noisy.pixels - exact.pixels
    # 720 numbers: the standard deviation is known to 1/sqrt(2 * 720) = 2.6 %.
    assert 0.09 < difference.std() < 0.11
    tangent = se3_log(se3_inverse(noisy.base_from_flange) @ truth.base_from_flange)
    assert 2.7e-5 < tangent[:, :3].std() < 3.3e-5
    assert 0.9e-4 < tangent[:, 3:].std() < 1.1e-4
    np.testing.assert_allclose(noisy.pixel_covariance[0, 0, 0], 0.01 * np.eye(2))


def test_same_seed_same_session():
    pair = [
        synthesize(
            reference_geometry(np.random.default_rng(9)),
            np.random.default_rng(9),
            sigma_px=0.1,
        )[0]
        for _ in range(2)
    ]
    np.testing.assert_array_equal(pair[0].pixels, pair[1].pixels)


def test_bad_input_is_named():
    geometry = reference_geometry(np.random.default_rng(0), half_turns=2)
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="sigma_px"):
        synthesize(geometry, rng, sigma_px=-1.0)
    with pytest.raises(InputError, match="marker_radii"):
        synthesize(geometry, rng, sigma_px=0.1, marker_radii=(1.0, -1.0, 0.0))
    with pytest.raises(NoPlanError, match="farther away") as caught:
        reference_geometry(rng, distance=0.3)
    assert caught.value.rejected["view"] > 0


def test_after_a_tool_change_the_triangle_sits_otherwise():
    geometry = two_mount_geometry(
        np.random.default_rng(2), half_turns=3, evaluation_stations=1
    )
    session, truth = synthesize(geometry, np.random.default_rng(3), sigma_px=0.0)
    assert session.mounts.tolist() == 7 * [0] + 7 * [1]
    assert [turn.axis for turn in session.half_turns] == 3 * ["normal"] + 3 * ["BC"]
    kinds = [station.kind for station in session.stations]
    assert kinds == 2 * (6 * ["calibration"] + ["evaluation"])
    (second,) = truth.other_mounts
    assert second.flange_from_triangle == geometry.other_mounts[0]
    for j, mount in ((6, truth), (13, second)):
        base = session.stations[j].base_from_flange.apply(mount.markers)
        local = geometry.base_from_camera[1].inverse().apply(base)
        exact = geometry.cameras[1].project(local)
        np.testing.assert_allclose(session.pixels[1, j], exact, atol=1e-9)
    turn = session.half_turns[-1]
    before, after = (
        session.stations[j].base_from_flange @ second.flange_from_triangle
        for j in (turn.before, turn.after)
    )
    np.testing.assert_allclose(
        (before.inverse() @ after).matrix,
        geometry.triangle.half_turn("BC").matrix,
        atol=1e-14,
    )


def test_one_tool_change_after_the_other():
    rng = np.random.default_rng(0)
    one = reference_geometry(rng, half_turns=1, evaluation_stations=0)
    both = one.followed_by(one)
    mounts = [station.mount for station in both.followed_by(one).stations]
    assert mounts == [0, 0, 1, 1, 2, 2]
    with pytest.raises(InputError, match="then must have one mount, got 2"):
        one.followed_by(both)
