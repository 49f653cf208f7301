"""Camera and hand-eye calibration of a robot cell with three points.

The public names load their modules on first use, so that importing the package
costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from handeye_tri.adjustment import adjust
    from handeye_tri.calibrate_cameras import (
        calibrate_camera,
        calibrate_cameras_general,
        calibrate_session_cameras,
        calibrate_target_views,
        calibrate_trials,
    )
    from handeye_tri.camera import Intrinsics, Lens, PinholeCamera, StereoRig
    from handeye_tri.errors import HandEyeError
    from handeye_tri.evaluate import evaluate_track
    from handeye_tri.hand_eye import (
        calibrate_hand_eye,
        solve_axxb,
        solve_axzb,
        solve_pose_pairs,
    )
    from handeye_tri.records import (
        CameraCalibration,
        Covariance,
        HandEyeCalibration,
        PosePairs,
        Session,
        TrackEvaluation,
    )
    from handeye_tri.se3 import SE3
    from handeye_tri.triangle import TriangleRig

_HOMES = {
    "CameraCalibration": "records",
    "Covariance": "records",
    "HandEyeCalibration": "records",
    "HandEyeError": "errors",
    "Intrinsics": "camera",
    "Lens": "camera",
    "PinholeCamera": "camera",
    "PosePairs": "records",
    "SE3": "se3",
    "Session": "records",
    "StereoRig": "camera",
    "TrackEvaluation": "records",
    "TriangleRig": "triangle",
    "adjust": "adjustment",
    "calibrate_camera": "calibrate_cameras",
    "calibrate_cameras_general": "calibrate_cameras",
    "calibrate_hand_eye": "hand_eye",
    "calibrate_session_cameras": "calibrate_cameras",
    "calibrate_target_views": "calibrate_cameras",
    "calibrate_trials": "calibrate_cameras",
    "evaluate_track": "evaluate",
    "solve_axxb": "hand_eye",
    "solve_axzb": "hand_eye",
    "solve_pose_pairs": "hand_eye",
}

__all__ = [
    "SE3",
    "CameraCalibration",
    "Covariance",
    "HandEyeCalibration",
    "HandEyeError",
    "Intrinsics",
    "Lens",
    "PinholeCamera",
    "PosePairs",
    "Session",
    "StereoRig",
    "TrackEvaluation",
    "TriangleRig",
    "adjust",
    "calibrate_camera",
    "calibrate_cameras_general",
    "calibrate_hand_eye",
    "calibrate_session_cameras",
    "calibrate_target_views",
    "calibrate_trials",
    "evaluate_track",
    "solve_axxb",
    "solve_axzb",
    "solve_pose_pairs",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
