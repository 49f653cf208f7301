"""Each cause is named, with its size and its place, and nothing else is."""

import re
from dataclasses import replace

import numpy as np
import pytest
from wrong_sessions import at_poses, geometry, moved, observed, told, with_views

from handeye_tri.adjustment import joint_offsets
from handeye_tri.diagnose import with_causes
from handeye_tri.diagnose.gates import Finding, Verdict, prediction_gate
from handeye_tri.se3 import SE3, se3_exp
from handeye_tri.triangle import TriangleRig


def codes(findings):
    return [one.code for one in findings]


def first_number(text):
    return float(re.search(r"[-+]?\d+\.\d+", text)[0])


@pytest.mark.parametrize("seed", range(8))
def test_a_healthy_session_is_not_accused(seed):
    assert told(observed(seed)) == ()


@pytest.mark.parametrize("noise", [3.0, 10.0])
def test_noise_that_is_larger_than_stated_accuses_nobody(noise):
    session = observed(1)
    less = session.repeatability
    stated = replace(
        less, translation=less.translation / noise, rotation=less.rotation / noise
    )
    assert told(replace(session, repeatability=stated)) == ()


@pytest.mark.parametrize(("i", "station"), [(0, 7), (1, 16)])
def test_a_camera_that_moved_is_named_with_the_size_of_its_step(i, station):
    cell = geometry(1)
    places = list(cell.base_from_camera)
    places[i] = places[i] @ moved(1.0, 0.1, seed=3)
    later = observed(1, replace(cell, base_from_camera=tuple(places)))
    session = with_views(observed(1), later, np.s_[i, station:])
    (finding,) = told(session)
    assert finding.code == "CAMERA_MOVED"
    assert finding.camera == session.cameras[i].name
    assert finding.stations == (station,)
    assert finding.severity == "error"
    assert first_number(finding.evidence) == pytest.approx(1.0, abs=0.2)
    assert f"between stations {station - 1} and {station}" in finding.evidence


def test_a_rig_that_slipped_is_no_moved_camera():
    cell = geometry(2)
    slipped = replace(
        cell, flange_from_triangle=cell.flange_from_triangle @ moved(0.8, 0.5, seed=4)
    )
    session = with_views(observed(2), observed(2, slipped), np.s_[:, 11:])
    (finding,) = told(session)
    assert (finding.code, finding.stations, finding.camera) == (
        "RIG_SLIPPED",
        (11,),
        "",
    )


def test_an_offset_joint_is_named_with_its_angle():
    cell = geometry(3)
    # Joints that turn the flange about its own axes, by more or less at each station.
    rng = np.random.default_rng(5)
    jacobian = rng.normal(size=(len(cell.stations), 6, 4))
    jacobian[:, :3] *= 0.3
    offset = np.radians([0.0, 0.0, 0.12, 0.0])
    reported = np.array([s.base_from_flange.matrix for s in cell.stations])
    true = at_poses(cell, reported @ se3_exp(jacobian @ offset))
    session = replace(observed(3, true), stations=cell.stations)
    joints = joint_offsets(["swing", "lower", "upper", "wrist"], jacobian)
    (finding,) = told(session, joints=joints)
    assert finding.code == "JOINT_OFFSET"
    assert "upper.offset" in finding.evidence
    assert first_number(finding.evidence) == pytest.approx(0.12, abs=0.01)


def test_images_taken_on_the_way_are_a_matter_of_clocks():
    cell = geometry(4)
    reported = np.array([s.base_from_flange.matrix for s in cell.stations])
    ways = [
        SE3(a).inverse() @ SE3(b)
        for a, b in zip(reported[:-1], reported[1:], strict=True)
    ]
    steps = np.array([0.003 * way.log() for way in ways] + [np.zeros(6)])
    session = observed(4, at_poses(cell, reported @ se3_exp(steps)))
    (finding,) = told(replace(session, stations=cell.stations))
    assert finding.code == "CLOCK_OFFSET"
    assert "had left for the next station" in finding.cause


def test_a_turn_that_stopped_early_is_named_with_its_angle():
    cell = geometry(5)
    station = cell.half_turns[4].after
    frame = cell.flange_from_triangle @ SE3.from_parts(
        np.eye(3), np.append(cell.triangle.circumcentre, 0.0)
    )
    more = frame @ SE3.exp([0, 0, 0, 0, 0, np.radians(3.0)]) @ frame.inverse()
    poses = np.array([s.base_from_flange.matrix for s in cell.stations])
    poses[station] = poses[station] @ more.matrix
    true = at_poses(cell, poses)
    (finding,) = told(replace(observed(5, true), stations=cell.stations))
    assert (finding.code, finding.stations) == ("TURN_ANGLE", (station,))
    assert abs(first_number(finding.evidence)) == pytest.approx(3.0, abs=0.05)
    # Where the robot says so itself, nothing has to be fitted.
    (finding,) = told(observed(5, true))
    assert (finding.code, finding.severity) == ("TURN_ANGLE", "warning")
    assert "177.00 degrees reported" in finding.evidence


def test_a_station_that_the_robot_missed_and_a_view_that_fits_nothing():
    session = observed(6)
    stations = list(session.stations)
    stations[9] = replace(
        stations[9],
        base_from_flange=stations[9].base_from_flange @ moved(2.0, 0.3, seed=6),
    )
    (finding,) = told(replace(session, stations=tuple(stations)))
    assert (finding.code, finding.stations) == ("POSE", (9,))
    pixels = session.pixels.copy()
    pixels[1, 20, 2] += (0.9, -0.7)
    (finding,) = told(replace(session, pixels=pixels))
    assert (finding.code, finding.stations, finding.camera) == (
        "DETECTION",
        (20,),
        session.cameras[1].name,
    )


@pytest.mark.parametrize("station", [4, 24])
def test_exchanged_markers_and_old_images_are_told_apart(station):
    session = observed(7)
    pixels = session.pixels.copy()
    pixels[0, station] = pixels[0, station, [0, 2, 1]]
    (finding,) = told(replace(session, pixels=pixels))
    assert (finding.code, finding.stations, finding.camera) == (
        "LABELS",
        (station,),
        session.cameras[0].name,
    )
    assert "A, B, C are A, C, B" in finding.evidence
    pixels = session.pixels.copy()
    pixels[1, station] = pixels[1, station - 1]
    (finding,) = told(replace(session, pixels=pixels))
    assert (finding.code, finding.stations) == ("STALE", (station,))
    assert f"as at station {station - 1}" in finding.evidence


@pytest.mark.parametrize(
    ("k", "words"), [(0, "side AB"), (1, "side AC"), (2, "the angle")]
)
def test_the_side_that_was_measured_wrongly_is_named(k, words):
    session = observed(8)
    right = session.triangle
    values = [right.side_ab, right.side_ac, right.angle]
    values[k] *= 1.01
    (finding,) = told(replace(session, triangle=TriangleRig(*values)))
    assert finding.code == "SIDES"
    assert finding.cause.startswith(words)
    factor = 1e3 if k < 2 else np.degrees(1.0)
    stated = factor * values[k]
    assert first_number(finding.evidence) == pytest.approx(stated / 1.01, rel=1e-3)


def test_sides_a_ruler_could_not_tell_are_not_named():
    session = observed(8)
    right = session.triangle
    near = TriangleRig(1.0005 * right.side_ab, right.side_ac, right.angle)
    assert told(replace(session, triangle=near)) == ()


def test_lengths_in_another_unit_are_a_unit():
    session = observed(9)
    stations = tuple(
        replace(
            station,
            base_from_flange=SE3.from_parts(
                station.base_from_flange.rotation,
                0.0254 * station.base_from_flange.translation,
            ),
        )
        for station in session.stations
    )
    found = told(replace(session, stations=stations))
    assert found[-1].code == "UNIT"
    assert "metres for inches" in found[-1].cause


def test_a_view_that_is_drawn_out_is_blurred():
    session = observed(1)
    edges = np.zeros((*session.pixels.shape[:3], 3))
    edges[..., 0] = 0.1
    edges[0, 6, :, 0] += 4.0**2 / 24
    edges[0, 6, :, 1] = 4.0**2 / 24
    (finding,) = told(session, edges=edges)
    assert (finding.code, finding.stations) == ("BLUR", (6,))
    assert "station 6: 4.0 px" in finding.evidence


def test_noise_and_missing_markers_are_poor_detection():
    session = observed(1)
    pixels = session.pixels.copy()
    pixels[1, ::4, 0] = np.nan
    (finding,) = told(replace(session, pixels=pixels))
    assert (finding.code, finding.camera) == ("DETECTION", session.cameras[1].name)
    assert "7 of 168 markers missing" in finding.evidence


@pytest.mark.parametrize("way", ["beside the image", "aslant", "in the image"])
def test_a_camera_that_does_not_see_the_rig_detects_nothing_poorly(way):
    """Markers of both cameras lack at four stations, where it is no wonder or is."""
    session = observed(2)
    poses = session.base_from_flange.copy()
    if way == "beside the image":
        poses[-4:, :3, 3] += [0.0, 0.0, 2.0]
    elif way == "aslant":
        left, right = (place.translation for place in geometry(2).base_from_camera)
        for pose in poses[-4:]:
            across = np.cross(right - left, pose[:3, 3] - left)
            pose[:3, :3] = np.linalg.qr(np.c_[across, np.eye(3)[:, :2]])[0][
                :, [1, 2, 0]
            ]
            pose[:3, 1] *= np.linalg.det(pose[:3, :3])
    pixels = session.pixels.copy()
    pixels[:, -4:] = np.nan
    found = told(at_poses(replace(session, pixels=pixels), poses))
    assert codes(found) == (["DETECTION"] if way == "in the image" else [])


def test_what_single_stations_are_off_beside_a_late_image_follows_from_it():
    """The way to the next station is not even: stations differ in where they are."""
    cell = geometry(4)
    reported = np.array([s.base_from_flange.matrix for s in cell.stations])
    rng = np.random.default_rng(8)
    steps = [
        share * (SE3(a).inverse() @ SE3(b)).log()
        for a, b, share in zip(
            reported[:-1],
            reported[1:],
            np.where(rng.random(len(reported) - 1) < 0.1, 0.05, 0.01),
            strict=True,
        )
    ]
    session = observed(4, at_poses(cell, reported @ se3_exp([*steps, np.zeros(6)])))
    first, *others = told(replace(session, stations=cell.stations))
    assert (first.code, first.follows) == ("CLOCK_OFFSET", "")
    assert {one.code for one in others} <= {"POSE", "TURN_ANGLE", "DETECTION"}
    assert others
    assert {one.follows for one in others} == {"CLOCK_OFFSET"}


TRACK = Finding("TRACK", "", "", "error", "")


@pytest.mark.parametrize(
    ("severity", "outcome"), [("error", "FAIL"), ("warning", "PASS")]
)
def test_what_concerns_the_whole_session_is_not_passed(severity, outcome):
    verdict = Verdict("PASS", "fine", (prediction_gate(1.2),), "-", (TRACK,))
    cause = Finding("RIG_SLIPPED", "the rig moved", "by 2 mm", severity, "tighten it")
    found = with_causes(verdict, [cause])
    assert found.outcome == outcome
    assert [(one.code, one.follows) for one in found.findings] == [
        ("RIG_SLIPPED", ""),
        ("TRACK", "RIG_SLIPPED"),
    ]
    holds = "the result holds: held-out track / predicted 1.20 (limit 2.00)"
    assert (holds in found.findings[0].evidence) == (outcome == "PASS")


def test_errors_stand_before_warnings_and_both_before_what_follows():
    causes = [
        Finding("BLUR", "", "", "warning", ""),
        Finding("POSE", "", "", "error", "", follows="BLUR"),
        Finding("CAMERA_MOVED", "", "", "error", ""),
    ]
    found = with_causes(Verdict("FAIL", "", (), "-", (TRACK,)), causes).findings
    assert codes(found) == ["CAMERA_MOVED", "BLUR", "POSE", "TRACK"]
    assert [one.follows for one in found] == ["", "", "BLUR", "CAMERA_MOVED"]


def test_without_causes_the_verdict_stays_as_it_is():
    verdict = Verdict("FAIL", "", (), "-", (TRACK,))
    assert with_causes(verdict, []) is verdict
