"""What a URDF must say of the arm's joints and meshes."""

from __future__ import annotations

import re

import numpy as np
import pytest
from small_cell import DATA, with_arm

from handeye_tri.arm import Arm
from handeye_tri.errors import InputError
from handeye_tri.simulate import compile_mechanism

ARM = (DATA / "small_arm.urdf").read_text()
CELL = with_arm(flange="tool0")
ELBOW = '<limit lower="-2.5" upper="2.5" velocity="2" effort="10"/>'
EXTEND = '<limit lower="0" upper="0.08" velocity="0.4" effort="10"/>'
BOX = '<box size="0.2 0.2 0.1"/>'


def compiled(tmp_path, old, new):
    assert ARM.count(old) == 1
    path = tmp_path / "arm.urdf"
    path.write_text(ARM.replace(old, new))
    return compile_mechanism(CELL, path)


def test_limits_and_speeds_are_those_of_the_file():
    arm = Arm(compile_mechanism(CELL, DATA / "small_arm.urdf"))
    inf = np.inf
    np.testing.assert_allclose(arm.lower, (-3, -2, -2.5, -inf, -2, 0))
    np.testing.assert_allclose(arm.upper, (3, 2.2, 2.5, inf, 2, 0.08))
    np.testing.assert_allclose(arm.speed, (2.5, 2, 2, 1, 3, 0.4))
    assert arm.without_speed == ("roll_joint",)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (ELBOW, "", r"'elbow' is revolute and states no lower and no upper limit; .*"),
        (ELBOW, '<limit upper="1"/>', r"states no lower limit; .* in rad, or make it"),
        (EXTEND, "", r"'extend' is prismatic and states no lower .* in m$"),
        (ELBOW, '<limit lower="2" upper="-2"/>', r"'2' must be a number below .* '-2'"),
        (ELBOW, '<limit lower="0" upper="0"/>', r"'0' must be a number below the"),
        (
            ELBOW,
            '<limit lower="low" upper="0"/>',
            r"limit 'low' must be a number",
        ),
        ('velocity="0.4"', 'velocity="0"', r"'extend': its speed must be a positive"),
        ('velocity="0.4"', 'velocity="-1"', r"'extend': its speed .* got '-1'"),
        ('velocity="0.4"', 'velocity="fast"', r"'extend': its speed .* got 'fast'"),
        ('"continuous"', '"floating"', r"'roll_joint' is floating; between base and"),
        ('"continuous"', '"planar"', r"'roll_joint' is planar; between base and"),
        (
            BOX,
            '<mesh filename="package://arm/base.stl"/>',
            r"are not searched",
        ),
        (BOX, '<mesh filename="base.dae"/>', r"convert it to one of .stl, .obj, .msh"),
        (BOX, '<mesh filename="base.stl"/>', r"'base.stl' is not at .*/base.stl; put"),
    ],
)
def test_what_is_missing_is_named_with_what_to_do(tmp_path, old, new, said):
    with pytest.raises(InputError, match=r"^.*arm\.urdf: .*" + said):
        compiled(tmp_path, old, new)


def test_masses_and_what_the_flange_does_not_ride_on_may_be_missing(tmp_path):
    text, count = re.subn("<inertial>.*</inertial>", "", ARM)
    assert count == 6
    grip = '<joint name="grip" type="prismatic"><parent link="tool0"/>'
    grip += '<child link="finger"/></joint><link name="finger"/>'
    path = tmp_path / "arm.urdf"
    path.write_text(text.replace("</robot>", grip + "</robot>"))
    assert len(Arm(compile_mechanism(CELL, path)).joint_names) == 6
