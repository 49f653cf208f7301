from dataclasses import replace

import numpy as np
import pytest

from handeye_tri.adjustment import adjust
from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.diagnose import assess, free_scale, radius_95
from handeye_tri.evaluate import evaluate_track
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.records import Repeatability, Station
from handeye_tri.se3 import SE3
from handeye_tri.synthesize import reference_geometry, synthesize
from handeye_tri.triangle import TriangleRig

REPEATABILITY = Repeatability(3e-5, float(np.radians(0.005)))


def observe(seed):
    rng = np.random.default_rng(seed)
    session, _ = synthesize(
        reference_geometry(rng), rng, sigma_px=0.02, repeatability=REPEATABILITY
    )
    return session


def judge(session, spread_deg=20.0, jointly=False):
    cameras = calibrate_session_cameras(session)
    session = session.without(cameras.details["dropped"])
    calibration = calibrate_hand_eye(session, cameras)
    if jointly:
        calibration = adjust(session, calibration)
    track = evaluate_track(calibration, session)
    verdict = assess(
        session, cameras, calibration, track,
        track_limit=1e-3, min_plane_spread=float(np.radians(spread_deg)),
    )  # fmt: skip
    return verdict, free_scale(session, cameras, calibration)


def rescaled(session, factor):
    """The same robot, its translations multiplied by a factor."""
    stations = tuple(
        Station(
            s.index,
            s.kind,
            s.joints,
            SE3.from_parts(
                s.base_from_flange.rotation, factor * s.base_from_flange.translation
            ),
        )
        for s in session.stations
    )
    return replace(session, stations=stations)


def codes(verdict):
    return {finding.code for finding in verdict.findings}


@pytest.mark.parametrize("seed", range(3))
def test_a_healthy_session_passes(seed):
    verdict, (scale, sigma) = judge(observe(seed))
    assert verdict.outcome == "PASS", codes(verdict)
    assert abs(scale - 1) < 4 * sigma < 0.01


@pytest.mark.parametrize("cameras", [(1,), (0, 1)])
@pytest.mark.parametrize("jointly", [False, True])
def test_a_bad_half_turn_is_left_out_and_named(cameras, jointly):
    session = observe(1)
    turn = session.half_turns[4]
    pixels = session.pixels.copy()
    for i in cameras:
        pixels[i, turn.after] = pixels[i, turn.after, [1, 0, 2]]
    verdict, _ = judge(replace(session, pixels=pixels), jointly=jointly)
    assert verdict.outcome == "PASS", codes(verdict)
    assert codes(verdict) == {"DROPPED"}
    (finding,) = verdict.findings
    assert finding.stations == (turn.before, turn.after)
    assert finding.camera == ("" if len(cameras) > 1 else session.cameras[1].name)
    for i in cameras:
        name = session.cameras[i].name
        assert f"{name}, half-turn 4 (stations {turn.before}" in finding.evidence
    assert "labels exchanged" in finding.evidence


def test_the_scale_scatters_as_it_says():
    ratios = []
    for seed in range(16):
        session = observe(100 + seed)
        cameras = calibrate_session_cameras(session)
        scale, sigma = free_scale(
            session, cameras, calibrate_hand_eye(session, cameras)
        )
        ratios.append((scale - 1) / sigma)
    # The root mean square of 16 unit normals has a standard deviation of 0.18.
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.55


def test_a_wrong_side_length_is_seen_as_a_scale():
    session = observe(1)
    rig = session.triangle
    longer = TriangleRig(1.01 * rig.side_ab, 1.01 * rig.side_ac, rig.angle)
    verdict, (scale, _) = judge(replace(session, triangle=longer))
    assert verdict.outcome == "FAIL"
    assert "SCALE" in codes(verdict)
    # The cameras' lengths are 1 % too long, so the robot's are shorter.
    assert scale == pytest.approx(1 / 1.01, abs=1e-3)


def test_poses_in_another_unit_never_pass():
    verdict, _ = judge(rescaled(observe(1), 0.0254))
    assert verdict.outcome != "PASS"
    assert "SCALE" in codes(verdict)


def test_a_moved_robot_station_fails():
    session = observe(2)
    stations = list(session.stations)
    wrong = stations[5]
    stations[5] = Station(
        5, wrong.kind, wrong.joints, wrong.base_from_flange @ SE3.exp([0.005] + [0] * 5)
    )
    verdict, _ = judge(replace(session, stations=tuple(stations)))
    assert verdict.outcome == "FAIL"
    assert "LOOP" in codes(verdict)


def test_a_spread_below_what_is_asked_cannot_tell():
    verdict, _ = judge(observe(1), spread_deg=89.9)
    assert verdict.outcome == "CANNOT TELL"
    assert codes(verdict) == {"MOTION"}


def test_radius_95_holds_95_percent():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(4, 3, 3)) * np.array([1.0, 0.3, 3.0])
    drawn = np.einsum("rab,rnb->rna", root, rng.normal(size=(4, 40_000, 3)))
    inside = np.linalg.norm(drawn, axis=2) < radius_95(root @ root.mT)[:, None]
    # The approximation is good to half a percent, the sampling to 0.1.
    assert np.abs(inside.mean(axis=1) - 0.95).max() < 0.008
