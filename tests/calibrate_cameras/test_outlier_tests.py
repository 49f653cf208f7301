"""Chances of the tests of a half-turn, and what is decided from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from half_turn_scene import IMAGE_SIZE, make_scene
from scipy.stats import chi2, f, false_discovery_control, kstest

from handeye_tri.calibrate_cameras import calibrate_camera
from handeye_tri.calibrate_cameras.half_turns import read_half_turns
from handeye_tri.calibrate_cameras.intrinsic_choice import IntrinsicChoice
from handeye_tri.calibrate_cameras.least_squares import NormalEquations, minimise
from handeye_tri.calibrate_cameras.outlier_tests import (
    FALSE_DISCOVERIES,
    Noise,
    discovered,
    left_over,
)
from handeye_tri.calibrate_cameras.refine import HalfTurnModel, State
from handeye_tri.calibrate_cameras.turn_angle import turned

SIGMA = 0.2


def model_and_state(scene, before, after, turn_covariance=None, o_mode="shared"):
    found = calibrate_camera(
        before,
        after,
        scene.triangle,
        image_size=IMAGE_SIZE,
        axis=scene.axes,
        sigma_px=SIGMA,
        turn_covariance=turn_covariance,
        o=o_mode,
    )
    data, _ = read_half_turns(
        before, after, scene.triangle, IMAGE_SIZE, scene.axes, SIGMA, None
    )
    n = len(data)
    model = HalfTurnModel(
        data,
        choice=IntrinsicChoice.of(True, {}, None),
        lens=(),
        o_mode=o_mode,
        turn_covariance=None
        if turn_covariance is None
        else np.broadcast_to(turn_covariance, (n, 6, 6)),
    )
    deviation = found.details.get("turn_sigmas", np.zeros((n, 0)))
    return model, State(
        found.camera.intrinsics.vector,
        np.zeros(5),
        found.details["camera_from_triangle"].copy(),
        np.nan_to_num(found.details["o"]),
        deviation.copy(),
    )


@pytest.mark.parametrize("axis", ["normal", "AB", "BC", "CA"])
@pytest.mark.parametrize("inexact", [False, True])
def test_derivative_by_the_angle(axis, inexact) -> None:
    rng = np.random.default_rng(1)
    scene = make_scene(rng, 4, axis)
    turn = np.diag([1e-4] * 3 + [1e-3] * 3) ** 2 if inexact else None
    model, state = model_and_state(scene, *scene.noisy(rng, SIGMA), turn)
    rows = model.by_angle(state, model.evaluate(state))
    h, data = 1e-5, model.data
    ends = []
    for step in (h, -h):
        model.data = turned(data, state.o, np.full(4, np.pi + step))
        ends.append(model.evaluate(state).residuals)
    # Central differences: h^2 of the third derivative, and rounding over h.
    expected = (ends[0] - ends[1]) / (2 * h)
    np.testing.assert_allclose(rows, expected, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize("axis", ["normal", "BC", ("normal", "CA") * 6])
def test_what_good_half_turns_leave_over_is_what_theory_says(axis) -> None:
    squares, by_angle = [], []
    for seed in range(25):
        rng = np.random.default_rng([2, seed])
        scene = make_scene(rng, 12, axis)
        model, state = model_and_state(scene, *scene.noisy(rng, SIGMA))
        information = NormalEquations.of(model.evaluate(state)).reduced()
        left = left_over(model, state, np.linalg.inv(information), -np.ones(12))
        squares.append(left.square)
        by_angle.append(left.by_angle)
    # 300 of each, in sets of 12 that share a camera: nearly independent. A test of
    # 1 in 1000 each, with seeds that do not change.
    assert kstest(np.ravel(squares), chi2(6).cdf).pvalue > 1e-3
    assert kstest(np.ravel(by_angle), chi2(1).cdf).pvalue > 1e-3


def test_change_of_the_angle_is_found_with_its_sigma() -> None:
    scores = []
    for seed in range(15):
        rng = np.random.default_rng([3, seed])
        scene = make_scene(rng, 8, "CA", angle_deg=180.5)
        before, after = scene.noisy(rng, SIGMA)
        model, state = model_and_state(scene, before, after)
        # With the true camera nothing is uncertain but the pixels.
        known = replace(state, intrinsics=scene.camera.intrinsics.vector)
        fixed = model.with_camera_known()
        end = minimise(fixed.evaluate, fixed.retract, known, 1e-9)
        left = left_over(model, end.state, np.zeros((5, 5)), np.ones(8))
        scores += ((left.change - np.radians(0.5)) / left.sigma).tolist()
    # 120 of them: their mean spreads by 0.09, their mean square by 0.13.
    assert abs(np.mean(scores)) < 0.3
    assert np.mean(np.square(scores)) == pytest.approx(1.0, abs=0.45)


def test_an_angle_that_may_be_anything_says_nothing() -> None:
    rng = np.random.default_rng(4)
    scene = make_scene(rng, 3, "CA")
    model, state = model_and_state(scene, *scene.noisy(rng, SIGMA))
    _, along = model.data.axis_lines(state.o)
    # C A passes through the origin, so that no translation goes with it.
    turn = np.zeros((3, 6, 6))
    turn[:, 3:, 3:] = 1e6 * along[:, :, None] * along[:, None, :]
    loose = HalfTurnModel(
        model.data, choice=model.choice, lens=(), o_mode="shared", turn_covariance=turn
    )
    zero = replace(state, turn=np.zeros((3, 6)))
    left = left_over(loose, zero, np.zeros((5, 5)), np.ones(3))
    assert (left.by_angle < 1e-6).all()
    assert (left_over(model, state, np.zeros((5, 5)), np.ones(3)).by_angle > 1e-3).any()


def test_chances_are_tails() -> None:
    square, freedom = np.array([3.0, 30.0]), np.array([1.0, 6.0])
    stated = Noise.of(1.2, 15, True)
    assert stated == Noise(1.0, 0)
    np.testing.assert_allclose(
        stated.chances(square, freedom), chi2.sf(square, freedom)
    )
    larger = Noise.of(4.0, 15, True)
    assert larger == Noise(4.0, 15)
    known = 0.58 * 6 * 15
    np.testing.assert_allclose(
        larger.chances(square, freedom), f.sf(square / 4.0 / freedom, freedom, known)
    )
    for noise in (stated, larger):
        at_limit = noise.chances(np.array([noise.limit(6)]), np.array([6.0]))
        assert at_limit[0] == pytest.approx(1e-4)


def test_discoveries_are_those_of_benjamini_and_hochberg() -> None:
    rng = np.random.default_rng(5)
    for _ in range(200):
        chance = rng.random(20) ** rng.uniform(1, 6)
        expected = false_discovery_control(chance) <= FALSE_DISCOVERIES
        np.testing.assert_array_equal(discovered(chance), expected)


def test_less_is_needed_where_others_are_bad() -> None:
    alone, among = np.full(20, 0.5), np.full(20, 0.5)
    alone[0] = among[0] = 3.0 / 20.0 * FALSE_DISCOVERIES
    among[1:4] = 0.0
    assert not discovered(alone).any()
    assert np.flatnonzero(discovered(among)).tolist() == [0, 1, 2, 3]
