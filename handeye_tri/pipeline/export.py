"""A finished session in the formats of other tools."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from handeye_tri import exchange, storage
from handeye_tri.errors import InputError, StorageError
from handeye_tri.exchange import CameraFrame, FrameNames, Results
from handeye_tri.hand_eye.observed_poses import triangle_poses
from handeye_tri.pipeline.execution import require
from handeye_tri.pipeline.run import (
    CAMERAS_SCHEMA,
    HAND_EYE_SCHEMA,
    PLAN_SCHEMA,
    Run,
)
from handeye_tri.pipeline.stages import stages_of
from handeye_tri.records import CameraCalibration
from handeye_tri.se3 import se3_inverse
from handeye_tri.storage import codec

# What each is for, in a few words.
FORMATS = {
    "camera_info": "ROS camera_info, one YAML per camera, rectified if a pair",
    "opencv": "OpenCV FileStorage YAML of everything",
    "kalibr": "Kalibr camchain YAML",
    "easy_handeye2": "easy_handeye2 .calib, one per camera",
    "ros2_static_tf": "ROS 2 static transforms: launch file with the commands",
    "urdf": "URDF joints from the base to the cameras",
    "tum": "TUM trajectories: the robot's and the observed track",
    "mcap": "the whole session as an MCAP file, or as a rosbag2 folder",
    "json": "everything, with its JSON Schema beside it",
}
# A JSON text of these and no more is what other tools get of session.json.
_HEADER = ("software", "cell", "seed", "half_turns", "simulated", "method")


def verdict_of(run: Run) -> str:
    """The verdict of a session whose evaluation is whole and up to date.

    Raises:
        StorageError: it is not evaluated, or something changed since.
    """
    stages = stages_of(run)
    require(run, stages, stages["evaluate"])
    return str(run.evaluation()["verdict"])


def read_results(run: Run, frames: FrameNames) -> Results:
    """A calibrated session as the formats take it.

    Raises:
        StorageError: a file of the session is missing or damaged.
    """
    from handeye_tri.pipeline.robot import with_robot_applied

    evaluation = run.evaluation()
    session, hand_eye = with_robot_applied(run, run.session(), run.hand_eye())
    base_from_first = hand_eye.base_from_camera[0]
    cameras = CameraCalibration(
        cameras=hand_eye.cameras,
        reference_from_camera=tuple(
            base_from_first.inverse() @ motion for motion in hand_eye.base_from_camera
        ),
        covariance=hand_eye.covariance,
        chi2=hand_eye.chi2,
        dof=hand_eye.dof,
        residuals=np.zeros((len(hand_eye.cameras), 0, 3, 2)),
        condition=0.0,
        cost_start=0.0,
        method=hand_eye.method,
    )
    held = np.array([mount.flange_from_triangle.matrix for mount in hand_eye.mounts])
    flange_from_triangle = held[session.mounts]
    observed = triangle_poses(
        session.triangle,
        cameras,
        session.pixels,
        session.pixel_covariance,
        session.marker_radii,
        start=se3_inverse(hand_eye.base_from_camera[0].matrix)
        @ session.base_from_flange
        @ flange_from_triangle,
    )
    return Results(
        cell=run.cell.name,
        calibration=hand_eye,
        verdict=str(evaluation["verdict"]),
        sentence=str(evaluation["sentence"]),
        simulated=session.simulated,
        base_from_flange=session.base_from_flange,
        mounts=session.mounts,
        stations=tuple(observed.views.tolist()),
        observed_base_from_flange=base_from_first.matrix
        @ observed.reference_from_triangle
        @ se3_inverse(flange_from_triangle[observed.views]),
        frames=frames,
    )


def export(
    run: Run,
    name: str,
    path: Path,
    *,
    frames: FrameNames,
    camera_frame: CameraFrame = "mounting",
) -> tuple[list[Path], Results]:
    """Write a session's results in one format.

    Args:
        run: A session that is evaluated.
        name: One of FORMATS.
        path: The file; where a format has several, each gets a name before the suffix.
            For "mcap" without a suffix, the folder of a rosbag2.
        frames: What the frames are called.
        camera_frame: For URDF, where its joint ends.

    Returns:
        The files written, and what they were written from.

    Raises:
        InputError: the format cannot hold the result.
        StorageError: the session is not evaluated, or a file cannot be written.
    """
    if path.is_dir():
        raise StorageError(f"{path}: this is a folder; name a file with -o")
    results = read_results(run, frames)
    if name == "mcap":
        bag = _bag(run, results)
        if path.suffix:
            storage.write_bytes(path, exchange.session_mcap(bag))
            return [path], results
        files = exchange.session_rosbag2(bag, path.name)
        for label, data in files.items():
            storage.write_bytes(path / label, data)
        return [path / label for label in files], results
    writers: dict[str, Callable[[], str | Mapping[str, str]]] = {
        "camera_info": lambda: exchange.camera_info_yaml(results),
        "opencv": lambda: exchange.opencv_yaml(results),
        "kalibr": lambda: exchange.kalibr_yaml(results),
        "easy_handeye2": lambda: exchange.easy_handeye2_calib(results),
        "ros2_static_tf": lambda: exchange.static_tf_launch(results),
        "urdf": lambda: exchange.cameras_urdf(results, camera_frame),
        "tum": lambda: exchange.tum_tracks(results),
        "json": lambda: _everything(run, results),
    }
    if name not in writers:
        raise InputError(f"there is no format {name!r}; there are {', '.join(writers)}")
    texts = writers[name]()
    if isinstance(texts, str):
        texts = {"": texts}
    written = []
    for part, text in texts.items():
        label = f"{path.stem}_{part}{path.suffix}" if part else path.name
        storage.write_bytes(path.with_name(label), text.encode())
        written.append(path.with_name(label))
    return written, results


def _everything(run: Run, results: Results) -> dict[str, str]:
    folder, header, session = run.folder, run.folder.header, run.session()
    frames, truth = results.frames, run.truth()
    data: dict[str, Any] = {
        "schema": exchange.EXPORT_SCHEMA,
        "notice": results.head,
        "frames": {
            "base": frames.base,
            "flange": frames.flange,
            "optical": {
                camera.name: frames.camera(camera.name)
                for camera in results.calibration.cameras
            },
        },
        "session": {key: header[key] for key in _HEADER if key in header},
        "plan": storage.read_json(folder.file("plan.json"), PLAN_SCHEMA),
        "observations": {
            "pixels_px": codec.numbers(session.pixels),
            "pixel_covariance_px2": codec.numbers(session.pixel_covariance),
        },
        "cameras": storage.read_json(folder.file("cameras.json"), CAMERAS_SCHEMA),
        "hand_eye": storage.read_json(folder.file("hand_eye.json"), HAND_EYE_SCHEMA),
        "evaluation": run.evaluation(),
        "truth": codec.truth_to_json(*truth) if truth else None,
    }
    return {
        "": json.dumps(data, indent=1, allow_nan=False, ensure_ascii=False) + "\n",
        "schema": json.dumps(exchange.json_schema(), indent=1) + "\n",
    }


def _bag(run: Run, results: Results) -> exchange.Bag:
    header, plan = run.folder.header, run.plan()
    about: dict[str, Any] = {
        "schema": exchange.EXPORT_SCHEMA,
        "notice": results.head,
        "session": {key: header[key] for key in _HEADER if key in header},
    }
    if plan.tool_change is not None:
        before = plan.tool_change.before
        mount = plan.stations[before].mount
        about["tool_change"] = {"before": before, "mount": mount}
        about["notice"] = [
            *results.head,
            f"The tool is changed before station {before}: the frame triangle moves on "
            "the flange then, and the robot's description has no holder.",
        ]

    def photograph(camera: str, station: int) -> bytes | None:
        if not run.was_taken(camera, station):
            return None
        return storage.read_bytes(run.folder.file(run.image_name(camera, station)))

    bag = exchange.Bag(results, json.dumps(about, ensure_ascii=False), photograph)
    if not run.has_robot:
        return bag
    joints = np.array([station.joints for station in plan.stations])
    mechanism = run.mechanism
    if plan.tool_change is not None:
        bare = [g for g in mechanism.geometries if g.body != mechanism.marker_body]
        mechanism = replace(mechanism, geometries=tuple(bare))
    names = exchange.link_names(mechanism, results.frames.base, results.frames.flange)
    world_from_body = run.arm.body_poses(joints)
    links = []
    for index, body in enumerate(mechanism.bodies[1:], 1):
        parent_from_world = se3_inverse(world_from_body[:, body.parent])
        pose = parent_from_world @ world_from_body[:, index]
        links.append((names[body.parent], names[index], pose))
    return replace(
        bag,
        joint_names=run.arm.joint_names,
        joints=joints,
        description=exchange.robot_urdf(mechanism, names),
        links=links,
    )
