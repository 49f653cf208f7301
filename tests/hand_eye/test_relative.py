"""AX = XB: exact data, half-turns, noise, degenerate motions, bad input."""

import json
from pathlib import Path

import numpy as np
import pytest

from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.hand_eye import RELATIVE_METHODS, relative_motions, solve_axxb
from handeye_tri.se3 import (
    SE3,
    nearest_rotation,
    rotation_from_quaternion_wxyz,
    se3_exp,
    se3_inverse,
    so3_exp,
    so3_log,
)

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def random_poses(rng, n, spread=0.5):
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = rotation_from_quaternion_wxyz(rng.standard_normal((n, 4)))
    poses[:, :3, 3] = spread * rng.standard_normal((n, 3))
    return poses


def half_turn(axis, through=(0.0, 0.0, 0.0)):
    axis = np.asarray(axis, dtype=float)
    axis = axis / np.linalg.norm(axis)
    rotation = 2 * np.outer(axis, axis) - np.eye(3)
    return SE3.from_parts(rotation, np.asarray(through) - rotation @ through).matrix


def need(folder):
    path = DATA / folder
    if not path.is_dir():
        pytest.skip(f"the data set {folder} is not at {path}")
    return path


@pytest.mark.parametrize("method", RELATIVE_METHODS)
@pytest.mark.parametrize("side", ["left", "right"])
def test_exact_data_give_the_exact_motion(method, side):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        x, z = random_poses(rng, 2)
        a = random_poses(rng, 6)
        b = se3_inverse(z) @ a @ x
        found = solve_axxb(
            relative_motions(a, side=side),
            relative_motions(b, side=side),
            method=method,
        )
        expected = z if side == "left" else x
        np.testing.assert_allclose(found.matrix, expected, atol=1e-12)


@pytest.mark.parametrize("method", RELATIVE_METHODS)
@pytest.mark.parametrize("diagonal", [(1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
def test_an_unknown_that_is_a_half_turn_is_no_special_case(method, diagonal):
    rng = np.random.default_rng(0)
    x = SE3.from_parts(np.diag(diagonal), (0.1, -0.2, 0.3)).matrix
    a = random_poses(rng, 5)
    b = se3_inverse(x) @ a @ x
    found = solve_axxb(a, b, method=method)
    np.testing.assert_allclose(found.matrix, x, atol=1e-12)


@pytest.mark.parametrize("method", RELATIVE_METHODS)
def test_exact_half_turns_about_axes_that_span_space(method):
    rng = np.random.default_rng(1)
    (x,) = random_poses(rng, 1)
    axes = [(1, 0.2, 0.1), (0.3, 1, -0.4), (0.2, 0.5, 1), (1, 1, 1)]
    a = np.array([half_turn(axis, rng.standard_normal(3)) for axis in axes])
    b = se3_inverse(x) @ a @ x
    found = solve_axxb(a, b, method=method)
    np.testing.assert_allclose(found.matrix, x, atol=1e-12)


def noisy_half_turn_poses(rng, general):
    """Eight poses and their half-turn twins, 0.1 deg and 0.5 mm of noise on each."""
    x, z = random_poses(rng, 2, 0.2)
    first = random_poses(rng, 8, 0.3)
    twins = np.array(
        [
            p @ half_turn(rng.standard_normal(3), 0.1 * rng.standard_normal(3))
            for p in first
        ]
    )
    a = np.stack([first, twins], axis=1).reshape(-1, 4, 4)
    sigma = np.repeat([0.5e-3, np.radians(0.1)], 3)
    b = se3_inverse(z) @ a @ x @ se3_exp(sigma * rng.standard_normal((16, 6)))
    if general:
        return relative_motions(a, side="right"), relative_motions(b, side="right"), x
    pick = np.arange(0, 16, 2)
    return (
        se3_inverse(a[pick]) @ a[pick + 1],
        se3_inverse(b[pick]) @ b[pick + 1],
        x,
    )


@pytest.mark.parametrize("general", [False, True], ids=["half-turns", "all-pairs"])
@pytest.mark.parametrize("method", RELATIVE_METHODS)
def test_no_method_fails_at_half_turns(method, general):
    # Without settled signs 75 to 100 % of these trials end more than 20 mm off.
    for seed in range(30):
        a, b, x = noisy_half_turn_poses(np.random.default_rng([7, seed]), general)
        error = solve_axxb(a, b, method=method).matrix[:3, 3] - x[:3, 3]
        assert np.linalg.norm(error) < 0.02


def test_the_half_turn_data_do_defeat_plain_rotation_vectors():
    # Park and Martin with the principal logarithm, as usually implemented.
    bad = 0
    for seed in range(30):
        a, b, x = noisy_half_turn_poses(np.random.default_rng([7, seed]), False)
        moment = so3_log(a[:, :3, :3]).T @ so3_log(b[:, :3, :3])
        rotation = nearest_rotation(moment)
        bad += np.linalg.norm(so3_log(rotation.T @ x[:3, :3])) > np.radians(5)
    assert bad > 15


@pytest.mark.parametrize("method", RELATIVE_METHODS)
def test_opencv_regression_near_180_degrees(method):
    data = json.loads((need("opencv_24871") / "poses.json").read_text())
    a = np.array(data["gripper2base"])
    b = se3_inverse(np.array(data["target2cam"]))
    found = solve_axxb(
        relative_motions(a, side="right"),
        relative_motions(b, side="right"),
        method=method,
    )
    np.testing.assert_allclose(found.matrix, data["cam2gripper_true"], atol=1e-12)


@pytest.mark.parametrize("method", RELATIVE_METHODS)
def test_moveit_samples_agree_with_their_published_result(method):
    path = need("moveit_pose_samples") / "pose_samples.json"
    poses = np.array(json.loads(path.read_text()))
    found = solve_axxb(
        relative_motions(poses[:, 0]), relative_motions(poses[:, 1]), method=method
    )
    # Euler angles about the moving x, y and z axes, published to three decimals.
    rotation = so3_exp((0.230, 0, 0)) @ so3_exp((0, -2.540, 0)) @ so3_exp((0, 0, 1.950))
    expected = SE3.from_parts(rotation, (0.659, -0.249, 0.830))
    assert np.degrees((expected.inverse() @ found).angle) < 0.4
    assert np.linalg.norm(found.translation - expected.translation) < 1.5e-3


@pytest.mark.parametrize("method", RELATIVE_METHODS)
def test_parallel_axes_are_refused_with_numbers(method):
    rng = np.random.default_rng(3)
    (x,) = random_poses(rng, 1)
    a = np.array(
        [
            SE3.from_parts(so3_exp((0, 0, w)), rng.standard_normal(3)).matrix
            for w in (0.3, 1.0, 2.0)
        ]
    )
    with pytest.raises(DegenerateMotionError, match=r"parallel within .*1\.000"):
        solve_axxb(a, se3_inverse(x) @ a @ x, method=method)


@pytest.mark.parametrize("method", RELATIVE_METHODS)
@pytest.mark.parametrize(
    "axes",
    [
        [(1, 0, 0), (0.5, 1, 0)],
        [(1, 0, 0), (0.5, 1, 0), (-0.7, 0.6, 0)],
        [(1, 0, 0), (0, 1, 0), (0, 0, 1)],
    ],
    ids=["two", "coplanar", "orthogonal"],
)
def test_ambiguous_half_turns_are_refused(method, axes):
    rng = np.random.default_rng(4)
    (x,) = random_poses(rng, 1)
    sigma = np.repeat([1e-4, np.radians(0.02)], 3)
    a = np.array([half_turn(axis, rng.standard_normal(3)) for axis in axes])
    b = se3_inverse(x) @ a @ x @ se3_exp(sigma * rng.standard_normal((len(a), 6)))
    with pytest.raises(DegenerateMotionError, match="half-turns.*ambiguous"):
        solve_axxb(a, b, method=method)
    # One motion that is no half-turn settles it.
    more = np.concatenate([a, [SE3.exp((0.1, 0, 0, 0.4, 0.5, 0.6)).matrix]])
    found = solve_axxb(more, se3_inverse(x) @ more @ x, method=method)
    np.testing.assert_allclose(found.matrix, x, atol=1e-12)


def test_poses_that_hardly_turn_are_refused():
    rng = np.random.default_rng(5)
    sigma = np.repeat([0.1, np.radians(0.1)], 3)
    a = se3_exp(sigma * rng.standard_normal((5, 6)))
    with pytest.raises(DegenerateMotionError, match="turn by at most 0"):
        solve_axxb(a, a)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a, b: (a, b[:-1]), "a holds 4 motions and b 3"),
        (lambda a, b: (a[:1], b[:1]), "holds 1 motion; at least 2"),
        (lambda a, b: (a[0], b), r"shape \(n, 4, 4\)"),
        (lambda a, b: ("poses", b), "a must be real numbers"),
        (lambda a, b: ([a[0], a[1][:3]], b), "a must be .* in lists of equal length"),
        (lambda a, b: (a, b + 1j), "b must be real numbers"),
        (lambda a, b: (a * [[[np.nan]], [[1]], [[1]], [[1]]], b), r"a\[0\] holds NaN"),
        (
            lambda a, b: (a, b * [[1.01], [1], [1], [1]]),
            r"b\[\d\] is not a rotation.*differs from I by 0\.0",
        ),
        (lambda a, b: (a * [[-1], [-1], [-1], [1]], b), "determinant -1"),
        (lambda a, b: (np.swapaxes(a, 1, 2), b), "last row.*row-major"),
    ],
)
def test_bad_input_is_named(change, message):
    rng = np.random.default_rng(6)
    a, b = change(random_poses(rng, 4), random_poses(rng, 4))
    with pytest.raises(InputError, match=message):
        solve_axxb(a, b)


def test_unknown_method_is_named_with_the_known_ones():
    a = random_poses(np.random.default_rng(0), 3)
    with pytest.raises(InputError, match="park_martin.*'park'"):
        solve_axxb(a, a, method="park")


def test_two_half_turns_are_refused_however_well_they_fit():
    # With 1 degree of noise some pairs fit each other by chance: the ratio of the two
    # residuals alone would let 1 in 50 through.
    sigma = np.repeat([1e-3, np.radians(1.0)], 3)
    for seed in range(50):
        rng = np.random.default_rng([14, seed])
        (x,) = random_poses(rng, 1)
        a = np.array([half_turn(rng.standard_normal(3)) for _ in range(2)])
        b = se3_inverse(x) @ a @ x @ se3_exp(sigma * rng.standard_normal((2, 6)))
        with pytest.raises(DegenerateMotionError):
            solve_axxb(a, b)


@pytest.mark.parametrize("keyword", ["pairs", "side"])
def test_an_unknown_word_is_refused(keyword):
    poses = random_poses(np.random.default_rng(7), 3)
    with pytest.raises(InputError, match=f"{keyword} must be one of .*got .both."):
        relative_motions(poses, **{keyword: "both"})
