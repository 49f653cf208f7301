"""Cameras from general motions: exactness, bound, missing points, honest failure."""

from __future__ import annotations

import numpy as np
import pytest
from general_motion_scene import IMAGE_SIZE, TRIANGLE, make_scene, nees

from handeye_tri import calibrate_cameras_general
from handeye_tri.camera import Lens
from handeye_tri.errors import (
    ConvergenceError,
    DegenerateMotionError,
    HandEyeError,
    InputError,
)
from handeye_tri.triangle import TriangleRig


def calibrate(pixels, triangle=TRIANGLE, **options):
    return calibrate_cameras_general(
        pixels, triangle, **{"image_sizes": IMAGE_SIZE, **options}
    )


def intrinsics(result):
    return np.array([camera.intrinsics.vector for camera in result.cameras])


@pytest.mark.parametrize("m", [2, 3, 4, 6])
@pytest.mark.parametrize("around", [1.2, 6.0])
def test_exact_data_give_the_exact_cameras(m, around) -> None:
    scene = make_scene(np.random.default_rng([1, m]), m, around=around)
    result = calibrate(scene.pixels)
    true = np.array([camera.intrinsics.vector for camera in scene.cameras])
    assert np.abs(intrinsics(result) - true).max() < 1e-7
    for found, place in zip(
        result.reference_from_camera, scene.places_from_first, strict=True
    ):
        np.testing.assert_allclose(found.matrix, place.matrix, atol=1e-9)
    np.testing.assert_allclose(
        result.details["reference_from_triangle"], scene.poses_from_first, atol=1e-9
    )
    assert np.abs(result.residuals).max() < 1e-7
    assert result.details["left_out"].size == 0


@pytest.mark.parametrize("m", [2, 3, 6])
@pytest.mark.parametrize("sigma", [0.1, 1.0])
def test_every_run_converges_and_says_its_spread(m, sigma) -> None:
    trials = 8
    scores, ratios = [], []
    for trial in range(trials):
        rng = np.random.default_rng([2, m, trial])
        scene = make_scene(rng, m)
        result = calibrate(scene.noisy(rng, sigma), sigma_px=sigma)
        scores.append(nees(result, scene))
        ratios.append(result.chi2 / result.dof)
    # Four standard errors of the means.
    assert np.mean(scores) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (5 * m * trials)))
    assert np.mean(ratios) == pytest.approx(
        1.0, abs=4 * np.sqrt(2 / (result.dof * trials))
    )


@pytest.mark.parametrize(
    ("m", "n", "missing", "steepest"),
    [(2, 40, 0.2, 80), (3, 30, 0.15, 90), (8, 60, 0.4, 75)],
)
def test_missing_points_and_rigs_seen_from_any_side(m, n, missing, steepest) -> None:
    for seed in range(3):
        rng = np.random.default_rng([3, m, seed])
        scene = make_scene(rng, m, n, around=6.0, steepest_deg=steepest)
        pixels = scene.noisy(rng, 0.2)
        pixels[rng.random(pixels.shape[:3]) < missing] = np.nan
        result = calibrate(pixels, sigma_px=0.2)
        # Four standard deviations of one score of 5 m unknowns.
        assert nees(result, scene) < 1.0 + 4 * np.sqrt(2 / (5 * m))
        unseen = np.isnan(result.residuals[..., 0])
        out = result.details["left_out"]
        assert unseen[:, out].all()
        kept = np.setdiff1d(np.arange(n), out)
        np.testing.assert_array_equal(
            unseen[:, kept], np.isnan(pixels[..., 0])[:, kept]
        )
        assert kept.tolist() == result.details["used"].tolist()


def test_a_marker_seen_by_one_camera_still_places_the_triangle() -> None:
    scene = make_scene(np.random.default_rng(4), 3)
    pixels = scene.pixels.copy()
    pixels[1:, 4, 2] = np.nan
    pixels[0, 7, 0] = pixels[2, 7, 0] = np.nan
    result = calibrate(pixels)
    assert result.details["left_out"].size == 0
    np.testing.assert_allclose(
        result.details["reference_from_triangle"], scene.poses_from_first, atol=1e-9
    )
    pixels[:, 9, 1] = np.nan
    assert calibrate(pixels).details["left_out"].tolist() == [9]


def test_only_ratios_of_the_sides_matter_for_k() -> None:
    rng = np.random.default_rng(5)
    scene = make_scene(rng, 3)
    pixels = scene.noisy(rng, 0.2)
    double = TriangleRig(2 * TRIANGLE.side_ab, 2 * TRIANGLE.side_ac, TRIANGLE.angle)
    one, two = calibrate(pixels), calibrate(pixels, double)
    np.testing.assert_allclose(intrinsics(two), intrinsics(one), atol=1e-3)
    for a, b in zip(one.reference_from_camera, two.reference_from_camera, strict=True):
        np.testing.assert_allclose(b.translation, 2 * a.translation, atol=1e-6)


def test_unknown_noise_scales_the_covariance() -> None:
    rng = np.random.default_rng(6)
    scene = make_scene(rng, 3)
    pixels = scene.noisy(rng, 0.3)
    known, unknown = calibrate(pixels, sigma_px=0.3), calibrate(pixels)
    np.testing.assert_allclose(
        unknown.covariance.matrix / known.covariance.matrix,
        known.chi2 / known.dof,
        rtol=1e-3,
    )
    spread = np.broadcast_to(0.09 * np.eye(2), (*pixels.shape, 2))
    matrix = calibrate(pixels, covariance=spread)
    assert matrix.chi2 == pytest.approx(known.chi2, rel=1e-9)


def test_zero_skew_and_lens() -> None:
    lens = Lens("radtan", np.array([-0.2, 0.08, 0.0, 0.0, 0.0]))
    rng = np.random.default_rng(7)
    scene = make_scene(rng, 3, 30, skew=0.0, lens=lens)
    pixels = scene.noisy(rng, 0.1)
    result = calibrate(pixels, skew=False, distortion=("k1", "k2"), sigma_px=0.1)
    assert all(camera.intrinsics.skew == 0.0 for camera in result.cameras)
    assert "camera1.k2" in result.covariance.labels
    assert result.chi2 == pytest.approx(result.dof, abs=5 * np.sqrt(2 * result.dof))
    for camera in result.cameras:
        sigma = result.covariance.std(f"{camera.name}.k1")
        assert abs(camera.lens.coefficients[0] + 0.2) < 4.5 * sigma < 0.2


def test_wrong_sides_are_not_called_a_calibration() -> None:
    rng = np.random.default_rng(8)
    scene = make_scene(rng, 3)
    wrong = TriangleRig(TRIANGLE.side_ab, 1.3 * TRIANGLE.side_ac, TRIANGLE.angle)
    with pytest.raises((ConvergenceError, DegenerateMotionError)):
        calibrate(scene.noisy(rng, 0.2), wrong, sigma_px=0.2)


def test_many_cameras_at_many_stations() -> None:
    rng = np.random.default_rng(9)
    scene = make_scene(rng, 16, 150, around=6.0, steepest_deg=75.0)
    pixels = scene.noisy(rng, 0.1)
    pixels[rng.random(pixels.shape[:3]) < 0.3] = np.nan
    result = calibrate(pixels, sigma_px=0.1)
    assert nees(result, scene) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 80))


def parallel(pixels):
    scene = make_scene(np.random.default_rng(10), 2, 3)
    return {"pixels": scene.pixels}


def one_camera(pixels):
    return {"pixels": pixels[:1]}


def blind(pixels):
    pixels[2] = np.nan


def nothing(pixels):
    pixels[:] = np.nan


def doubled(pixels):
    pixels[1, 5, 1] = pixels[1, 5, 0]


def near(pixels):
    pixels[:, :, 1] = pixels[:, :, 0] + 0.02


def outside(pixels):
    pixels[1, 3, 2] = (2000.0, 5.0)


def apart(pixels):
    pixels[2, :11] = np.nan
    pixels[:2, 11:] = np.nan


@pytest.mark.parametrize(
    ("change", "options", "error", "message"),
    [
        (one_camera, {}, InputError, "1 cameras.*at least 2.*calibrate_camera"),
        (lambda p: {"pixels": p[0]}, {}, InputError, r"shape \(m, n, 3, 2\)"),
        (blind, {}, InputError, "'camera2' saw no marker in any of the 22 views"),
        (nothing, {}, InputError, "'camera0' saw no marker"),
        (doubled, {}, InputError, r"points\[1, 5\] has markers A and B at the same"),
        (outside, {}, InputError, r"points\[1, 3, 2\].*outside the 1024 x 768"),
        (parallel, {}, DegenerateMotionError, "3 views.*at least 4 views"),
        (apart, {}, HandEyeError, "camera2"),
        (lambda p: {"pixels": "image"}, {}, InputError, "points must be real numbers"),
        (lambda p: {"pixels": p * np.inf}, {}, InputError, "'camera0' saw no marker"),
        (near, {}, InputError, r"points\[0\] has markers A and B less than 0.5 px"),
        (None, {"sigma_px": "a"}, InputError, "sigma_px must be a positive"),
        (
            None,
            {"covariance": np.tile(-np.eye(2), (3, 22, 3, 1, 1))},
            InputError,
            r"covariance\[0, 0, 0\] must be symmetric and positive",
        ),
        (None, {"names": ["a", "b"]}, InputError, "names must be 3"),
        (None, {"image_sizes": [(9, 9)] * 2}, InputError, "one or 3 of them"),
        (None, {"sigma_px": -1.0}, InputError, "sigma_px must be a positive"),
        (None, {"covariance": np.eye(2)}, InputError, "covariance must have shape"),
        (None, {"distortion": "fisheye"}, InputError, "'fisheye'"),
    ],
)
def test_bad_input_is_named(change, options, error, message) -> None:
    pixels = make_scene(np.random.default_rng(11), 3).pixels.copy()
    changed = None if change is None else change(pixels)
    if changed is not None:
        pixels = changed["pixels"]
    with pytest.raises(error, match=message):
        calibrate(pixels, **options)
