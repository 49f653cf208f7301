"""A cell whose triangle is put on another mount, from the plan to other tools."""

from __future__ import annotations

import contextlib
import io
import json

import jsonschema
import numpy as np
import pytest
from drawn_session import few_replicates

from handeye_tri import cli
from handeye_tri.exchange.bags import BagFile
from handeye_tri.pipeline import (
    STAGES,
    VERBS,
    NullProgress,
    Run,
    execute,
    stages_of,
    start,
)
from handeye_tri.pipeline.execution import inputs_of
from handeye_tri.pipeline.programme import plan_more
from handeye_tri.replay.recording import read_numbers
from handeye_tri.storage import SessionFolder
from handeye_tri.summary import plan_text


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("both")
    session = Run(start("hp3_stereo_both", folder / "out", 1, 6), NullProgress())
    with session.folder.locked(), few_replicates():
        execute(session, STAGES, VERBS, again=False)
    return session


@pytest.fixture(scope="module")
def imported(run):
    """The session exported as a bag and imported again, and what was printed."""
    folder, printed = run.folder.path.parent, io.StringIO()
    for arguments in (
        ("export", run.folder.path, "mcap", "-o", folder / "session.mcap"),
        ("import", "bag", folder / "session.mcap", "-o", folder / "back"),
    ):
        with contextlib.redirect_stdout(printed), pytest.raises(SystemExit) as left:
            cli.main([str(argument) for argument in arguments])
        assert not left.value.code
    back = Run(SessionFolder.open(folder / "back"), NullProgress())
    with back.folder.locked():
        execute(back, stages_of(back), ("detect", "calibrate"), again=False)
    return back, printed.getvalue()


def test_more_half_turns_begin_with_the_mount_that_the_arm_carries(run):
    more, path = plan_more(run, 4)
    carried = run.plan().stations[-1].mount
    mounts = [station.mount for station in more.stations]
    assert len(more.half_turns) == 4
    if more.tool_change is None:
        assert set(mounts) == {carried}
    elif more.tool_change.before:
        assert mounts[0] == carried
    else:
        assert carried not in mounts
    whole = run.plan().certificate["track_calibration_rms_mm"]
    assert more.certificate["track_calibration_rms_mm"] < whole
    assert more.certificate["mount_1.half_turns"] >= 2
    if path.suffix == ".csv":
        rows = [line.split(",") for line in path.read_text().splitlines()]
        assert [row[-1] for row in rows] == ["mount", *(str(m + 1) for m in mounts)]
    path.unlink()


def test_it_passes_with_half_turns_on_both_mounts(run):
    plan, session = run.plan(), run.session()
    assert run.evaluation()["verdict"] == "PASS"
    assert plan.tool_change is not None
    assert (
        session.mounts == (np.arange(len(session.mounts)) >= plan.tool_change.before)
    ).all()
    made = [(plan.stations[t.before].mount, t.axis) for t in plan.half_turns]
    assert set(made) == {(0, "normal"), (1, "BC")}
    assert len(made) == 6
    assert np.isfinite(session.pixels).all()
    assert "a tool change" in run.folder.header["stages"]["plan"]["line"]
    change = f"Tool change before station {plan.tool_change.before}, to mount 2 (about"
    assert change in plan_text(plan, run.cell)


def test_every_estimate_is_within_its_stated_sigma_of_the_truth(run):
    rows = run.evaluation()["truth"]
    ratios = {name: abs(row["error"]) / row["sigma"] for name, row in rows.items()}
    assert {"flange_from_triangle_2.x", "marker_A_2.x", "marker_A.x"} <= set(ratios)
    # The largest of about 60 normal errors is beyond 4.5 sigmas once in 2500 runs.
    assert max(ratios.values()) < 4.5, max(ratios, key=ratios.get)


def test_recording_and_page_tell_both_mounts(run):
    numbers = read_numbers(run.folder.file("replay.rrd"))
    assert numbers["mean_mm"] == run.evaluation()["track"]["mean_mm"]
    page = run.folder.file("report.html").read_text()
    assert "mount 1 (about a normal)" in page
    assert "mount 2 (about its edge BC)" in page


def test_the_bag_brings_the_tool_change_with_it(run, imported):
    back, printed = imported
    ours, theirs = run.plan(), back.plan()
    assert f"--tool-change {ours.tool_change.before}\n" in printed
    assert theirs.tool_change.before == ours.tool_change.before
    assert set(theirs.half_turns) == set(ours.half_turns)
    assert [s.mount for s in theirs.stations] == [s.mount for s in ours.stations]
    mine, other = run.hand_eye(), back.hand_eye()
    for one, again in zip(mine.mounts, other.mounts, strict=True):
        np.testing.assert_allclose(again.markers, one.markers, atol=1e-9)


def test_a_bag_that_begins_with_the_second_mount_is_not_guessed(
    run, imported, monkeypatch, capsys
):
    bag = run.folder.path.parent / "session.mcap"
    about = {"session": {"cell": run.folder.header["cell"]}}
    about["tool_change"] = {"before": 7, "mount": 0}
    monkeypatch.setattr(BagFile, "about", lambda self: json.dumps(about))
    with pytest.raises(SystemExit) as left:
        cli.main(["import", "bag", str(bag), "-o", str(bag.with_name("new"))])
    assert left.value.code == 2
    assert "begins with its second mount" in capsys.readouterr().err
    assert not bag.with_name("new").exists()


def test_the_json_follows_its_schema(run):
    path = run.folder.path.parent / "all.json"
    with contextlib.redirect_stdout(io.StringIO()), pytest.raises(SystemExit) as left:
        cli.main(["export", str(run.folder.path), "json", "-o", str(path)])
    assert not left.value.code
    data = json.loads(path.read_text())
    schema = json.loads(path.with_name("all_schema.json").read_text())
    jsonschema.validate(data, schema)
    (other,) = data["hand_eye"]["other_mounts"]
    expected = run.hand_eye().other_mounts[0].markers.tolist()
    assert other["markers_in_flange_m"] == expected
    del other["markers_in_flange_m"]
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(data, schema)


def test_a_stage_of_a_session_depends_on_its_second_mount(run):
    header = run.folder.header
    mount = {**header["cell"]["second_mount"], "ahead_mm": 91.0}
    changed = {**header, "cell": {**header["cell"], "second_mount": mount}}
    folder = SessionFolder(run.folder.path, changed)
    other = Run(folder, NullProgress())
    stale = {
        name
        for name, stage in STAGES.items()
        if inputs_of(other, stage) != inputs_of(run, stage)
    }
    # What the markers look like is the same.
    assert stale == set(STAGES) - {"detect"}
