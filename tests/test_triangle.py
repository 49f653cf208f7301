"""The triangle: its sides and angles, its half-turns, what is no triangle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from handeye_tri.errors import InputError
from handeye_tri.se3 import SE3
from handeye_tri.triangle import AXES, EDGES, TriangleRig

RIG = TriangleRig(0.13, 0.12, np.radians(65))
rigs = st.builds(
    lambda ab, ac, degrees: (ab, ac, np.radians(degrees)),
    st.floats(0.02, 0.5),
    st.floats(0.02, 0.5),
    st.floats(5, 170),
)


def proper(sides: tuple[float, float, float]) -> TriangleRig:
    ab, ac, angle = sides
    height = ab * ac * np.sin(angle)
    longest = max(ab, ac, np.sqrt(ab**2 + ac**2 - 2 * ab * ac * np.cos(angle)))
    assume(height / longest**2 > 0.06)
    return TriangleRig(ab, ac, angle)


@given(rigs)
def test_points_have_the_sides_and_angles(sides: tuple[float, float, float]) -> None:
    rig = proper(sides)
    a, b, c = rig.points
    assert np.linalg.norm(b - a) == pytest.approx(rig.side_ab, rel=1e-15)
    assert np.linalg.norm(c - a) == pytest.approx(rig.side_ac, rel=1e-14)
    assert np.linalg.norm(c - b) == pytest.approx(rig.side_bc, rel=1e-13)
    for (p, q, r), angle in zip(
        ((a, b, c), (b, c, a), (c, a, b)), rig.angles, strict=True
    ):
        u, v = q - p, r - p
        found = np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v)
        assert found == pytest.approx(angle, abs=1e-12)
    assert (a == 0).all()
    assert b[1] == b[2] == c[2] == 0
    assert c[1] > 0


@given(rigs, st.tuples(*[st.floats(-2, 2)] * 6))
def test_measured_points_give_the_triangle_wherever_they_are(
    sides: tuple[float, float, float], tangent: tuple[float, ...]
) -> None:
    rig = proper(sides)
    back = TriangleRig.from_points(SE3.exp(tangent).apply(rig.points))
    assert back.side_ab == pytest.approx(rig.side_ab, abs=1e-14)
    assert back.side_ac == pytest.approx(rig.side_ac, abs=1e-14)
    assert back.angle == pytest.approx(rig.angle, abs=1e-12)


def test_points_in_the_plane_will_do() -> None:
    back = TriangleRig.from_points(RIG.points[:, :2])
    assert back.angle == pytest.approx(RIG.angle, abs=1e-15)


@given(rigs)
def test_circumcentre_is_equally_far_from_all(
    sides: tuple[float, float, float],
) -> None:
    rig = proper(sides)
    distances = np.linalg.norm(rig.points[:, :2] - rig.circumcentre, axis=1)
    assert distances == pytest.approx(distances[0], rel=1e-11)


@pytest.mark.parametrize("axis", AXES)
def test_half_turns_are_their_own_inverse_and_turn_by_pi(axis: str) -> None:
    turn = RIG.half_turn(axis, (0.03, 0.02) if axis == "normal" else None)  # type: ignore[arg-type]
    assert np.abs((turn @ turn).matrix - np.eye(4)).max() < 1e-15
    assert turn.angle == pytest.approx(np.pi, abs=1e-15)
    # No motion along the axis: this is a pure rotation.
    assert abs(turn.log()[:3] @ turn.log()[3:]) < 1e-15


def test_normal_half_turn_mirrors_through_its_foot_in_the_plane() -> None:
    o = np.array([0.03, 0.02])
    turned = RIG.half_turn("normal", o).apply(RIG.points)
    assert turned[:, :2] == pytest.approx(2 * o - RIG.points[:, :2])
    assert turned[:, 2] == pytest.approx(0)


@pytest.mark.parametrize("axis", EDGES)
def test_edge_half_turn_keeps_the_edge_and_mirrors_the_third(axis: str) -> None:
    first, second = EDGES[axis]
    third = 3 - first - second
    turned = RIG.half_turn(axis).apply(RIG.points)  # type: ignore[arg-type]
    assert turned[[first, second]] == pytest.approx(RIG.points[[first, second]])
    foot = RIG.foot(axis)  # type: ignore[arg-type]
    assert turned[third, :2] == pytest.approx(2 * foot - RIG.points[third, :2])
    # The foot is on the edge's line, below the third vertex.
    edge = RIG.points[second, :2] - RIG.points[first, :2]
    assert (RIG.points[third, :2] - foot) @ edge == pytest.approx(0, abs=1e-17)
    offset = foot - RIG.points[first, :2]
    assert edge[0] * offset[1] - edge[1] * offset[0] == pytest.approx(0, abs=1e-17)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((0.0, 0.1, 1.0), "side_ab must be a positive length, got 0.0 m"),
        ((0.1, np.nan, 1.0), "side_ac must be a positive length, got nan m"),
        ((0.1, np.inf, 1.0), "side_ac"),
        ((-0.1, 0.1, 1.0), "side_ab must be a positive length, got -0.1 m"),
        (("0.1", 0.1, 1.0), "side_ab must be a number, got '0.1'"),
        ((0.1, 0.1, None), "angle must be a number, got None"),
        ((0.1, 0.1, 65.0), "between 0 and pi radians, got 65.0; degrees must be"),
        ((0.1, 0.1, 0.0), "between 0 and pi"),
        ((0.1, 0.1, np.nan), "between 0 and pi"),
        ((0.1, 0.1, 0.01), r"nearly collinear: the smallest angle is 0.573 degrees"),
        ((0.1, 0.1, 3.13), "nearly collinear"),
        ((0.001, 0.5, 1.0), "nearly collinear"),
    ],
)
def test_what_is_no_triangle(values: tuple[Any, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        TriangleRig(*values)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[0, 0], [0, 0], [1, 0]], "coincide"),
        ([[0, 0], [1, 0], [1, 0]], "coincide"),
        ([[0, 0], [1, 0], [2, 0]], "are collinear; move one marker off"),
        ([[0, 0], [1, 0], [2, 0.01]], "nearly collinear"),
        ([[0, 0], [1, 0]], r"shape \(3, 3\) or \(3, 2\), got \(2, 2\)"),
        ([[0, 0], [np.nan, 0], [1, 1]], "positive length, got nan"),
        ([["a", 0], [1, 0], [1, 1]], "A, B and C must be real numbers, got"),
    ],
)
def test_points_that_are_no_triangle(points: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        TriangleRig.from_points(points)


def test_axes_that_do_not_exist() -> None:
    with pytest.raises(InputError, match="one of normal, AB, BC, CA, got 'AC'"):
        RIG.half_turn("AC")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="needs o"):
        RIG.half_turn("normal")
    with pytest.raises(InputError, match="needs an edge, got 'normal'"):
        RIG.foot("normal")
