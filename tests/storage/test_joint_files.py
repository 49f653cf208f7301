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
    joints = read_joint_list(written(tmp_path, GOOD), NAMES, SLIDES)
    np.testing.assert_allclose(
        joints, [[np.pi / 2, 0.5, 0.25], [-np.pi / 2, -0.5, 0.0]]
    )


def test_what_is_written_is_read_again(tmp_path):
    joints = np.random.default_rng(0).normal(size=(5, 3))
    path = tmp_path / "out.csv"
    write_joint_list(path, NAMES, SLIDES, joints)
    assert path.read_text().splitlines()[0] == "s_deg,l_deg,rail_mm"
    np.testing.assert_allclose(read_joint_list(path, NAMES, SLIDES), joints, rtol=1e-14)


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
        joints = read_joint_list(path, NAMES, SLIDES)
    except HandEyeError as error:
        said = str(error)
    else:
        said = "stations.csv"
        assert np.isfinite(joints).all()
    assert "stations.csv" in said
