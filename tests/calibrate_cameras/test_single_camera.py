"""calibrate_camera: exact on exact data, efficient and honest on noisy data."""

from __future__ import annotations

import numpy as np
import pytest
from half_turn_scene import (
    FOOT,
    IMAGE_SIZE,
    TRIANGLE,
    camera,
    cramer_rao,
    make_scene,
)

from handeye_tri.calibrate_cameras import calibrate_camera
from handeye_tri.camera import Lens
from handeye_tri.triangle import TriangleRig

MIXED = ("normal", "AB", "BC", "CA", "normal", "BC")
MIDDLE = tuple(TRIANGLE.points[1:, :2].mean(axis=0))
TURN_COVARIANCE = np.diag([3e-5**2] * 3 + [np.radians(0.005) ** 2] * 3)


def calibrate(scene, before=None, after=None, **options):
    return calibrate_camera(
        scene.before if before is None else before,
        scene.after if after is None else after,
        scene.triangle,
        image_size=IMAGE_SIZE,
        **{"axis": scene.axes, **options},
    )


@pytest.mark.parametrize("axes", ["normal", "AB", "BC", "CA", MIXED])
@pytest.mark.parametrize("method", ["whitened", "paper"])
@pytest.mark.parametrize("refine", [False, True])
@pytest.mark.parametrize("o", ["shared", "free", FOOT])
def test_exact_data_give_the_exact_camera(axes, method, refine, o) -> None:
    scene = make_scene(np.random.default_rng(1), 6, axes)
    result = calibrate(scene, method=method, refine=refine, o=o)
    error = result.camera.intrinsics.vector - scene.camera.intrinsics.vector
    assert np.abs(error).max() < 1e-7
    found = result.details["camera_from_triangle"]
    np.testing.assert_allclose(found, scene.poses, atol=1e-10)
    assert np.abs(result.residuals).max() < 1e-7
    assert result.details["self_check_px"].max() < 1e-8
    normal = np.array(scene.axes) == "normal"
    np.testing.assert_allclose(
        result.details["o"][normal], np.tile(FOOT, (normal.sum(), 1)), atol=1e-10
    )
    assert np.isnan(result.details["o"][~normal]).all()


@pytest.mark.parametrize("foot", [(0.0, 0.0), (0.13, 0.0), MIDDLE, (0.16, -0.03)])
@pytest.mark.parametrize("o", ["shared", "free", "known"])
@pytest.mark.parametrize("refine", [False, True])
def test_axis_through_a_vertex_or_an_edges_middle(foot, o, refine) -> None:
    scene = make_scene(np.random.default_rng(2), 6, foot=foot)
    result = calibrate(scene, o=foot if o == "known" else o, refine=refine)
    error = result.camera.intrinsics.vector - scene.camera.intrinsics.vector
    assert np.abs(error).max() < 1e-7


@pytest.mark.parametrize("axis", ["normal", "AB", "BC", "CA"])
@pytest.mark.parametrize(
    "triangle",
    [
        TriangleRig(0.1, 0.12, np.radians(110.0)),
        TriangleRig(0.12, 0.05, np.radians(35.0)),
    ],
)
def test_obtuse_and_thin_triangles(axis, triangle) -> None:
    scene = make_scene(np.random.default_rng(3), 6, axis, triangle=triangle)
    for refine in (False, True):
        error = (
            calibrate(scene, refine=refine).camera.intrinsics.vector
            - scene.camera.intrinsics.vector
        )
        assert np.abs(error).max() < 1e-7


@pytest.mark.parametrize("axes", ["normal", "AB", "BC", "CA", MIXED])
@pytest.mark.parametrize("refine", [False, True])
@pytest.mark.parametrize("method", ["whitened", "paper"])
@pytest.mark.parametrize(("n", "skew"), [(2, False), (3, False), (3, True)])
def test_least_number_of_half_turns(axes, refine, method, n, skew) -> None:
    axes = axes if isinstance(axes, str) else axes[:n]
    view = camera(skew=1.5 if skew else 0.0)
    scene = make_scene(np.random.default_rng(32), n, axes, view=view)
    # Nothing but the ratios of the sides is known.
    ratios = TriangleRig(1.0, TRIANGLE.side_ac / TRIANGLE.side_ab, TRIANGLE.angle)
    result = calibrate_camera(
        scene.before,
        scene.after,
        ratios,
        image_size=IMAGE_SIZE,
        axis=axes,
        skew=skew,
        refine=refine,
        method=method,
    )
    error = result.camera.intrinsics.vector - scene.camera.intrinsics.vector
    assert np.abs(error).max() < 1e-7


def test_only_side_ratios_matter_for_k_and_sides_set_the_scale_of_poses() -> None:
    scene = make_scene(np.random.default_rng(4), 6)
    rng = np.random.default_rng(5)
    seen = scene.noisy(rng, 0.1)
    result = calibrate(scene, *seen)
    double = TriangleRig(2 * TRIANGLE.side_ab, 2 * TRIANGLE.side_ac, TRIANGLE.angle)
    scaled = calibrate_camera(*seen, double, image_size=IMAGE_SIZE)
    np.testing.assert_allclose(
        scaled.camera.intrinsics.vector, result.camera.intrinsics.vector, atol=1e-4
    )
    np.testing.assert_allclose(
        scaled.details["camera_from_triangle"][:, :3, 3],
        2 * result.details["camera_from_triangle"][:, :3, 3],
        rtol=1e-6,
    )


@pytest.mark.parametrize("axis", ["normal", "CA"])
@pytest.mark.parametrize(
    ("model", "names", "coefficients"),
    [
        ("radtan", ("k1", "k2", "p1", "p2"), (-0.21, 0.13, 1e-3, -6e-4, 0)),
        ("radtan", "radtan", (-0.21, 0.13, 1e-3, -6e-4, 0.05)),
        ("rational", ("k1", "k4"), (0.1, 0, 0, 0, 0, 0.35, 0, 0)),
    ],
)
def test_lens_is_recovered_from_exact_data(axis, model, names, coefficients) -> None:
    view = camera(lens=Lens(model, np.array(coefficients)))
    scene = make_scene(np.random.default_rng(6), 14, axis, view=view)
    result = calibrate(scene, distortion=names)
    assert result.camera.lens.model == model
    # High orders are weak: the intrinsics and the map of rays are the judges.
    error = result.camera.intrinsics.vector - scene.camera.intrinsics.vector
    assert np.abs(error).max() < 1e-4
    assert np.abs(result.residuals).max() < 1e-7
    labels = names if names != "radtan" else ("k1", "k2", "p1", "p2", "k3")
    assert result.covariance.labels[5:] == tuple(f"camera.{n}" for n in labels)


def test_an_unmodelled_lens_shows_in_chi2() -> None:
    view = camera(lens=Lens("radtan", np.array([-0.2, 0.1, 0, 0, 0])))
    scene = make_scene(np.random.default_rng(7), 11, view=view)
    seen = scene.noisy(np.random.default_rng(8), 0.05)
    pinhole = calibrate(scene, *seen, sigma_px=0.05)
    assert pinhole.chi2 / pinhole.dof > 5
    lens = calibrate(scene, *seen, sigma_px=0.05, distortion=("k1", "k2", "p1", "p2"))
    assert 0.5 < lens.chi2 / lens.dof < 1.6


def statistics(scene, sigma, trials, seed, truth=None, **options):
    truth = scene.camera.intrinsics.vector if truth is None else truth
    errors, nees, ratio = [], [], []
    for trial in range(trials):
        rng = np.random.default_rng([seed, trial])
        result = calibrate(scene, *scene.noisy(rng, sigma), sigma_px=sigma, **options)
        error = result.camera.intrinsics.vector - truth
        errors.append(error)
        nees.append(error @ np.linalg.solve(result.covariance.matrix, error) / 5)
        ratio.append(result.chi2 / result.dof)
    return np.array(errors), np.mean(nees), np.mean(ratio)


@pytest.mark.parametrize("axis", ["normal", "CA"])
@pytest.mark.parametrize("sigma", [0.1, 1.0])
def test_reaches_the_cramer_rao_bound_and_says_its_spread(axis, sigma) -> None:
    scene = make_scene(np.random.default_rng(9), 11, axis)
    trials = 100
    errors, nees, ratio = statistics(scene, sigma, trials, 10)
    bound = np.sqrt(np.diagonal(cramer_rao(scene, sigma)))
    # Four standard errors of a root mean square of so many, of NEES, of chi2 / dof;
    # 2 % more at 1 px for the estimator's own curvature.
    slack = 4 / np.sqrt(2 * trials) + 0.02 * sigma
    rmse = np.sqrt((errors**2).mean(axis=0)) / bound
    np.testing.assert_allclose(rmse, 1.0, atol=slack)
    assert nees == pytest.approx(1.0, abs=4 * np.sqrt(2 / (5 * trials)) + 0.02 * sigma)
    assert ratio == pytest.approx(1.0, abs=4 * np.sqrt(2 / (60 * trials)))


@pytest.mark.parametrize("axis", ["normal", "CA"])
def test_reported_covariance_is_the_bound_and_needs_no_known_noise(axis) -> None:
    scene = make_scene(np.random.default_rng(11), 11, axis)
    bound = cramer_rao(scene, 0.1)
    result = calibrate(scene, sigma_px=0.1)
    # The bound's central differences leave about 1e-6 of it.
    np.testing.assert_allclose(
        result.covariance.matrix, bound, rtol=1e-4, atol=1e-6 * np.abs(bound).max()
    )
    assert result.covariance.labels == tuple(
        f"camera.{name}" for name in ("fx", "fy", "skew", "cx", "cy")
    )
    seen = scene.noisy(np.random.default_rng(12), 0.1)
    unknown, known = calibrate(scene, *seen), calibrate(scene, *seen, sigma_px=0.1)
    np.testing.assert_allclose(
        unknown.covariance.matrix / known.covariance.matrix,
        known.chi2 / known.dof,
        rtol=1e-3,
    )


@pytest.mark.parametrize("axis", ["normal", "CA"])
@pytest.mark.parametrize(
    ("method", "sigma"), [("whitened", 0.1), ("whitened", 1.0), ("paper", 0.1)]
)
def test_closed_form_says_its_own_spread(axis, method, sigma) -> None:
    scene = make_scene(np.random.default_rng(13), 11, axis, tilt_deg=(60.0, 60.0))
    trials = 80
    errors, nees, _ = statistics(scene, sigma, trials, 14, refine=False, method=method)
    bound = np.sqrt(np.diagonal(cramer_rao(scene, sigma)))
    ratio = np.sqrt((errors**2).mean(axis=0)) / bound
    assert nees == pytest.approx(1.0, abs=5 * np.sqrt(2 / (5 * trials)))
    if method == "whitened":
        # At most 1.15, and four standard errors of so few trials.
        assert ratio.max() < 1.15 + 4 / np.sqrt(2 * trials)
    else:
        assert ratio.max() > 1.4


@pytest.mark.parametrize("axis", ["normal", "CA"])
def test_inexact_robot_is_believed_no_more_than_it_deserves(axis) -> None:
    sigma, trials = 0.015, 80
    root = np.sqrt(TURN_COVARIANCE)
    nees, told, untold = [], [], []
    for trial in range(trials):
        rng = np.random.default_rng([15, trial])
        scene = make_scene(rng, 11, axis, turn_root=root)
        seen = scene.noisy(rng, sigma)
        result = calibrate(
            scene, *seen, sigma_px=sigma, turn_covariance=TURN_COVARIANCE
        )
        error = result.camera.intrinsics.vector - scene.camera.intrinsics.vector
        nees.append(error @ np.linalg.solve(result.covariance.matrix, error) / 5)
        told.append(result.chi2 / result.dof)
        if trial < 10:
            exact = calibrate(scene, *seen, sigma_px=sigma)
            untold.append(exact.chi2 / exact.dof)
    assert np.mean(nees) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (5 * trials)))
    assert np.mean(told) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (60 * trials)))
    assert np.mean(untold) > 3.0


def test_exact_robot_is_the_limit_of_a_small_turn_covariance() -> None:
    scene = make_scene(np.random.default_rng(16), 8, MIXED + ("normal", "CA"))
    seen = scene.noisy(np.random.default_rng(17), 0.1)
    exact = calibrate(scene, *seen, sigma_px=0.1)
    for scale in (1e-12, 0.0):
        limit = calibrate(
            scene, *seen, sigma_px=0.1, turn_covariance=scale * TURN_COVARIANCE
        )
        assert limit.dof == exact.dof
        np.testing.assert_allclose(limit.chi2, exact.chi2, rtol=1e-6)
        np.testing.assert_allclose(
            limit.camera.intrinsics.vector, exact.camera.intrinsics.vector, atol=1e-3
        )
        np.testing.assert_allclose(
            limit.covariance.matrix, exact.covariance.matrix, rtol=1e-4
        )


@pytest.mark.parametrize("axis", ["normal", "CA"])
def test_a_turn_of_179_degrees_shows_in_chi2_and_in_the_self_check(axis) -> None:
    rng = np.random.default_rng(18)
    scene = make_scene(rng, 11, axis, angle_deg=179.0)
    good = make_scene(np.random.default_rng(18), 11, axis)
    assert (calibrate(scene, *scene.noisy(rng, 0.1), sigma_px=0.1).chi2) > 10 * 60
    result = calibrate(good, *good.noisy(rng, 0.1), sigma_px=0.1)
    if axis == "normal":
        # Markers on an edge stay put whatever the angle; AA', BB', CC' do not meet.
        bad = calibrate(scene, scene.before, scene.after, refine=False)
        assert bad.details["self_check_px"].min() > 0.2
        assert result.details["self_check_px"].max() < 0.5
        exact = calibrate(good, good.before, good.after, refine=False)
        assert exact.details["self_check_px"].max() < 1e-9
    # chi2 of about 60 degrees of freedom: 4 standard deviations.
    assert result.chi2 < result.dof + 4 * np.sqrt(2 * result.dof)


def test_self_check_finds_the_one_bad_half_turn_without_k() -> None:
    rng = np.random.default_rng(19)
    scene = make_scene(rng, 8)
    bad = make_scene(np.random.default_rng(20), 1, angle_deg=176.0)
    after, before = scene.after.copy(), scene.before.copy()
    before[5], after[5] = bad.before[0], bad.after[0]
    check = calibrate(scene, before, after, o="free").details["self_check_px"]
    assert np.argmax(check) == 5
    assert check[5] > 100 * np.delete(check, 5).max()


def test_unseen_markers_leave_their_half_turn_out() -> None:
    rng = np.random.default_rng(21)
    scene = make_scene(rng, 7, MIXED + ("CA",))
    before, after = scene.noisy(rng, 0.1)
    kept = [0, 2, 3, 4, 6]
    less = calibrate(
        scene,
        before[kept],
        after[kept],
        axis=[scene.axes[i] for i in kept],
        sigma_px=0.1,
    )
    before[1, 2] = np.nan
    covariance = np.tile(0.01 * np.eye(2), (7, 2, 3, 1, 1))
    covariance[5, 1, 0] = np.nan
    result = calibrate(scene, before, after, covariance=covariance)
    np.testing.assert_allclose(
        result.camera.intrinsics.vector, less.camera.intrinsics.vector, atol=1e-6
    )
    assert result.dof == less.dof
    assert result.residuals.shape == (1, 14, 3, 2)
    unseen = np.isnan(result.residuals[0]).all(axis=(1, 2))
    assert np.flatnonzero(unseen).tolist() == [1, 5, 8, 12]
    np.testing.assert_allclose(
        result.residuals[0, kept], less.residuals[0, :5], atol=1e-6
    )
    assert result.details["used"].tolist() == kept
    assert np.isnan(result.details["camera_from_triangle"][[1, 5]]).all()


def test_covariances_weigh_points_and_agree_with_sigma() -> None:
    rng = np.random.default_rng(22)
    scene = make_scene(rng, 8)
    before, after = scene.noisy(rng, 0.1)
    same = np.tile(0.01 * np.eye(2), (8, 2, 3, 1, 1))
    by_sigma = calibrate(scene, before, after, sigma_px=0.1)
    by_matrix = calibrate(scene, before, after, covariance=same)
    np.testing.assert_allclose(by_matrix.chi2, by_sigma.chi2, rtol=1e-9)
    # A point with a gross error, and a covariance that says so, does no harm.
    before[3, 1] += (5.0, -4.0)
    same[3, 0, 1] = 1e4 * np.eye(2)
    robust = calibrate(scene, before, after, covariance=same)
    sigma = np.sqrt(np.diagonal(by_sigma.covariance.matrix))
    change = robust.camera.intrinsics.vector - by_sigma.camera.intrinsics.vector
    assert np.abs(change / sigma).max() < 2.0
    naive = calibrate(scene, before, after, sigma_px=0.1)
    assert naive.chi2 > 10 * robust.chi2


def test_record_says_what_was_done() -> None:
    rng = np.random.default_rng(23)
    scene = make_scene(rng, 6, view=camera(skew=0.0, name="left"))
    before, after = scene.noisy(rng, 0.1)
    result = calibrate(scene, before, after, skew=False, sigma_px=0.1, name="left")
    assert result.camera.name == "left"
    assert result.camera.intrinsics.skew == 0.0
    assert result.covariance.labels == ("left.fx", "left.fy", "left.cx", "left.cy")
    assert result.dof == 6 * 6 - 4 - 2
    assert result.chi2 == pytest.approx(np.sum(result.residuals**2) / 0.1**2, rel=1e-9)
    assert result.cost_start > result.chi2
    assert result.method == "whitened, refined"
    # Residuals are detected less predicted, views before first.
    pose = result.details["camera_from_triangle"][2]
    seen = result.camera.project(TRIANGLE.points @ pose[:3, :3].T + pose[:3, 3])
    np.testing.assert_allclose(result.residuals[0, 2], before[2] - seen, atol=1e-9)
    pose = result.details["camera_from_triangle_after"][2]
    seen = result.camera.project(TRIANGLE.points @ pose[:3, :3].T + pose[:3, 3])
    np.testing.assert_allclose(result.residuals[0, 8], after[2] - seen, atol=1e-9)
