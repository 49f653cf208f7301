from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from ruamel.yaml import YAML

from handeye_tri.errors import InputError
from handeye_tri.exchange.robot_programme import (
    Programme,
    ToolChange,
    joint_trajectory_yaml,
    programme_json,
    urscript,
)

RNG = np.random.default_rng(0)
SPEED = np.array([3.5, 2.6, 3.3, 5.2, 5.2, 7.3])
RAMP = 0.3
PROGRAMME = Programme(
    head=("made by a test",),
    joint_names=tuple("slurbt"),
    slides=np.zeros(6, dtype=bool),
    home=np.zeros(6),
    stops=RNG.uniform(-1.5, 1.5, (5, 6)),
    kinds=("calibration",) * 4 + ("evaluation",),
    via=[RNG.uniform(-1, 1, (k, 6)) for k in (0, 2, 0, 0, 1)],
    speed=SPEED,
    acceleration_time=RAMP,
    dwell=0.5,
)


def way():
    """All points driven through, stops and points between, shape (n, 6)."""
    parts = [PROGRAMME.home[None]]
    for via, stop in zip(PROGRAMME.via, PROGRAMME.stops, strict=True):
        parts += [via, stop[None]]
    return np.concatenate(parts)


def test_json_holds_every_joint_exactly():
    data = json.loads(programme_json(PROGRAMME))
    assert data["joint_names"] == list("slurbt")
    assert data["joint_units"] == ["rad"] * 6
    joints = [data["home"]]
    for station in data["stations"]:
        joints += [*station["via"], station["joints"]]
    np.testing.assert_array_equal(np.array(joints), way())
    assert [s["kind"] for s in data["stations"]] == list(PROGRAMME.kinds)


def test_joint_trajectory_stays_within_speed_and_acceleration():
    data = YAML(typ="safe").load(joint_trajectory_yaml(PROGRAMME))
    assert data["joint_names"] == list("slurbt")
    points = np.array([p["positions"] for p in data["points"]])
    assert not np.any([p["velocities"] for p in data["points"]])
    times = np.array(
        [
            p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"]
            for p in data["points"]
        ]
    )
    span = np.diff(times)
    assert (span > 0).all()
    moving = np.abs(np.diff(points, axis=0)).max(axis=1) > 0
    np.testing.assert_array_equal(points[np.r_[True, moving]], way())
    assert (~moving).sum() == len(PROGRAMME.stops)
    np.testing.assert_allclose(span[~moving], 0.5, atol=1e-8)
    # The cubic between points at rest, sampled: speed and acceleration by joint.
    s = np.linspace(0, 1, 201)
    rate, bend = 6 * s * (1 - s), 6 - 12 * s
    most = np.zeros((2, 6))
    for start, end, seconds in zip(points[:-1], points[1:], span, strict=True):
        travel = np.abs(end - start)[:, None]
        speeds = (travel * rate / seconds).max(axis=1) / SPEED
        bends = (travel * np.abs(bend) / seconds**2).max(axis=1) / (SPEED / RAMP)
        assert max(speeds.max(), bends.max()) <= 1 + 1e-6
        most = np.maximum(most, [speeds, bends])
    # And no slower than needed: some joint is at its limit.
    assert most.max() > 0.999


def test_urscript_moves_no_joint_beyond_its_limits_and_stops_at_stations():
    text = urscript(PROGRAMME)
    pattern = r"movej\(\[(.*?)\], a=(\S+), v=([^,)]+)(, r=0.01)?\)"
    moves = re.findall(pattern, text)
    joints = np.array([[float(v) for v in m[0].split(",")] for m in moves])
    # First to where the programme starts, from wherever the robot is.
    np.testing.assert_allclose(joints, way(), atol=1e-9)
    for start, move, end in zip(joints[:-1], moves[1:], joints[1:], strict=True):
        travel = np.abs(end - start)
        share = travel / travel.max()
        assert (float(move[2]) * share <= SPEED * (1 + 1e-5)).all()
        assert (float(move[1]) * share <= SPEED / RAMP * (1 + 1e-5)).all()
    blended = sum(bool(m[3]) for m in moves)
    assert blended == sum(len(via) for via in PROGRAMME.via)
    assert text.count("sleep(0.5)") == len(PROGRAMME.stops)
    assert text.startswith("# made by a test\n")
    assert text.rstrip().endswith("end\ncalibration_programme()")


def test_urscript_is_for_six_hinges():
    slides = np.array([True] + [False] * 5)
    with pytest.raises(InputError, match="six hinges, got s, l, u, r, b, t"):
        urscript(replace(PROGRAMME, slides=slides))


@pytest.mark.parametrize("dwell", [-1.0, np.nan])
def test_dwell_must_be_a_time(dwell):
    with pytest.raises(InputError, match="dwell must be 0 s or longer"):
        replace(PROGRAMME, dwell=dwell)


CHANGE = ToolChange(
    before=3,
    joints=np.full(6, 0.25),
    via=RNG.uniform(-1, 1, (2, 6)),
    tools=("the first rig", "the other rig"),
    mount="the other rig (as described)",
)
CHANGED = replace(PROGRAMME, change=CHANGE)
STATED = "tool change: take off the first rig, put on the other rig (as described)"


def changed_way():
    """All points of the programme with a tool change, shape (n, 6)."""
    parts = [PROGRAMME.home[None]]
    for k, (via, stop) in enumerate(zip(PROGRAMME.via, PROGRAMME.stops, strict=True)):
        parts += [CHANGE.via, CHANGE.joints[None]] if k == 3 else []
        parts += [via, stop[None]]
    return np.concatenate(parts)


def test_json_states_the_tool_change_where_it_belongs():
    assert "tool_change" not in json.loads(programme_json(PROGRAMME))
    change = json.loads(programme_json(CHANGED))["tool_change"]
    assert change["before_station"] == 3
    assert change["joints"] == CHANGE.joints.tolist()
    assert change["via"] == CHANGE.via.tolist()
    assert (change["take_off"], change["mount"]) == (CHANGE.tools[0], CHANGE.mount)


def test_a_trajectory_ends_at_the_tool_change_and_another_begins_there():
    text = joint_trajectory_yaml(CHANGED)
    assert f"---\n# {STATED}; then send this second message.\n" in text
    first, second = YAML(typ="safe").load_all(text)
    rows = [
        [p["positions"] for p in data["points"]]
        for data in (first, second)
        if data["joint_names"] == list("slurbt")
    ]
    assert rows[0][-1] == rows[1][0] == CHANGE.joints.tolist()
    points = np.array([*rows[0], *rows[1]])
    moving = np.abs(np.diff(points, axis=0)).max(axis=1) > 0
    np.testing.assert_array_equal(points[np.r_[True, moving]], changed_way())
    start = second["points"][0]["time_from_start"]
    assert (start["sec"], start["nanosec"]) == (0, 0)


def test_urscript_waits_for_a_person_at_the_tool_change():
    text = urscript(CHANGED)
    moves = re.findall(r"movej\(\[(.*?)\]", text)
    joints = np.array([[float(v) for v in m.split(",")] for m in moves])
    np.testing.assert_allclose(joints, changed_way(), atol=1e-9)
    before, after = text.split(
        f'  popup("{STATED}", title="Tool change", warning=True, blocking=True)\n'
    )
    assert before.count("sleep(") == 3
    assert 'textmsg("station ", "2 of the first rig")' in before
    assert 'textmsg("station ", "0 of the other rig")' in after


def test_a_tool_may_be_changed_before_the_first_station():
    """The robot comes with the other tool, and goes where it waits first."""
    begin = replace(PROGRAMME, change=replace(CHANGE, before=0))
    way = begin.way_to_change(0)
    np.testing.assert_array_equal(way[[0, -1]], [begin.home, CHANGE.joints])
    np.testing.assert_array_equal(begin.leg(0)[0], CHANGE.joints)
    assert "after 0 of 5 stations" in begin.change.of_programme(5)


def test_mounts_are_counted_from_one():
    data = json.loads(programme_json(replace(CHANGED, mounts=(0, 0, 0, 1, 1))))
    assert [station["mount"] for station in data["stations"]] == [1, 1, 1, 2, 2]
    assert "mount" not in json.loads(programme_json(CHANGED))["stations"][0]
