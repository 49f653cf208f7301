from __future__ import annotations

import numpy as np
import planning_scene as scene
import pytest

from handeye_tri.errors import InputError
from handeye_tri.plan import certify_stations

NAME = "hp3_stereo"


def planned():
    """Joints, half-turn by half-turn."""
    joints, _, turns = scene.calibration_of(scene.plan_of(NAME))
    return joints[turns.ravel()]


def pairs(plan):
    return [(turn.before, turn.after) for turn in plan.half_turns]


def certified(joints):
    return certify_stations(scene.cell_of(NAME), scene.arm_of(NAME), joints)


def test_a_plans_own_stations_get_its_own_certificate():
    plan = scene.plan_of(NAME)
    joints, _, turns = scene.calibration_of(plan)
    again = certified(joints)
    assert again.outcome == plan.outcome == "PASS"
    assert again.findings == ()
    # Half-turns are found whatever lies between their stations.
    assert (np.diff(turns, axis=1) > 1).any()
    assert pairs(again) == [tuple(turn) for turn in turns]
    for name, value in again.certificate.items():
        if name != "cycle_time_s":
            assert value == pytest.approx(plan.certificate[name], rel=1e-6), name


def test_half_turns_survive_rounding_to_a_hundredth_of_a_degree():
    rounded = np.radians(np.round(np.degrees(planned()), 2))
    assert pairs(certified(rounded)) == [(2 * k, 2 * k + 1) for k in range(11)]


def test_stations_in_a_row_pair_up_once():
    """Three half-turns of one place: stations 0 and 1 pair, 2 waits for none."""
    first, second = planned()[:2]
    plan = certified([first, second, first, planned()[4]])
    assert pairs(plan) == [(0, 1)]


def test_what_forbids_a_station_is_named():
    joints = planned()
    joints[3, 5] = np.radians(400)
    joints[6] = scene.arm_of(NAME).home
    plan = certified(joints)
    assert plan.outcome == "FAIL"
    text = "\n".join(plan.findings)
    assert "station 3: joint t at 6.981 leaves its limits" in text
    assert "station 6: all markers are in the images of fewer than 2 cameras" in text


def test_too_few_stations_say_what_to_add():
    plan = certified(planned()[:2])
    assert plan.outcome == "CANNOT TELL"
    assert "1 half-turn: at least 2" in "\n".join(plan.findings)
    assert plan.findings[-1].startswith("Do: add a half-turn")


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (np.zeros((4, 5)), r"shape \(n, 6\).*got \(4, 5\)"),
        (np.zeros((1, 6)), "n at least 2"),
        (np.full((3, 6), np.nan), r"joints\[0, 0\] \(s\) is not finite"),
    ],
)
def test_wrong_shapes_are_refused(joints, message):
    with pytest.raises(InputError, match=message):
        certified(joints)
