"""The paper's formulas against exact depths, rows and cameras."""

from __future__ import annotations

import numpy as np
import pytest
from half_turn_scene import TRIANGLE, camera, make_scene

from handeye_tri.calibrate_cameras.special_motion import (
    conic_matrix,
    conic_row,
    constraint_rows,
    depths,
    diagonals_meet,
    foot_fraction,
    homogeneous,
    intrinsics_from_conic,
    solve_conic,
)
from handeye_tri.errors import DegenerateMotionError
from handeye_tri.triangle import TriangleRig

AXES = ["normal", "AB", "BC", "CA"]


def seen(scene):
    """Images in units that keep the rows well scaled."""
    return (
        homogeneous((scene.before - 500.0) / 1000.0),
        homogeneous((scene.after - 500.0) / 1000.0),
    )


def scaled_camera():
    k = camera().intrinsics.matrix
    return np.array([[1e-3, 0, -0.5], [0, 1e-3, -0.5], [0, 0, 1]]) @ k


def conic_of(k):
    w = np.linalg.inv(k @ k.T)
    return w[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]


def test_conic_row_is_the_bilinear_form() -> None:
    rng = np.random.default_rng(0)
    h, g, b = rng.standard_normal((4, 3)), rng.standard_normal((4, 3)), rng.random(6)
    expected = np.einsum("ni,ij,nj->n", h, conic_matrix(b), g)
    np.testing.assert_allclose(conic_row(h, g) @ b, expected, rtol=1e-13)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize(
    "triangle", [TRIANGLE, TriangleRig(0.1, 0.12, np.radians(110.0))]
)
def test_depths_are_the_true_ones_up_to_a_factor(axis, triangle) -> None:
    scene = make_scene(np.random.default_rng(1), 5, axis, triangle=triangle)
    points = triangle.points @ np.swapaxes(scene.poses[:, :3, :3], 1, 2)
    true = points[..., 2] + scene.poses[:, None, 2, 3]
    ratio = depths(*seen(scene), triangle, scene.axes) / true
    np.testing.assert_allclose(ratio / ratio[:, :1], 1.0, atol=1e-11)


@pytest.mark.parametrize("axis", AXES)
def test_rows_vanish_at_the_true_conic_and_have_rank_two(axis) -> None:
    scene = make_scene(np.random.default_rng(2), 5, axis)
    rows = constraint_rows(*seen(scene), TRIANGLE, scene.axes)
    b = conic_of(scaled_camera())
    assert np.abs(rows @ (b / np.linalg.norm(b))).max() < 1e-13
    values = np.linalg.svd(rows, compute_uv=False)
    assert (values[:, 2] < 1e-13 * values[:, 0]).all()
    assert (values[:, 1] > 1e-5 * values[:, 0]).all()


@pytest.mark.parametrize(("n", "skew"), [(3, True), (2, False), (6, True)])
def test_solves_for_k_from_the_least_number_of_half_turns(n, skew) -> None:
    view = camera(skew=1.5 if skew else 0.0)
    scene = make_scene(np.random.default_rng(3), n, "normal", view=view)
    rows = constraint_rows(*seen(scene), TRIANGLE, scene.axes).reshape(-1, 6)
    basis = np.eye(6) if skew else np.delete(np.eye(6), 1, axis=1)
    b, values, inverse = solve_conic(rows, basis)
    k = intrinsics_from_conic(b)
    expected = np.array([[1e-3, 0, -0.5], [0, 1e-3, -0.5], [0, 0, 1]])
    np.testing.assert_allclose(k, expected @ view.intrinsics.matrix, atol=1e-9)
    assert values[-1] < 1e-12 * values[0]
    # The pseudo-inverse undoes the rows on everything but b itself.
    used = np.arange(6) if skew else np.array([0, 2, 3, 4, 5])
    unit = b[used]
    np.testing.assert_allclose(
        (inverse @ rows)[np.ix_(used, used)],
        np.eye(len(used)) - np.outer(unit, unit),
        atol=1e-8,
    )


def test_common_point_of_the_diagonals_where_one_vanishes_or_two_coincide() -> None:
    vertex = (0.0, 0.0)
    middle = tuple(TRIANGLE.points[1:, :2].mean(axis=0))
    for foot in (vertex, middle):
        scene = make_scene(np.random.default_rng(4), 6, "normal", foot=foot)
        before = scene.before + 1e-6 * np.random.default_rng(5).standard_normal(
            scene.before.shape
        )
        o, distance = diagonals_meet(before, scene.after)
        centre = scene.poses[:, :3, :3] @ [*foot, 0.0] + scene.poses[:, :3, 3]
        np.testing.assert_allclose(o, scene.camera.project(centre), atol=1e-4)
        assert distance.max() < 1e-5


def test_axis_through_a_marker_is_refused_by_name() -> None:
    scene = make_scene(np.random.default_rng(6), 4, "normal", foot=(0.0, 0.0))
    with pytest.raises(
        DegenerateMotionError, match=r"marker A does not move.*whitened"
    ):
        depths(*seen(scene), TRIANGLE, scene.axes)


def test_conic_that_is_no_camera_is_refused_with_its_eigenvalues() -> None:
    with pytest.raises(DegenerateMotionError, match=r"eigenvalues -2, 1, 1"):
        intrinsics_from_conic(np.array([1.0, 0.0, 1.0, 0.0, 0.0, -2.0]))


def test_foot_fraction_says_where_the_third_vertex_projects() -> None:
    right = TriangleRig(0.1, 0.1, np.pi / 2)
    assert foot_fraction(right, "AB") == pytest.approx(0.0, abs=1e-12)
    assert foot_fraction(right, "CA") == pytest.approx(1.0, abs=1e-12)
    assert foot_fraction(right, "BC") == pytest.approx(0.5, abs=1e-12)
    obtuse = TriangleRig(0.1, 0.1, np.radians(120.0))
    assert foot_fraction(obtuse, "AB") == pytest.approx(-0.5, abs=1e-12)
