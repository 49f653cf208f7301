from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from finished_session import finished_on_two_mounts

from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.diagnose import Finding
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.records import Covariance, Repeatability
from handeye_tri.summary import digits, result_rows, round_magnification, summary_text
from handeye_tri.synthesize import reference_geometry, synthesize

REPEATABILITY = Repeatability(3e-5, float(np.radians(0.005)))


@pytest.fixture(scope="module")
def calibrated():
    rng = np.random.default_rng(4)
    session, truth = synthesize(
        reference_geometry(rng), rng, sigma_px=0.02, repeatability=REPEATABILITY
    )
    return calibrate_hand_eye(session, calibrate_session_cameras(session)), truth


@pytest.mark.parametrize(
    ("sigma", "expected"),
    [(0.23, 2), (2.3, 1), (23.0, 0), (230.0, 0), (0.0023, 4), (0.1, 2), (0.0, 4)],
)
def test_digits_follow_the_uncertainty(sigma, expected):
    assert digits(sigma) == expected


def test_rows_subtract_to_their_errors(calibrated):
    calibration, truth = calibrated
    rows = {row["name"]: row for row in result_rows(calibration, truth)}
    left = rows["left.fx"]
    fx = truth.cameras[0].intrinsics.fx
    assert left["value"] - left["error"] == pytest.approx(fx, abs=1e-9)
    x = rows["base_from_right.x"]
    true_x = 1e3 * truth.base_from_camera[1].translation[0]
    assert x["value"] - x["error"] == pytest.approx(true_x, abs=1e-9)
    assert x["unit"] == "mm"
    turn = rows["flange_from_triangle.rx"]
    true_turn = np.degrees(truth.flange_from_triangle.log()[3])
    # Beyond first order the linear map leaves the square of 1e-4 rad.
    assert turn["value"] - turn["error"] == pytest.approx(true_turn, abs=1e-5)


def test_rows_have_sigmas_that_hold_their_errors(calibrated):
    ratio = [row["error"] / row["sigma"] for row in result_rows(*calibrated)]
    assert np.isfinite(ratio).all()
    assert np.sqrt(np.mean(np.square(ratio))) < 2
    assert len(ratio) == 2 * 5 + 3 * 6


def test_each_mount_has_its_rows():
    done = finished_on_two_mounts()
    rows = {row["name"]: row for row in result_rows(done.calibration, done.truth)}
    assert len(rows) == 2 * 5 + 4 * 6
    for name, mount in (
        ("flange_from_triangle.x", done.truth),
        ("flange_from_triangle_2.x", done.truth.other_mounts[0]),
    ):
        true = 1e3 * mount.flange_from_triangle.translation[0]
        row = rows[name]
        assert row["value"] - row["error"] == pytest.approx(true, abs=1e-9)
        assert abs(row["error"]) < 5 * row["sigma"]


def test_rows_without_truth_have_no_error(calibrated):
    assert {row["error"] for row in result_rows(calibrated[0], None)} == {None}


def evaluation(calibrated, **changes):
    gate = {
        "name": "loop", "found": "1.0", "limit": "1.6", "verdict": "good",
        "blind_to": "scale",
    }  # fmt: skip
    return {
        "verdict": "PASS",
        "sentence": "Within 0.2 mm.",
        "nearest": "loop 1.0 (limit 1.6)",
        "simulated": True,
        "gates": [gate, {**gate, "name": "touch test", "verdict": "not run"}],
        "findings": [],
        "cross_checks": {
            "cross_validation": {
                "folds": 11, "groups": 11, "rms_mm": 0.0734, "predicted_rms_mm": 0.0741,
            },
            "bootstrap": {
                "drawn_from": 11, "relative_error": 0.2431,
                "track_calibration_mm": 0.0327,
                "track_calibration_by_covariance_mm": 0.0301,
            },
        },
        "track": {
            "source": "held-out stations", "stations": 6,
            "mean_mm": 0.0712, "rms_mm": 0.08, "max_mm": 0.15,
            "predicted_rms_mm": 0.082, "against_prediction": None,
            "worst_station": 24, "worst_marker": "B",
            "predicted_parts_mm": {"calibration": 0.03, "pixels": 0.04, "robot": 0.0},
        },
        "robot": {"asked": [], "estimated": [], "undetermined": []},
        "result": result_rows(*calibrated),
        **changes,
    }  # fmt: skip


def test_the_verdict_comes_first_and_the_commands_last(calibrated):
    text = summary_text(evaluation(calibrated), Path("out"), ["report.html", "a.json"])
    lines = text.splitlines()
    assert lines[0].startswith("VERDICT  PASS")
    assert "1 of 1 gates met, 1 not run" in lines[0]
    assert "0.071 mm mean" in text
    assert "station 24, marker B" in text
    assert "pixels 64 % (0.040 mm)" in text
    assert lines[-1] == "NEXT  handeye-tri replay out"
    assert "out/report.html   start here" in text
    assert max(len(line) for line in lines) <= 100


def test_cross_checks_stand_beside_the_track_test(calibrated):
    text = summary_text(evaluation(calibrated), Path("out"), [])
    assert "Track test, 6 held-out stations: 0.071 mm mean" in text
    assert (
        "Cross-validation, one half-turn left out at a time: 0.073 mm rms "
        "(0.074 predicted)." in text
    )
    assert (
        "0.030 mm by covariance, 0.033 +- 24 % by drawing its 11 half-turns again."
        in text
    )


def test_a_track_from_cross_validation_is_told_once(calibrated):
    changed = evaluation(calibrated)
    changed["track"].update(source="cross-validation", stations=22)
    changed["cross_checks"]["bootstrap"] = {"not_run": "too few half-turns"}
    text = summary_text(changed, Path("out"), [])
    assert "Track test, 22 stations, each left out of its own calibration: " in text
    assert "Cross-validation" not in text
    assert "Repeatability not run: too few half-turns" in text


def test_without_truth_there_is_no_truth_column(calibrated):
    bare = evaluation(calibrated, result=result_rows(calibrated[0], None))
    assert "truth" not in summary_text(bare, Path("out"), [])
    assert "truth - value" in summary_text(evaluation(calibrated), Path("out"), [])


def test_findings_are_told_with_what_to_do(calibrated):
    findings = [
        Finding("SIDES", "sides differ", "1.01", "warning", "measure again"),
        Finding("LOOP", "noise " * 20, "1.9", "error", "look", follows="SIDES"),
    ]
    told = evaluation(calibrated, findings=[asdict(one) for one in findings])
    text = summary_text(told, Path("out"), [])
    assert "\n  SIDES: sides differ; 1.01\n    Do: measure again.\n" in text
    assert "\n    LOOP, likely from SIDES: noise noise" in text
    assert "Do: look" not in text
    told = text[text.index("SIDES") : text.index("RESULT")]
    assert max(map(len, told.splitlines())) <= 88


@pytest.mark.parametrize(
    ("largest", "expected"),
    [(1e-4, 1000), (1.3e-4, 500), (0.06, 2), (1.0, 1), (0.0, 1_000_000)],
)
def test_gaps_are_drawn_round_times_too_long_within_the_limit(largest, expected):
    assert round_magnification(largest, 0.12) == expected


def test_errors_of_the_robot_are_told_with_what_was_left_open(calibrated):
    changed = evaluation(calibrated)
    robot = {"asked": ["joint-offsets"], "estimated": ["s.offset"]}
    changed["robot"] = {**robot, "undetermined": ["t.offset"]}
    text = summary_text(changed, Path("out"), [])
    assert "1 of 2 errors of the robot estimated; left at zero" in text
    assert "tell them: t.offset (" in text
    assert "errors of the robot" not in summary_text(
        evaluation(calibrated), Path("out"), []
    )


def test_errors_of_the_robot_have_units_for_people(calibrated):
    calibration, _ = calibrated
    labels = (*calibration.covariance.labels, "s.offset", "s.x")
    n = len(labels)
    matrix = np.diag(np.r_[np.ones(n - 2), 1e-4, 1e-8])
    found = replace(
        calibration,
        covariance=Covariance(labels, matrix),
        robot={"s.offset": 1e-3, "s.x": 2e-4},
    )
    rows = {row["name"]: row for row in result_rows(found, None)}
    assert rows["s.offset"]["unit"] == "deg"
    assert rows["s.offset"]["value"] == pytest.approx(np.degrees(1e-3))
    assert rows["s.offset"]["sigma"] == pytest.approx(np.degrees(1e-2))
    assert rows["s.x"]["unit"] == "mm"
    assert rows["s.x"]["value"] == pytest.approx(0.2)
    assert rows["s.x"]["sigma"] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("outcome", "words"),
    [
        ("consistent", "Consistent with the prediction: 95 % of such tests have 0.050"),
        ("better", "Better than predicted"),
        ("worse", "Worse than predicted"),
    ],
)
def test_the_track_is_judged_against_its_prediction(calibrated, outcome, words):
    changed = evaluation(calibrated)
    range_ = {"outcome": outcome, "low_mm": 0.05, "high_mm": 0.12}
    changed["track"] = {**changed["track"], "against_prediction": range_}
    assert words in summary_text(changed, Path("out"), [])
