"""Results out to other tools' formats, and real robots' data in.

Every format names its directions and units in the file itself; what it cannot hold is
refused or said, never dropped in silence.
"""

from handeye_tri.exchange.camera_info import camera_info_yaml
from handeye_tri.exchange.easy_handeye2 import easy_handeye2_calib
from handeye_tri.exchange.everything import EXPORT_SCHEMA, json_schema
from handeye_tri.exchange.kalibr import kalibr_yaml
from handeye_tri.exchange.mcap_bag import Bag, session_mcap, session_rosbag2
from handeye_tri.exchange.opencv import opencv_yaml
from handeye_tri.exchange.results import FrameNames, Results
from handeye_tri.exchange.robot_description import link_names, robot_urdf
from handeye_tri.exchange.ros2_static_tf import static_tf_commands, static_tf_launch
from handeye_tri.exchange.tum import tum_tracks
from handeye_tri.exchange.urdf import CameraFrame, cameras_urdf

__all__ = [
    "EXPORT_SCHEMA",
    "Bag",
    "CameraFrame",
    "FrameNames",
    "Results",
    "camera_info_yaml",
    "cameras_urdf",
    "easy_handeye2_calib",
    "json_schema",
    "kalibr_yaml",
    "link_names",
    "opencv_yaml",
    "robot_urdf",
    "session_mcap",
    "session_rosbag2",
    "static_tf_commands",
    "static_tf_launch",
    "tum_tracks",
]
