"""The verdict on lens coefficients: those that are there, and those that are not."""

from __future__ import annotations

import re

import numpy as np
import pytest
from half_turn_scene import IMAGE_SIZE, camera, make_scene

from handeye_tri.calibrate_cameras import calibrate_camera
from handeye_tri.camera import Lens
from handeye_tri.errors import ConvergenceError, DegenerateMotionError


def verdicts(scene, rng, sigma, names):
    result = calibrate_camera(
        *scene.noisy(rng, sigma),
        scene.triangle,
        image_size=IMAGE_SIZE,
        distortion=names,
        sigma_px=sigma,
    )
    return result, {found.name: found for found in result.details["lens_verdict"]}


def test_a_strong_coefficient_is_determined_and_an_absent_one_mostly_not() -> None:
    lens = Lens("radtan", np.array([-0.25, 0.0, 0.0, 0.0, 0.0]))
    scene = make_scene(np.random.default_rng(1), 14, view=camera(lens=lens))
    absent = 0
    trials = 12
    for trial in range(trials):
        rng = np.random.default_rng([2, trial])
        result, found = verdicts(scene, rng, 0.05, ("k1", "p1", "p2"))
        assert list(found) == ["k1", "p1", "p2"]
        assert found["k1"].determined
        absent += (not found["p1"].determined) + (not found["p2"].determined)
    # |x| < sigma has a chance of 0.68 for what is not there: 16 of 24, minus 4 sigmas.
    assert absent >= 0.68 * 2 * trials - 4 * np.sqrt(2 * trials * 0.68 * 0.32)
    assert "leave it out of distortion" not in str(found["k1"])
    # The effect is that of switching the coefficient off.
    local = [
        scene.triangle.points @ pose[:3, :3].T + pose[:3, 3]
        for pose in (
            *result.details["camera_from_triangle"],
            *result.details["camera_from_triangle_after"],
        )
    ]
    coefficients = result.camera.lens.coefficients.copy()
    coefficients[0] = 0.0
    off = camera(lens=Lens("radtan", coefficients))
    with_k = camera(lens=result.camera.lens)
    moved = np.array([with_k.project(p) - off.project(p) for p in local])
    rms = np.sqrt((moved**2).sum(axis=-1).mean())
    assert abs(found["k1"].effect_px / rms - 1) < 0.01


def test_high_orders_at_the_middle_of_the_image_are_reported_with_the_remedy() -> None:
    scene = make_scene(np.random.default_rng(3), 14)
    weak = []
    for seed in range(6):
        rng = np.random.default_rng([4, seed])
        _, found = verdicts(scene, rng, 0.3, ("k1", "k2", "k3"))
        weak += [verdict for verdict in found.values() if not verdict.determined]
    for verdict in weak:
        assert verdict.sigma > abs(verdict.value)
        assert verdict.sigma_px > verdict.effect_px
        assert "not determined; leave it out of distortion" in str(verdict)
    assert weak


def test_rational_lens_is_judged_too() -> None:
    lens = Lens("rational", np.array([0.1, 0, 0, 0, 0, 0.35, 0, 0]))
    scene = make_scene(np.random.default_rng(5), 20, view=camera(lens=lens))
    result, found = verdicts(scene, np.random.default_rng(6), 0.02, ("k1", "k4"))
    assert result.camera.lens.model == "rational"
    # One of the two can stand for the other at this field of view.
    assert found["k1"].sigma_px > 0
    assert found["k4"].sigma_px > 0
    assert result.chi2 < result.dof + 5 * np.sqrt(2 * result.dof)


def test_coefficients_that_cannot_be_told_apart_are_said_to_be_the_lens() -> None:
    scene = make_scene(np.random.default_rng(7), 14, tilt_deg=(20.0, 40.0))
    said = []
    for seed in range(4):
        rng = np.random.default_rng([8, seed])
        try:
            _, found = verdicts(scene, rng, 0.1, "rational")
        except (DegenerateMotionError, ConvergenceError) as error:
            said.append(str(error))
        else:
            # A lens that is not there: most of its eight coefficients are noise.
            assert sum(not verdict.determined for verdict in found.values()) >= 2
    assert said
    assert all("estimate fewer" in text for text in said)
    assert any("do not tell 8 lens coefficients apart" in text for text in said)
    # There is none: at 1 in 100 for each of eight, one may seem to be.
    assert sum("The data determine no coefficient" in text for text in said) >= 1


def test_refusal_says_which_coefficients_the_data_determine() -> None:
    lens = Lens("rational", np.array([-0.25, 0, 0, 0, 0, 0, 0, 0]))
    rng = np.random.default_rng(9)
    scene = make_scene(rng, 14, view=camera(lens=lens), sideways=0.2)
    seen = scene.noisy(rng, 0.02)
    options = {"image_size": IMAGE_SIZE, "sigma_px": 0.02}
    with pytest.raises((DegenerateMotionError, ConvergenceError)) as caught:
        calibrate_camera(*seen, scene.triangle, distortion="rational", **options)
    found = re.search(
        r"The data determine distortion=\((.*),\); chi2", str(caught.value)
    )
    assert found
    names = re.findall(r"k\d|p\d", found[1])
    assert 1 <= len(names) <= 2
    assert set(names) & {"k1", "k4"}
    result = calibrate_camera(*seen, scene.triangle, distortion=names, **options)
    assert f"chi2 is then {result.chi2:.4g} for {result.dof} degrees" in str(
        caught.value
    )
