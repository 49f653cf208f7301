"""One adjustment of everything: cameras, their places, markers, robot poses."""

from handeye_tri.adjustment.joint import adjust
from handeye_tri.adjustment.robot import (
    RobotParameters,
    clock_offset,
    joint_offsets,
    link_corrections,
)
from handeye_tri.adjustment.robust import Loss

__all__ = [
    "Loss",
    "RobotParameters",
    "adjust",
    "clock_offset",
    "joint_offsets",
    "link_corrections",
]
