"""Bare pose pairs as a whole: mountings, wrong poses, few axes, real data."""

import json
from pathlib import Path

import numpy as np
import pytest
from pose_scene import pairs_of, random_poses, scene

from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.hand_eye import PAIR_METHODS, solve_pose_pairs
from handeye_tri.records import PosePairs
from handeye_tri.se3 import (
    SE3,
    rotation_from_quaternion_wxyz,
    se3_exp,
    se3_inverse,
    so3_exp,
)

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def need(folder):
    path = DATA / folder
    if not path.is_dir():
        pytest.skip(f"the data set {folder} is not at {path}")
    return path


@pytest.mark.parametrize("mounting", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("robot_direction", ["flange_in_base", "base_in_flange"])
@pytest.mark.parametrize("observed_direction", ["target_in_camera", "camera_in_target"])
def test_the_user_never_inverts_a_pose(mounting, robot_direction, observed_direction):
    robot, observed, x, z = scene(0, 12, mounting)
    if robot_direction == "base_in_flange":
        robot = se3_inverse(robot)
    if observed_direction == "camera_in_target":
        observed = se3_inverse(observed)
    found = solve_pose_pairs(
        PosePairs(robot, observed, mounting, robot_direction, observed_direction)
    )
    names = {
        "eye_in_hand": ("flange_from_camera", "base_from_target"),
        "eye_to_hand": ("flange_from_target", "base_from_camera"),
    }
    assert found.names == names[mounting]
    assert np.linalg.norm(found.x.translation - x[:3, 3]) < 3e-3
    assert np.linalg.norm(found.z.translation - z[:3, 3]) < 3e-3
    assert found.dropped == ()
    assert found.undetermined == ()


@pytest.mark.parametrize("method", PAIR_METHODS)
def test_every_method_is_exact_on_exact_poses(method):
    rng = np.random.default_rng(1)
    x, z = random_poses(rng, 2)
    a = random_poses(rng, 8)
    found = solve_pose_pairs(
        pairs_of(a, se3_inverse(z) @ a @ x, "eye_to_hand"), method=method
    )
    np.testing.assert_allclose(found.x.matrix, x, atol=1e-12)
    np.testing.assert_allclose(found.z.matrix, z, atol=1e-12)
    assert found.residual_positions.max() < 1e-12


@pytest.mark.parametrize("method", ["shah", "park_martin"])
def test_closed_forms_bring_sigmas_of_the_right_size(method):
    ratios = []
    for seed in range(20):
        robot, observed, x, _ = scene(seed, 15)
        found = solve_pose_pairs(pairs_of(robot, observed), method=method)
        error = (found.x.inverse() @ SE3(x)).log()
        sigma = np.sqrt(np.diagonal(found.covariance.matrix)[:6])
        ratios.append(error / sigma)
    # 20 draws, and a jackknife of 15 is itself uncertain by 18 %.
    assert 0.65 < np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_wrong_poses_are_named_and_do_no_harm():
    for seed in range(6):
        robot, observed, x, _ = scene(seed, 20)
        clean = solve_pose_pairs(pairs_of(robot, observed))
        rng = np.random.default_rng([5, seed])
        wrong = np.sort(rng.choice(20, 6, replace=False))
        robot[wrong] = random_poses(rng, 6)
        names = tuple(f"pose_{i:02d}.png" for i in range(20))
        found = solve_pose_pairs(pairs_of(robot, observed, names=names))
        assert set(names[i] for i in wrong) <= set(found.dropped)
        assert len(found.dropped) <= 7
        assert found.residual_positions[wrong].min() > 0.05
        assert np.linalg.norm(found.x.translation - x[:3, 3]) < 4e-3
        assert len(clean.dropped) <= 1


@pytest.mark.parametrize("seed", range(4))
def test_half_of_the_poses_may_be_wrong(seed):
    robot, observed, x, _ = scene(seed, 30)
    rng = np.random.default_rng(seed)
    wrong = rng.permutation(30)[:15]
    observed[wrong, :3, :3] = random_poses(rng, 15)[:, :3, :3]
    found = solve_pose_pairs(pairs_of(robot, observed))
    assert found.undetermined == ()
    assert {int(name) for name in found.dropped} >= set(wrong)
    assert len(found.dropped) <= 16
    assert np.degrees((found.x.inverse() @ SE3(x)).angle) < 0.5


def test_a_wrong_pose_that_is_only_a_little_wrong_is_noticed():
    robot, observed, _, _ = scene(3, 25)
    robot[7] = robot[7] @ se3_exp([0.02, 0, 0, 0, 0.02, 0])
    assert solve_pose_pairs(pairs_of(robot, observed)).dropped == ("7",)


def test_few_clean_poses_are_seldom_dropped():
    dropped = 0
    for seed in range(30):
        robot, observed, _, _ = scene(seed, 12)
        dropped += len(solve_pose_pairs(pairs_of(robot, observed)).dropped)
    # One in 100 data sets by construction; the noise is estimated from few.
    assert dropped <= 3


def test_an_unknown_target_size_is_solved_for():
    robot, observed, x, z = scene(2, 25)
    observed[:, :3, 3] *= 40.0
    found = solve_pose_pairs(pairs_of(robot, observed, metric=False))
    sigma = found.covariance.std("log_scale")
    assert abs(np.log(40 * found.scale)) < 4 * sigma
    assert sigma < 0.01
    assert np.linalg.norm(found.x.translation - x[:3, 3]) < 5e-3
    np.testing.assert_allclose(
        found.b[:, :3, 3], se3_inverse(observed / 1)[:, :3, 3] * found.scale, atol=1e-12
    )


def test_the_same_pose_over_and_over_is_refused():
    robot, observed, _, _ = scene(0, 1)
    many = [np.repeat(poses, 9, axis=0) for poses in (robot, observed)]
    with pytest.raises(DegenerateMotionError, match="all 9 robot poses are the same"):
        solve_pose_pairs(pairs_of(*many))
    robot, observed, _, _ = scene(0, 9)
    observed[:] = observed[0]
    with pytest.raises(DegenerateMotionError, match="9 observed poses are the same"):
        solve_pose_pairs(pairs_of(robot, observed))


@pytest.mark.parametrize(
    ("change", "keywords", "message"),
    [
        (lambda r, o: (r[:2], o[:2]), {}, "holds 2 motions; at least 3"),
        (lambda r, o: (r[:1], o[:1]), {}, "holds 1 motion; at least 3.*record more"),
        (
            lambda r, o: (r, o * [[[1.2], [1.2], [1.2], [1]]]),
            {},
            "too far for rounding: check how it was written",
        ),
        (
            lambda r, o: (r * [1, 1, -1, 1], o),
            {},
            "mirror image.*one axis has the wrong sign",
        ),
        (
            lambda r, o: (r, o * [[[1.001], [1], [1], [1]]]),
            {},
            r"observed\[\d+\] is not a rotation.*differs from I by 0\.00",
        ),
        (lambda r, o: (r * [[[np.nan]] * 4], o), {}, r"robot\[0\] holds NaN"),
        (lambda r, o: (r, o), {"method": "best"}, "likelihood.*'best'"),
        (lambda r, o: (r, o), {"shift_along_axis": 0.1}, "leave 0 shifts open"),
        (
            lambda r, o: (r, o),
            {"shift_along_axis": np.nan},
            "must be a number, got nan",
        ),
        (
            lambda r, o: (r, o),
            {"method": "shah", "shift_along_axis": 0.1},
            "without a stated shift",
        ),
    ],
)
def test_bad_input_is_named(change, keywords, message):
    robot, observed, _, _ = scene(0, 10)
    with pytest.raises(InputError, match=message):
        solve_pose_pairs(pairs_of(*change(robot, observed)), **keywords)


def half_turns(seed, axes, spread):
    """Half-turns about axes, and turns about z, of a flange that moves by spread."""
    rng = np.random.default_rng([9, seed])
    x, z = random_poses(rng, 2, 0.1)
    vectors = np.vstack(
        [np.zeros(3), np.pi * np.array(axes), [(0, 0, 0.5)], [(0, 0, 2)]]
    )
    a = np.tile(np.eye(4), (len(vectors), 1, 1))
    a[:, :3, :3] = so3_exp(vectors)
    a[:, :3, 3] = spread * rng.standard_normal((len(a), 3))
    a = random_poses(rng, 1)[0] @ a
    noise = np.repeat([5e-4, 2e-3], 3) * rng.standard_normal((len(a), 6))
    return a, se3_inverse(z) @ a @ x @ se3_exp(noise), x


IN_ONE_PLANE = [(np.cos(t), np.sin(t), 0) for t in (0.3, 1.1, 1.9, 2.8)]


@pytest.mark.parametrize("seed", range(4))
def test_half_turns_with_two_solutions_are_refused(seed):
    a, b, _ = half_turns(seed, IN_ONE_PLANE, 0.0)
    with pytest.raises(DegenerateMotionError, match="two solutions fit the 7 poses"):
        solve_pose_pairs(pairs_of(a, b, "eye_to_hand"))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("axes", "spread"), [(IN_ONE_PLANE, 0.2), ([*IN_ONE_PLANE, (0.48, 0.64, 0.6)], 0.0)]
)
def test_positions_or_one_axis_out_of_plane_settle_half_turns(axes, spread, seed):
    a, b, x = half_turns(seed, axes, spread)
    found = solve_pose_pairs(pairs_of(a, b, "eye_to_hand"))
    assert np.linalg.norm(found.x.translation - x[:3, 3]) < 5e-3


def test_opencv_regression_near_180_degrees_is_exact():
    data = json.loads((need("opencv_24871") / "poses.json").read_text())
    found = solve_pose_pairs(pairs_of(data["gripper2base"], data["target2cam"]))
    np.testing.assert_allclose(found.x.matrix, data["cam2gripper_true"], atol=1e-12)


def test_moveit_samples_agree_with_their_published_result():
    path = need("moveit_pose_samples") / "pose_samples.json"
    poses = np.array(json.loads(path.read_text()))
    found = solve_pose_pairs(pairs_of(poses[:, 0], poses[:, 1], "eye_to_hand"))
    # Euler angles about the moving x, y and z axes, published to three decimals.
    rotation = so3_exp((0.230, 0, 0)) @ so3_exp((0, -2.540, 0)) @ so3_exp((0, 0, 1.950))
    expected = SE3.from_parts(rotation, (0.659, -0.249, 0.830))
    assert np.degrees((expected.inverse() @ found.z).angle) < 0.4
    assert np.linalg.norm(found.z.translation - expected.translation) < 1.5e-3
    assert found.dropped == ()
    assert np.mean(found.residual_positions) == pytest.approx(4.33e-3, rel=0.01)
    assert np.degrees(np.mean(found.residual_angles)) == pytest.approx(0.084, rel=0.02)


def recorded(path):
    """Times and poses of a CSV file with t, x y z, qx qy qz qw; later rows only."""
    rows = np.loadtxt(path, delimiter=",")
    later = rows[1:, 0] > np.maximum.accumulate(rows[:, 0])[:-1]
    rows = rows[np.append(True, later)]
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rotation_from_quaternion_wxyz(rows[:, [7, 4, 5, 6]])
    poses[:, :3, 3] = rows[:, 1:4]
    return rows[:, 0], poses


@pytest.mark.parametrize(
    ("robot", "camera", "offset_ms", "position_mm", "angle_deg"),
    [
        (
            "robot_arm/robot_arm_complete_bag_color_and_ir_base_link_sr300_hinge.csv",
            "robot_arm/robot_arm_complete_bag_color_and_ir_target_ir.csv",
            12.7,
            8.0,
            0.5,
        ),
        (
            "robot_arm_w_color_camera_sim/robot_arm_sim_hand.csv",
            "robot_arm_w_color_camera_sim/robot_arm_sim_camera.csv",
            -0.3,
            3.0,
            0.2,
        ),
    ],
)
def test_eth_streams_with_a_clock_offset(
    robot, camera, offset_ms, position_mm, angle_deg
):
    folder = need("eth_robot_arm")
    robot_times, base_from_hand = recorded(folder / robot)
    camera_times, target_from_camera = recorded(folder / camera)
    start = robot_times[0]
    # Every sixth picture: the streams are far denser than needed.
    found = solve_pose_pairs(
        pairs_of(
            base_from_hand,
            target_from_camera[::6],
            observed_direction="camera_in_target",
            robot_times=robot_times - start,
            observed_times=camera_times[::6] - start,
        )
    )
    # Correlation alone gives the figure; the motions refine it by a few ms.
    assert 1e3 * found.clock_offset == pytest.approx(offset_ms, abs=6)
    assert np.median(found.residual_positions) < 1e-3 * position_mm
    assert np.degrees(np.median(found.residual_angles)) < angle_deg
    assert len(found.dropped) < 0.05 * len(found.poses)
