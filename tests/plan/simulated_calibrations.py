"""Whole calibrations of a planned cell, simulated, beside its certificate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.adjustment import adjust
from handeye_tri.arm import Arm
from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.config import Cell
from handeye_tri.evaluate import evaluate_track
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.plan.information import StationInformation
from handeye_tri.records import (
    Covariance,
    GroundTruth,
    HalfTurn,
    HandEyeCalibration,
    Plan,
    Repeatability,
    Session,
    Station,
    triangle_name,
)
from handeye_tri.se3 import SE3
from handeye_tri.synthesize import Geometry, synthesize

Floats = NDArray[np.float64]


def predictions(cell: Cell, arm: Arm) -> StationInformation:
    """What stations of the cell tell, as its plan predicts it."""
    return StationInformation(
        cell,
        arm.base_from_world.matrix,
        cell.repeatability,
        cell.plan.expected_sigma_px,
    )


def geometry(
    cell: Cell,
    model: StationInformation,
    stations: Sequence[Station],
    half_turns: Sequence[HalfTurn],
) -> Geometry:
    """The cell as designed, and where the robot is told to go."""
    return Geometry(
        cell.rig.triangle,
        cell.rig.flange_from_triangle,
        model.views[0].cameras,
        tuple(SE3(model.base_from_world @ m) for m in model.views[0].world_from_camera),
        tuple(stations),
        tuple(half_turns),
        tuple(view.flange_from_triangle for view in model.views[1:]),
    )


def asked(session: Session, cell: Cell) -> Session:
    """The same session, asking for what the cell asks for."""
    return replace(session, cameras=tuple(camera.info for camera in cell.cameras))


def calibrated(session: Session) -> HandEyeCalibration:
    """The whole estimation: cameras, hand-eye, joint adjustment."""
    cameras = calibrate_session_cameras(session)
    kept = session.without(cameras.details["dropped"])
    return adjust(kept, calibrate_hand_eye(kept, cameras))


def from_truth(
    session: Session, truth: GroundTruth, correlation: float | None = None
) -> HandEyeCalibration:
    """The joint adjustment alone, started where it should end.

    Args:
        session: What was seen.
        truth: Where to start.
        correlation: That of detection errors of a marker on the axis; None: estimated.
    """
    start = HandEyeCalibration(
        truth.cameras,
        truth.base_from_camera,
        truth.flange_from_triangle,
        truth.markers,
        Covariance(("none.x",), np.eye(1)),
        0.0,
        1,
        np.zeros((1, 6)),
        "the truth",
        other_mounts=truth.other_mounts,
    )
    return adjust(session, start, on_axis_correlation=correlation)


@dataclass(frozen=True, slots=True, eq=False)
class WorkspaceTest:
    """Where a calibration is tested: all over the workspace box.

    Attributes:
        exact: A session of exact pixels and robot, so that what is wrong there is
            the calibration's own part.
        noisy: The same stations with the noise of a new view and of the robot.
    """

    exact: Session
    noisy: Session


def workspace_test(
    cell: Cell, model: StationInformation, rng: np.random.Generator
) -> WorkspaceTest:
    """Stations at the places that the track error is predicted at."""
    there = [
        one
        for at in model.places
        for one in zip(at.base_from_flange, at.seen, at.mounts.tolist(), strict=True)
    ]
    stations = [
        Station(k, "evaluation", np.empty(0), SE3(pose), mount)
        for k, (pose, _, mount) in enumerate(there)
    ]
    seen = np.array([one[1] for one in there])
    box = geometry(cell, model, stations, ())

    def session(sigma_px: float, robot: Repeatability | None) -> Session:
        made, _ = synthesize(box, rng, sigma_px=sigma_px, repeatability=robot)
        pixels = np.where(seen.T[..., None, None], made.pixels, np.nan)
        return asked(replace(made, pixels=pixels), cell)

    return WorkspaceTest(
        session(0.0, None), session(model.sigma_px, cell.repeatability)
    )


def squared_errors(
    found: HandEyeCalibration, truth: GroundTruth, test: WorkspaceTest
) -> dict[str, float]:
    """What the certificate predicts, as it came out, squared, in its units."""
    errors: dict[str, float] = {}
    for mine, true in zip(found.cameras, truth.cameras, strict=True):
        for name in ("fx", "fy", "skew", "cx", "cy"):
            off = getattr(mine.intrinsics, name) - getattr(true.intrinsics, name)
            errors[f"sigma.{mine.name}.{name}_px"] = off**2
        for name, a, b in zip(
            mine.lens.names, mine.lens.coefficients, true.lens.coefficients, strict=True
        ):
            errors[f"sigma.{mine.name}.{name}"] = (a - b) ** 2
    motions = {
        f"base_from_{camera.name}": pair
        for camera, *pair in zip(
            found.cameras, found.base_from_camera, truth.base_from_camera, strict=True
        )
    }
    mounts = [truth.flange_from_triangle]
    mounts += [mount.flange_from_triangle for mount in truth.other_mounts]
    for k, (mine, true) in enumerate(zip(found.mounts, mounts, strict=True)):
        motions[triangle_name(k)] = [mine.flange_from_triangle, true]
    for name, (mine, true) in motions.items():
        off = (mine.inverse() @ true).log()
        errors[f"sigma.{name}.translation_mm"] = 1e6 * off[:3] @ off[:3]
        errors[f"sigma.{name}.rotation_deg"] = np.degrees(1) ** 2 * off[3:] @ off[3:]
    if len(found.cameras) > 1:
        length = [
            np.linalg.norm((cell[0].inverse() @ cell[1]).translation)
            for cell in (found.base_from_camera, truth.base_from_camera)
        ]
        errors["sigma.baseline_mm"] = 1e6 * (length[0] - length[1]) ** 2
    for name, session in (
        ("track_calibration_rms_mm", test.exact),
        ("track_predicted_rms_mm", test.noisy),
    ):
        errors[name] = 1e6 * evaluate_track(found, session).rms ** 2
    return errors


@dataclass(frozen=True, slots=True)
class Ratio:
    """What came out over what was predicted.

    Attributes:
        value: Root of the mean square over the predicted sigma.
        error: Its standard error, from the scatter of the squares.
    """

    value: float
    error: float


def ratio(squares: Floats) -> Ratio:
    """From squares over predicted variances, one row a run, any columns."""
    runs = np.asarray(squares, dtype=float).reshape(len(squares), -1).mean(axis=1)
    value = float(np.sqrt(runs.mean()))
    return Ratio(value, float(runs.std(ddof=1) / np.sqrt(len(runs)) / (2 * value)))


def block_of(name: str) -> str:
    """Which pool a quantity of the certificate is in."""
    if name.startswith("track"):
        return name.removesuffix("_rms_mm")
    owner = name.removeprefix("sigma.").split(".")[0]
    if owner.startswith("base_from_") or owner == "baseline_mm":
        return "places"
    return "rig" if owner.startswith("flange_from_triangle") else "intrinsics"


def by_quantity(
    runs: Sequence[Mapping[str, float]], certificate: Mapping[str, float]
) -> dict[str, Floats]:
    """Squared errors over predicted variances, by quantity, shape (runs,).

    A quantity that the certificate does not name is not estimated.
    """
    return {
        name: np.array([run[name] for run in runs]) / certificate[name] ** 2
        for name in runs[0]
        if name in certificate
    }


def by_block(quantities: Mapping[str, Floats]) -> dict[str, Floats]:
    """The same pooled, shape (runs, quantities)."""
    pooled: dict[str, list[Floats]] = {}
    for name, squares in quantities.items():
        pooled.setdefault(block_of(name), []).append(squares)
    return {name: np.stack(columns, axis=1) for name, columns in pooled.items()}


def simulated(
    cell: Cell,
    model: StationInformation,
    stations: Sequence[Station],
    half_turns: Sequence[HalfTurn],
    rng: np.random.Generator,
) -> tuple[Session, GroundTruth]:
    """One session from a programme, with the noise that its certificate assumes."""
    session, truth = synthesize(
        geometry(cell, model, stations, half_turns),
        rng,
        sigma_px=model.sigma_px,
        repeatability=cell.repeatability,
    )
    return asked(session, cell), truth


def to_calibrate(plan: Plan) -> tuple[tuple[Station, ...], tuple[HalfTurn, ...]]:
    """The stations that calibrate, and their half-turns, numbered without others."""
    used = [s for s in plan.stations if s.kind == "calibration"]
    number = {station.index: k for k, station in enumerate(used)}
    return (
        tuple(replace(s, index=k) for k, s in enumerate(used)),
        tuple(
            replace(t, before=number[t.before], after=number[t.after])
            for t in plan.half_turns
        ),
    )
