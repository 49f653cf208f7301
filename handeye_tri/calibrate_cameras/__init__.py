"""Stage 4: cameras from the three markers.

One camera from half-turns of the triangle (Zhao, Liu and Zhang 2008,
doi:10.1109/TIP.2008.2005562, Sec. III): special_motion (III-A, B, C), homography and
closed_form (the same constraints, whitened), extrinsics (III-D), refine (III-E),
degeneracy (III-F), outliers (outlier_tests, outlier_reasons, turn_angle), lens_verdict
and lens_selection; trials (the same for many independent sets at once). Several cameras
from any motions (Appendix A): general_motion, with projective, metric_upgrade and
focal_sweep for its starts. Several cameras that saw half-turns: bundle (all of
them and the triangle's poses adjusted together), eccentricity (of a sphere's outline),
session_camera (one of them alone, without bad half-turns), session (every step in
order). Flat targets of many points, as a chessboard: target_views.
"""

from handeye_tri.calibrate_cameras.general_motion import calibrate_cameras_general
from handeye_tri.calibrate_cameras.session import calibrate_session_cameras
from handeye_tri.calibrate_cameras.single_camera import calibrate_camera
from handeye_tri.calibrate_cameras.target_views import calibrate_target_views
from handeye_tri.calibrate_cameras.trials import TrialCalibrations, calibrate_trials

__all__ = [
    "TrialCalibrations",
    "calibrate_camera",
    "calibrate_cameras_general",
    "calibrate_session_cameras",
    "calibrate_target_views",
    "calibrate_trials",
]
