"""Half-turns that are none are dropped and named; good ones stay."""

from __future__ import annotations

import re

import numpy as np
import pytest
from half_turn_damage import (
    SIGMA,
    repeated,
    swapped,
    turned_by_170,
    wrong_point,
)
from half_turn_scene import IMAGE_SIZE, make_scene

from handeye_tri.calibrate_cameras import calibrate_camera
from handeye_tri.errors import DegenerateMotionError, InputError


def calibrate(scene, before, after, **options):
    return calibrate_camera(
        before,
        after,
        scene.triangle,
        image_size=IMAGE_SIZE,
        **{"axis": scene.axes, "sigma_px": SIGMA, **options},
    )


@pytest.mark.parametrize("axis", ["normal", "CA"])
@pytest.mark.parametrize("damage", [wrong_point, swapped, repeated, turned_by_170])
def test_four_of_twenty_bad_are_named_and_do_no_harm(axis, damage) -> None:
    without, rejected = [], []
    for seed in range(2):
        rng = np.random.default_rng([1, seed])
        scene = make_scene(rng, 20, axis)
        before, after = scene.noisy(rng, SIGMA)
        bad = np.sort(rng.choice(20, 4, replace=False))
        words = [damage(scene, before, after, i, rng) for i in bad]
        good = np.setdiff1d(np.arange(20), bad)
        result = calibrate(scene, before, after, reject=True)
        dropped = result.details["dropped"]
        assert sorted(dropped) == bad.tolist()
        for i, word in zip(bad, words, strict=True):
            assert re.search(word, dropped[i]), dropped[i]
        assert result.details["used"].tolist() == good.tolist()
        axes = [scene.axes[i] for i in good]
        best = calibrate(scene, before[good], after[good], axis=axes)
        true = scene.camera.intrinsics.vector
        without.append(best.camera.intrinsics.vector - true)
        rejected.append(result.camera.intrinsics.vector - true)
    ratio = np.sqrt(np.square(rejected).mean(0) / np.square(without).mean(0))
    assert ratio.max() < 1.2


def test_bad_half_turns_that_pull_the_camera_towards_them_are_found() -> None:
    rng = np.random.default_rng([11, 20])
    scene = make_scene(rng, 20, "AB")
    before, after = scene.noisy(rng, SIGMA)
    bad = rng.choice(20, 4, replace=False)
    for i in bad:
        turned_by_170(scene, before, after, i, rng)
    dropped = calibrate(scene, before, after, reject=True).details["dropped"]
    assert sorted(dropped) == sorted(bad.tolist())


def test_noise_that_is_not_stated_is_taken_from_the_half_turns() -> None:
    rng = np.random.default_rng(9)
    scene = make_scene(rng, 14)
    before, after = scene.noisy(rng, 0.02)
    # Forty sigmas, but less than a pixel.
    after[5, 1] += (0.8, 0.0)
    dropped = calibrate(scene, before, after, reject=True, sigma_px=None).details[
        "dropped"
    ]
    assert list(dropped) == [5]
    assert "marker B after it is 0.8 px off" in dropped[5]


def test_angle_of_a_turn_about_the_normal_is_said() -> None:
    rng = np.random.default_rng(2)
    scene = make_scene(rng, 12)
    before, after = scene.noisy(rng, SIGMA)
    turned_by_170(scene, before, after, 7, rng)
    dropped = calibrate(scene, before, after, reject=True).details["dropped"]
    assert list(dropped) == [7]
    assert float(dropped[7].split()[3]) == pytest.approx(170.0, abs=1.0)


@pytest.mark.parametrize("axis", ["normal", "CA", ("normal", "CA") * 6])
@pytest.mark.parametrize("known", [True, False])
def test_healthy_data_lose_nothing(axis, known) -> None:
    for seed in range(2):
        rng = np.random.default_rng([3, seed])
        scene = make_scene(rng, 12, axis)
        seen = scene.noisy(rng, SIGMA)
        options = {} if known else {"sigma_px": None}
        result = calibrate(scene, *seen, reject=True, **options)
        assert result.details["dropped"] == {}
        plain = calibrate(scene, *seen, **options)
        np.testing.assert_array_equal(
            result.camera.intrinsics.vector, plain.camera.intrinsics.vector
        )


def test_noise_that_was_stated_too_small_is_no_outlier() -> None:
    rng = np.random.default_rng(4)
    scene = make_scene(rng, 14)
    result = calibrate(scene, *scene.noisy(rng, 3 * SIGMA), reject=True)
    assert result.details["dropped"] == {}


def test_a_majority_of_bad_half_turns_is_an_error() -> None:
    rng = np.random.default_rng(5)
    scene = make_scene(rng, 12)
    before, after = scene.noisy(rng, SIGMA)
    for i in range(6):
        swapped(scene, before, after, i, rng)
    with pytest.raises(DegenerateMotionError, match=r"of 12 half-turns agree"):
        calibrate(scene, before, after, reject=True)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_losses_bound_the_harm_of_heavy_tails(loss) -> None:
    squares, softened = [], []
    for seed in range(10):
        rng = np.random.default_rng([6, seed])
        scene = make_scene(rng, 14)
        before, after = scene.noisy(rng, SIGMA)
        far = rng.random(before.shape[:2]) < 0.06
        before[far] += 3.0 * rng.standard_normal((int(far.sum()), 2))
        true = scene.camera.intrinsics.vector
        for errors, options in ((squares, {}), (softened, {"loss": loss})):
            found = calibrate(scene, before, after, **options).camera.intrinsics
            errors.append(found.vector - true)
    gain = np.sqrt(np.square(squares).mean(0) / np.square(softened).mean(0))
    assert gain.min() > 1.2
    assert gain.max() > 2.0


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_losses_agree_with_squares_on_exact_data(loss) -> None:
    scene = make_scene(np.random.default_rng(7), 6)
    result = calibrate(scene, scene.before, scene.after, loss=loss)
    error = result.camera.intrinsics.vector - scene.camera.intrinsics.vector
    assert np.abs(error).max() < 1e-7


def test_loss_needs_to_know_what_is_far() -> None:
    scene = make_scene(np.random.default_rng(8), 6)
    with pytest.raises(InputError, match="sigma_px or covariance"):
        calibrate(scene, scene.before, scene.after, loss="huber", sigma_px=None)
    with pytest.raises(InputError, match="got 'tukey'"):
        calibrate(scene, scene.before, scene.after, loss="tukey")
