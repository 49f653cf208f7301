"""handeye-tri check: a session judged again from its files."""

import json

import numpy as np
import pytest
from drawn_session import drawn_session

from handeye_tri import cli, storage
from handeye_tri.storage import sha256


def call(capsys, *arguments):
    """Run the command line in this process: exit code, stdout, stderr."""
    with pytest.raises(SystemExit) as left:
        cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return left.value.code, out, err


def digests(folder):
    return {path: sha256(path) for path in sorted(folder.rglob("*")) if path.is_file()}


def test_a_whole_session_is_judged_as_before_and_left_alone(capsys, tmp_path):
    run = drawn_session(tmp_path)
    before = digests(run.folder.path)
    code, out, err = call(capsys, "check", run.folder.path, "--json")
    assert (code, err) == (0, "")
    checked, recorded = json.loads(out), run.evaluation()
    for key in ("verdict", "sentence", "nearest", "simulated", "gates", "findings"):
        assert checked[key] == recorded[key]
    assert checked["track"]["rms_mm"] == recorded["track"]["rms_mm"]
    assert checked["files_verified"] == len(before) - 1
    assert (checked["stale"], checked["recorded_verdict"]) == ([], "PASS")
    code, out, _ = call(capsys, "check", run.folder.path)
    assert code == 0
    assert out.startswith("VERDICT  PASS")
    assert f"FILES  {len(before) - 1} as recorded (SHA-256)" in out
    assert digests(run.folder.path) == before


def test_every_changed_or_missing_file_is_named(capsys, tmp_path):
    run = drawn_session(tmp_path)
    image = run.folder.file("images/left_002.png")
    image.write_bytes(image.read_bytes() + b"\0")
    run.folder.file("track_observed.tum").unlink()
    code, out, err = call(capsys, "check", run.folder.path)
    assert (code, out) == (2, "")
    assert "2 of " in err
    assert "images/left_002.png was changed or damaged (handeye-tri simulate)" in err
    assert "track_observed.tum is missing (handeye-tri evaluate)" in err


def test_an_uncalibrated_session_says_what_to_run(capsys, tmp_path):
    run = drawn_session(tmp_path)
    for stage in ("hand_eye", "evaluate"):
        del run.folder.header["stages"][stage]
    run.folder.save()
    code, _, err = call(capsys, "check", run.folder.path)
    assert code == 2
    assert f"handeye-tri calibrate {run.folder.path}" in err


def change_plan(run, change):
    """Have another plan.json, with the hash in order, and nothing calibrated."""
    data = storage.read_json(run.folder.file("plan.json"), "handeye_tri.plan/1")
    change(data)
    storage.write_json(run.folder.file("plan.json"), data)
    for stage in ("cameras", "hand_eye", "evaluate"):
        del run.folder.header["stages"][stage]
    record_again(run, "plan")


def in_millimetres(data):
    for station in data["stations"]:
        place = station["base_from_flange"]["translation_m"]
        station["base_from_flange"]["translation_m"] = [1e3 * x for x in place]


def test_a_session_that_does_not_calibrate_says_why(capsys, tmp_path):
    run = drawn_session(tmp_path)
    change_plan(run, in_millimetres)
    before = digests(run.folder.path)
    code, out, err = call(capsys, "check", run.folder.path)
    assert (code, err) == (3, "")
    first, second, *_ = out.splitlines()
    assert first == "VERDICT  FAIL      SIMULATED, not calibrated, no gate run"
    assert second.startswith("  Not calibrated: ")
    assert "\n  UNIT: both sides disagree on lengths: robot translations are " in out
    assert "\n    Do: " in out
    assert "\n    RESIDUAL, likely from UNIT: " in out
    told = out[: out.index("\nFILES")]
    assert max(map(len, told.splitlines())) <= 88
    code, out, _ = call(capsys, "check", run.folder.path, "--json")
    checked = json.loads(out)
    assert (code, checked["verdict"], checked["track"]) == (3, "FAIL", None)
    assert [one["code"] for one in checked["findings"]] == ["UNIT", "RESIDUAL"]
    assert digests(run.folder.path) == before


def test_a_session_without_half_turns_leaves_with_4(capsys, tmp_path):
    run = drawn_session(tmp_path)
    change_plan(run, lambda data: data["half_turns"].clear())
    code, out, err = call(capsys, "check", run.folder.path)
    assert (code, err) == (4, "")
    assert out.startswith("VERDICT  CANNOT TELL      SIMULATED, not calibrated")
    assert "the session has no half_turns" in out


def test_what_nobody_could_calibrate_is_no_usable_input(capsys, tmp_path):
    run = drawn_session(tmp_path)
    del run.folder.header["stages"]["hand_eye"]
    run.folder.header |= {"method": "separate", "robot_errors": ["joint-offsets"]}
    run.folder.save()
    code, out, err = call(capsys, "check", run.folder.path)
    assert (code, out) == (2, "")
    assert err.startswith("error: --robot joint-offsets needs --method joint")


def record_again(run, stage):
    """Take a stage's files as they are, with the inputs that were recorded."""
    entry = run.folder.header["stages"][stage]
    run.folder.record(stage, entry["inputs"], list(entry["outputs"]), entry["line"])


def test_what_no_longer_fits_fails_and_says_what_was_said_before(capsys, tmp_path):
    """Where the robot's poses of the test are 3 mm off, the track gate must see it."""
    run = drawn_session(tmp_path)
    data = storage.read_json(run.folder.file("plan.json"), "handeye_tri.plan/1")
    for station in data["stations"]:
        if station["kind"] == "evaluation":
            station["base_from_flange"]["translation_m"][1] += 0.003
    storage.write_json(run.folder.file("plan.json"), data)
    record_again(run, "plan")
    code, out, _ = call(capsys, "check", run.folder.path)
    assert code == 3
    assert out.startswith("VERDICT  FAIL")
    assert "TRACK: the held-out track is worse than the cell allows" in out
    assert "BEFORE evaluation.json says PASS" in out
    # Everything after the plan was made from another plan.
    stale = [line.split()[1] for line in out.splitlines() if line.startswith("STALE")]
    assert stale == ["simulate:", "cameras:", "hand_eye:", "evaluate:"]


def test_data_that_cannot_decide_leave_with_4(capsys, tmp_path):
    """Observations a thousand times as uncertain leave the scale open."""
    run = drawn_session(tmp_path)
    path = run.folder.file("cameras.json")
    data = storage.read_json(path, "handeye_tri.cameras/1")
    matrix = 1e6 * np.array(data["covariance"]["matrix"])
    data["covariance"]["matrix"] = matrix.tolist()
    storage.write_json(path, data)
    record_again(run, "cameras")
    code, out, _ = call(capsys, "check", run.folder.path, "--json")
    assert code == 4
    checked = json.loads(out)
    assert checked["verdict"] == "CANNOT TELL"
    assert [finding["code"] for finding in checked["findings"]] == ["SCALE"]
