from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from handeye_tri.errors import InputError
from handeye_tri.mechanism import Geometry
from handeye_tri.se3 import SE3, so3_exp
from handeye_tri.solids import (
    SightCone,
    bounding_radius,
    coal_shape,
    frame_along,
    touch,
    transform,
)

TETRAHEDRON = 0.1 * np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
# Shape, size, and how far the solid reaches along x and along z.
EXTENTS = [
    ("box", (0.1, 0.2, 0.3), 0.1, 0.3),
    ("sphere", (0.1,), 0.1, 0.1),
    ("capsule", (0.1, 0.2), 0.1, 0.3),
    ("cylinder", (0.1, 0.2), 0.1, 0.2),
    ("ellipsoid", (0.1, 0.2, 0.3), 0.1, 0.3),
]


def geometry(shape, size=(), vertices=None):
    mesh = vertices is not None
    return Geometry(
        "solid",
        0,
        shape,
        np.array(size, dtype=float),
        SE3.identity(),
        vertices if mesh else np.zeros((0, 3)),
        FACES if mesh else np.zeros((0, 3), dtype=np.int64),
        np.ones(4),
        True,
    )


PROBE = coal_shape(geometry("sphere", (0.01,)))
STILL = transform(np.eye(3), np.zeros(3))


def touches(shape, probe_at):
    return touch(shape, STILL, PROBE, transform(np.eye(3), np.array(probe_at)))


@pytest.mark.parametrize(("shape", "size", "along_x", "along_z"), EXTENTS)
def test_shapes_end_where_their_sizes_say(shape, size, along_x, along_z):
    solid = coal_shape(geometry(shape, size))
    for over, hit in ((1e-4, False), (-1e-4, True)):
        assert touches(solid, (along_x + 0.01 + over, 0, 0)) is hit
        assert touches(solid, (0, 0, -along_z - 0.01 - over)) is hit


def test_a_mesh_is_its_convex_hull():
    solid = coal_shape(geometry("mesh", vertices=TETRAHEDRON))
    # The face opposite to (1, 1, 1) has distance 0.1 / sqrt(3) from the centre.
    toward = -np.ones(3) / np.sqrt(3)
    for over, hit in ((1e-4, False), (-1e-4, True)):
        assert touches(solid, (0.1 / np.sqrt(3) + 0.01 + over) * toward) is hit
    assert touches(solid, (0, 0, 0))


@pytest.mark.parametrize("corners", [4, 3, 2, 1])
def test_a_sheet_and_a_line_are_solids_too(corners):
    """A label in a model's drawing has no thickness; coal's hull needs one."""
    square = np.array([[0.1, 0.1, 0], [-0.1, -0.1, 0], [0.1, -0.1, 0], [-0.1, 0.1, 0]])
    turn = so3_exp([0.3, -0.4, 0.5])
    shape = coal_shape(
        replace(
            geometry("mesh", vertices=TETRAHEDRON),
            vertices=square[:corners] @ turn.T,
            faces=np.zeros((1, 3), dtype=np.int64),
        )
    )
    for corner in square[:corners]:
        assert touches(shape, turn @ (corner + [0, 0, 0.0099]))
        assert not touches(shape, turn @ (corner + [0, 0, 0.0101]))
    assert touches(shape, np.zeros(3)) == (corners > 1)


def test_a_plane_is_solid_below_it():
    plane = coal_shape(geometry("plane"))
    assert touches(plane, (5, 5, -3))
    assert not touches(plane, (0, 0, 0.011))


def test_bounding_balls_hold_their_solids():
    for shape, size, along_x, along_z in EXTENTS:
        assert bounding_radius(geometry(shape, size)) >= max(along_x, along_z)
    mesh = geometry("mesh", vertices=TETRAHEDRON)
    assert bounding_radius(mesh) == pytest.approx(0.1 * np.sqrt(3))
    assert bounding_radius(geometry("plane")) == np.inf


def test_frame_along_is_a_rotation():
    for axis in np.random.default_rng(0).normal(size=(50, 3)):
        frame = frame_along(axis)
        np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-15)
        assert np.linalg.det(frame) == pytest.approx(1)
        np.testing.assert_allclose(frame[:, 2], axis / np.linalg.norm(axis))


@pytest.fixture(params=range(3))
def somewhere(request):
    """A cone of 1 m to a ball of 50 mm, anywhere; its frame has z along the sight."""
    rng = np.random.default_rng(request.param)
    rotation = so3_exp(rng.normal(size=3))
    apex = rng.normal(size=3)
    cone = SightCone(apex, apex + rotation[:, 2], 0.05)
    return cone, lambda p: apex + rotation @ np.array(p)


def test_a_ball_enters_where_the_tangent_cone_is(somewhere):
    cone, place = somewhere
    half = np.arcsin(0.05)
    for depth in (0.05, 0.5, 0.9):
        for over, hit in ((1e-4, False), (-1e-4, True)):
            aside = (depth * np.sin(half) + 0.01 + over) / np.cos(half)
            pose = transform(np.eye(3), place((aside, 0, depth)))
            assert cone.entered_by(PROBE, pose) is hit


def test_the_cone_ends_at_the_outline_and_starts_ahead_of_the_camera(somewhere):
    cone, place = somewhere
    outline = 1 - 0.05**2
    for depth, hit in (
        (outline + 0.0101, False),
        (outline + 0.0099, True),
        (-0.0095, False),
        (0.02, True),
    ):
        pose = transform(np.eye(3), place((0, 0, depth)))
        assert cone.entered_by(PROBE, pose) is hit


def test_near_never_leaves_out_what_enters(somewhere):
    cone, place = somewhere
    rng = np.random.default_rng(9)
    local = rng.uniform((-0.1, -0.1, -0.2), (0.1, 0.1, 1.2), (500, 3))
    centres = np.array([place(p) for p in local])
    near = set(cone.near(centres, np.full(500, 0.01)))
    entered = {
        k
        for k in range(500)
        if cone.entered_by(PROBE, transform(np.eye(3), centres[k]))
    }
    assert len(entered) > 20
    assert entered <= near
    assert len(near) < 1.3 * len(entered)


def test_a_holder_may_fill_the_sphere_but_not_leave_it_to_the_front(somewhere):
    cone, place = somewhere

    def enters(radius, depth, aside=0.0):
        ball = coal_shape(geometry("sphere", (radius,)))
        return cone.entered_by_holder(
            ball, transform(np.eye(3), place((aside, 0, depth)))
        )

    assert not enters(0.049, 1.0)
    assert enters(0.049, 0.99)
    # Beside the sphere: seen before the outline's plane, hidden behind it.
    assert enters(0.01, 0.98, aside=0.05)
    assert not enters(0.01, 1.01, aside=0.05)


def test_a_camera_within_the_sphere_is_refused():
    with pytest.raises(InputError, match=r"0\.040 m .* within its radius of 0\.050 m"):
        SightCone(np.zeros(3), np.array([0, 0, 0.04]), 0.05)
