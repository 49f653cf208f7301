"""handeye-tri compare: one session of a cell against an older one."""

import json
from dataclasses import replace

import numpy as np
import pytest
from drawn_session import drawn_session, with_outcome

from handeye_tri import cli, storage
from handeye_tri.pipeline import STAGES, NullProgress, Run
from handeye_tri.pipeline.execution import inputs_of
from handeye_tri.records import Mount
from handeye_tri.se3 import SE3
from handeye_tri.storage import codec, find_cell, find_model, read_cell


def call(capsys, *arguments):
    """Run the command line in this process: exit code, stdout, stderr."""
    with pytest.raises(SystemExit) as left:
        cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return left.value.code, out, err


@pytest.fixture(scope="module")
def moved_cell(tmp_path_factory):
    """The same cell after somebody pushed the left camera by 1.5 mm."""
    path = find_cell("hp3_stereo")
    text = path.read_text()
    text = text.replace("hp3_like.xml", str(find_model(read_cell(path), path)))
    old = "position_m: [1.35, 0.125, 0.45]"
    assert old in text
    moved = tmp_path_factory.mktemp("cell") / "moved.yaml"
    moved.write_text(text.replace(old, "position_m: [1.35, 0.125, 0.4515]"))
    return str(moved)


def folders(*runs):
    return [run.folder.path for run in runs]


def test_an_unchanged_cell_passes(capsys, tmp_path):
    before = drawn_session(tmp_path, name="before")
    after = drawn_session(tmp_path, seed=4, name="after")
    code, out, err = call(capsys, "compare", *folders(before, after), "--json")
    assert (code, err) == (0, "")
    compared = json.loads(out)
    assert compared["verdict"] == "PASS"
    assert compared["why"] == []
    assert [compared[key]["verdict"] for key in ("before", "after")] == ["PASS"] * 2
    assert not any(change["changed"] for change in compared["changes"])
    placed = compared["placement"]
    assert placed["rms_mm"] < 3 * placed["expected_rms_mm"] < 0.3 * placed["limit_mm"]
    # Side by side: what each session's evaluation says, and both sigmas together.
    for run, key in ((before, "before"), (after, "after")):
        said = {row["name"]: row["value"] for row in run.evaluation()["result"]}
        assert {row["name"]: row[key] for row in compared["quantities"]} == said
    for row, one, other in zip(
        compared["quantities"],
        before.evaluation()["result"],
        after.evaluation()["result"],
        strict=True,
    ):
        both = (one["sigma"] ** 2 + other["sigma"] ** 2) ** 0.5
        assert row["sigma"] == pytest.approx(both)
        assert row["difference"] == pytest.approx(
            row["after"] - row["before"], abs=0.05 * both
        )
        assert abs(row["sigmas"]) < 4.5


def test_a_pushed_camera_fails_and_is_named(capsys, tmp_path, moved_cell):
    before = drawn_session(tmp_path, name="before")
    after = drawn_session(tmp_path, cell=moved_cell, seed=5, name="after")
    code, out, _ = call(capsys, "compare", *folders(before, after))
    assert code == 3
    assert out.startswith("VERDICT  FAIL      changed")
    assert "\n  Camera left moved 1." in out
    changed = [line.split("  ")[1] for line in out.splitlines() if "CHANGED" in line]
    assert changed == ["left in base", "right to first camera"]
    assert "markers seen after" in out


def slipped(run, mount, by):
    """The session had the rig moved on a mount (from 1, m): its results say so."""
    found = run.hand_eye()
    mounts = list(found.mounts)
    one = mounts[mount - 1]
    way = SE3.from_parts(np.eye(3), np.array([by, 0.0, 0.0]))
    frame = way @ one.flange_from_triangle
    mounts[mount - 1] = Mount(frame, way.apply(one.markers))
    changed = replace(
        found,
        flange_from_triangle=mounts[0].flange_from_triangle,
        markers=mounts[0].markers,
        other_mounts=tuple(mounts[1:]),
    )
    path = run.folder.file("hand_eye.json")
    data = json.loads(path.read_text()) | codec.hand_eye_to_json(changed)
    storage.write_json(path, data)
    for name in ("hand_eye", "evaluate"):
        line = run.folder.header["stages"][name]["line"]
        outputs = list(run.folder.outputs(name))
        run.folder.record(name, inputs_of(run, STAGES[name]), outputs, line)
    return Run(storage.SessionFolder.open(run.folder.path), NullProgress())


def test_mounts_are_compared_one_by_one(capsys, tmp_path):
    cell = "hp3_stereo_both"
    before = drawn_session(tmp_path, cell=cell, name="before")
    after = drawn_session(tmp_path, cell=cell, seed=4, name="after")
    code, out, _ = call(capsys, "compare", *folders(before, after))
    assert code == 0, out
    assert "rig on flange, mount 1" in out
    code, out, _ = call(capsys, "compare", *folders(before, slipped(after, 2, 1e-3)))
    assert code == 3
    assert "The rig has slipped on mount 2 by " in out
    changed = [line.split("  ")[1] for line in out.splitlines() if "CHANGED" in line]
    assert changed == ["rig on flange, mount 2"]


def test_a_second_mount_that_one_session_lacks_is_one_clear_sentence(capsys, tmp_path):
    before, other = (drawn_session(tmp_path, name=name) for name in ("before", "other"))
    second = {"axis": "BC", "ahead_mm": 90.0, "turn_deg": 0.0, "holder": "rods"}
    other.folder.header["cell"]["second_mount"] = second
    other.folder.save()
    for pair in ((before, other), (other, before)):
        code, out, err = call(capsys, "compare", *folders(*pair))
        assert (code, out) == (2, "")
        assert len(err.splitlines()) == 1
        assert f"only {other.folder.path} has a second mount of its rig (about BC)" in (
            err
        )


def test_what_cannot_decide_leaves_with_4(capsys, tmp_path):
    """One set of observations twice, and a session that failed itself."""
    before = drawn_session(tmp_path, name="before")
    again = drawn_session(tmp_path, name="again")
    code, out, _ = call(capsys, "compare", *folders(before, again))
    assert code == 4
    assert "both rest on the same observations" in out
    failed = with_outcome(drawn_session(tmp_path, seed=4, name="failed"), "FAIL")
    code, out, _ = call(capsys, "compare", *folders(before, failed), "--json")
    assert code == 4
    assert json.loads(out)["why"] == [f"{failed.folder.path} has the verdict FAIL"]


def test_noise_that_would_hide_a_change_leaves_with_4(capsys, tmp_path):
    """Where the cell allows less than the two calibrations can see."""
    runs = [
        drawn_session(tmp_path, seed=seed, name=f"session{seed}") for seed in (3, 4)
    ]
    for run in runs:
        run.folder.header["cell"]["track_limit_mm"] = 1e-3
        entry = run.folder.header["stages"]["evaluate"]
        entry["inputs"] = inputs_of(run, STAGES["evaluate"])
        run.folder.save()
    code, out, _ = call(capsys, "compare", *folders(*runs))
    assert code == 4
    assert "would hide in the noise" in " ".join(out.split())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h: h["cell"].update(name="welder"), "cell hp3_stereo against welder"),
        (
            lambda h: h["cell"]["cameras"][0].update(image_size_px=[640, 480]),
            "cameras left 1024 x 768",
        ),
        (lambda h: h["cell"]["rig"].update(side_ab_mm=131.0), "rig.side_ab_mm 130"),
    ],
)
def test_sessions_of_different_cells_are_one_clear_sentence(
    capsys, tmp_path, change, message
):
    before, other = (drawn_session(tmp_path, name=name) for name in ("before", "other"))
    change(other.folder.header)
    other.folder.save()
    code, out, err = call(capsys, "compare", *folders(before, other))
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert message in err


def test_a_session_that_is_not_evaluated_says_what_to_run(capsys, tmp_path):
    before, other = (drawn_session(tmp_path, name=name) for name in ("before", "other"))
    del other.folder.header["stages"]["evaluate"]
    other.folder.save()
    code, _, err = call(capsys, "compare", *folders(before, other))
    assert code == 2
    assert f"handeye-tri evaluate {other.folder.path}" in err
    code, _, err = call(capsys, "compare", before.folder.path, tmp_path / "absent")
    assert code == 2
    assert "there is no such session folder" in err
    # Nothing of either session was written.
    assert storage.SessionFolder.open(before.folder.path).header == before.folder.header
