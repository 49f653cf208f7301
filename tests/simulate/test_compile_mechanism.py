"""Any arm becomes a mechanism; what cannot is one sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_cell import DATA, HP3, shipped, with_arm

from handeye_tri.arm import Arm
from handeye_tri.errors import InputError
from handeye_tri.se3 import SE3
from handeye_tri.simulate import compile_mechanism


def test_the_hp3_keeps_its_published_reach() -> None:
    arm = Arm(compile_mechanism(shipped("hp3_stereo"), HP3))
    home = np.zeros(6)
    flange = arm.forward(home)
    np.testing.assert_allclose(flange[:3, 3], (0.49, 0.0, 0.675), atol=1e-12)
    np.testing.assert_allclose(flange[:3, 2], (1, 0, 0), atol=1e-12)
    # Stretched out to the wrist: lower arm and the elbow's offset in one line.
    stretched = np.array([0, np.pi / 2, np.arctan2(0.3, 0.085), 0, 0, 0])
    wrist = arm.body_poses(stretched)[arm.mechanism.flange_body - 1]
    reach = 0.1 + 0.29 + np.hypot(0.3, 0.085)
    assert reach == pytest.approx(0.7018, abs=5e-5)
    np.testing.assert_allclose(wrist[:3, 3], (reach, 0, 0.3), atol=1e-12)
    speeds = [joint.speed for joint in arm.mechanism.joints]
    np.testing.assert_allclose(np.degrees(speeds), (200, 150, 190, 300, 300, 420))


def test_the_base_stands_where_the_cell_says() -> None:
    cell = shipped("hp3_stereo")
    moved = cell.model_copy(
        update={"arm": cell.arm.model_copy(update={"position_m": (0.1, 0.2, 0.3)})}
    )
    arm = Arm(compile_mechanism(moved, HP3))
    np.testing.assert_allclose(
        arm.base_from_world.matrix, SE3.exp((-0.1, -0.2, -0.3, 0, 0, 0)).matrix
    )


def test_what_the_cell_adds_is_in_the_mechanism() -> None:
    cell = shipped("hp3_stereo")
    mechanism = compile_mechanism(cell, HP3)
    solids = {solid.name: solid for solid in mechanism.geometries}
    table = solids["cell/table"]
    np.testing.assert_allclose(table.size, (0.9, 0.6, 0.02))
    assert table.collides
    for k, letter in enumerate("ABC"):
        ball = solids[f"rig/marker {letter}"]
        assert ball.body == mechanism.marker_body
        np.testing.assert_allclose(
            ball.body_from_geometry.translation, mechanism.markers[k], atol=1e-15
        )
        np.testing.assert_allclose(ball.rgba[:3], cell.rig.marker_colours[k])
    sides = mechanism.markers[[1, 2]] - mechanism.markers[0]
    np.testing.assert_allclose(np.linalg.norm(sides, axis=1), (0.13, 0.12))
    for config in cell.cameras:
        # Behind the optical centre: never in its own view.
        for part in ("lens", "body"):
            housing = solids[f"cell/camera {config.name} {part}"]
            depth = (
                config.world_from_camera.inverse() @ housing.body_from_geometry
            ).translation[2]
            reach = housing.size[-1]
            assert depth + reach < 0
    touching = {
        frozenset(mechanism.bodies[k].name for k in pair) for pair in mechanism.touching
    }
    assert frozenset({"link_s", "link_l"}) in touching


def test_unknown_frames_are_listed() -> None:
    with pytest.raises(InputError, match=r"arm\.flange.*'tool9'.*link_t.*sites flange"):
        compile_mechanism(with_arm(flange="tool9"), HP3)
    with pytest.raises(InputError, match=r"arm\.base.*'floor'.*base, link_s"):
        compile_mechanism(with_arm(base="floor"), HP3)


def test_a_base_must_stand_still_and_carry_the_flange() -> None:
    with pytest.raises(InputError, match="'link_l' moves.*link_s, link_l"):
        compile_mechanism(with_arm(base="link_l"), HP3)
    cell = with_arm(base="shelf", flange="tool")
    with pytest.raises(InputError, match="'shelf' does not carry the flange 'tool'"):
        compile_mechanism(cell, DATA / "seven_joints.xml")


MODEL = "<mujoco><worldbody><body name='b'>{}</body></worldbody></mujoco>"
BAD_FILES = {
    "free": (
        MODEL.format("<freejoint name='fly'/><geom size='1'/>"),
        "'fly' is a free",
    ),
    "ball": (
        MODEL.format("<joint name='hip' type='ball'/><geom size='1'/>"),
        "'hip' is a ball",
    ),
    "field": (
        "<mujoco><asset><hfield name='h' nrow='2' ncol='2' size='1 1 1 1'/></asset>"
        "<worldbody><geom type='hfield' hfield='h'/><body name='b'>"
        "<joint/><geom size='1'/></body></worldbody></mujoco>",
        "height field",
    ),
    "mesh": (
        "<mujoco><asset><mesh name='m' file='gone.stl'/></asset>"
        "<worldbody><body name='b'><geom type='mesh' mesh='m'/></body></worldbody>"
        "</mujoco>",
        "gone.stl",
    ),
    "syntax": ("<mujoco><worldbody>", "cannot read"),
    "text": ("a robot", "cannot read"),
    "empty": ("", "cannot read"),
    "world only": ("<mujoco/>", "no body or site 'b'"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_model_is_one_sentence(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text, message = BAD_FILES[name]
    path = tmp_path / "arm.xml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        compile_mechanism(with_arm(flange="b"), path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    # MuJoCo leaves no log behind.
    assert [p.name for p in tmp_path.iterdir()] == ["arm.xml"]


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere.xml"):
        compile_mechanism(with_arm(), tmp_path / "nowhere.xml")
