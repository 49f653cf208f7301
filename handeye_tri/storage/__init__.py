"""Sessions, results and cell descriptions on disk; the only reader and writer."""

from handeye_tri.storage.cells import (
    find_cell,
    find_model,
    read_any_cell,
    read_cell,
    shipped,
)
from handeye_tri.storage.files import (
    decode_image,
    read_arrays,
    read_bytes,
    read_image,
    read_json,
    sha256,
    write_arrays,
    write_bytes,
    write_image,
    write_json,
)
from handeye_tri.storage.folder import (
    SESSION_SCHEMA,
    SessionFolder,
    decoded,
    fingerprint,
)
from handeye_tri.storage.joint_files import read_joint_list, write_joint_list
from handeye_tri.storage.pose_files import (
    POSES_SCHEMA,
    read_moveit_samples,
    read_pose_pairs,
)
from handeye_tri.storage.pose_reader import PoseReader
from handeye_tri.storage.structured import read_structured
from handeye_tri.storage.trajectories import tum_text, write_tum

__all__ = [
    "POSES_SCHEMA",
    "SESSION_SCHEMA",
    "PoseReader",
    "SessionFolder",
    "decode_image",
    "decoded",
    "find_cell",
    "find_model",
    "fingerprint",
    "read_any_cell",
    "read_arrays",
    "read_bytes",
    "read_cell",
    "read_image",
    "read_joint_list",
    "read_json",
    "read_moveit_samples",
    "read_pose_pairs",
    "read_structured",
    "sha256",
    "shipped",
    "tum_text",
    "write_arrays",
    "write_bytes",
    "write_image",
    "write_joint_list",
    "write_json",
    "write_tum",
]
