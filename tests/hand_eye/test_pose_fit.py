"""The likelihood fit: noise found, efficiency, covariance, scale, open directions."""

import numpy as np
import pytest
from pose_scene import NOISE, noisy, random_poses, scene

from handeye_tri.hand_eye import solve_axzb
from handeye_tri.hand_eye.clock import RobotTrack
from handeye_tri.hand_eye.pose_fit import fit_poses
from handeye_tri.hand_eye.pose_iteration import PoseIteration
from handeye_tri.hand_eye.pose_model import PoseInput
from handeye_tri.hand_eye.pose_noise import noise_shapes
from handeye_tri.records import PoseNoise
from handeye_tri.se3 import se3_exp, se3_inverse, se3_log, so3_exp

MOUNTINGS = ("eye_in_hand", "eye_to_hand")


def fit(robot, observed, mounting, **keywords):
    data = PoseInput(robot, observed, mounting == "eye_in_hand")
    x, z = solve_axzb(robot, data.b)
    return fit_poses(data, x.matrix, z.matrix, **keywords)


def error(found, x, z):
    return np.append(
        se3_log(se3_inverse(found.x) @ x), se3_log(se3_inverse(found.z) @ z)
    )


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_noise_shapes_against_noise_that_is_drawn(mounting):
    # One component at a time, 1e-5 small: the residual's covariance is its shape.
    rng = np.random.default_rng(0)
    n = 40000
    size = 1e-5
    for k in range(5):
        sigma = np.zeros(5)
        sigma[k] = size
        robot, observed, x, z = scene(
            3, 1, mounting, PoseNoise(1e-30, 1e-30, 1e-30, 1e-30, 1e-30)
        )
        many = [np.repeat(poses, n, axis=0) for poses in (robot, observed)]
        small = PoseNoise(*np.maximum(sigma, 1e-14))
        noisy_robot, noisy_observed = noisy(rng, *many, small)
        b = noisy_observed if mounting == "eye_to_hand" else se3_inverse(noisy_observed)
        e = se3_log(se3_inverse(noisy_robot @ x) @ (z @ b)) / size
        shape = noise_shapes(observed, x, eye_in_hand=mounting == "eye_in_hand")[k, 0]
        # 40000 draws tell a variance to 0.7 %, a zero to 0.5 % of the largest.
        np.testing.assert_allclose(e.T @ e / n, shape, atol=0.035 * shape.max())


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_derivatives_against_differences(mounting):
    robot, observed, x, z = scene(1, 6, mounting)
    times = np.linspace(0.0, 1.0, 6)
    rng = np.random.default_rng(2)
    track = RobotTrack(np.linspace(-0.5, 1.5, 5), random_poses(rng, 5))
    data = PoseInput(
        robot, observed, mounting == "eye_in_hand", True, track=track, times=times
    )
    state = PoseIteration(data, x, z, 1.3, 0.013, NOISE)
    h = 1e-6
    base = np.array(state.jacobian)

    def moved(k, by):
        state = PoseIteration(data, x, z, 1.3, 0.013, NOISE)
        tangent = np.zeros(12)
        if k < 12:
            tangent[k] = by
        state.x, state.z = (
            state.x @ se3_exp(tangent[:6]),
            state.z @ se3_exp(tangent[6:]),
        )
        state.scale *= np.exp(by if k == 12 else 0.0)
        state.offset += by if k == 13 else 0.0
        state._linearise()
        return state.e

    for k in range(14):
        numeric = (moved(k, h) - moved(k, -h)) / (2 * h)
        # Third derivatives of order 100 times h^2, rounding 1e-15 / h.
        np.testing.assert_allclose(
            base[:, :, k], numeric, atol=2e-7 * max(1, np.abs(numeric).max())
        )


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_more_accurate_than_shah_and_covariance_honest_with_stated_noise(mounting):
    squares, nees, chi2 = np.zeros((2, 2)), [], []
    for seed in range(60):
        robot, observed, x, z = scene(seed, 20, mounting)
        data = PoseInput(robot, observed, mounting == "eye_in_hand")
        shah = solve_axzb(robot, data.b)
        found = fit(robot, observed, mounting, noise=NOISE)
        e = error(found, x, z)
        nees.append(e @ np.linalg.solve(found.covariance, e) / 12)
        chi2.append(found.chi2 / found.dof)
        for row, one in enumerate((shah[0].matrix, found.x)):
            parts = se3_log(se3_inverse(one) @ x).reshape(2, 3)
            squares[row] += (parts**2).sum(axis=1)
    # Means of 60 normalised chi-squares of 12 and of 108 degrees of freedom have
    # standard deviations of 0.053 and 0.018.
    assert abs(np.mean(nees) - 1) < 0.2
    assert abs(np.mean(chi2) - 1) < 0.07
    assert np.sqrt(squares[1] / squares[0]).max() < 0.85


def test_noise_from_residuals_costs_little_and_stays_honest():
    nees, squares = [], np.zeros(2)
    for seed in range(25):
        robot, observed, x, z = scene(seed, 30)
        found = fit(robot, observed, "eye_in_hand")
        known = fit(robot, observed, "eye_in_hand", noise=NOISE)
        e = error(found, x, z)
        nees.append(e @ np.linalg.solve(found.covariance, e) / 12)
        squares += [np.sum(error(one, x, z)[:3] ** 2) for one in (found, known)]
    assert 0.6 < np.mean(nees) < 1.25
    assert squares[0] < 1.2 * squares[1]


def test_many_poses_tell_the_noise_apart():
    robot, observed, _, _ = scene(0, 400)
    found = fit(robot, observed, "eye_in_hand")
    # Position noise of robot and camera differ in direction alone: their sum is told.
    assert found.noise.rotation == pytest.approx(NOISE.rotation, rel=0.1)
    lateral = np.hypot(found.noise.robot_translation, found.noise.lateral)
    depth = np.hypot(found.noise.robot_translation, found.noise.depth)
    assert lateral == pytest.approx(np.hypot(2e-4, 5e-4), rel=0.2)
    assert depth == pytest.approx(np.hypot(2e-4, 1.5e-3), rel=0.1)
    assert np.isinf(found.tail)


def test_heavy_tails_are_noticed_and_pay():
    squares, tails = np.zeros(2), []
    for seed in range(15):
        robot, observed, x, z = scene(seed, 40, tail=2.5)
        found = fit(robot, observed, "eye_in_hand")
        plain = fit(robot, observed, "eye_in_hand", noise=NOISE)
        tails.append(found.tail)
        squares += [np.sum(error(one, x, z)[:3] ** 2) for one in (found, plain)]
    assert np.median(tails) <= 6
    assert squares[0] < 0.8 * squares[1]


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_a_free_scale_is_found_with_its_sigma(mounting):
    errors = []
    for seed in range(25):
        robot, observed, x, z = scene(seed, 25, mounting)
        observed[:, :3, 3] *= 3.0
        data = PoseInput(robot, observed, mounting == "eye_in_hand", free_scale=True)
        found = fit_poses(data, x, z, scale=0.3)
        errors.append(np.log(found.scale * 3.0) / np.sqrt(found.covariance[12, 12]))
    # 25 draws: the spread is known to 14 %, the mean to 0.2.
    assert abs(np.mean(errors)) < 0.8
    assert 0.5 < np.std(errors) < 1.5


def test_a_direction_that_is_open_is_named_and_not_moved():
    rng = np.random.default_rng(5)
    x, z = random_poses(rng, 2, 0.2)
    turns = np.zeros((25, 6))
    turns[:, 2] = 0.1 * rng.standard_normal(25)
    turns[:, :2] = 0.2 * rng.standard_normal((25, 2))
    turns[:, 5] = np.linspace(-1, 1, 25)
    b = se3_inverse(z) @ se3_exp(turns) @ x
    robot, observed = noisy(rng, se3_exp(turns), b, NOISE)
    found = fit_poses(PoseInput(robot, observed, False, few_axes=True), x, z)
    assert len(found.undetermined) == 1
    assert found.certainty < 1
    # It is a shift of both motions along the axis and nothing else.
    direction = found.undetermined[0]
    shift = found.x[:3, :3] @ direction[:3]
    np.testing.assert_allclose(
        np.abs(shift[2]), np.linalg.norm(direction[:3]), rtol=1e-3
    )
    np.testing.assert_allclose(direction[3:6], 0, atol=5e-3)
    # What is told is right, the open direction stayed near its start.
    moved = found.x @ se3_inverse(x)
    assert np.abs(se3_log(moved)[[0, 1, 3, 4, 5]]).max() < 5e-3
    assert abs(moved[2, 3]) < 5e-2


def test_poses_that_do_not_belong_together_show_as_noise():
    rng = np.random.default_rng(6)
    data = PoseInput(random_poses(rng, 12), random_poses(rng, 12), True)
    found = fit_poses(data, np.eye(4), np.eye(4))
    assert found.noise.rotation + found.noise.robot_rotation > 0.3


def drifting(seed, n=200, scale=0.5):
    """A camera on the flange whose odometry adds up its errors, scaled."""
    rng = np.random.default_rng([9, seed])
    x = random_poses(rng, 1, 0.1)[0]
    times = np.arange(n) / 30
    phases = np.array([0.31, 0.47, 0.23, 0.53, 0.37, 0.29])
    size = np.array([0.2, 0.2, 0.15, 0.9, 0.8, 1.0])
    robot = se3_exp(size * np.sin(2 * np.pi * phases * times[:, None] + phases * 9))
    camera = robot @ x
    steps = se3_inverse(camera[:-1]) @ camera[1:]
    steps = steps @ se3_exp(
        np.repeat([1e-3, 5e-4], 3) * rng.standard_normal((n - 1, 6))
    )
    odometry = [np.eye(4)]
    for step in steps:
        odometry.append(odometry[-1] @ step)
    odometry = np.array(odometry)
    odometry[:, :3, 3] *= scale
    reported = robot @ se3_exp(1e-4 * rng.standard_normal((n, 6)))
    # World: where the first picture was taken; b is camera in that world.
    return reported, se3_inverse(odometry), x, camera[0]


def test_errors_that_add_up_are_noticed_and_the_covariance_holds():
    errors, squares, correlations = [], np.zeros(2), []
    for seed in range(10):
        robot, observed, x, z = drifting(seed)
        data = PoseInput(robot, observed, True, free_scale=True)
        found = fit_poses(data, x, z, scale=2.0)
        white = fit_poses(
            data, x, z, scale=2.0, noise=PoseNoise(1e-3, 1e-3, 5e-3, 5e-3, 5e-3)
        )
        correlations.append(found.correlation)
        e = error(found, x, z)
        errors.append(e[:6] / np.sqrt(np.diagonal(found.covariance)[:6]))
        errors[-1][0] = np.log(found.scale / 2) / np.sqrt(found.covariance[12, 12])
        squares += [np.sum(error(one, x, z)[:3] ** 2) for one in (found, white)]
    assert np.median(correlations) > 0.9
    assert squares[0] < 0.5 * squares[1]
    # The model of one correlation is not the truth's sum of two kinds of noise.
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.8


def test_noisy_lengths_do_not_shrink_the_scale():
    # Positions spread by 25 mm with 10 mm of noise: derivatives taken at the noisy
    # places would make the scale 14 % too small.
    rng = np.random.default_rng(12)
    x, z = random_poses(rng, 2, 0.05)
    logs = []
    for _ in range(12):
        b = random_poses(rng, 150, 0.025)
        b[:, :3, :3] = so3_exp(0.6 * rng.standard_normal((150, 3)))
        robot = z @ b @ se3_inverse(x)
        b[:, :3, 3] += 0.010 * rng.standard_normal((150, 3))
        data = PoseInput(robot, b, False, free_scale=True)
        found = fit_poses(data, x, z, noise=PoseNoise(1e-5, 1e-5, 0.010, 0.010, 1e-4))
        logs.append(np.log(found.scale))
    assert abs(np.mean(logs)) < 0.03
