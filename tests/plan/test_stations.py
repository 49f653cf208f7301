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


BOTH = "hp3_stereo_both"


def planned_with_both():
    """Joints and mounts of a plan's stations that calibrate, in the order driven."""
    used = [s for s in scene.plan_of(BOTH).stations if s.kind == "calibration"]
    return np.array([s.joints for s in used]), np.array([s.mount for s in used])


def certified_with_both(joints, mounts):
    return certify_stations(scene.cell_of(BOTH), scene.arms_of(BOTH), joints, mounts)


def test_stations_with_two_mounts_get_their_plans_certificate():
    plan = scene.plan_of(BOTH)
    joints, mounts = planned_with_both()
    again = certified_with_both(joints, mounts)
    assert again.outcome == "PASS", again.findings
    assert [s.mount for s in again.stations] == mounts.tolist()
    assert len(again.half_turns) == len(plan.half_turns)
    assert {t.axis for t in again.half_turns} == {"normal", "BC"}
    for name, value in again.certificate.items():
        if name != "cycle_time_s":
            assert value == pytest.approx(plan.certificate[name], rel=1e-6), name
    change = again.tool_change
    assert change.before == np.flatnonzero(mounts)[0]
    np.testing.assert_array_equal(change.joints, plan.tool_change.joints)
    # On the way home and back from it, beside all other moves.
    assert again.certificate["cycle_time_s"] > 0.6 * plan.certificate["cycle_time_s"]


def test_half_turns_are_made_with_one_mount():
    """The same places: one station of every pair with the other mount."""
    joints, _ = planned_with_both()
    pair = joints[[0, 0]]
    pair[1, 5] += np.pi if pair[0, 5] < 0 else -np.pi
    assert pairs(certified_with_both(pair, [0, 0])) == [(0, 1)]
    assert pairs(certified_with_both(pair, [0, 1])) == []


def test_stations_without_one_mount_cannot_tell_of_it():
    joints, mounts = planned_with_both()
    plan = certified_with_both(joints[mounts == 0], mounts[mounts == 0])
    assert plan.outcome == "CANNOT TELL"
    assert "no station has mount 2 (about its edge BC)" in "\n".join(plan.findings)
    assert plan.tool_change is None


def test_the_way_home_to_the_tool_change_is_looked_at(monkeypatch):
    """A post beside the first mount's last station, between it and home."""
    joints, mounts = planned_with_both()
    arms = scene.arms_of(BOTH)
    free = arms[0].path_collision

    def blocked(start, end):
        return (
            ("post", "rig") if np.array_equal(end, arms[0].home) else free(start, end)
        )

    monkeypatch.setattr(arms[0], "path_collision", blocked)
    monkeypatch.setattr("handeye_tri.plan.route.can_go_round", lambda: False)
    plan = certified_with_both(joints, mounts)
    last = np.flatnonzero(mounts)[0] - 1
    assert plan.outcome == "FAIL"
    message = f"from station {last} home for the tool change: post touches rig"
    assert message in plan.findings


@pytest.mark.parametrize(
    ("mounts", "message"),
    [
        (None, "mounts must say which of the 2 mounts"),
        ([0, 1], r"mounts must be 4 whole numbers, one by station, got shape \(2,\)"),
        ([0, 0, 0.5, 1], "got shape .* of float64"),
        ([0, 0, 1, 2], "mounts must be from 0 to 1 in cell 'hp3_stereo_both', got 2"),
        ([0, 1, 1, 0], "the mount changes before stations 1, 3, but a programme"),
    ],
)
def test_wrong_mounts_are_refused(mounts, message):
    with pytest.raises(InputError, match=message):
        certified_with_both(np.zeros((4, 6)), mounts)


@pytest.mark.parametrize(
    ("name", "whose"), [(NAME, ""), (BOTH, "of mount 1 \\(about a normal\\) ")]
)
def test_a_box_that_no_camera_sees_is_named(name, whose):
    cameras = scene.cell_of(name).model_dump()["cameras"]
    away = [{**camera, "look_at_m": (3.0, 0.0, 0.4)} for camera in cameras]
    cell = scene.changed(name, cameras=away)
    mounts = [0] * 4
    message = f"workspace box none shows the triangle {whose}to 2 cameras; turn the cam"
    with pytest.raises(InputError, match=message):
        certify_stations(cell, scene.arms_of(name), np.zeros((4, 6)), mounts)
