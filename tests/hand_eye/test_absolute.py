"""AX = ZB: exact data, half-turns, weights, covariance, cost, degenerate poses."""

import json
from pathlib import Path

import numpy as np
import pytest

from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.hand_eye import (
    ABSOLUTE_METHODS,
    relative_motions,
    solve_axxb,
    solve_axzb,
)
from handeye_tri.se3 import (
    SE3,
    rotation_from_quaternion_wxyz,
    se3_exp,
    se3_inverse,
    se3_log,
    so3_exp,
)

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def random_poses(rng, n, spread=0.5):
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = rotation_from_quaternion_wxyz(rng.standard_normal((n, 4)))
    poses[:, :3, 3] = spread * rng.standard_normal((n, 3))
    return poses


def need(folder):
    path = DATA / folder
    if not path.is_dir():
        pytest.skip(f"the data set {folder} is not at {path}")
    return path


@pytest.mark.parametrize("method", ABSOLUTE_METHODS)
def test_exact_data_give_the_exact_motions(method):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        x, z = random_poses(rng, 2)
        a = random_poses(rng, 6)
        found_x, found_z = solve_axzb(a, se3_inverse(z) @ a @ x, method=method)
        np.testing.assert_allclose(found_x.matrix, x, atol=1e-12)
        np.testing.assert_allclose(found_z.matrix, z, atol=1e-12)


def twins(rng, sigma):
    """Eight poses and their half-turn twins with noise on b."""
    x, z = random_poses(rng, 2, 0.2)
    first = random_poses(rng, 8, 0.3)
    axes = rng.standard_normal((8, 3))
    axes *= np.pi / np.linalg.norm(axes, axis=1, keepdims=True)
    turn = np.tile(np.eye(4), (8, 1, 1))
    turn[:, :3, :3] = so3_exp(axes)
    a = np.concatenate([first, first @ turn])
    b = se3_inverse(z) @ a @ x @ se3_exp(sigma * rng.standard_normal((16, 6)))
    return a, b, x, z


@pytest.mark.parametrize("method", ABSOLUTE_METHODS)
def test_half_turn_twins_are_no_special_case(method):
    sigma = np.repeat([0.5e-3, np.radians(0.1)], 3)
    errors = []
    for seed in range(30):
        a, b, x, z = twins(np.random.default_rng([8, seed]), sigma)
        found = solve_axzb(a, b, method=method)
        errors.append(
            [
                np.linalg.norm(f.translation - t[:3, 3])
                for f, t in zip(found, (x, z), strict=True)
            ]
        )
    assert np.max(errors) < 0.02
    assert np.sqrt(np.mean(np.square(errors))) < 1.5e-3


@pytest.mark.parametrize("method", ABSOLUTE_METHODS)
def test_opencv_regression_near_180_degrees(method):
    data = json.loads((need("opencv_24871") / "poses.json").read_text())
    a = np.array(data["gripper2base"])
    b = se3_inverse(np.array(data["target2cam"]))
    x, _ = solve_axzb(a, b, method=method)
    np.testing.assert_allclose(x.matrix, data["cam2gripper_true"], atol=1e-12)


@pytest.mark.parametrize("method", ABSOLUTE_METHODS)
def test_moveit_samples_agree_with_their_published_result(method):
    path = need("moveit_pose_samples") / "pose_samples.json"
    poses = np.array(json.loads(path.read_text()))
    _, z = solve_axzb(poses[:, 0], poses[:, 1], method=method)
    rotation = so3_exp((0.230, 0, 0)) @ so3_exp((0, -2.540, 0)) @ so3_exp((0, 0, 1.950))
    expected = SE3.from_parts(rotation, (0.659, -0.249, 0.830))
    assert np.degrees((expected.inverse() @ z).angle) < 0.4
    assert np.linalg.norm(z.translation - expected.translation) < 1.5e-3


def test_shah_uses_the_information_of_all_pairs():
    # Its rotation is the one of the linear relative method on all n (n - 1) / 2 pairs.
    sigma = np.repeat([0.5e-3, np.radians(0.1)], 3)
    a, b, _, _ = twins(np.random.default_rng(9), sigma)
    x, z = solve_axzb(a, b, method="shah")
    for side, found in (("right", x), ("left", z)):
        expected = solve_axxb(
            relative_motions(a, side=side),
            relative_motions(b, side=side),
            method="andreff",
        )
        np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-10)


def test_shah_against_park_on_all_pairs():
    # 200 seeds of 22 poses: rotation as good as Park's, translation clearly better.
    sigma = np.repeat([0.5e-3, np.radians(0.1)], 3)
    squares = np.zeros((2, 2))
    for seed in range(200):
        rng = np.random.default_rng([10, seed])
        x, z = random_poses(rng, 2, 0.2)
        a = random_poses(rng, 22, 0.5)
        b = se3_inverse(z) @ a @ x @ se3_exp(sigma * rng.standard_normal((22, 6)))
        ours = solve_axzb(a, b)[1]
        park = solve_axxb(relative_motions(a), relative_motions(b))
        for row, found in enumerate((ours, park)):
            error = se3_log(se3_inverse(z) @ found.matrix).reshape(2, 3)
            squares[row] += (error**2).sum(axis=1)
    ratio = np.sqrt(squares[0] / squares[1])
    assert ratio[1] <= 1.01
    assert ratio[0] <= 0.75


def test_refinement_beats_shah_where_noise_is_uneven():
    # Translation of b is 20 times worse along its z axis, as in a camera's view.
    sigma = np.array([1e-4, 1e-4, 2e-3, 1e-3, 1e-3, 1e-4])
    squares = np.zeros(2)
    for seed in range(40):
        a, b, _, z = twins(np.random.default_rng([11, seed]), sigma)
        covariance = np.diag(sigma**2)
        refined = solve_axzb(a, b, method="refined", covariance_b=covariance)[1]
        for k, found in enumerate((solve_axzb(a, b)[1], refined)):
            error = found.translation - z[:3, 3]
            squares[k] += error @ error
    assert squares[1] < 0.5 * squares[0]


def test_refined_without_covariance_finds_the_noise_levels():
    # The estimate is nearer to that with the true levels than separate steps are;
    # poor rotations and good translations make the ratio of the levels matter.
    sigma = np.repeat([1e-4, 1e-2], 3)
    a, b, _, _ = twins(np.random.default_rng(12), sigma)
    known = solve_axzb(a, b, method="refined", covariance_b=np.diag(sigma**2))
    found = solve_axzb(a, b, method="refined")
    plain = solve_axzb(a, b)
    near, far = (
        np.degrees((known[1].inverse() @ other[1]).angle) for other in (found, plain)
    )
    assert far > 0.1
    assert near < 0.1 * far


@pytest.mark.parametrize("method", ABSOLUTE_METHODS)
def test_parallel_axes_are_refused(method):
    rng = np.random.default_rng(3)
    x, z = random_poses(rng, 2)
    start = random_poses(rng, 1)[0]
    a = np.array(
        [
            start @ SE3.from_parts(so3_exp((0, w, 0)), rng.standard_normal(3)).matrix
            for w in (0.0, 0.3, 1.0, 2.0)
        ]
    )
    with pytest.raises(DegenerateMotionError, match="parallel within"):
        solve_axzb(a, se3_inverse(z) @ a @ x, method=method)


def test_the_same_pose_over_and_over_is_refused():
    a = np.tile(SE3.exp((0.1, 0.2, 0.3, 1, 2, 0.5)).matrix, (5, 1, 1))
    with pytest.raises(DegenerateMotionError, match="turn by at most"):
        solve_axzb(a, a)


def test_li_refuses_what_has_no_scale():
    rng = np.random.default_rng(2)
    a = random_poses(rng, 6, 0.0)
    with pytest.raises(DegenerateMotionError, match="scale"):
        solve_axzb(a, a, method="li")
    x, z = solve_axzb(a, a)
    np.testing.assert_allclose(x.rotation, z.rotation, atol=1e-12)


@pytest.mark.parametrize("method", ABSOLUTE_METHODS)
def test_many_poses_are_no_special_case(method):
    # More than two of the chunks in which the joint system is factorised; all pairs
    # of so many poses would not fit into memory.
    rng = np.random.default_rng(13)
    x, z = random_poses(rng, 2)
    a = random_poses(rng, 10000)
    found = solve_axzb(a, se3_inverse(z) @ a @ x, method=method)
    np.testing.assert_allclose(found[0].matrix, x, atol=1e-12)
    np.testing.assert_allclose(found[1].matrix, z, atol=1e-12)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"method": "best"}, "shah.*'best'"),
        ({"method": "shah", "covariance_b": np.eye(6)}, "takes no covariance"),
        ({"method": "refined", "covariance_a": np.eye(3)}, r"covariance_a.*\(6, 6\)"),
        ({"method": "refined", "covariance_b": np.full((6, 6), np.nan)}, "finite"),
        ({"method": "refined", "covariance_a": np.zeros((6, 6))}, "without noise"),
        (
            {"method": "refined", "covariance_a": -np.eye(6)},
            "negative in any direction",
        ),
    ],
)
def test_bad_keywords_are_named(keywords, message):
    rng = np.random.default_rng(0)
    a = random_poses(rng, 4)
    with pytest.raises(InputError, match=message):
        solve_axzb(a, a, **keywords)


def test_fewer_than_three_poses_are_refused():
    a = random_poses(np.random.default_rng(0), 2)
    with pytest.raises(InputError, match="at least 3"):
        solve_axzb(a, a)
