"""The same arm as MJCF and as URDF, from the cell's file to the plan."""

from __future__ import annotations

import json

import numpy as np
import planning_scene as scene
import pytest
from arm_as_urdf import write_urdf

from handeye_tri import cli
from handeye_tri.arm import Arm
from handeye_tri.simulate import compile_mechanism


def test_a_urdf_is_planned_for_as_the_same_arm_in_mjcf(tmp_path):
    path = tmp_path / "arm.urdf"
    write_urdf(scene.compiled(scene.cell_of("hp3_stereo")), path)
    text = (scene.REPO / "scenes" / "hp3_stereo.yaml").read_text()
    assert text.count("hp3_like.xml") == 1
    (tmp_path / "cell.yaml").write_text(text.replace("hp3_like.xml", "arm.urdf"))
    with pytest.raises(SystemExit) as left:
        cli.main(["plan", str(tmp_path / "out"), "--cell", str(tmp_path / "cell.yaml"),
                  "--seed", "1"])  # fmt: skip
    assert not left.value.code
    plan = json.loads((tmp_path / "out" / "plan.json").read_text())
    expected = scene.plan_of("hp3_stereo", 1)
    np.testing.assert_allclose(
        [station["joints_rad_or_m"] for station in plan["stations"]],
        [station.joints for station in expected.stations],
        atol=1e-9,
    )
    assert plan["certificate"] == pytest.approx(dict(expected.certificate), rel=1e-6)


@pytest.mark.parametrize("seven", [False, True])
def test_limits_speeds_and_kinematics_are_equal(tmp_path, seven):
    cell = scene.cell_of("hp3_stereo")
    model = scene.seven_joints(tmp_path) if seven else scene.MODEL
    one = Arm(compile_mechanism(cell, model))
    write_urdf(one.mechanism, tmp_path / "arm.urdf")
    other = Arm(compile_mechanism(cell, tmp_path / "arm.urdf"))
    assert other.joint_names == one.joint_names
    assert len(one.joint_names) == 6 + seven
    for key in ("lower", "upper", "speed", "home", "slides"):
        np.testing.assert_allclose(getattr(other, key), getattr(one, key), atol=1e-12)
    rng = np.random.default_rng(0)
    joints = rng.uniform(one.lower, one.upper, (200, len(one.lower)))
    np.testing.assert_allclose(other.forward(joints), one.forward(joints), atol=1e-9)
    if seven:
        # MJCF excludes neighbours across a joint in between; URDF cannot.
        return
    touching = [arm.collision(q) is None for arm in (one, other) for q in joints]
    assert touching[:200] == touching[200:]
    assert 20 < sum(touching[:200]) < 180
