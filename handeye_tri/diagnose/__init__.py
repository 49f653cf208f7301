"""Is a calibration fit for use, how is that known, and what is wrong if not."""

from handeye_tri.diagnose.assess import assess, free_scale, radius_95
from handeye_tri.diagnose.gates import Finding, Gate, Verdict, judge
from handeye_tri.diagnose.pose_pairs import assess_pose_pairs

__all__ = [
    "Finding",
    "Gate",
    "Verdict",
    "assess",
    "assess_pose_pairs",
    "free_scale",
    "judge",
    "radius_95",
]
