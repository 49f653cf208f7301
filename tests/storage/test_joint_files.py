from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handeye_tri.errors import HandEyeError, InputError
from handeye_tri.storage import read_joint_list, write_joint_list

NAMES = ("s", "l", "rail")
SLIDES = np.array([False, False, True])
GOOD = "s_deg,rail_mm,l_rad\n90,250,0.5\n\n-90,0,-0.5\n"


def written(tmp_path, text):
    path = tmp_path / "stations.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_units_and_columns_are_taken_by_name(tmp_path):
    joints, mounts = read_joint_list(written(tmp_path, GOOD), NAMES, SLIDES)
    assert not mounts.any()
    np.testing.assert_allclose(
        joints, [[np.pi / 2, 0.5, 0.25], [-np.pi / 2, -0.5, 0.0]]
    )


def test_what_is_written_is_read_again(tmp_path):
    joints = np.random.default_rng(0).normal(size=(5, 3))
    path = tmp_path / "out.csv"
    write_joint_list(path, NAMES, SLIDES, joints)
    assert path.read_text().splitlines()[0] == "s_deg,l_deg,rail_mm"
    read, _ = read_joint_list(path, NAMES, SLIDES)
    np.testing.assert_allclose(read, joints, rtol=1e-14)


def test_mounts_that_are_written_are_read_again(tmp_path):
    joints = np.random.default_rng(0).normal(size=(4, 3))
    path = tmp_path / "out.csv"
    write_joint_list(path, NAMES, SLIDES, joints, np.array([1, 1, 0, 0]))
    lines = path.read_text().splitlines()
    assert [line.rsplit(",", 1)[1] for line in lines] == ["mount", *"2211"]
    read, mounts = read_joint_list(path, NAMES, SLIDES, 2)
    np.testing.assert_allclose(read, joints, rtol=1e-14)
    assert mounts.tolist() == [1, 1, 0, 0]


def with_mounts(*values):
    lines = ["s_deg,l_deg,rail_m,mount", *(f"1,2,3,{value}" for value in values)]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("text", "mounts", "message"),
    [
        (GOOD, 2, "line 1 must have one column mount, since the cell has 2 mounts"),
        (with_mounts(1, 2), 1, "line 3, mount: '2' is none of the cell's mounts; it "),
        (with_mounts(1, 3), 2, "line 3, mount: '3' is none of"),
        (with_mounts(0, 1), 2, "line 2, mount: '0' is none of"),
        (with_mounts(1, ""), 2, "line 3, mount: '' is none of"),
        (with_mounts(1, 2, 1), 2, "the mount changes in lines 3, 4, but a programme"),
        (
            "s_deg,l_deg,rail_m,mount,mount\n1,2,3,1,1\n",
            1,
            "line 1 must have one column mount, since the cell has 1 mount",
        ),
    ],
)
def test_wrong_mounts_are_refused_by_line(tmp_path, text, mounts, message):
    with pytest.raises(InputError, match="stations.csv") as caught:
        read_joint_list(written(tmp_path, text), NAMES, SLIDES, mounts)
    assert message in str(caught.value)


def test_a_cell_with_one_mount_may_say_so(tmp_path):
    path = written(tmp_path, with_mounts(1, 1))
    assert read_joint_list(path, NAMES, SLIDES)[1].tolist() == [0, 0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("s,l,rail\n1,2,3\n", "one column for joint s, s_deg or s_rad; it has s, l"),
        ("s_deg,s_rad,l_deg,rail_m\n", "it has s_deg, s_rad"),
        ("s_deg,l_deg\n1,2\n3,4\n", "joint rail, rail_mm or rail_m"),
        ("s_deg,l_deg,rail_deg\n1,2,3\n", "joint rail, rail_mm or rail_m"),
        ("s_deg,l_deg,rail_m,t_deg\n1,2,3,4\n", "no joint of the arm: t_deg"),
        (GOOD.replace("250", "much"), "line 2, rail_mm: 'much' is no finite number"),
        (GOOD.replace("250", "nan"), "line 2, rail_mm: 'nan' is no finite number"),
        (GOOD.replace(",-0.5", ""), "line 4, l_rad: '' is no finite number"),
        ("s_deg,l_deg,rail_m\n1,2,3\n", "holds 1 station, needs at least 2"),
        (b"\xff\xfe\x00s", "byte 0 is no UTF-8 text"),
    ],
)
def test_wrong_files_are_refused_by_line_and_column(tmp_path, text, message):
    with pytest.raises(InputError, match="stations.csv") as caught:
        read_joint_list(written(tmp_path, text), NAMES, SLIDES)
    assert message in str(caught.value)


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_end_in_numbers_or_a_sentence(tmp_path_factory, data):
    path = written(tmp_path_factory.mktemp("fuzz"), data)
    try:
        joints, _ = read_joint_list(path, NAMES, SLIDES)
    except HandEyeError as error:
        said = str(error)
    else:
        said = "stations.csv"
        assert np.isfinite(joints).all()
    assert "stations.csv" in said
