"""What flows between stages: frozen records whose arrays are copied and locked.

Indices: i counts the m cameras, j the n stations, k the markers A, B, C.
Metres, radians and pixels inside; files and people get mm and degrees by name.
"""

from handeye_tri.records.arrays import Floats, locked, numeric
from handeye_tri.records.covariance import (
    MARKER_LABELS,
    MOTION_QUANTITIES,
    Covariance,
    marker_labels,
    motion_labels,
    triangle_name,
)
from handeye_tri.records.pose_pairs import (
    Mounting,
    ObservedDirection,
    PoseNoise,
    PosePairs,
    RobotDirection,
)
from handeye_tri.records.results import (
    CameraCalibration,
    GroundTruth,
    HandEyeCalibration,
    Mount,
    TrackEvaluation,
)
from handeye_tri.records.session import (
    CameraInfo,
    DroppedHalfTurn,
    HalfTurn,
    Plan,
    Repeatability,
    Session,
    Station,
    StationKind,
    ToolChange,
)

__all__ = [
    "Floats",
    "locked",
    "numeric",
    "MARKER_LABELS",
    "MOTION_QUANTITIES",
    "Covariance",
    "marker_labels",
    "motion_labels",
    "triangle_name",
    "Mounting",
    "ObservedDirection",
    "PoseNoise",
    "PosePairs",
    "RobotDirection",
    "CameraCalibration",
    "GroundTruth",
    "HandEyeCalibration",
    "Mount",
    "TrackEvaluation",
    "CameraInfo",
    "DroppedHalfTurn",
    "HalfTurn",
    "Plan",
    "Repeatability",
    "Session",
    "Station",
    "StationKind",
    "ToolChange",
]
