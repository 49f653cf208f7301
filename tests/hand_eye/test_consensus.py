"""Consensus: what wrong poses cannot spoil."""

import numpy as np
import pytest
from pose_scene import random_poses, scene

from handeye_tri.errors import DegenerateMotionError
from handeye_tri.hand_eye import solve_axzb
from handeye_tri.hand_eye.consensus import find_consensus, solve_samples
from handeye_tri.hand_eye.pose_model import PoseInput
from handeye_tri.se3 import se3_inverse


def equation(robot, observed, mounting="eye_in_hand"):
    data = PoseInput(robot, observed, mounting == "eye_in_hand")
    return robot, data.b


def spoiled(seed, n, share, mounting="eye_in_hand"):
    robot, observed, x, z = scene(seed, n, mounting)
    rng = np.random.default_rng([99, seed])
    wrong = rng.choice(n, int(round(share * n)), replace=False)
    robot[wrong] = random_poses(rng, len(wrong))
    right = np.ones(n, bool)
    right[wrong] = False
    return *equation(robot, observed, mounting), x, z, right


@pytest.mark.parametrize(("n", "share"), [(10, 0.3), (20, 0.3), (30, 0.5), (250, 0.4)])
def test_wrong_poses_are_told_from_right_ones(n, share):
    for seed in range(6):
        a, b, x, _, right = spoiled(seed, n, share)
        found = find_consensus(a, b, seed=seed)
        assert not found.agreeing[~right].any()
        # Noise of three sigmas leaves one pose out now and then.
        assert found.agreeing[right].mean() > 0.85
        assert np.linalg.norm((se3_inverse(x) @ found.x)[:3, 3]) < 0.02


def test_clean_poses_all_agree():
    for seed in range(20):
        robot, observed, _, _ = scene(seed, 8)
        assert find_consensus(*equation(robot, observed)).agreeing.sum() >= 7


def test_exact_poses_give_exact_motions_and_a_wrong_one_is_left_out():
    rng = np.random.default_rng(0)
    x, z = random_poses(rng, 2)
    a = random_poses(rng, 6)
    b = se3_inverse(z) @ a @ x
    b[2] = random_poses(rng, 1)[0]
    found = find_consensus(a, b)
    np.testing.assert_array_equal(found.agreeing, [1, 1, 0, 1, 1, 1])
    np.testing.assert_allclose(found.x, x, atol=1e-9)
    np.testing.assert_allclose(found.z, z, atol=1e-9)


def test_an_unknown_scale_is_found_beside_wrong_poses():
    for seed in range(5):
        a, b, _, _, right = spoiled(seed, 30, 0.3)
        b[:, :3, 3] *= 4.0
        found = find_consensus(a, b, free_scale=True, seed=seed)
        assert not found.agreeing[~right].any()
        assert found.scale == pytest.approx(0.25, rel=0.02)


def test_the_same_seed_gives_the_same_result():
    a, b, *_ = spoiled(1, 30, 0.4)
    first, second = (find_consensus(a, b, seed=7) for _ in range(2))
    np.testing.assert_array_equal(first.x, second.x)
    np.testing.assert_array_equal(first.agreeing, second.agreeing)


def test_weights_select_poses():
    rng = np.random.default_rng(3)
    x, z = random_poses(rng, 2)
    a = random_poses(rng, 7)
    b = se3_inverse(z) @ a @ x
    b[5:] = random_poses(rng, 2)
    weights = np.array([[1.0, 1, 1, 1, 1, 0, 0], [1, 0, 2, 1, 0, 0, 0]])
    shape = (2, 7, 4, 4)
    found = solve_samples(
        np.broadcast_to(a, shape), np.broadcast_to(b, shape), weights, False
    )
    for one in range(2):
        np.testing.assert_allclose(found[0][one], x, atol=1e-9)
        np.testing.assert_allclose(found[1][one], z, atol=1e-9)


@pytest.mark.parametrize("method", ["shah", "li", "refined"])
def test_solve_axzb_leaves_wrong_poses_out_on_request(method):
    a, b, x, _, _ = spoiled(2, 20, 0.3)
    with pytest.raises(DegenerateMotionError, match=r"contradict.*robust=True"):
        solve_axzb(a, b, method=method)
    robust = solve_axzb(a, b, method=method, robust=True)[0]
    assert np.linalg.norm(robust.translation - x[:3, 3]) < 5e-3
