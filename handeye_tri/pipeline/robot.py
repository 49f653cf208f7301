"""Systematic errors of a session's robot: as unknowns, and applied once found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from handeye_tri.adjustment import (
    RobotParameters,
    adjust,
    joint_offsets,
    link_corrections,
)
from handeye_tri.errors import InputError
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.pipeline.run import Run
from handeye_tri.records import CameraCalibration, HandEyeCalibration, Session
from handeye_tri.se3 import SE3, se3_inverse


def robot_parameters(run: Run) -> RobotParameters | None:
    """What the session's calibration is asked to estimate of its robot, None: nothing.

    Raises:
        InputError: it is asked for with a method or a session that cannot have it.
    """
    asked = run.robot_errors
    if not asked:
        return None
    if run.method != "joint":
        raise InputError(
            f"--robot {','.join(asked)} needs --method joint: step by step nothing "
            "tells errors of the robot from errors of the cameras"
        )
    if not run.has_robot:
        raise InputError(
            f"{run.folder.path}: --robot {','.join(asked)} needs a model of the robot "
            "and its joints at every station; this session has poses only"
        )
    arm = run.arm
    joints = np.array([station.joints for station in run.plan().stations])
    sets = []
    if "joint-offsets" in asked:
        sets.append(turning_offsets(run))
    if "link-corrections" in asked:
        bodies = [arm.mechanism.joints[k].body for k in arm.mechanism.arm_joints]
        links = arm.base_from_world.matrix @ arm.body_poses(joints)[:, bodies]
        whole = link_corrections(
            arm.joint_names, se3_inverse(arm.forward(joints))[:, None] @ links
        )
        # Where each link's end is; a slide's zero is among them.
        places = [f"{name}.{axis}" for name in arm.joint_names for axis in "xyz"]
        sets.append(whole.select(places))
    result = sets[0]
    for other in sets[1:]:
        result = result + other
    return result


def turning_offsets(run: Run) -> RobotParameters:
    """Offsets of the turning joints, where :attr:`Run.has_robot`."""
    arm = run.arm
    joints = np.array([station.joints for station in run.plan().stations])
    turning = [
        f"{name}.offset"
        for name, k in zip(arm.joint_names, arm.mechanism.arm_joints, strict=True)
        if arm.mechanism.joints[k].kind == "hinge"
    ]
    return joint_offsets(arm.joint_names, arm.jacobian(joints)).select(turning)


def calibrated_cell(
    run: Run, session: Session, cameras: CameraCalibration
) -> HandEyeCalibration:
    """The cell by the session's method, with those errors that it asks for.

    Raises:
        HandEyeError: it cannot be had from these data.
    """
    parameters = robot_parameters(run)
    result = calibrate_hand_eye(session, cameras)
    if run.method == "joint":
        return adjust(session, result, robot_parameters=parameters)
    return result


def with_robot_applied(
    run: Run, session: Session, hand_eye: HandEyeCalibration
) -> tuple[Session, HandEyeCalibration]:
    """The session as its robot would report it, had it none of the errors found.

    The calibration is the same with nothing left to apply.
    """
    parameters = robot_parameters(run)
    if parameters is None or not hand_eye.robot:
        return session, hand_eye
    chosen = parameters.select(tuple(hand_eye.robot))
    values = np.array(list(hand_eye.robot.values()))
    poses, _ = chosen.poses(session.base_from_flange, values)
    stations = tuple(
        replace(station, base_from_flange=SE3(pose))
        for station, pose in zip(session.stations, poses, strict=True)
    )
    return replace(session, stations=stations), replace(hand_eye, robot={})
