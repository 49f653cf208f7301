"""Robots that turn about one direction or not at all, wrong poses among them."""

import numpy as np
import pytest
from pose_scene import NOISE, noisy, pairs_of, random_poses

from handeye_tri.errors import DegenerateMotionError
from handeye_tri.hand_eye import solve_pose_pairs
from handeye_tri.hand_eye.consensus import solve_samples
from handeye_tri.se3 import SE3, se3_exp, se3_inverse


def scara(seed, with_shifts=True, n=25):
    """A 4-axis robot: turns about one axis, shifts along all three."""
    rng = np.random.default_rng([seed, 4])
    x, z = random_poses(rng, 2, 0.15)
    turns = np.zeros((n, 6))
    if with_shifts:
        turns[:, :3] = (0.25, 0.25, 0.1) * rng.standard_normal((n, 3))
    turns[:, 5] = rng.uniform(-2, 2, n)
    lean = se3_exp([0.4, 0.1, 0.3, 0.7, -0.4, 0.2])
    a = lean @ se3_exp(turns)
    camera_from_target = se3_inverse(z) @ a @ x
    shift = np.eye(4)
    shift[2, 3] = 2.0
    camera_from_target, z = shift @ camera_from_target, z @ se3_inverse(shift)
    robot, observed = noisy(rng, a, camera_from_target, NOISE)
    return robot, observed, x, z, lean[:3, 2]


@pytest.mark.parametrize("seed", range(4))
def test_a_four_axis_robot_leaves_one_shift_open_and_takes_a_measured_one(seed):
    robot, observed, x, z, axis_in_base = scara(seed)
    pairs = pairs_of(robot, observed, "eye_to_hand")
    found = solve_pose_pairs(pairs)
    (one,) = found.undetermined
    assert one.kind == "shift"
    np.testing.assert_allclose(one.axis_in_flange, (0, 0, 1), atol=2e-3)
    np.testing.assert_allclose(one.axis_in_base, axis_in_base, atol=2e-3)
    assert "shift along the axis" in one.text
    # Everything else is right: rotation, and the shift across the axis.
    assert np.degrees((found.x.inverse() @ SE3(x)).angle) < 0.3
    np.testing.assert_allclose(found.x.translation[:2], x[:2, 3], atol=5e-3)
    measured = solve_pose_pairs(pairs, shift_along_axis=float(x[2, 3]))
    assert measured.undetermined == ()
    np.testing.assert_allclose(measured.x.translation, x[:3, 3], atol=5e-3)
    np.testing.assert_allclose(measured.z.translation, z[:3, 3], atol=2e-2)
    before, after = (
        np.sqrt(np.mean(one.residual_positions**2)) for one in (found, measured)
    )
    assert after < 1.1 * before


def five_axes(seed, yaws=1.0, rolls=1.0, n=25):
    """A 5-axis arm: its tool stays in the upright plane through the base's axis."""
    rng = np.random.default_rng([seed, 5])
    x, z = random_poses(rng, 2, 0.15)
    yaw, pitch, roll, out = np.zeros((4, n, 6))
    yaw[:, 5] = yaws * rng.uniform(-0.7, 0.7, n)
    out[:, 0], out[:, 2] = rng.uniform((0.3, 0.1), (0.6, 0.5), (n, 2)).T
    pitch[:, 4] = rng.uniform(0.6, 2.2, n)
    roll[:, 5] = rolls * rng.uniform(-1.5, 1.5, n)
    a = se3_exp(yaw) @ se3_exp(out) @ se3_exp(pitch) @ se3_exp(roll)
    camera_from_target = se3_inverse(z) @ a @ x
    shift = np.eye(4)
    shift[2, 3] = 2.0
    camera_from_target, z = shift @ camera_from_target, z @ se3_inverse(shift)
    return *noisy(rng, a, camera_from_target, NOISE), x


@pytest.mark.parametrize(("yaws", "rolls"), [(1, 1), (1, 0), (0, 1)])
def test_a_five_axis_robot_that_uses_two_of_its_turns_leaves_nothing_open(yaws, rolls):
    errors = []
    for seed in range(6):
        robot, observed, x = five_axes(seed, yaws, rolls)
        found = solve_pose_pairs(pairs_of(robot, observed, "eye_to_hand"))
        assert found.undetermined == ()
        error = (found.x.inverse() @ SE3(x)).log()
        covariance = found.covariance.matrix[:6, :6]
        errors.append(error @ np.linalg.solve(covariance, error) / 6)
    assert 0.4 < np.mean(errors) < 2.0


@pytest.mark.parametrize("seed", range(2))
def test_a_five_axis_robot_that_only_pitches_leaves_one_shift_open(seed):
    robot, observed, x = five_axes(seed, yaws=0, rolls=0)
    pairs = pairs_of(robot, observed, "eye_to_hand")
    (one,) = solve_pose_pairs(pairs).undetermined
    assert one.kind == "shift"
    np.testing.assert_allclose(one.axis_in_flange, (0, 1, 0), atol=2e-3)
    np.testing.assert_allclose(one.axis_in_base, (0, 1, 0), atol=2e-3)
    measured = solve_pose_pairs(pairs, shift_along_axis=float(x[1, 3]))
    assert measured.undetermined == ()
    np.testing.assert_allclose(measured.x.translation, x[:3, 3], atol=5e-3)


def test_one_turning_joint_leaves_a_turn_and_a_shift_open():
    robot, observed, *_ = scara(0, with_shifts=False)
    found = solve_pose_pairs(pairs_of(robot, observed, "eye_to_hand"))
    assert sorted(one.kind for one in found.undetermined) == ["shift", "turn"]
    for one in found.undetermined:
        np.testing.assert_allclose(one.axis_in_flange, (0, 0, 1), atol=0.02)
    with pytest.raises(DegenerateMotionError):
        solve_pose_pairs(pairs_of(robot, observed, "eye_to_hand"), method="shah")


def shifts_only(seed, n=25):
    """A gantry: shifts along all three axes."""
    rng = np.random.default_rng(seed)
    x, z = random_poses(rng, 2, 0.2)
    a = np.tile(random_poses(rng, 1), (n, 1, 1))
    a[:, :3, 3] += 0.2 * rng.standard_normal((n, 3))
    return *noisy(rng, a, se3_inverse(z) @ a @ x, NOISE), x


def test_without_turns_three_shifts_are_open_and_the_rotation_is_right():
    robot, observed, x = shifts_only(8, 15)
    found = solve_pose_pairs(pairs_of(robot, observed, "eye_to_hand"))
    assert [one.kind for one in found.undetermined] == ["shift"] * 3
    assert np.degrees((found.x.inverse() @ SE3(x)).angle) < 0.5


SCENES = {
    "four axes": lambda seed: scara(seed)[:3],
    "a pitch alone": lambda seed: five_axes(seed, 0, 0),
    "one joint": lambda seed: scara(seed, with_shifts=False)[:3],
    "a gantry": shifts_only,
}


def wrong_thirds(seed, robot, observed, how):
    """Poses of which 8 of 25 are wrong, and which."""
    rng = np.random.default_rng([7, seed])
    wrong = np.sort(rng.permutation(25)[:8])
    if how == "a robot pose of anywhere":
        robot[wrong] = random_poses(rng, 8)
    elif how == "a misread target":
        observed[wrong, :3, :3] = random_poses(rng, 8)[:, :3, :3]
    else:
        observed[wrong] = observed[np.roll(wrong, 1)]
    return wrong


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    "how", ["a robot pose of anywhere", "a misread target", "mixed-up pairs"]
)
@pytest.mark.parametrize("name", SCENES)
def test_wrong_poses_are_named_and_the_rest_is_as_without_them(name, how, seed):
    robot, observed, x = SCENES[name](seed)
    clean = solve_pose_pairs(pairs_of(robot, observed, "eye_to_hand"))
    wrong = wrong_thirds(seed, robot, observed, how)
    found = solve_pose_pairs(pairs_of(robot, observed, "eye_to_hand"))
    assert {int(name) for name in found.dropped} >= set(wrong)
    assert len(found.dropped) <= 9
    assert [one.kind for one in found.undetermined] == [
        one.kind for one in clean.undetermined
    ]
    if name != "one joint":
        assert np.degrees((found.x.inverse() @ SE3(x)).angle) < 0.6


@pytest.mark.parametrize("unit", [1.0, 0.025])
@pytest.mark.parametrize("name", ["four axes", "a pitch alone"])
def test_an_unknown_scale_is_found_beside_wrong_poses(name, unit):
    robot, observed, x = SCENES[name](3)
    wrong = wrong_thirds(3, robot, observed, "a misread target")
    observed[:, :3, 3] /= unit
    pairs = pairs_of(robot, observed, "eye_to_hand", metric=False)
    found = solve_pose_pairs(pairs)
    assert {int(name) for name in found.dropped} >= set(wrong)
    assert [one.kind for one in found.undetermined] == ["shift"]
    assert found.scale == pytest.approx(unit, rel=0.01)
    assert np.degrees((found.x.inverse() @ SE3(x)).angle) < 0.6


def test_a_scale_that_nothing_tells_stays_one():
    robot, observed, _ = SCENES["one joint"](0)
    robot[:, :3, 3] = robot[0, :3, 3]
    weights = np.ones((1, len(robot)))
    for few_axes in (False, True):
        *_, scale = solve_samples(robot[None], observed[None], weights, True, few_axes)
        assert scale[0] == 1.0


@pytest.mark.parametrize("turns", [(-2.0, 0.3, 1.1, 1.9), (0.4, 0.4, 0.4, 0.4)])
def test_exact_samples_give_exact_motions_but_for_the_open_shifts(turns):
    rng = np.random.default_rng(2)
    x, z = random_poses(rng, 2)
    moved = np.zeros((4, 6))
    moved[:, :3] = rng.standard_normal((4, 3))
    moved[:, 5] = turns
    a = random_poses(rng, 1) @ se3_exp(moved)
    b = se3_inverse(z) @ a @ x
    b[:, :3, 3] /= 3.0
    # The fourth pose is wrong and has no weight.
    b[3] = random_poses(rng, 1)[0]
    found_x, found_z, scale = solve_samples(
        a[None], b[None], np.array([[1.0, 1.0, 1.0, 0.0]]), True, True
    )
    assert scale[0] == pytest.approx(3.0)
    np.testing.assert_allclose(found_x[0, :3, :3], x[:3, :3], atol=1e-9)
    np.testing.assert_allclose(found_z[0, :3, :3], z[:3, :3], atol=1e-9)
    b[:, :3, 3] *= 3.0
    np.testing.assert_allclose((a @ found_x[0])[:3], (found_z[0] @ b)[:3], atol=1e-9)
