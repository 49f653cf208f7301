"""Is a calibration fit for use, how is that known, and what is wrong if not."""

from handeye_tri.diagnose.assess import assess, free_scale, radius_95
from handeye_tri.diagnose.gates import Finding, Gate, Verdict, judge
from handeye_tri.diagnose.pose_pairs import assess_pose_pairs
from handeye_tri.diagnose.session_causes import Evidence, session_causes, with_causes
from handeye_tri.diagnose.uncalibrated import uncalibrated_verdict, why_uncalibrated

__all__ = [
    "Evidence",
    "Finding",
    "Gate",
    "Verdict",
    "assess",
    "assess_pose_pairs",
    "free_scale",
    "judge",
    "radius_95",
    "session_causes",
    "uncalibrated_verdict",
    "why_uncalibrated",
    "with_causes",
]
