import pytest

from handeye_tri.errors import InputError, StorageError
from handeye_tri.pipeline import Run, start


def test_start_writes_nothing_and_knows_what_it_is_about(tmp_path):
    folder = start("hp3_stereo", tmp_path / "out", 7, 5)
    assert not (tmp_path / "out").exists()
    assert folder.cell.name == "hp3_stereo"
    assert (folder.header["seed"], folder.header["half_turns"]) == (7, 5)
    assert folder.header["software"]["handeye-tri"] != "absent"
    assert start("hp3_stereo", tmp_path / "out", 7, None).header["half_turns"] == 11


def test_start_refuses_a_negative_seed_and_a_taken_folder(tmp_path):
    with pytest.raises(InputError, match="--seed must not be negative, got -1"):
        start("hp3_stereo", tmp_path / "out", -1, None)
    (tmp_path / "x").write_text("x")
    with pytest.raises(StorageError, match="holds something else"):
        start("hp3_stereo", tmp_path, 1, None)


def test_a_session_read_back_after_its_cell_moved_still_knows_it(tmp_path):
    folder = start("hp3_stereo", tmp_path / "out", 7, 5)
    with folder.locked():
        folder.save()
    again = start("hp3_stereo", tmp_path / "out", 7, 5)
    assert again.header == folder.header


class Silent:
    """Progress of nobody."""

    def begin(self, number, total, stage):
        pass

    def advance(self, done, total):
        pass

    def end(self, line, seconds):
        pass


def test_a_session_is_calibrated_jointly_unless_it_says_otherwise(tmp_path):
    folder = start("hp3_stereo", tmp_path / "out", 7, 5)
    assert Run(folder, Silent()).method == "joint"
    folder.header["method"] = "separate"
    assert Run(folder, Silent()).method == "separate"
    folder.header["method"] = "guess"
    with pytest.raises(StorageError, match="one of joint, separate, got 'guess'"):
        _ = Run(folder, Silent()).method
