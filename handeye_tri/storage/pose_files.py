"""Files of bare pose pairs: units, directions, mounting and formats are stated.

Nothing is guessed and nothing converted: a file that leaves one of them out is refused
with what to write. The keys of a file::

    "schema": "handeye-tri poses 1"
    "mounting": "eye_in_hand" | "eye_to_hand"
    "robot_poses": "flange_in_base" | "base_in_flange"
    "observed_poses": "target_in_camera" | "camera_in_target"
    "target_size": "known" | "unknown"                      (unknown: scale is free)
    "noise": {robot_translation_mm, robot_rotation_deg, lateral_mm, depth_mm,
              rotation_deg}                                            (optional)
    "pairs": [{"name": optional, "robot": POSE, "observed": POSE}, ...]
    or, with clocks: "robot": [POSE with "time_s", ...], "observed": [...]

A POSE is in any of the forms of :mod:`handeye_tri.storage.pose_reader`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from handeye_tri.errors import InputError
from handeye_tri.records import Floats, PosePairs
from handeye_tri.storage.pose_reader import HEAD, PoseReader
from handeye_tri.storage.structured import read_structured

POSES_SCHEMA = "handeye-tri poses 1"


def read_pose_pairs(path: Path, *, orthonormalise: bool = False) -> PosePairs:
    """Read a file of pose pairs, see the module.

    Args:
        path: The file.
        orthonormalise: Whether rotations that are a little off (matrices printed with
            few digits) are replaced by the nearest ones.

    Raises:
        StorageError: missing, or not JSON.
        InputError: a key is missing, unknown or contradictory, a number is not
            finite, a rotation is none, or counts differ; the message names it.
    """
    data = read_structured(path)
    if not isinstance(data, dict):
        raise InputError(
            f"{path}: this is no object with a head; a file of pose pairs starts with "
            f'"schema": "{POSES_SCHEMA}" (a list of MoveIt samples: --format moveit)'
        )
    reader = PoseReader(path, orthonormalise)
    schema = data.get("schema")
    if schema != POSES_SCHEMA:
        raise InputError(
            f'{path}: "schema" must be "{POSES_SCHEMA}", got {schema!r}; see '
            "scripts/README.md for the format"
        )
    known = {"schema", *HEAD, "noise", "pairs", "robot", "observed"}
    reader.only(data, known, "the head")
    head = {key: reader.word(data, key) for key in HEAD}
    robot, observed, names, times = reader.streams(data)
    noise = reader.noise(data.get("noise"))
    try:
        return PosePairs(
            robot,
            observed,
            head["mounting"],  # type: ignore[arg-type]
            head["robot_poses"],  # type: ignore[arg-type]
            head["observed_poses"],  # type: ignore[arg-type]
            metric=head["target_size"] == "known",
            names=names,
            robot_times=times[0],
            observed_times=times[1],
            noise=noise,
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def read_moveit_samples(
    path: Path, mounting: str | None, *, orthonormalise: bool = False
) -> PosePairs:
    """Read samples as MoveIt's calibration plugin saves them.

    A list with one item per sample: ``effector_wrt_world`` and ``object_wrt_sensor``,
    16 numbers row by row each, metres; or both as a pair of 4x4 lists. The format says
    nothing about the mounting.

    Args:
        path: JSON or YAML file.
        mounting: "eye_in_hand" or "eye_to_hand".
        orthonormalise: As in :func:`read_pose_pairs`.

    Raises:
        StorageError: missing or unreadable.
        InputError: the mounting is missing, or a sample is malformed.
    """
    if mounting is None:
        raise InputError(
            f"{path}: MoveIt samples do not say how the camera is mounted; add "
            "--mounting eye_in_hand or --mounting eye_to_hand"
        )
    samples = read_structured(path)
    if not isinstance(samples, list) or not samples:
        raise InputError(f"{path}: MoveIt samples are a list, this is none")
    reader = PoseReader(path, orthonormalise)
    both: list[list[Floats]] = []
    for i, sample in enumerate(samples):
        if isinstance(sample, Mapping):
            reader.only(sample, {"effector_wrt_world", "object_wrt_sensor"}, f"[{i}]")
            sample = [
                reader.need(sample, key, f"sample {i}")
                for key in ("effector_wrt_world", "object_wrt_sensor")
            ]
        if not isinstance(sample, Sequence) or len(sample) != 2:
            raise InputError(f"{path}: sample {i} is no pair of poses")
        both.append(
            [
                reader.matrix(part, 1.0, f"sample {i}, {name}")
                for part, name in zip(sample, ("robot", "observed"), strict=True)
            ]
        )
    poses = np.array(both)
    return PosePairs(
        poses[:, 0],
        poses[:, 1],
        mounting,  # type: ignore[arg-type]
        "flange_in_base",
        "target_in_camera",
    )
