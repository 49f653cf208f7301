"""A full disk, a read-only one and a second process: one clear sentence each."""

import os
import shutil
import subprocess
import sys

import pytest
from drawn_session import drawn_session, few_replicates

from handeye_tri import cli
from handeye_tri.storage import sha256


def call(capsys, *arguments):
    """Run the command line in this process: exit code, stdout, stderr."""
    with pytest.raises(SystemExit) as left:
        cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return left.value.code, out, err


def digests(folder):
    return {path: sha256(path) for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture
def disk(tmp_path):
    """A disk of its own, 24 MiB, with an evaluated session on it."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=24M", "tmpfs", str(place)]
    if shutil.which("mount") is None or subprocess.run(command, check=False).returncode:
        pytest.skip("only root may mount a small disk of its own")
    drawn_session(tmp_path)
    shutil.move(tmp_path / "session", place / "session")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def fill(disk, leave):
    """Take all of the disk but so many bytes; returns the file to delete."""
    filler = disk / "filler"
    free = os.statvfs(disk)
    with filler.open("wb") as stream:
        stream.write(bytes(free.f_bavail * free.f_frsize - leave))
    return filler


def assert_one_sentence(err, reason):
    """The last line is the error; before it are only lines of stages that ran."""
    *progress, last = err.splitlines()
    assert last.startswith("error: ")
    assert f"cannot be written ({reason})" in last
    assert not any("error" in line or "Traceback" in line for line in progress)


def test_a_full_disk(capsys, disk):
    session = disk / "session"
    before = digests(session)
    verbs = (
        (("calibrate", session, "--again"), 0),
        (("calibrate", session, "--again"), 30_000),
        (("detect", session, "--again"), 4_096),
        (("report", session), 500_000),
        (("export", session, "json", "-o", disk / "all.json"), 20_000),
        (("export", session, "mcap", "-o", disk / "all.mcap"), 20_000),
        (("run", "hp3_stereo", "-o", disk / "new", "--half-turns", "2"), 0),
    )
    with few_replicates():
        for arguments, leave in verbs:
            filler = fill(disk, leave)
            code, out, err = call(capsys, *arguments)
            filler.unlink()
            assert (code, out) == (2, ""), arguments
            assert_one_sentence(err, "no space left on device")
            # No half of a file, and none that was there is another now, but what a
            # stage before the one that failed wrote again: the same.
            assert digests(session) == before, arguments
            assert not (disk / "all.json").exists()
            assert not (disk / "all.mcap").exists()
        # With room again the same command goes on.
        code, _, _ = call(capsys, "report", session)
    assert code == 0
    assert (session / "report.html").is_file()


def test_a_read_only_disk(capsys, tmp_path, disk):
    session = disk / "session"
    before = digests(session)
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    for arguments in (
        ("calibrate", session, "--again"),
        ("detect", session, "--again"),
        ("report", session),
        ("export", session, "json", "-o", disk / "all.json"),
    ):
        code, out, err = call(capsys, *arguments)
        assert (code, out) == (2, "")
        assert_one_sentence(err, "read-only file system")
    code, out, err = call(capsys, "run", "hp3_stereo", "-o", disk / "new")
    assert (code, out) == (2, "")
    assert "cannot be made (read-only file system)" in err
    # Whoever only looks at a session needs no right to write it.
    code, out, _ = call(capsys, "check", session)
    assert code == 0
    code, _, _ = call(capsys, "export", session, "json", "-o", tmp_path / "all.json")
    assert code == 0
    assert digests(session) == before


def test_a_second_process_on_a_session(capsys, tmp_path):
    run = drawn_session(tmp_path)
    session = run.folder.path
    holder = (
        "import sys, pathlib; from handeye_tri.storage import SessionFolder\n"
        "with SessionFolder.open(pathlib.Path(sys.argv[1])).locked():\n"
        "    print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", holder, str(session)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as other:
        assert other.stdout.readline() == b"held\n"
        for verb in ("detect", "calibrate", "evaluate", "report"):
            code, out, err = call(capsys, verb, session)
            assert (code, out) == (2, "")
            assert len(err.splitlines()) == 1
            assert "another handeye-tri works on this session; wait for it" in err
        other.communicate()
    code, _, _ = call(capsys, "calibrate", session)
    assert code == 0
