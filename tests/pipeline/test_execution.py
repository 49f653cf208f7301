from dataclasses import replace

import pytest

from handeye_tri.errors import HandEyeError, MissingDependencyError, StorageError
from handeye_tri.pipeline import Run, Stage, execute, start
from handeye_tri.storage import SessionFolder, write_json


class Recorder:
    """Progress that remembers what it was told."""

    def __init__(self):
        self.said = []

    def begin(self, number, total, stage):
        self.said.append((number, total, stage))

    def advance(self, done, total):
        pass

    def end(self, line, seconds):
        self.said.append((line, seconds is None))


class Fake:
    """Two stages that count how often they run."""

    def __init__(self):
        self.ran = []
        self.stages = {
            "first": Stage("first", "one", ("track_limit_mm",), (), self.first),
            "second": Stage("second", "two", (), ("first",), self.second),
        }

    def first(self, run):
        self.ran.append("first")
        limit = run.folder.header["cell"]["track_limit_mm"]
        write_json(run.folder.file("first.json"), {"schema": "s", "limit": limit})
        return ["first.json"], "line one"

    def second(self, run):
        self.ran.append("second")
        write_json(run.folder.file("second.json"), {"schema": "s"})
        return ["second.json"], "line two"


@pytest.fixture
def fake():
    return Fake()


def work(path, fake, verbs=("one", "two"), *, again=False, **header):
    folder = (
        SessionFolder.open(path)
        if (path / "session.json").exists()
        else start("hp3_stereo", path, 1, None)
    )
    folder.header.update(header)
    progress = Recorder()
    with folder.locked():
        execute(Run(folder, progress), fake.stages, verbs, again=again)
    return progress.said


def test_finished_stages_are_not_done_again(tmp_path, fake):
    said = work(tmp_path / "s", fake)
    assert said == [
        (1, 2, "first"), ("line one", False), (2, 2, "second"), ("line two", False),
    ]  # fmt: skip
    said = work(tmp_path / "s", fake)
    assert fake.ran == ["first", "second"]
    assert said[1] == ("line one", True)
    work(tmp_path / "s", fake, again=True)
    assert fake.ran == ["first", "second"] * 2


def test_a_stage_goes_stale_with_what_it_reads(tmp_path, fake):
    work(tmp_path / "s", fake)
    cell = SessionFolder.open(tmp_path / "s").header["cell"]
    work(tmp_path / "s", fake, cell={**cell, "track_limit_mm": 2.0})
    assert fake.ran == ["first", "second"] * 2
    work(tmp_path / "s", fake, cell={**cell, "track_limit_mm": 2.0, "name": "x"})
    assert fake.ran == ["first", "second"] * 2
    work(tmp_path / "s", fake, seed=2)
    assert fake.ran == ["first", "second"] * 3


def test_a_damaged_file_is_made_again_by_run_and_named_by_a_verb(tmp_path, fake):
    work(tmp_path / "s", fake)
    (tmp_path / "s" / "first.json").write_text("damage")
    with pytest.raises(StorageError, match=r"'first' is needed first: first\.json was"):
        work(tmp_path / "s", fake, ["two"])
    work(tmp_path / "s", fake)
    # The same bytes come back, so what was made from them is still good.
    assert fake.ran == ["first", "second", "first"]


def test_a_verb_needs_the_stages_before_it(tmp_path, fake):
    with pytest.raises(StorageError, match="run: handeye-tri one"):
        work(tmp_path / "s", fake, ["two"])
    assert fake.ran == []
    assert not (tmp_path / "s").exists()


def test_what_the_machine_cannot_do_is_said_before_any_work(tmp_path, fake):
    def absent():
        raise MissingDependencyError("no OpenGL")

    fake.stages["second"] = Stage(
        "second", "two", (), ("first",), fake.second, preflight=absent
    )
    with pytest.raises(MissingDependencyError, match="no OpenGL"):
        work(tmp_path / "s", fake)
    assert fake.ran == []
    assert not (tmp_path / "s").exists()


def test_a_finished_stage_needs_no_preflight(tmp_path, fake):
    calls = []
    fake.stages["second"] = Stage(
        "second",
        "two",
        (),
        ("first",),
        fake.second,
        preflight=lambda: calls.append("asked"),
    )
    work(tmp_path / "s", fake)
    work(tmp_path / "s", fake)
    assert calls == ["asked"]


def test_a_failing_stage_leaves_the_ones_before_it_done(tmp_path, fake):
    def fail(run):
        raise HandEyeError("no")

    broken = Fake()
    broken.stages["second"] = Stage("second", "two", (), ("first",), fail)
    with pytest.raises(HandEyeError, match="no"):
        work(tmp_path / "s", broken)
    work(tmp_path / "s", fake)
    assert fake.ran == ["second"]


def test_a_stage_is_stale_when_what_it_reads_of_the_header_changes(tmp_path, fake):
    second = replace(fake.stages["second"], header_keys=("method",))
    fake.stages["second"] = second
    work(tmp_path / "x", fake)
    work(tmp_path / "x", fake, method="separate")
    assert fake.ran == ["first", "second", "second"]
    work(tmp_path / "x", fake)
    assert fake.ran == ["first", "second", "second"]
