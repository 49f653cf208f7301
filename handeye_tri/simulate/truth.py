"""What the simulated robot truly does, beside what it reports."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from handeye_tri.errors import InputError
from handeye_tri.records import Floats, GroundTruth, Mount, Plan, Repeatability

if TYPE_CHECKING:
    from handeye_tri.arm import Arm
    from handeye_tri.config import Cell

# Name of the random stream; that of the sensor is another.
_ROBOT_STREAM = 101


def execute(arm: Arm, plan: Plan, repeatability: Repeatability, seed: int) -> Floats:
    """Where the robot truly goes when it is told to follow a plan.

    The robot reports the commanded pose; it stands at commanded @ exp(xi), xi
    normal with the repeatability as its standard deviation, one draw per station.

    Returns:
        Joints, shape (stations, q), rad or m.

    Raises:
        InputError: the plan's stations carry no joints of this arm.
    """
    sigma = np.repeat([repeatability.translation, repeatability.rotation], 3)
    tangents = []
    for station in plan.stations:
        if station.joints.shape != arm.home.shape:
            raise InputError(
                f"station {station.index} of the plan has {station.joints.size} "
                f"joints, the arm has {arm.home.size}; plan again for this arm"
            )
        rng = np.random.default_rng([seed, _ROBOT_STREAM, station.index])
        tangents.append(sigma * rng.standard_normal(6))
    commanded = np.array([station.joints for station in plan.stations])
    return arm.perturbed(commanded, tangents)


def ground_truth(cell: Cell, arm: Arm, joints: ArrayLike) -> GroundTruth:
    """The truth of a simulated cell in the robot's base frame.

    Args:
        cell: True cameras, where they stand, and how the rig is held.
        arm: The robot.
        joints: Executed joints, shape (n, q), rad or m.
    """
    points = cell.rig.triangle.points
    first, *others = (
        Mount(motion, motion.apply(points))
        for motion in (alone.rig.flange_from_triangle for alone in cell.mounted)
    )
    return GroundTruth(
        cameras=tuple(camera.camera for camera in cell.cameras),
        base_from_camera=tuple(
            arm.base_from_world @ camera.world_from_camera for camera in cell.cameras
        ),
        flange_from_triangle=first.flange_from_triangle,
        base_from_flange=arm.forward(joints),
        markers=first.markers,
        other_mounts=tuple(others),
    )
