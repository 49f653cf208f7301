"""Bare pose pairs: directions by name, counts, times, noise."""

import numpy as np
import pytest

from handeye_tri.errors import InputError
from handeye_tri.records import PoseNoise, PosePairs
from handeye_tri.se3 import se3_exp, se3_inverse

RNG = np.random.default_rng(0)
ROBOT, OBSERVED = se3_exp(RNG.standard_normal((2, 4, 6)))
STATED = ("eye_in_hand", "flange_in_base", "target_in_camera")


def test_directions_are_turned_by_name():
    same = PosePairs(ROBOT, OBSERVED, *STATED)
    np.testing.assert_array_equal(same.base_from_flange, ROBOT)
    np.testing.assert_array_equal(same.camera_from_target, OBSERVED)
    other = PosePairs(
        ROBOT, OBSERVED, "eye_to_hand", "base_in_flange", "camera_in_target"
    )
    np.testing.assert_allclose(other.base_from_flange, se3_inverse(ROBOT))
    np.testing.assert_allclose(other.camera_from_target, se3_inverse(OBSERVED))
    assert same.unknowns == ("flange_from_camera", "base_from_target")
    assert other.unknowns == ("flange_from_target", "base_from_camera")
    assert same.names == ("0", "1", "2", "3")


def test_arrays_are_copied_and_locked():
    robot = np.array(ROBOT)
    pairs = PosePairs(robot, OBSERVED, *STATED)
    robot[0] = 0
    assert pairs.robot[0, 3, 3] == 1
    with pytest.raises(ValueError, match="read-only"):
        pairs.observed[0, 0, 0] = 2


@pytest.mark.parametrize(
    ("arguments", "keywords", "message"),
    [
        ((ROBOT, OBSERVED, "on_hand", *STATED[1:]), {}, "mounting must be one of"),
        ((ROBOT, OBSERVED, STATED[0], "tool", STATED[2]), {}, "robot_direction must"),
        ((ROBOT, OBSERVED, *STATED[:2], "tag"), {}, "observed_direction must"),
        ((ROBOT[:3], OBSERVED, *STATED), {}, "3 robot poses and 4 observed.*times"),
        ((ROBOT[0], OBSERVED, *STATED), {}, "robot must have shape"),
        (
            (ROBOT, OBSERVED, *STATED),
            {"names": ("a",)},
            "4 observed poses need as many",
        ),
        (
            (ROBOT, OBSERVED, *STATED),
            {"names": ("a", "b", "c", "b")},
            "names must differ, and 'b' is that of observed poses 1 and 3",
        ),
        (
            (ROBOT, OBSERVED, *STATED),
            {"robot_times": [0, 1, 2, 3]},
            "robot's are there, the camera's absent",
        ),
        (
            (ROBOT, OBSERVED, *STATED),
            {"robot_times": [0, 1, 1, 2], "observed_times": [0, 1, 2, 3]},
            r"robot_times must increase, but robot_times\[2\] = 1.0+ s follows 1.0",
        ),
        (
            (ROBOT, OBSERVED, *STATED),
            {"robot_times": [0, 1, 2, 3], "observed_times": [0, 1, np.nan, 3]},
            "observed_times must be finite",
        ),
    ],
)
def test_what_does_not_fit_is_named(arguments, keywords, message):
    with pytest.raises(InputError, match=message):
        PosePairs(*arguments, **keywords)


def test_streams_may_differ_in_length():
    pairs = PosePairs(
        ROBOT,
        OBSERVED[:2],
        *STATED,
        robot_times=[0, 1, 2, 3],
        observed_times=[5, 6],
    )
    assert pairs.timed
    assert len(pairs.names) == 2


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((-1, 0, 1, 1, 1), "robot_translation must not be negative"),
        ((np.nan, 0, 1, 1, 1), "robot_translation"),
        ((0, 0, 1, 0, 1), "lateral and depth must be above 0"),
        ((1, 0, 1, 1, 0), "both are 0"),
    ],
)
def test_noise_must_be_somewhere_in_every_direction(values, message):
    with pytest.raises(InputError, match=message):
        PoseNoise(*values)
