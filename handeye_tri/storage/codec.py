"""Records to JSON and back; every key states its unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.errors import InputError, StorageError
from handeye_tri.records import (
    CameraCalibration,
    Covariance,
    DroppedHalfTurn,
    GroundTruth,
    HalfTurn,
    HandEyeCalibration,
    Mount,
    Plan,
    Station,
    ToolChange,
)
from handeye_tri.se3 import SE3, quaternion_wxyz, rotation_from_quaternion_wxyz

Json = dict[str, Any]

_POSES = "reference_from_triangle"


def numbers(array: NDArray[np.float64]) -> Any:
    """Nested lists of an array of any shape; NaN becomes null."""
    if np.isfinite(array).all():
        return array.tolist()
    boxed = array.astype(object)
    boxed[~np.isfinite(array)] = None
    return boxed.tolist()


def array(data: Any, where: str) -> NDArray[np.float64]:
    """Array of nested lists; null becomes NaN.

    Raises:
        StorageError: not numbers, or a ragged list.
    """
    try:
        return np.array(data, dtype=object).astype(float)
    except (TypeError, ValueError) as error:
        raise StorageError(f"{where}: these are not numbers ({error})") from None


def motion_to_json(motion: SE3) -> Json:
    """A rigid motion as translation in metres and named quaternion."""
    w, x, y, z = quaternion_wxyz(motion.rotation).tolist()
    return {
        "translation_m": motion.translation.tolist(),
        "quaternion": {"w": w, "x": x, "y": y, "z": z},
    }


def motion_from_json(data: Mapping[str, Any]) -> SE3:
    """Inverse of :func:`motion_to_json`."""
    q = [float(data["quaternion"][name]) for name in "wxyz"]
    if not np.isfinite(q).all() or abs(np.linalg.norm(q) - 1) > 1e-6:
        raise InputError(f"a quaternion must have length 1, got {q}")
    return SE3.from_parts(rotation_from_quaternion_wxyz(q), data["translation_m"])


def camera_to_json(camera: PinholeCamera) -> Json:
    """One camera; pixels and bare lens coefficients."""
    k = camera.intrinsics
    return {
        "name": camera.name,
        "image_size_px": list(camera.image_size),
        "fx_px": k.fx,
        "fy_px": k.fy,
        "skew_px": k.skew,
        "cx_px": k.cx,
        "cy_px": k.cy,
        "lens": {
            "model": camera.lens.model,
            "coefficients": dict(
                zip(camera.lens.names, camera.lens.coefficients.tolist(), strict=True)
            ),
        },
    }


def camera_from_json(data: Mapping[str, Any]) -> PinholeCamera:
    """Inverse of :func:`camera_to_json`."""
    lens = data["lens"]
    width, height = data["image_size_px"]
    names = Lens(lens["model"], np.zeros(8 if lens["model"] == "rational" else 5)).names
    return PinholeCamera(
        str(data["name"]),
        Intrinsics(*(float(data[f"{n}_px"]) for n in ("fx", "fy", "skew", "cx", "cy"))),
        (int(width), int(height)),
        Lens(lens["model"], np.array([lens["coefficients"][name] for name in names])),
    )


def covariance_to_json(covariance: Covariance) -> Json:
    """A labelled covariance; px, m, rad as the labels say."""
    return {"labels": list(covariance.labels), "matrix": numbers(covariance.matrix)}


def covariance_from_json(data: Mapping[str, Any]) -> Covariance:
    """Inverse of :func:`covariance_to_json`."""
    return Covariance(tuple(data["labels"]), array(data["matrix"], "covariance"))


def plan_to_json(plan: Plan) -> Json:
    """A robot programme."""
    return {
        "seed": plan.seed,
        "stations": [
            {
                "index": s.index,
                "kind": s.kind,
                "mount": s.mount,
                "via_rad_or_m": via.tolist(),
                "joints_rad_or_m": s.joints.tolist(),
                "base_from_flange": motion_to_json(s.base_from_flange),
            }
            for s, via in zip(plan.stations, plan.via, strict=True)
        ],
        "half_turns": [
            {"before": t.before, "after": t.after, "axis": t.axis}
            for t in plan.half_turns
        ],
        "rejected_candidates": dict(plan.rejected),
        "certificate": dict(plan.certificate),
        "outcome": plan.outcome,
        "findings": list(plan.findings),
        "tool_change": None
        if plan.tool_change is None
        else {
            "before": plan.tool_change.before,
            "joints_rad_or_m": plan.tool_change.joints.tolist(),
            "via_rad_or_m": plan.tool_change.via.tolist(),
        },
    }


def plan_from_json(data: Mapping[str, Any]) -> Plan:
    """Inverse of :func:`plan_to_json`."""
    return Plan(
        stations=tuple(
            Station(
                int(s["index"]),
                s["kind"],
                array(s["joints_rad_or_m"], "joints_rad_or_m"),
                motion_from_json(s["base_from_flange"]),
                int(s.get("mount", 0)),
            )
            for s in data["stations"]
        ),
        half_turns=tuple(
            HalfTurn(int(t["before"]), int(t["after"]), t["axis"])
            for t in data["half_turns"]
        ),
        rejected={str(k): int(v) for k, v in data["rejected_candidates"].items()},
        certificate={str(k): float(v) for k, v in data["certificate"].items()},
        seed=int(data["seed"]),
        outcome=data["outcome"],
        findings=tuple(str(line) for line in data["findings"]),
        via=tuple(
            _via(s["via_rad_or_m"], len(s["joints_rad_or_m"])) for s in data["stations"]
        ),
        tool_change=_tool_change(data.get("tool_change")),
    )


def _via(points: Any, joints: int) -> NDArray[np.float64]:
    """Joints passed, shape (k, joints); an empty list has lost its width."""
    return array(points, "via_rad_or_m").reshape(len(points), joints)


def _tool_change(data: Mapping[str, Any] | None) -> ToolChange | None:
    if data is None:
        return None
    joints = array(data["joints_rad_or_m"], "joints_rad_or_m")
    return ToolChange(
        int(data["before"]), joints, _via(data["via_rad_or_m"], len(joints))
    )


def _mounts_to_json(mounts: Sequence[Mount]) -> list[Json]:
    """How the rig sits after a tool change."""
    return [
        {
            "flange_from_triangle": motion_to_json(mount.flange_from_triangle),
            "markers_in_flange_m": numbers(mount.markers),
        }
        for mount in mounts
    ]


def _mounts_from_json(data: Sequence[Mapping[str, Any]]) -> tuple[Mount, ...]:
    """Inverse of :func:`_mounts_to_json`."""
    return tuple(
        Mount(
            motion_from_json(one["flange_from_triangle"]),
            array(one["markers_in_flange_m"], "markers_in_flange_m"),
        )
        for one in data
    )


def truth_to_json(truth: GroundTruth, joints: NDArray[np.float64]) -> Json:
    """What the simulation knows, with the joints it executed, shape (n, q)."""
    return {
        "cameras": [camera_to_json(camera) for camera in truth.cameras],
        "base_from_camera": [
            motion_to_json(motion) for motion in truth.base_from_camera
        ],
        "flange_from_triangle": motion_to_json(truth.flange_from_triangle),
        "base_from_flange": [
            motion_to_json(SE3(matrix)) for matrix in truth.base_from_flange
        ],
        "markers_in_flange_m": None
        if truth.markers is None
        else numbers(truth.markers),
        "other_mounts": _mounts_to_json(truth.other_mounts),
        "executed_joints_rad_or_m": numbers(joints),
    }


def truth_from_json(data: Mapping[str, Any]) -> tuple[GroundTruth, NDArray[np.float64]]:
    """Inverse of :func:`truth_to_json`."""
    markers = data.get("markers_in_flange_m")
    truth = GroundTruth(
        cameras=tuple(camera_from_json(camera) for camera in data["cameras"]),
        base_from_camera=tuple(motion_from_json(m) for m in data["base_from_camera"]),
        flange_from_triangle=motion_from_json(data["flange_from_triangle"]),
        base_from_flange=np.array(
            [motion_from_json(m).matrix for m in data["base_from_flange"]]
        ),
        markers=None if markers is None else array(markers, "markers_in_flange_m"),
        other_mounts=_mounts_from_json(data.get("other_mounts", ())),
    )
    return truth, array(data["executed_joints_rad_or_m"], "executed_joints_rad_or_m")


def camera_calibration_to_json(result: CameraCalibration) -> Json:
    """Calibrated cameras with their covariance."""
    poses = result.details.get(_POSES)
    return {
        "method": result.method,
        "cameras": [camera_to_json(camera) for camera in result.cameras],
        "reference_from_camera": [
            motion_to_json(motion) for motion in result.reference_from_camera
        ],
        "chi2": result.chi2,
        "dof": result.dof,
        "chi2_start": result.cost_start,
        "condition": result.condition,
        "covariance": covariance_to_json(result.covariance),
        "residuals_px": numbers(result.residuals),
        "dropped": [asdict(one) for one in result.details.get("dropped", ())],
        _POSES: None if poses is None else numbers(poses),
    }


def camera_calibration_from_json(data: Mapping[str, Any]) -> CameraCalibration:
    """Inverse of :func:`camera_calibration_to_json`."""
    return CameraCalibration(
        cameras=tuple(camera_from_json(camera) for camera in data["cameras"]),
        reference_from_camera=tuple(
            motion_from_json(motion) for motion in data["reference_from_camera"]
        ),
        covariance=covariance_from_json(data["covariance"]),
        chi2=float(data["chi2"]),
        dof=int(data["dof"]),
        residuals=array(data["residuals_px"], "residuals_px"),
        condition=float(data["condition"]),
        cost_start=float(data["chi2_start"]),
        method=str(data["method"]),
        details={
            "dropped": tuple(
                DroppedHalfTurn(
                    str(one["camera"]),
                    int(one["half_turn"]),
                    int(one["before"]),
                    int(one["after"]),
                    str(one["why"]),
                )
                for one in data.get("dropped", ())
            ),
            **_poses_from_json(data),
        },
    )


def _poses_from_json(data: Mapping[str, Any]) -> dict[str, NDArray[np.float64]]:
    """Where the cameras saw the triangle, by station, where that was kept."""
    if data.get(_POSES) is None:
        return {}
    poses = array(data[_POSES], _POSES)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise StorageError(
            f"{_POSES} must have shape (n, 4, 4), got {poses.shape}; run "
            "handeye-tri calibrate again"
        )
    return {_POSES: poses}


def hand_eye_to_json(result: HandEyeCalibration) -> Json:
    """The calibrated cell."""
    return {
        "method": result.method,
        "cameras": [camera_to_json(camera) for camera in result.cameras],
        "base_from_camera": {
            camera.name: motion_to_json(motion)
            for camera, motion in zip(
                result.cameras, result.base_from_camera, strict=True
            )
        },
        "flange_from_triangle": motion_to_json(result.flange_from_triangle),
        "markers_in_flange_m": numbers(result.markers),
        "other_mounts": _mounts_to_json(result.other_mounts),
        "chi2": result.chi2,
        "dof": result.dof,
        "covariance": covariance_to_json(result.covariance),
        "residuals_m_rad": numbers(result.residuals),
        "base_from_reference_by_method": {
            name: motion_to_json(motion) for name, motion in result.alternatives.items()
        },
        "robot_parameters_m_rad_s": dict(result.robot),
    }


def hand_eye_from_json(data: Mapping[str, Any]) -> HandEyeCalibration:
    """Inverse of :func:`hand_eye_to_json`."""
    cameras = tuple(camera_from_json(camera) for camera in data["cameras"])
    return HandEyeCalibration(
        cameras=cameras,
        base_from_camera=tuple(
            motion_from_json(data["base_from_camera"][camera.name])
            for camera in cameras
        ),
        flange_from_triangle=motion_from_json(data["flange_from_triangle"]),
        markers=array(data["markers_in_flange_m"], "markers_in_flange_m"),
        other_mounts=_mounts_from_json(data.get("other_mounts", ())),
        covariance=covariance_from_json(data["covariance"]),
        chi2=float(data["chi2"]),
        dof=int(data["dof"]),
        residuals=array(data["residuals_m_rad"], "residuals_m_rad"),
        method=str(data["method"]),
        alternatives={
            str(name): motion_from_json(motion)
            for name, motion in data["base_from_reference_by_method"].items()
        },
        robot={
            str(name): float(value)
            for name, value in data.get("robot_parameters_m_rad_s", {}).items()
        },
    )
