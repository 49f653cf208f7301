"""Sessions that do not calibrate end with the reason by name."""

from dataclasses import replace

import numpy as np
import pytest
from wrong_sessions import geometry, observed

from handeye_tri.adjustment import adjust
from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.diagnose import Finding, uncalibrated_verdict, why_uncalibrated
from handeye_tri.errors import ConvergenceError, DegenerateMotionError, HandEyeError
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.se3 import SE3
from handeye_tri.triangle import TriangleRig


def reason(session):
    """The first finding; calibration must have given up."""
    with pytest.raises(HandEyeError):
        adjust(session, calibrate_hand_eye(session, calibrate_session_cameras(session)))
    return why_uncalibrated(session, min_plane_spread=float(np.radians(20.0)))[0]


def with_poses(session, change):
    return replace(
        session,
        stations=tuple(
            replace(station, base_from_flange=change(station.base_from_flange))
            for station in session.stations
        ),
    )


def test_inverted_poses():
    finding = reason(with_poses(observed(1), SE3.inverse))
    assert finding.code == "READING"
    assert "base_in_flange" in finding.cause


@pytest.mark.parametrize(
    ("factor", "words"), [(1e3, "millimetres"), (1e2, "centimetres")]
)
def test_poses_in_another_unit(factor, words):
    def scaled(pose):
        return SE3.from_parts(pose.rotation, factor * pose.translation)

    finding = reason(with_poses(observed(1), scaled))
    assert finding.code == "UNIT"
    assert words in finding.cause


def test_a_rig_in_another_unit():
    session = observed(1)
    right = session.triangle
    inches = TriangleRig(right.side_ab / 25.4, right.side_ac / 25.4, right.angle)
    finding = reason(
        replace(session, triangle=inches, marker_radii=session.marker_radii / 25.4)
    )
    assert finding.code == "UNIT"
    assert "inches for millimetres" in finding.cause


@pytest.mark.parametrize(("way", "word"), [(1, "before"), (-1, "after")])
def test_pairs_shifted_by_one(way, word):
    session = observed(2)
    finding = reason(
        replace(
            session,
            pixels=np.roll(session.pixels, way, axis=1),
            pixel_covariance=np.roll(session.pixel_covariance, way, axis=1),
        )
    )
    assert finding.code == "READING"
    assert f"the robot pose {word} it" in finding.cause


def test_markers_named_wrongly_everywhere():
    session = observed(3)
    finding = reason(replace(session, pixels=session.pixels[:, :, [1, 0, 2]]))
    assert finding.code == "LABELS"
    assert "A, B, C are B, A, C" in finding.cause


@pytest.mark.parametrize(
    ("code", "order"), [("STALE", [0, 1, 2]), ("LABELS", [1, 0, 2])]
)
def test_more_bad_views_of_a_camera_than_calibration_leaves_out(code, order):
    session = observed(5)
    pixels = session.pixels.copy()
    bad = sorted(turn.after for turn in session.half_turns[1::3])
    assert len(bad) > len(session.half_turns) / 4
    for station in bad:
        # Of the half-turn before: that of its own station before would be no turn.
        shown = station - 2 * (code == "STALE")
        pixels[1, station] = session.pixels[1, shown, order]
    finding = reason(replace(session, pixels=pixels))
    assert (finding.code, finding.camera) == (code, session.cameras[1].name)
    assert finding.stations == tuple(bad)


def test_half_turns_that_are_all_alike():
    cell = geometry(4)
    stations = list(cell.stations)
    first = cell.half_turns[0]
    rng = np.random.default_rng(7)
    for turn in cell.half_turns:
        near = SE3.exp(rng.normal(scale=[0.01] * 3 + [0.02] * 3))
        for mine, other in ((turn.before, first.before), (turn.after, first.after)):
            pose = near @ cell.stations[other].base_from_flange
            stations[mine] = replace(stations[mine], base_from_flange=pose)
    session = observed(4, replace(cell, stations=tuple(stations)))
    finding = why_uncalibrated(session, min_plane_spread=float(np.radians(20.0)))[0]
    assert finding.code == "MOTION"


@pytest.mark.parametrize(
    ("error", "code", "outcome"),
    [
        (DegenerateMotionError, "MOTION", "CANNOT TELL"),
        (DegenerateMotionError, "READING", "FAIL"),
        (ConvergenceError, "MOTION", "CANNOT TELL"),
        (DegenerateMotionError, None, "CANNOT TELL"),
        (ConvergenceError, None, "FAIL"),
    ],
)
def test_only_poor_motions_leave_open_whether_something_is_wrong(error, code, outcome):
    findings = [] if code is None else [Finding(code, "", "", "error", "")]
    verdict = uncalibrated_verdict(error("planes 2 deg apart"), findings)
    assert verdict.outcome == outcome
    assert verdict.sentence == "Not calibrated: planes 2 deg apart"
    assert verdict.findings == tuple(findings)
