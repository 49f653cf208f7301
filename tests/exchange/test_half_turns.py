"""Half-turns found in poses: which, which not, and why."""

from __future__ import annotations

import numpy as np
import pytest

from handeye_tri.exchange.half_turns import (
    TurnTolerance,
    find_half_turns,
    parse_stations,
    turn_between,
)
from handeye_tri.se3 import SE3, hat, se3_exp, so3_exp

TOLERANCE = TurnTolerance(float(np.radians(1)), 1e-3)
AXIS = np.array([0.6, -0.48, 0.64])
FOOT = np.array([0.02, 0.03, 0.00375])


def about(axis, through, angle=np.pi, pitch=0.0):
    """Motion of the flange in its own frame: a turn about a line, and a shift."""
    rotation = so3_exp(angle * axis)
    shift = through - rotation @ through + pitch * axis
    return SE3.from_parts(rotation, shift).matrix


def programme(rng, turns, noise=0.0):
    """Pairs of stations: each turn from a pose of its own."""
    poses = []
    for turn in turns:
        start = se3_exp(rng.uniform(-0.8, 0.8, 6))
        poses += [start, start @ turn @ se3_exp(noise * rng.standard_normal(6))]
    return np.array(poses)


def pairs(found):
    return [(turn.before, turn.after) for turn in found.turns]


def test_the_foot_is_square_to_the_axis_of_the_fixture():
    assert pytest.approx(0, abs=1e-12) == AXIS @ FOOT
    assert np.linalg.norm(AXIS) == pytest.approx(1)


def test_a_turn_is_measured_as_it_was_made():
    rng = np.random.default_rng(1)
    poses = programme(rng, [about(AXIS, FOOT, np.pi - 0.002, 4e-4)])
    turn = turn_between(poses, 0, 1)
    sign = np.sign(turn.axis @ AXIS)
    assert turn.miss == pytest.approx(0.002, abs=1e-9)
    np.testing.assert_allclose(sign * turn.axis, AXIS, atol=1e-9)
    np.testing.assert_allclose(turn.foot, FOOT, atol=1e-9)
    assert sign * turn.pitch == pytest.approx(4e-4, abs=1e-9)


def test_every_pair_is_found_with_the_rigs_axis_whatever_the_noise():
    rng = np.random.default_rng(2)
    poses = programme(rng, [about(AXIS, FOOT)] * 8, noise=1e-4)
    found = find_half_turns(poses, TOLERANCE)
    assert pairs(found) == [(2 * k, 2 * k + 1) for k in range(8)]
    assert found.others == ()
    assert abs(found.axis @ AXIS) > np.cos(3e-4)
    assert np.linalg.norm(found.foot - FOOT) < 3e-4


def test_turns_that_are_none_of_the_rig_are_named_with_the_reason():
    rng = np.random.default_rng(3)
    other = np.cross(AXIS, [0, 0, 1.0])
    other /= np.linalg.norm(other)
    beside = FOOT + 5e-3 * other
    good = about(AXIS, FOOT)
    poses = programme(
        rng,
        [
            *(good, about(other, FOOT), good, about(AXIS, FOOT, pitch=2e-3)),
            *(good, about(AXIS, beside), about(AXIS, FOOT, np.radians(170))),
        ],
    )
    found = find_half_turns(poses, TOLERANCE)
    assert pairs(found) == [(0, 1), (4, 5), (8, 9)]
    reasons = "\n".join(found.others)
    assert "2-3: its axis is 90.0 deg off the others' in the flange" in reasons
    assert "6-7: the flange moved" in reasons
    assert "2.00 mm along the axis" in reasons
    assert "10-11: its axis is 5.00 mm beside the others' in the flange" in reasons
    # Ten degrees short is no half-turn at all.
    assert "12-13" not in reasons


def test_a_station_belongs_to_one_half_turn():
    start = se3_exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    turn = about(AXIS, FOOT)
    poses = np.array([start, start @ turn, start @ turn @ turn])
    found = find_half_turns(poses, TOLERANCE)
    assert pairs(found) == [(0, 1)]
    assert found.others == ("1-2: station 1 already belongs to 0-1",)


@pytest.mark.parametrize("seed", range(5))
def test_the_stations_of_a_half_turn_may_lie_anywhere(seed):
    rng = np.random.default_rng([5, seed])
    poses = programme(rng, [about(AXIS, FOOT)] * 11, noise=1e-4)
    poses = np.concatenate([poses, se3_exp(rng.uniform(-0.8, 0.8, (6, 6)))])
    order = rng.permutation(len(poses))
    at = np.argsort(order)
    expected = sorted(sorted((int(at[2 * k]), int(at[2 * k + 1]))) for k in range(11))
    found = find_half_turns(poses[order], TOLERANCE)
    assert [list(pair) for pair in pairs(found)] == expected
    assert abs(found.axis @ AXIS) > np.cos(3e-4)


def test_of_several_partners_the_nearest_in_order_is_taken():
    start = se3_exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    turn = about(AXIS, FOOT)
    elsewhere = se3_exp([0.3, -0.2, 0.1, -0.5, 0.2, 0.1])
    poses = [start, start @ turn, elsewhere, start, start @ turn]
    assert pairs(find_half_turns(np.array(poses), TOLERANCE)) == [(0, 1), (3, 4)]
    poses = [start, elsewhere, start @ turn, elsewhere @ turn]
    assert pairs(find_half_turns(np.array(poses), TOLERANCE)) == [(0, 2), (1, 3)]


def test_many_stations_take_little_time():
    rng = np.random.default_rng(6)
    poses = programme(rng, [about(AXIS, FOOT)] * 500, noise=1e-4)
    assert len(find_half_turns(poses, TOLERANCE).turns) == 500


def test_without_any_there_are_none():
    rng = np.random.default_rng(4)
    poses = se3_exp(rng.uniform(-0.5, 0.5, (9, 6)))
    assert pairs(find_half_turns(poses, TOLERANCE)) == []
    assert pairs(find_half_turns(poses[:1], TOLERANCE)) == []
    moved = programme(rng, [about(AXIS, FOOT, pitch=0.1)] * 3)
    found = find_half_turns(moved, TOLERANCE)
    assert pairs(found) == []
    assert len(found.others) == 3


def test_the_pitch_has_no_part_in_the_foot():
    """hat(axis) squared is -2 (I - R) / 4 of a half-turn: the pseudo-inverse is I/2."""
    rotation = so3_exp(np.pi * AXIS)
    np.testing.assert_allclose(
        np.eye(3) - rotation, -2 * hat(AXIS) @ hat(AXIS), atol=1e-12
    )


def test_stations_are_read_as_they_are_written():
    assert parse_stations("12-14, 3", 20, "--held-out") == [3, 12, 13, 14]
    assert parse_stations("none", 20, "--held-out") == []
