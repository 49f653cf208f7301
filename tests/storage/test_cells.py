from pathlib import Path

import pytest

from handeye_tri.errors import InputError
from handeye_tri.storage import find_cell, find_model, read_cell, shipped

SHIPPED = sorted(p.stem for p in shipped("scenes").glob("*.yaml"))


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_cell_reads_and_names_itself(name):
    path = find_cell(name)
    cell = read_cell(path)
    assert cell.name == name
    assert find_model(cell, path).is_file()


def test_unknown_cell_lists_what_there_is():
    with pytest.raises(InputError, match="no cell 'nothing'.*hp3_stereo"):
        find_cell("nothing")
    with pytest.raises(InputError, match=r"there is no such cell file"):
        find_cell("nothing.yaml")


def changed(tmp_path: Path, old: str, new: str) -> Path:
    text = find_cell("hp3_stereo").read_text()
    assert old in text
    path = tmp_path / "cell.yaml"
    path.write_text(text.replace(old, new, 1))
    return path


def test_a_model_may_stand_beside_the_cell(tmp_path):
    path = changed(tmp_path, "model: hp3_like.xml", "model: mine.xml")
    (tmp_path / "mine.xml").write_text("<mujoco/>")
    assert find_model(read_cell(path), path) == tmp_path / "mine.xml"
    (tmp_path / "mine.xml").unlink()
    with pytest.raises(InputError, match=r"arm\.model: no file 'mine\.xml'"):
        find_model(read_cell(path), path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("side_ab_mm:", "side_ab_m:", r"cell\.yaml: .*rig\.side_ab_m: this key is not"),
        ("half_turns: 11", "half_turns: 1", r"plan\.half_turns: .*got 1"),
        ("angle_deg: 65", "angle_deg: 0.2", "nearly collinear"),
        ("schema:", "schema: [", "not valid YAML"),
        ("name: hp3_stereo", "name: hp3_stereo\nname: twice", "not valid YAML"),
    ],
)
def test_a_bad_cell_names_file_and_key(tmp_path, old, new, message):
    path = changed(tmp_path, old, new)
    with pytest.raises(InputError, match=message) as caught:
        read_cell(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_not_text_and_not_a_mapping(tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="UTF-8"):
        read_cell(path)
    path.write_text("just words")
    with pytest.raises(InputError, match="mapping"):
        read_cell(path)
