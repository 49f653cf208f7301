import json
import subprocess
import sys

import pytest

from handeye_tri.errors import StorageError
from handeye_tri.storage import SessionFolder, decoded, fingerprint, write_json

HEADER = {
    "schema": "handeye_tri.session/2",
    "software": {},
    "cell": {},
    "cell_file": "c",
    "model_file": "m",
    "seed": 1,
    "half_turns": 3,
    "simulated": True,
    "stages": {},
}


@pytest.fixture
def folder(tmp_path):
    folder = SessionFolder.prepare(tmp_path / "out", dict(HEADER, stages={}))
    with folder.locked():
        write_json(folder.file("a.json"), {"schema": "s", "x": 1})
        folder.record("plan", "inputs", ["a.json"], "a line")
    return folder


def test_fingerprint_ignores_the_order_of_keys():
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    assert fingerprint({"a": 1}) != fingerprint({"a": 2})


def test_states(folder):
    assert folder.state("plan", "inputs")[0] == "done"
    assert folder.state("detect", "inputs")[0] == "missing"
    assert folder.state("plan", "other")[0] == "stale"
    folder.file("a.json").write_text("changed")
    assert folder.state("plan", "inputs") == (
        "damaged",
        "a.json was changed or damaged",
    )
    folder.file("a.json").unlink()
    assert folder.state("plan", "inputs") == ("damaged", "a.json is missing")
    with pytest.raises(StorageError, match="'plan' is needed first: a.json is missing"):
        folder.require("plan")


def test_reopening_finds_the_same(folder):
    again = SessionFolder.open(folder.path)
    assert again.header == folder.header
    assert again.state("plan", "inputs")[0] == "done"


def test_a_stage_drops_what_it_no_longer_writes(folder):
    write_json(folder.file("b.json"), {"schema": "s"})
    folder.record("plan", "inputs", ["b.json"], "a line")
    assert not folder.file("a.json").exists()


def test_a_folder_that_holds_something_else_is_refused_untouched(tmp_path):
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(StorageError, match="holds something else"):
        SessionFolder.prepare(tmp_path, dict(HEADER))
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]
    with pytest.raises(StorageError, match="this is a file"):
        SessionFolder.prepare(tmp_path / "mine.txt", dict(HEADER))
    with pytest.raises(StorageError, match="holds no session.json"):
        SessionFolder.open(tmp_path)
    with pytest.raises(StorageError, match="there is no such session folder"):
        SessionFolder.open(tmp_path / "absent")


def test_a_real_robots_session_is_not_replaced(folder):
    folder.header["simulated"] = False
    folder.save()
    with pytest.raises(StorageError, match="real robot's data"):
        SessionFolder.prepare(folder.path, dict(HEADER))


def test_a_start_that_fails_leaves_no_folder(tmp_path):
    folder = SessionFolder.prepare(tmp_path / "deep" / "out", dict(HEADER))

    def fail():
        with folder.locked():
            assert folder.path.is_dir()
            raise RuntimeError

    pytest.raises(RuntimeError, fail)
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_left_half_written_goes(folder):
    part = folder.path / "images" / ".left_000.png.abc.part"
    part.parent.mkdir()
    part.write_bytes(b"half")
    with folder.locked():
        assert not part.exists()
    assert folder.file("a.json").is_file()


def test_two_processes_cannot_share_a_session(folder):
    code = (
        "import sys, pathlib; from handeye_tri.storage import SessionFolder\n"
        "folder = SessionFolder.open(pathlib.Path(sys.argv[1]))\n"
        "with folder.locked(): pass"
    )
    with folder.locked():
        done = subprocess.run(
            [sys.executable, "-c", code, str(folder.path)],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
    assert "another handeye-tri works on this session" in done.stderr


@pytest.mark.parametrize("name", ["../x", "/etc/passwd", "a/../../x", ""])
def test_files_cannot_leave_the_session(folder, name):
    with pytest.raises(StorageError, match="leaves the session's folder"):
        folder.file(name)


def test_a_session_json_with_wrong_kinds_is_refused(folder):
    path = folder.path / "session.json"
    data = json.loads(path.read_text())
    data["stages"] = []
    path.write_text(json.dumps(data))
    with pytest.raises(StorageError, match=r"session\.json: stages missing"):
        SessionFolder.open(folder.path)


def test_decoded_names_file_and_key(folder):
    path = folder.file("a.json")
    assert decoded(path, "s", lambda data: data["x"]) == 1
    with pytest.raises(StorageError, match=r"a\.json: key 'y' is missing"):
        decoded(path, "s", lambda data: data["y"])
