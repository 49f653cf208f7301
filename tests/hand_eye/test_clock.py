"""Clocks: interpolation, correlation, and the offset refined with the motions."""

import numpy as np
import pytest
from pose_scene import NOISE, noisy, pairs_of, random_poses

from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.hand_eye import solve_pose_pairs
from handeye_tri.hand_eye.clock import RobotTrack, correlate_clocks
from handeye_tri.se3 import se3_exp, se3_inverse, se3_log


def motion(times):
    """A smooth motion that turns about all axes, now faster, now slower."""
    phases = np.array([0.31, 0.47, 0.23, 0.53, 0.37, 0.29])
    size = np.array([0.2, 0.2, 0.15, 0.9, 0.8, 1.0])
    return se3_exp(size * np.sin(2 * np.pi * phases * times[:, None] + phases * 9))


def streams(seed, offset, noise=NOISE, seconds=20.0):
    """Robot at 100 Hz, camera at 15 Hz on a clock that is ahead by ``offset``."""
    rng = np.random.default_rng([seed, 77])
    x, z = random_poses(rng, 2, 0.1)
    robot_times = np.arange(0.0, seconds, 0.01)
    taken = np.arange(1.0, seconds - 1.0, 1 / 15) + 0.003
    b = se3_inverse(z) @ motion(taken) @ x
    # The camera stands a metre off, so that there is a line of sight.
    x_camera = np.eye(4)
    x_camera[2, 3] = 1.0
    b, z = x_camera @ b, z @ se3_inverse(x_camera)
    robot, _ = noisy(
        rng, motion(robot_times), np.tile(b[:1], (len(robot_times), 1, 1)), noise
    )
    _, observed = noisy(rng, b, b, noise)
    return robot_times, robot, taken + offset, observed, x, z


def test_interpolation_meets_the_samples_and_its_velocity_is_the_derivative():
    times = np.array([0.0, 0.5, 1.5])
    track = RobotTrack(times, motion(times))
    np.testing.assert_allclose(track.at(times)[0], motion(times), atol=1e-12)
    between = np.array([0.1, 0.7, 1.3])
    poses, rates = track.at(between)
    h = 1e-6
    later, earlier = track.at(between + h)[0], track.at(between - h)[0]
    numeric = se3_log(se3_inverse(earlier) @ later) / (2 * h)
    np.testing.assert_allclose(rates, numeric, atol=1e-8)
    np.testing.assert_array_equal(
        track.covers(np.array([-0.1, 0.0, 1.5, 1.6])), [0, 1, 1, 0]
    )
    assert poses.shape == (3, 4, 4)


@pytest.mark.parametrize("offset", [-0.35, 0.0, 0.0127, 4.0])
def test_correlation_finds_the_offset(offset):
    robot_times, robot, times, observed, _, _ = streams(0, offset)
    found, peak = correlate_clocks(robot_times, robot, times, observed)
    assert found == pytest.approx(offset, abs=0.01)
    assert peak > 0.9


def test_offset_is_refined_with_the_motions_and_its_sigma_holds():
    errors, coarse = [], []
    for seed in range(5):
        offset = 0.05 * seed - 0.1
        robot_times, robot, times, observed, x, _ = streams(seed, offset)
        coarse.append(correlate_clocks(robot_times, robot, times, observed)[0] - offset)
        found = solve_pose_pairs(
            pairs_of(
                robot,
                observed,
                "eye_to_hand",
                robot_times=robot_times,
                observed_times=times,
            )
        )
        error = found.clock_offset - offset
        errors.append(error / found.covariance.std("clock_offset"))
        assert abs(error) < 5e-4
        assert np.linalg.norm(found.x.translation - x[:3, 3]) < 5e-4
    assert np.sqrt(np.mean(np.square(errors))) < 2.5
    assert np.abs(coarse).max() < 0.02


def test_what_the_robot_never_recorded_is_left_out():
    robot_times, robot, times, observed, _, _ = streams(1, 0.1)
    kept = robot_times < 12.0
    found = solve_pose_pairs(
        pairs_of(
            robot[kept],
            observed,
            "eye_to_hand",
            robot_times=robot_times[kept],
            observed_times=times,
        )
    )
    assert len(found.poses) == pytest.approx(11 * 15, abs=3)
    assert found.clock_offset == pytest.approx(0.1, abs=1e-3)


def test_streams_that_do_not_turn_alike_are_refused():
    rng = np.random.default_rng(3)
    times = np.arange(0.0, 30.0, 0.05)
    still = np.tile(np.eye(4), (len(times), 1, 1))
    with pytest.raises(DegenerateMotionError, match="do not tell the clocks' offset"):
        correlate_clocks(times, still, times, motion(times))
    walk = se3_exp(np.cumsum(0.02 * rng.standard_normal((len(times), 6)), axis=0))
    with pytest.raises(DegenerateMotionError, match="best correlation 0"):
        correlate_clocks(times, walk, times, motion(times))


def test_too_little_overlap_is_named():
    robot_times, robot, times, observed, _, _ = streams(2, 0.0)
    few = pairs_of(
        robot[:150],
        observed[:2],
        "eye_to_hand",
        robot_times=robot_times[:150],
        observed_times=times[:2],
    )
    with pytest.raises(InputError, match="at least 3"):
        solve_pose_pairs(few)
