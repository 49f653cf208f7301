"""By what other angle a triangle was turned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from half_turn_damage import SIGMA, turned_by_170
from half_turn_scene import IMAGE_SIZE, camera, half_turn, make_scene
from scipy.stats import binom, chi2

from handeye_tri.calibrate_cameras import calibrate_camera
from handeye_tri.calibrate_cameras.half_turns import read_half_turns
from handeye_tri.calibrate_cameras.intrinsic_choice import IntrinsicChoice
from handeye_tri.calibrate_cameras.known_camera import own_homography
from handeye_tri.calibrate_cameras.outlier_tests import TURN_FREEDOM
from handeye_tri.calibrate_cameras.outliers import gain_of_another_turn
from handeye_tri.calibrate_cameras.refine import HalfTurnModel, State
from handeye_tri.calibrate_cameras.turn_angle import other_turns, turned
from handeye_tri.camera import Lens


def read(scene, before, after, sigma=SIGMA):
    data, _ = read_half_turns(
        before, after, scene.triangle, IMAGE_SIZE, scene.axes, sigma, None
    )
    state = State(
        scene.camera.intrinsics.vector,
        np.zeros(5),
        np.zeros((len(data), 4, 4)),
        np.tile(scene.foot, (len(data), 1)),
        np.zeros((len(data), 0)),
    )
    return data, state


def build(data, rows):
    return HalfTurnModel(
        data,
        choice=IntrinsicChoice.of(True, {}, None),
        lens=(),
        o_mode="shared",
        turn_covariance=None,
    )


@pytest.mark.parametrize("axis", ["normal", "AB", "BC", "CA"])
@pytest.mark.parametrize("angle", [180.0, 170.0, 75.0])
def test_turned_data_turn_by_that_angle(axis, angle) -> None:
    scene = make_scene(np.random.default_rng(1), 2, axis)
    data, state = read(scene, scene.before, scene.after)
    many = turned(data, state.o, np.radians(np.full(2, angle)))
    motion = half_turn(scene.triangle, axis, scene.foot, angle)
    np.testing.assert_allclose(many.rotation, [motion[:3, :3]] * 2, atol=1e-12)
    moved = many.translation(state.o)
    np.testing.assert_allclose(moved, [motion[:3, 3]] * 2, atol=1e-12)


@pytest.mark.parametrize("axis", ["normal", "AB", "BC", "CA"])
@pytest.mark.parametrize("angle", [179.0, 170.0, 150.0, 200.0])
def test_the_true_angle_is_among_those_that_fit(axis, angle) -> None:
    scene = make_scene(np.random.default_rng(2), 3, axis, angle_deg=angle)
    data, state = read(scene, scene.before, scene.after)
    for i in range(3):
        turns = other_turns(data.take([i]), build, state, np.zeros((7, 7)))
        exact = [turn for turn in turns if turn.square < 1e-9]
        off = min(abs(np.degrees(turn.angle) - angle) for turn in exact)
        assert off < 1e-5


@pytest.mark.parametrize(
    "lens",
    [
        Lens("radtan", np.array([-0.2, 0.06, 1e-3, -5e-4, 0.0])),
        Lens("rational", np.array([0.1, -0.05, 5e-4, 3e-4, 0.0, 0.2, 0.0, 0.0])),
    ],
)
def test_the_true_angle_is_found_through_a_lens(lens) -> None:
    view = camera(lens=lens)
    scene = make_scene(np.random.default_rng(5), 2, "CA", angle_deg=165.0, view=view)
    data, state = read(scene, scene.before, scene.after)
    state = replace(state, lens=np.array(lens.coefficients))
    for i in range(2):
        turns = other_turns(data.take([i]), build, state, np.zeros((5, 5)))
        best = min(turns, key=lambda turn: turn.square)
        assert np.degrees(best.angle) == pytest.approx(165.0, abs=1e-5)


def test_the_true_angle_is_found_where_each_half_turn_has_its_own_foot() -> None:
    scene = make_scene(np.random.default_rng(6), 2, angle_deg=172.0)
    data, state = read(scene, scene.before, scene.after)
    elsewhere = replace(state, o=state.o + 0.01)

    def build_free(part, rows):
        choice = IntrinsicChoice.of(True, {}, None)
        return HalfTurnModel(
            part, choice=choice, lens=(), o_mode="free", turn_covariance=None
        )

    turns = other_turns(data.take([0]), build_free, elsewhere, np.zeros((5, 5)))
    exact = [turn for turn in turns if turn.square < 1e-9]
    off = min(abs(np.degrees(turn.angle) - 172.0) for turn in exact)
    assert off < 1e-5


def test_the_angle_s_sigma_is_its_spread() -> None:
    scores = []
    rng = np.random.default_rng(3)
    scene = make_scene(rng, 20, "AB", angle_deg=172.0)
    data, state = read(scene, *scene.noisy(rng, SIGMA))
    for i in range(20):
        turns = other_turns(data.take([i]), build, state, np.zeros((5, 5)))
        scores.append(
            min(((t.angle - np.radians(172.0)) / t.sigma for t in turns), key=abs)
        )
    # 20 squares of mean 1: their mean spreads by 0.32.
    assert np.mean(np.square(scores)) == pytest.approx(1.0, abs=0.9)


def test_what_another_turn_gains_by_chance_is_less_than_stated() -> None:
    gains = []
    for seed in range(5):
        rng = np.random.default_rng([4, seed])
        scene = make_scene(rng, 20, "BC")
        data, state = read(scene, *scene.noisy(rng, SIGMA))
        for i in range(20):
            one = data.take([i])
            gains.append(
                gain_of_another_turn(
                    one,
                    build,
                    own_homography(one, state.o[0]),
                    state,
                    np.zeros((5, 5)),
                )
            )
    # What is stated is a bound: of 100 at most those of a chi-square, but for chance.
    for level in (0.2, 0.05):
        count = (np.array(gains) > chi2.isf(level, TURN_FREEDOM)).sum()
        assert count <= binom.isf(1e-3, 100, level)
    # Noise alone gains something, as the angle near 180 degrees is free.
    assert np.median(gains) > 0.2


def test_a_turn_seen_from_elsewhere_is_told_from_a_half_turn() -> None:
    """Its turn of 170 degrees leaves as little as half-turns do in 1 of 1000."""
    rng = np.random.default_rng([11, 14])
    scene = make_scene(rng, 20, "BC")
    before, after = scene.noisy(rng, SIGMA)
    bad = rng.choice(20, 4, replace=False).tolist()
    for i in bad:
        turned_by_170(scene, before, after, i, rng)
    found = calibrate_camera(
        before,
        after,
        scene.triangle,
        image_size=IMAGE_SIZE,
        axis="BC",
        sigma_px=SIGMA,
        reject=True,
    )
    dropped = found.details["dropped"]
    assert sorted(dropped) == sorted(bad)
    for why in dropped.values():
        words = why.split()
        # a turn of 170.2 +- 0.4 degrees, not 180
        angle, sigma = float(words[3]), float(words[5])
        assert abs(angle - 170.0) < 4.0 * sigma + 0.05


def test_angles_that_are_possible_too_are_said() -> None:
    """Seen from two of the places, this turn of 170 degrees is one of 178.3, too."""
    rng = np.random.default_rng([11, 41])
    scene = make_scene(rng, 20, "AB")
    before, after = scene.noisy(rng, SIGMA)
    for i in rng.choice(20, 4, replace=False).tolist():
        turned_by_170(scene, before, after, i, rng)
    found = calibrate_camera(
        before,
        after,
        scene.triangle,
        image_size=IMAGE_SIZE,
        axis="AB",
        sigma_px=SIGMA,
        reject=True,
    )
    why = found.details["dropped"][0]
    assert why == "a turn of 178.3 +- 0.2 degrees, not 180; 170.1 not ruled out"
