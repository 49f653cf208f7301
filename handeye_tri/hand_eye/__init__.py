"""Where the cameras stand in the robot's base, and how the rig sits on its flange."""

from handeye_tri.hand_eye.absolute import ABSOLUTE_METHODS, solve_axzb
from handeye_tri.hand_eye.calibrate import calibrate_hand_eye
from handeye_tri.hand_eye.motions import relative_motions
from handeye_tri.hand_eye.relative import RELATIVE_METHODS, solve_axxb

__all__ = [
    "ABSOLUTE_METHODS",
    "RELATIVE_METHODS",
    "calibrate_hand_eye",
    "relative_motions",
    "solve_axxb",
    "solve_axzb",
]
