from __future__ import annotations

from collections import Counter
from functools import cache
from itertools import pairwise

import numpy as np
import planning_scene as scene
import pytest
from replayed import contacts, driven

from handeye_tri.arm import Arm
from handeye_tri.plan import plan_motions, route
from handeye_tri.plan.paths import way_round
from handeye_tri.plan.route import Route, RoutePlanner
from handeye_tri.records import Plan, Station
from handeye_tri.se3 import SE3

POST = {"name": "post", "size_mm": (60, 60, 900), "position_m": (0.42, 0.0, 0.45)}


@cache
def obstructed():
    """The arm beside a post, and two places on either side of it."""
    arm = Arm(scene.compiled(scene.changed("hp3_stereo", surroundings=[POST])))
    ends = np.array([[0.5, 0.6, 0, 0, 0.3, 0], [-0.5, 0.6, 0, 0, 0.3, 0]])
    assert arm.collision(ends[0]) is None is arm.collision(ends[1])
    assert arm.path_collision(*ends) is not None
    return arm, ends


def test_a_way_leads_round_what_stands_between():
    arm, (start, end) = obstructed()
    via = way_round(arm, start, end, seed=3)
    assert via.shape[1:] == (6,)
    assert len(via) >= 1
    for a, b in pairwise([start, *via, end]):
        assert arm.path_collision(a, b) is None
    assert ((via >= arm.lower) & (via <= arm.upper)).all()
    np.testing.assert_array_equal(way_round(arm, start, end, seed=3), via)


def drive(arm, places, start, end=None):
    """The stations in order, the place in the way, or stations and the way back."""
    rejected = Counter()
    planner = RoutePlanner(arm, 0.3, 1, rejected, Counter())
    found = planner.drive(places, start, end)
    if isinstance(found, Route):
        found = found.stops if end is None else found
    return found, rejected


def single(joints):
    """A place of one station that is reached by one solution."""
    return [joints[None]]


def test_a_route_passes_points_only_where_it_must():
    arm, ends = obstructed()
    found, rejected = drive(arm, [single(q) for q in ends], ends[0])
    assert [stop.place for stop in found] == [0, 1]
    assert [len(stop.via) > 0 for stop in found] == [False, True]
    assert rejected["path"] >= 1
    near = [single(ends[0]), single(ends[0] + 0.01)]
    assert [len(stop.via) for stop in drive(arm, near, ends[0])[0]] == [0, 0]


def test_the_way_back_is_free_and_counts():
    """The station next to the end comes last, and the way back passes the post."""
    arm, ends = obstructed()
    places = [single(ends[0] + 0.02), single(ends[1]), single(ends[0] + 0.01)]
    found, _ = drive(arm, places, ends[0], ends[1])
    assert found.stops[-1].place == 1
    assert len(found.back) == 0
    found, _ = drive(arm, places, ends[0], ends[0])
    way = [found.stops[-1].joints, *found.back, ends[0]]
    for a, b in pairwise(way):
        assert arm.path_collision(a, b) is None
    assert len(found.back) + sum(len(stop.via) for stop in found.stops) > 0


def test_a_way_is_straight_where_it_can_be(monkeypatch):
    arm, (start, end) = obstructed()
    planner = RoutePlanner(arm, 0.3, 1, Counter(), Counter())
    assert planner.way(start, start + 0.01).shape == (0, 6)
    assert len(planner.way(start, end)) > 0
    monkeypatch.setattr(route, "can_go_round", lambda: False)
    assert planner.way(start, end) is None


def test_without_ompl_a_blocked_place_is_named(monkeypatch):
    monkeypatch.setattr(route, "can_go_round", lambda: False)
    arm, ends = obstructed()
    beside = ends[0] + 0.01
    found, rejected = drive(arm, [single(q) for q in (*ends, beside)], ends[0])
    assert found == 1
    assert rejected["path"] >= 1


def test_the_wrist_goes_out_on_one_side_of_half_turns_and_back_on_the_other():
    """Along a line: all stations before, one turn at its end, all stations after."""
    arm = scene.arm_of("hp3_stereo")
    place = np.array([0, 0.6, 0, 0, 0.3, -0.5])
    step, turn = np.eye(6)[0], np.pi * np.eye(6)[5]
    places = [
        [np.array([place + 0.1 * k * step, place + 0.1 * k * step + turn])]
        for k in (3, 1, 4, 0, 2)
    ]
    found, _ = drive(arm, places, places[3][0][0])
    assert [stop.step for stop in found] == [0] * 5 + [1] * 5
    assert [stop.place for stop in found] == [3, 1, 4, 0, 2, 2, 0, 4, 1, 3]


def test_a_whole_turn_of_the_last_joint_is_left_out():
    """The wrist would have to wind back; the same pose is a turn further on."""
    arm = scene.arm_of("hp3_stereo")
    start = np.array([0, 0.6, 0, 0, 0.3, np.radians(170)])
    there = start - np.radians([0, 0, 0, 0, 0, 340])
    found, _ = drive(arm, [single(there)], start)
    np.testing.assert_allclose(found[0].joints, start + np.radians([0] * 5 + [20]))
    np.testing.assert_allclose(
        arm.forward(found[0].joints), arm.forward(there), atol=1e-12
    )


def test_both_stations_of_a_half_turn_are_reached_by_the_same_solution():
    """Each station alone would be nearer by another solution."""
    arm = scene.arm_of("hp3_stereo")
    start = np.array([0, 0.6, 0, 0, 0.3, 0])
    far = start + np.eye(6)[0]
    place = [np.array([start, far]), np.array([far, start])]
    found, _ = drive(arm, [place], start)
    assert found[0].solution == found[1].solution


def test_a_move_keeps_speed_and_acceleration():
    """Each joint's limits, by differences; the slowest joint reaches both."""
    speed, ramp = np.array([2.0, 1.0]), 0.3
    for end in ([1.5, 0.4], [0.05, 0.3], [0.1, -0.1], [3.0, 2.0]):
        joints = driven(np.zeros(2), np.array(end), speed, ramp)[:-1]
        np.testing.assert_array_equal(joints[0], 0)
        velocity = np.abs(np.diff(joints, axis=0)).max(axis=0) / 1e-3
        force = np.abs(np.diff(joints, 2, axis=0)).max(axis=0) / 1e-6
        assert (velocity <= speed * (1 + 1e-9)).all()
        assert (force <= speed / ramp * (1 + 1e-6)).all()
        assert (force / (speed / ramp)).max() == pytest.approx(1)


@pytest.mark.parametrize("name", ["hp3_stereo", "hp3_stereo_edge"])
def test_no_contact_at_a_thousand_steps_a_second(name):
    """The whole programme from home, driven in the other engine."""
    cell, plan, arm = scene.cell_of(name), scene.plan_of(name), scene.arm_of(name)
    touching, steps = contacts(cell, scene.MODEL, arm, plan)
    assert touching == 0
    assert steps == pytest.approx(1e3 * plan.certificate["cycle_time_s"], rel=0.01)


def test_a_way_through_a_solid_is_contact():
    """What the count rests on: a straight way through the post is noticed."""
    cell = scene.changed("hp3_stereo", surroundings=[POST])
    arm, (start, end) = obstructed()
    stations = [
        Station(k, "calibration", q, SE3(arm.forward(q)))
        for k, q in enumerate([start, end])
    ]
    none = np.zeros((0, 6))
    plan = Plan(stations, (), {}, {}, 0, "PASS", (), (none, none))
    touching, steps = contacts(cell, scene.MODEL, arm, plan)
    assert 0.05 * steps < touching < steps


def test_a_post_in_the_cell_leaves_a_plan_with_free_ways():
    cell = scene.changed(
        "hp3_stereo", surroundings=[{**POST, "position_m": (0.30, -0.28, 0.45)}]
    )
    arm = Arm(scene.compiled(cell))
    plan = plan_motions(cell, arm, 1, half_turns=3)
    before = arm.home
    for station, via in zip(plan.stations, plan.via, strict=True):
        for a, b in pairwise([before, *via, station.joints]):
            assert arm.path_collision(a, b) is None
        before = station.joints
