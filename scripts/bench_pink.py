"""Peers of row 10 of `bench.py`; runs in their environment, without handeye_tri."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

SOLVER = "quadprog"
TOLERANCE = 1e-6
# From near, almost every target takes 3 to 6 steps.
MOST_STEPS = 30


def pink(
    placements: Any, flange: Any, limits: Any, targets: Any, starts: Any
) -> Callable[[], Any]:
    """Differential inverse kinematics of Pinocchio, whole steps, until it arrives.

    Args:
        placements: Of each hinge, about z, in the one before, (q, 4, 4), metres.
        flange: In the last, (4, 4).
        limits: Of the joints, (2, q), rad.
        targets: base_from_flange, (n, 4, 4).
        starts: Joints to start from, (n, q).

    Returns:
        A call that returns joints and which of them arrived.
    """
    import pinocchio as pin
    from pink import Configuration, solve_ik
    from pink.tasks import FrameTask

    model, joint = pin.Model(), 0
    for number, (placement, lower, upper) in enumerate(
        zip(placements, *limits, strict=True)
    ):
        joint = model.addJoint(
            joint,
            pin.JointModelRZ(),
            pin.SE3(placement),
            str(number),
            np.array([1e3]),
            np.array([1e3]),
            np.array([lower]),
            np.array([upper]),
        )
    kind = pin.FrameType.OP_FRAME
    model.addFrame(pin.Frame("flange", joint, 0, pin.SE3(flange), kind))
    configuration = Configuration(model, model.createData(), starts[0])
    task = FrameTask("flange", position_cost=1.0, orientation_cost=1.0)
    poses = [pin.SE3(target) for target in targets]

    def step() -> None:
        velocity = solve_ik(
            configuration, [task], 1.0, solver=SOLVER, safety_break=False
        )
        configuration.integrate_inplace(velocity, 1.0)

    return _until_there(configuration, task, step, poses, starts)


def mink(
    placements: Any, flange: Any, limits: Any, targets: Any, starts: Any
) -> Callable[[], Any]:
    """The same on MuJoCo; see :func:`pink`."""
    import mujoco
    from mink import SE3, Configuration, ConfigurationLimit, FrameTask, solve_ik

    def place(pose: Any) -> str:
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(pose[:3, :3]).ravel())
        words = [
            " ".join(repr(float(value)) for value in values)
            for values in (pose[:3, 3], quaternion)
        ]
        return 'pos="{}" quat="{}"'.format(*words)

    xml = f'<site name="flange" {place(flange)}/>'
    for placement, lower, upper in reversed(
        list(zip(placements, *limits, strict=True))
    ):
        xml = (
            f'<body {place(placement)}><joint axis="0 0 1" limited="true" '
            f'range="{float(lower)!r} {float(upper)!r}"/>'
            f'<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>{xml}</body>'
        )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><worldbody>{xml}</worldbody></mujoco>'
    )
    configuration = Configuration(model, starts[0])
    task = FrameTask("flange", "site", position_cost=1.0, orientation_cost=1.0)
    bounds = [ConfigurationLimit(model)]
    poses = [SE3.from_matrix(target) for target in targets]

    def step() -> None:
        velocity = solve_ik(configuration, [task], 1.0, SOLVER, limits=bounds)
        configuration.integrate_inplace(velocity, 1.0)

    return _until_there(configuration, task, step, poses, starts)


def _until_there(
    configuration: Any,
    task: Any,
    step: Callable[[], None],
    poses: list[Any],
    starts: Any,
) -> Callable[[], Any]:
    def solve() -> Any:
        joints, there = np.empty_like(starts), np.zeros(len(starts), dtype=bool)
        for k, (pose, start) in enumerate(zip(poses, starts, strict=True)):
            configuration.update(start)
            task.set_target(pose)
            for _ in range(MOST_STEPS):
                if np.abs(task.compute_error(configuration)).max() < TOLERANCE:
                    there[k] = True
                    break
                step()
            joints[k] = configuration.q
        return joints, there

    return solve
