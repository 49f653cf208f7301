"""Where the cameras stand in the robot's base, and how the rig sits on its flange."""

from handeye_tri.hand_eye.absolute import ABSOLUTE_METHODS, solve_axzb
from handeye_tri.hand_eye.calibrate import calibrate_hand_eye
from handeye_tri.hand_eye.hypotheses import Reading, free_scale_of, solve_readings
from handeye_tri.hand_eye.motions import relative_motions
from handeye_tri.hand_eye.pose_solution import PoseSolution, Undetermined
from handeye_tri.hand_eye.relative import RELATIVE_METHODS, solve_axxb
from handeye_tri.hand_eye.solve_pairs import (
    PAIR_METHODS,
    PairMethod,
    solve_pose_pairs,
)
from handeye_tri.hand_eye.target_views import (
    TargetAdjustment,
    TargetViews,
    adjust_target_views,
    target_views,
)

__all__ = [
    "ABSOLUTE_METHODS",
    "PAIR_METHODS",
    "RELATIVE_METHODS",
    "PairMethod",
    "PoseSolution",
    "Reading",
    "TargetAdjustment",
    "TargetViews",
    "Undetermined",
    "adjust_target_views",
    "calibrate_hand_eye",
    "free_scale_of",
    "relative_motions",
    "solve_axxb",
    "solve_axzb",
    "solve_pose_pairs",
    "solve_readings",
    "target_views",
]
