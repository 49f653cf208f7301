"""A session with one bit flipped, in any of its files: never a wrong number.

``HANDEYE_FUZZ=1000`` sets the number of flips (default 100), spread over all files;
``python scripts/check_readers.py`` does that.
"""

import contextlib
import json
import os
import shutil

import numpy as np
import pytest
from drawn_session import drawn_session, few_replicates

from handeye_tri import cli, storage
from handeye_tri.errors import StorageError
from handeye_tri.pipeline import STAGES, NullProgress, Run, execute
from handeye_tri.pipeline.run import SCHEMAS
from handeye_tri.storage import SessionFolder
from handeye_tri.summary import summary_text

FLIPS = int(os.environ.get("HANDEYE_FUZZ", "100"))


def call(capsys, *arguments):
    """Run the command line in this process: exit code, stdout, stderr."""
    with pytest.raises(SystemExit) as left:
        cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return left.value.code, out, err


def flip(path, rng):
    """Flip one bit of a file; returns what it held."""
    whole = path.read_bytes()
    data = bytearray(whole)
    data[rng.integers(len(data))] ^= 1 << rng.integers(8)
    path.write_bytes(bytes(data))
    return whole


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """A session with every file, page and recording too."""
    run = drawn_session(tmp_path_factory.mktemp("reported"))
    execute(run, STAGES, ("report",), again=False)
    return run.folder.path


def test_a_flipped_bit_anywhere_is_one_clear_sentence(capsys, tmp_path, reported):
    """By every verb that takes numbers out of a session and changes nothing in it."""
    target = tmp_path / "target"
    reads = {
        "check": ["check", reported, "--json"],
        "export": ["export", reported, "json", "-o", target],
        "programme": ["programme", reported, "csv", "-o", target],
        "replay": ["replay", reported, "--screenshot", tmp_path / "x.png"],
    }
    of_verb = {
        "programme": {"plan.json", "session.json"},
        "replay": {"replay.rrd", "report.html", "session.json"},
    }
    files = sorted(p for p in reported.rglob("*") if p.is_file())
    rng = np.random.default_rng(1)
    for number in range(max(FLIPS, 2 * len(files))):
        # session.json is what vouches for the others: every other flip is there.
        path = files[(number // 2) % len(files)]
        if number % 2:
            path = reported / "session.json"
        name = str(path.relative_to(reported))
        verbs = [verb for verb in reads if name in of_verb.get(verb, {name})]
        if name in ("replay.rrd", "report.html"):
            verbs.remove("export")
        verb = verbs[rng.integers(len(verbs))]
        whole = flip(path, rng)
        code, out, err = call(capsys, *reads[verb])
        path.write_bytes(whole)
        assert (code, out) == (2, ""), (name, verb)
        assert len(err.splitlines()) == 1
        assert name in err
        assert not target.exists()


def test_every_flip_that_is_read_all_the_same_gives_the_same_numbers(
    capsys, tmp_path, reported
):
    """White space of session.json, for one: the check is of what it says."""
    path = reported / "session.json"
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"\n", b"\n\n"))
    code, out, _ = call(capsys, "check", reported, "--json")
    path.write_bytes(whole)
    assert code == 0
    recorded = json.loads((reported / "evaluation.json").read_text())
    assert json.loads(out)["track"]["positions"] == recorded["track"]["positions"]


@pytest.mark.parametrize("name", ["observations.npz", "cameras.json", "hand_eye.json"])
def test_a_damaged_file_is_made_again_to_the_same_numbers(tmp_path, name):
    run = drawn_session(tmp_path)
    before = run.evaluation()
    flip(run.folder.file(name), np.random.default_rng(3))
    with few_replicates():
        execute(run, STAGES, ("detect", "calibrate", "evaluate"), again=False)
    assert run.evaluation() == before


def test_a_file_of_another_schema_says_which_and_what_to_do(capsys, tmp_path):
    run = drawn_session(tmp_path)
    path = run.folder.file("hand_eye.json")
    data = json.loads(path.read_text())
    for content, message in (
        ({**data, "schema": "handeye_tri.hand_eye/0"}, "its schema is 'handeye_tri."),
        ({k: v for k, v in data.items() if k != "chi2"}, "key 'chi2' is missing"),
    ):
        storage.write_json(path, content)
        with pytest.raises(StorageError) as caught:
            run.hand_eye()
        text = str(caught.value)
        assert str(path) in text
        assert message in text
        assert SCHEMAS["hand_eye"] in text
        assert f"handeye-tri calibrate {run.folder.path} --again" in text
    storage.write_json(path, data)
    header = run.folder.path / "session.json"
    old = json.loads(header.read_text()) | {"schema": "handeye_tri.session/1"}
    header.write_text(json.dumps(old))
    code, _, err = call(capsys, "evaluate", run.folder.path)
    assert code == 2
    assert "this version of handeye-tri reads 'handeye_tri.session/2'" in err
    assert "again into a new folder" in err


def test_stages_of_another_schema_are_stale(monkeypatch, tmp_path):
    run = drawn_session(tmp_path)
    monkeypatch.setitem(SCHEMAS, "hand_eye", "handeye_tri.hand_eye/9")
    with pytest.raises(StorageError, match="the stage 'hand_eye' is needed first"):
        execute(run, STAGES, ("evaluate",), again=False)


def key_paths(data, depth=2):
    for key, value in data.items():
        yield (key,)
        if isinstance(value, dict) and depth > 1:
            yield from ((key, *rest) for rest in key_paths(value, depth - 1))


def test_an_evaluation_without_a_key_is_refused_or_shown_all_the_same(tmp_path):
    """What the terminal and the verdict strip take must have been asked for."""
    run = drawn_session(tmp_path)
    path = run.folder.file("evaluation.json")
    whole = json.loads(path.read_text())
    for keys in key_paths({k: v for k, v in whole.items() if k != "truth"}):
        data = json.loads(path.read_text())
        part = data
        for key in keys[:-1]:
            part = part[key]
        del part[keys[-1]]
        storage.write_json(path, data)
        with contextlib.suppress(StorageError):
            summary_text(run.evaluation(), run.folder.path, [])
        storage.write_json(path, whole)


def test_a_session_moved_elsewhere_is_the_same(capsys, tmp_path):
    run = drawn_session(tmp_path)
    shutil.move(run.folder.path, tmp_path / "elsewhere")
    code, _, _ = call(capsys, "check", tmp_path / "elsewhere")
    assert code == 0
    again = Run(SessionFolder.open(tmp_path / "elsewhere"), NullProgress())
    assert again.evaluation()["verdict"] == "PASS"
