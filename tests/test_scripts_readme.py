"""What scripts/README.md says of pose files is what `handeye-tri solve` does."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from handeye_tri import cli
from handeye_tri.errors import InputError
from handeye_tri.storage import read_pose_pairs

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"
TEXT = (SCRIPTS / "README.md").read_text()
PAIRS, STREAMS = re.findall(r"```json\n(.*?)```", TEXT, re.DOTALL)[:2]
SHOWN = re.search(r"```text\n(.*?)```", TEXT, re.DOTALL).group(1)


def table(head):
    """Rows of a table: the cell of the key, and what is said of it."""
    text = TEXT[TEXT.index(head) :].split("\n\n")[0]
    return re.findall(r"^\| (`.*?) \| (.*) \|$", text, re.MULTILINE)


KEYS, OF_A_POSE = table("| key | value |"), table("| key of a pose | value |")


def words(text):
    return re.findall(r"`(\w+)`", text)


def test_the_example_is_solved_as_shown(capsys, tmp_path):
    path = tmp_path / "poses.json"
    path.write_text(PAIRS)
    with pytest.raises(SystemExit) as left:
        cli.main(["solve", str(path)])
    printed = capsys.readouterr().out.splitlines()
    assert left.value.code == 0
    for line in SHOWN.splitlines():
        assert line in printed


def test_the_example_of_streams_is_read(tmp_path):
    path = tmp_path / "streams.json"
    path.write_text(STREAMS)
    pairs = read_pose_pairs(path)
    assert pairs.timed
    np.testing.assert_allclose(pairs.observed_times, (86.533, 86.566, 86.6))


def test_keys_are_all_there_are(tmp_path):
    named = {word for key, _ in KEYS for word in words(key)}
    path = tmp_path / "poses.json"
    path.write_text(json.dumps({**json.loads(PAIRS), "surplus": 1}))
    with pytest.raises(InputError) as caught:
        read_pose_pairs(path)
    known = re.search(r"known are (.*)", str(caught.value)).group(1)
    assert named == set(known.split(", "))
    data = json.loads(PAIRS)
    data["pairs"][0]["robot"]["surplus"] = 1
    path.write_text(json.dumps(data))
    with pytest.raises(InputError) as caught:
        read_pose_pairs(path)
    known = re.search(r"known are (.*)", str(caught.value)).group(1)
    of_a_pose = {word for key, _ in OF_A_POSE for word in words(key)}
    assert of_a_pose | {"name"} == set(known.split(", "))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        (words(key)[0], value)
        for key, text in KEYS
        for value in words(text)
        if words(key)[0] in ("mounting", "robot_poses", "observed_poses", "target_size")
        and value != "solvePnP"
    ],
)
def test_values_are_taken(tmp_path, key, value):
    path = tmp_path / "poses.json"
    path.write_text(json.dumps({**json.loads(PAIRS), key: value}))
    assert len(read_pose_pairs(path).names) == 8
