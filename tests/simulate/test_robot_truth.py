"""The simulated robot misses by its repeatability; the truth knows."""

from __future__ import annotations

import numpy as np
import pytest
from small_cell import HP3, shipped, with_arm

from handeye_tri.arm import Arm
from handeye_tri.errors import InputError
from handeye_tri.records import Plan, Repeatability, Station
from handeye_tri.se3 import SE3, se3_inverse, se3_log
from handeye_tri.simulate import compile_mechanism, execute, ground_truth


def plan_of(arm: Arm, joints: np.ndarray) -> Plan:
    stations = tuple(
        Station(k, "calibration", q, SE3(arm.forward(q))) for k, q in enumerate(joints)
    )
    return Plan(stations, (), {}, {}, 0, "PASS", ())


def test_the_robot_misses_by_its_repeatability() -> None:
    arm = Arm(compile_mechanism(shipped("hp3_stereo"), HP3))
    rng = np.random.default_rng(2)
    home = np.array([0.1, 0.2, -0.5, 0.4, 0.9, -0.3])
    joints = home + rng.uniform(-0.2, 0.2, (150, 6))
    plan = plan_of(arm, joints)
    repeatability = Repeatability(3e-5, 1e-4)
    executed = execute(arm, plan, repeatability, 1)
    tangents = se3_log(se3_inverse(arm.forward(joints)) @ arm.forward(executed))
    scaled = tangents / np.repeat([3e-5, 1e-4], 3)
    # Four standard errors of a mean and of a standard deviation of 150 draws.
    assert np.abs(scaled.mean(axis=0)).max() < 4 / np.sqrt(150)
    assert np.abs(scaled.std(axis=0) - 1).max() < 4 / np.sqrt(300)
    np.testing.assert_array_equal(executed, execute(arm, plan, repeatability, 1))
    assert (executed != execute(arm, plan, repeatability, 2)).any()
    # A station's draw does not depend on the stations before it.
    few = execute(arm, plan_of(arm, joints[:3]), repeatability, 1)
    np.testing.assert_allclose(few, executed[:3], atol=1e-12)


def test_an_exact_robot_goes_where_it_is_told() -> None:
    arm = Arm(compile_mechanism(shipped("hp3_stereo"), HP3))
    joints = np.array([[0.1, 0.2, -0.5, 0.4, 0.9, -0.3]])
    executed = execute(arm, plan_of(arm, joints), Repeatability(0.0, 0.0), 1)
    np.testing.assert_allclose(executed, joints, atol=1e-12)


def test_a_plan_of_another_arm_is_refused() -> None:
    arm = Arm(compile_mechanism(shipped("hp3_stereo"), HP3))
    station = Station(0, "calibration", np.zeros(7), SE3.identity())
    plan = Plan((station,), (), {}, {}, 0, "PASS", ())
    with pytest.raises(InputError, match="7 joints, the arm has 6"):
        execute(arm, plan, Repeatability(0.0, 0.0), 1)


def test_the_truth_is_in_the_base_frame() -> None:
    cell = with_arm(position_m=(0.1, 0.2, 0.3))
    arm = Arm(compile_mechanism(cell, HP3))
    joints = np.array([[0.1, 0.2, -0.5, 0.4, 0.9, -0.3]])
    truth = ground_truth(cell, arm, joints)
    np.testing.assert_allclose(truth.base_from_flange, arm.forward(joints))
    for config, camera, pose in zip(
        cell.cameras, truth.cameras, truth.base_from_camera, strict=True
    ):
        assert camera.name == config.name
        np.testing.assert_allclose(
            pose.translation, np.subtract(config.position_m, (0.1, 0.2, 0.3))
        )
    markers = truth.flange_from_triangle.apply(cell.rig.triangle.points)
    np.testing.assert_allclose(
        SE3(truth.base_from_flange[0]).apply(markers), arm.marker_positions(joints)[0]
    )


def test_the_truth_knows_how_each_mount_holds_the_triangle() -> None:
    cell = shipped("hp3_stereo_both")
    arms = [Arm(compile_mechanism(alone, HP3)) for alone in cell.mounted]
    joints = np.array([[0.1, 0.2, -0.5, 0.4, 0.9, -0.3]])
    truth = ground_truth(cell, arms[0], joints)
    (other,) = truth.other_mounts
    np.testing.assert_allclose(
        SE3(truth.base_from_flange[0]).apply(other.markers),
        arms[1].marker_positions(joints)[0],
    )
    np.testing.assert_allclose(
        other.flange_from_triangle.apply(cell.rig.triangle.points), other.markers
    )
    assert ground_truth(cell.mounted[0], arms[0], joints).other_mounts == ()
