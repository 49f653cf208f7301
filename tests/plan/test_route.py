from __future__ import annotations

from collections import Counter
from functools import cache
from itertools import pairwise

import mujoco
import numpy as np
import planning_scene as scene
import pytest

from handeye_tri.arm import Arm
from handeye_tri.plan import plan_motions, route
from handeye_tri.plan.paths import way_round
from handeye_tri.plan.route import RoutePlanner
from handeye_tri.plan.sequence import Stops
from handeye_tri.simulate.compile import compile_cell

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


def drive(arm, ends):
    rejected = Counter()
    planner = RoutePlanner(arm, 0.3, 1, rejected)
    times = planner.time(ends[:, None], ends[None])
    stops = Stops(np.arange(2), planner.time(ends[0], ends), times)
    return planner.drive(stops, ends[0], ends, ends), rejected


def test_a_route_passes_points_only_where_it_must():
    arm, ends = obstructed()
    found, rejected = drive(arm, ends)
    assert found.order == [0, 1]
    assert len(found.via[0]) == 0
    assert len(found.via[1]) >= 1
    assert rejected["path"] >= 1
    free = np.array([ends[0], ends[0] + 0.01])
    assert [len(via) for via in drive(arm, free)[0].via] == [0, 0]


def test_without_ompl_a_blocked_route_is_none(monkeypatch):
    monkeypatch.setattr(route, "can_go_round", lambda: False)
    found, rejected = drive(*obstructed())
    assert found is None
    assert rejected["path"] >= 1


@pytest.mark.parametrize("name", ["hp3_stereo", "hp3_stereo_edge"])
def test_no_contact_at_a_thousand_steps_a_second(name):
    """The whole programme from home, driven by trapezoids, in the other engine."""
    cell, plan, arm = scene.cell_of(name), scene.plan_of(name), scene.arm_of(name)
    model, _ = compile_cell(cell, scene.MODEL)
    data = mujoco.MjData(model)
    points = [arm.home]
    for station, via in zip(plan.stations, plan.via, strict=True):
        points += [*via, station.joints]
    planner = RoutePlanner(arm, cell.arm.acceleration_time_s, 0, Counter())
    contacts = steps = 0
    for start, end in pairwise(points):
        seconds = float(planner.time(start, end))
        for part in np.linspace(0, 1, max(2, int(1000 * seconds))):
            data.qpos[:] = start + part * (end - start)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            contacts += int(data.ncon > 0 and data.contact.dist.min() <= 0)
            steps += 1
    assert contacts == 0
    assert steps > 15_000


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
