"""A session with a tool change: each cause by name, with its mount."""

from dataclasses import replace

import numpy as np
import pytest
from two_mount_cell import FREE, calibrated, free_covariance, geometry, observed
from wrong_sessions import at_poses, moved, with_views

from handeye_tri.adjustment import joint_offsets
from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.diagnose import (
    Evidence,
    free_scale,
    session_causes,
    why_uncalibrated,
)
from handeye_tri.errors import HandEyeError
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.se3 import SE3, se3_exp
from handeye_tri.triangle import TriangleRig

# The programme: six half-turns and three held-out stations with each mount.
CHANGE = 15


def told(session, true, **evidence):
    """What is wrong, of a cell that is known well."""
    calibration = calibrated(true, free_covariance(), np.zeros(FREE))
    return session_causes(Evidence(session, calibration, **evidence))


def recorded(session, mounts):
    """The session as if those mounts had been stated, and so the half-turns' axes."""
    return replace(
        session,
        stations=tuple(
            replace(station, mount=int(mount))
            for station, mount in zip(session.stations, mounts, strict=True)
        ),
        half_turns=tuple(
            replace(turn, axis=("normal", "BC")[mounts[turn.before]])
            for turn in session.half_turns
        ),
    )


def changed_before(session, station):
    return recorded(session, (np.arange(len(session.stations)) >= station).astype(int))


@pytest.mark.parametrize("seed", range(5))
def test_a_tool_change_is_not_a_slipped_rig(seed):
    true = geometry(seed)
    assert told(observed(true, seed), true) == ()


@pytest.mark.parametrize(
    ("station", "name"),
    [(7, "mount 1 (about a normal)"), (20, "mount 2 (about its edge BC)")],
)
def test_a_rig_that_slips_is_named_with_its_mount(station, name):
    true = geometry(2)
    slip = moved(0.8, 0.5, seed=4)
    slipped = replace(
        true,
        flange_from_triangle=true.flange_from_triangle @ slip,
        other_mounts=(true.other_mounts[0] @ slip,),
    )
    mine = slice(station, CHANGE if station < CHANGE else None)
    session = with_views(observed(true, 2), observed(slipped, 2), np.s_[:, mine])
    (finding,) = told(session, true)
    assert (finding.code, finding.stations) == ("RIG_SLIPPED", (station,))
    assert finding.cause == f"the rig moved on {name} in the middle of the session"


@pytest.mark.parametrize("station", [CHANGE - 1, CHANGE])
def test_a_single_station_beside_the_tool_change_is_no_slip(station):
    true = geometry(2)
    session = observed(true, 2)
    stations = list(session.stations)
    pose = stations[station].base_from_flange @ moved(2.0, 0.3, seed=6)
    stations[station] = replace(stations[station], base_from_flange=pose)
    (finding,) = told(replace(session, stations=tuple(stations)), true)
    assert (finding.code, finding.stations) == ("POSE", (station,))


def test_a_camera_that_moved_in_the_tool_change_is_no_rig():
    true = geometry(2)
    places = list(true.base_from_camera)
    places[1] = places[1] @ moved(1.0, 0.1, seed=3)
    later = observed(replace(true, base_from_camera=tuple(places)), 2)
    session = with_views(observed(true, 2), later, np.s_[1, CHANGE:])
    (finding,) = told(session, true)
    assert (finding.code, finding.stations, finding.camera) == (
        "CAMERA_MOVED",
        (CHANGE,),
        "right",
    )


@pytest.mark.parametrize("k", [0, 1, 2])
def test_a_side_is_the_same_in_both_mounts(k):
    true = geometry(3)
    session = observed(true, 3)
    right = session.triangle
    values = [right.side_ab, right.side_ac, right.angle]
    values[k] *= 1.01
    (finding,) = told(replace(session, triangle=TriangleRig(*values)), true)
    assert finding.code == "SIDES"
    words = ("side AB", "side AC", "the angle at A")[k]
    assert finding.cause == f"{words} of the triangle was measured wrongly"


def test_a_marker_that_moved_in_the_tool_change_is_another_triangle():
    true = geometry(3)
    longer = replace(true, triangle=TriangleRig(0.1305, 0.12, true.triangle.angle))
    session = with_views(observed(true, 3), observed(longer, 3), np.s_[:, CHANGE:])
    (finding,) = told(session, true)
    assert finding.code == "SIDES"
    assert finding.cause == "the mounts do not hold the same triangle"
    assert finding.evidence.startswith("side AB is 130.0")
    assert "130.5" in finding.evidence
    assert "side AC" not in finding.evidence


@pytest.mark.parametrize("station", [12, 14, 16, 17, 19])
def test_a_tool_change_at_the_wrong_station_is_named_with_the_right_one(station):
    true = geometry(4)
    session = observed(true, 4)
    if station == 16:
        # It parts a half-turn, which nobody can state then.
        session = replace(
            session,
            half_turns=tuple(t for t in session.half_turns if t.before != CHANGE),
        )
    (finding,) = told(changed_before(session, station), true)
    assert finding.code == "MOUNT"
    assert finding.cause == (
        f"the tool was changed before station {CHANGE}, not before station {station} "
        "as recorded"
    )
    assert finding.stations == tuple(range(min(CHANGE, station), max(CHANGE, station)))
    assert f"--tool-change {CHANGE}" in finding.remedy


def test_a_single_station_with_another_mount_is_named():
    true = geometry(4)
    session = observed(true, 4)
    mounts = session.mounts
    mounts[28] = 0
    (finding,) = told(recorded(session, mounts), true)
    assert (finding.code, finding.stations) == ("MOUNT", (28,))
    assert finding.evidence.startswith(
        "mount 2 (about its edge BC) where mount 1 (about a normal) is recorded: "
        "station 28: "
    )


@pytest.mark.parametrize("station", [8, 19])
def test_mounts_that_turn_about_the_same_axis_are_told_by_robot_and_cameras(station):
    true = geometry(3, axes=("normal", "normal"))
    session = observed(true, 3)
    later = (np.arange(len(session.stations)) >= station).astype(int)
    stated = replace(
        session,
        stations=tuple(
            replace(one, mount=int(mount))
            for one, mount in zip(session.stations, later, strict=True)
        ),
    )
    with pytest.raises(HandEyeError):
        calibrate_hand_eye(stated, calibrate_session_cameras(stated))
    (finding,) = why_uncalibrated(stated, min_plane_spread=float(np.radians(20.0)))
    assert finding.code == "MOUNT"
    assert finding.cause == (
        f"the tool was changed before station {CHANGE}, not before station {station} "
        "as recorded"
    )
    assert "robot and cameras fit" in finding.evidence


def given_up(session):
    with pytest.raises(HandEyeError):
        calibrate_session_cameras(session)
    return why_uncalibrated(session, min_plane_spread=float(np.radians(20.0)))


def test_exchanged_mounts_are_named():
    session = observed(geometry(5), 5)
    finding = given_up(recorded(session, 1 - session.mounts))[0]
    assert finding.code == "MOUNT"
    assert finding.cause == "the mounts were exchanged"
    assert "stations 0 and 1 about a normal" in finding.evidence
    assert "exchange rig and second_mount" in finding.remedy


def test_a_tool_change_that_spoils_the_cameras_is_named():
    (finding,) = given_up(changed_before(observed(geometry(5), 5), 4))
    assert finding.code == "MOUNT"
    assert finding.stations == tuple(range(4, CHANGE))
    assert "stations 4 and 5 about a normal" in finding.evidence
    assert "stations 12, 13, 14: " in finding.evidence


def test_an_offset_joint_is_named_through_a_tool_change():
    true = geometry(6)
    rng = np.random.default_rng(5)
    jacobian = rng.normal(size=(len(true.stations), 6, 4))
    jacobian[:, :3] *= 0.3
    offset = np.radians([0.0, 0.0, 0.12, 0.0])
    poses = np.array([s.base_from_flange.matrix for s in true.stations])
    there = at_poses(true, poses @ se3_exp(jacobian @ offset))
    session = replace(observed(there, 6), stations=true.stations)
    joints = joint_offsets(["swing", "lower", "upper", "wrist"], jacobian)
    (finding,) = told(session, true, joints=joints)
    assert finding.code == "JOINT_OFFSET"
    assert "upper.offset" in finding.evidence


def test_late_images_are_a_matter_of_clocks_whatever_the_way_to_the_tool_change():
    true = geometry(7)
    poses = np.array([s.base_from_flange.matrix for s in true.stations])
    ways = [
        (SE3(a).inverse() @ SE3(b)).log()
        for a, b in zip(poses[:-1], poses[1:], strict=True)
    ]
    ways[CHANGE - 1] = np.array([0.1, -0.2, 0.1, 0.4, 0.5, -0.8])
    there = at_poses(true, poses @ se3_exp(np.array([*ways, np.zeros(6)]) * 0.003))
    first, *others = told(replace(observed(there, 7), stations=true.stations), true)
    assert first.code == "CLOCK_OFFSET"
    assert {one.follows for one in others} <= {"CLOCK_OFFSET"}


@pytest.mark.parametrize("factor", [1.0, 1.01])
def test_robot_and_cameras_agree_on_the_metre_through_a_tool_change(factor):
    true = geometry(8)
    session = observed(true, 8)
    scaled = tuple(
        replace(
            station,
            base_from_flange=SE3.from_parts(
                station.base_from_flange.rotation,
                factor * station.base_from_flange.translation,
            ),
        )
        for station in session.stations
    )
    calibration = calibrated(true, free_covariance(), np.zeros(FREE))
    cameras = calibrate_session_cameras(session)
    scale, sigma = free_scale(replace(session, stations=scaled), cameras, calibration)
    assert sigma < 1e-3
    assert scale == pytest.approx(factor, abs=4 * sigma)


@pytest.mark.parametrize("mount", [0, 1])
def test_a_tool_that_was_never_changed_is_named(mount):
    """The other half of the programme is made with it as well."""
    true = geometry(5, axes=2 * (("normal", "BC")[mount],))
    session = observed(true, 5)
    stated = replace(
        session,
        half_turns=tuple(
            replace(turn, axis=("normal", "BC")[session.mounts[turn.before]])
            for turn in session.half_turns
        ),
    )
    found = why_uncalibrated(stated, min_plane_spread=float(np.radians(20.0)))[0]
    name = ("mount 1 (about a normal)", "mount 2 (about its edge BC)")[mount]
    assert found.code == "MOUNT"
    assert found.cause == f"the tool was not changed: always it was {name}"
    assert len(found.stations) == CHANGE
