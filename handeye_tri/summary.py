"""The result as text for a terminal: verdict first, digits after the uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import INTRINSIC_NAMES
from handeye_tri.config import CellToCalibrate
from handeye_tri.counting import counted
from handeye_tri.records import (
    GroundTruth,
    HandEyeCalibration,
    Plan,
    motion_labels,
    triangle_name,
)
from handeye_tri.se3 import SE3, so3_left_jacobian_inverse, so3_log

Floats = NDArray[np.float64]

# Factor and unit of what is wrong with a robot, by quantity; else it is an angle.
_ROBOT_UNITS = {axis: (1e3, "mm") for axis in "xyz"}


# Columns of a line of text; a table of long names may be wider.
LINE_WIDTH = 88


def wrapped(text: str, indent: int = 2) -> list[str]:
    """Lines of a sentence; what goes on is indented once more."""
    return wrap(
        text,
        LINE_WIDTH,
        initial_indent=" " * indent,
        subsequent_indent=" " * (indent + 2),
        break_on_hyphens=False,
        break_long_words=False,
    )


def digits(sigma: float) -> int:
    """Decimals that show two significant digits of a standard deviation."""
    if not math.isfinite(sigma) or sigma <= 0:
        return 4
    return max(0, 1 - math.floor(math.log10(sigma)))


def round_magnification(largest: float, longest: float) -> int:
    """How many times too long small gaps are drawn: 1, 2, 5, 10, 20, ....

    Args:
        largest: The largest gap.
        longest: How long it may be drawn, in the same unit; it is never shortened.
    """
    if largest * 1e6 <= longest:
        return 1_000_000
    wanted = max(longest / largest, 1.0)
    power = int(10 ** math.floor(math.log10(wanted)))
    return max(step * power for step in (1, 2, 5) if step * power <= wanted)


def summary_text(
    evaluation: Mapping[str, Any], folder: Path, written: Sequence[str]
) -> str:
    """What a person reads first, from ``evaluation.json``.

    Args:
        evaluation: The content of ``evaluation.json``.
        folder: The session's folder, for the commands to type next.
        written: Names of the files in the session worth opening, first one first.
    """
    lines = [
        *_verdict(evaluation, cross_check_lines(evaluation)),
        "",
        *_result(evaluation["result"]),
        *_robot(evaluation["robot"]),
        "",
        _origin(evaluation["track"]["predicted_parts_mm"]),
    ]
    if written:
        lines += ["", "WROTE"]
        for number, name in enumerate(written):
            lines.append(f"  {folder / name}" + ("   start here" if not number else ""))
    lines += ["", f"NEXT  handeye-tri replay {folder}"]
    return "\n".join(lines)


def plan_text(plan: Plan, cell: CellToCalibrate) -> str:
    """What a programme promises, before the robot moves.

    Args:
        plan: The programme.
        cell: What it was planned for.
    """
    number = plan.certificate
    held_out = sum(station.kind == "evaluation" for station in plan.stations)
    change = plan.tool_change
    lines = [
        f"VERDICT  {plan.outcome}      cell {cell.name}, before the robot moves",
        f"  {counted(len(plan.half_turns), 'half-turn')}, "
        f"{counted(len(plan.stations) - held_out, 'station')} + {held_out} held out; "
        f"{number['cycle_time_s']:.1f} s of moves",
        *(
            [
                f"  Tool change before station {change.before}, to "
                f"{cell.mount_name(plan.stations[change.before].mount)}"
            ]
            if change is not None
            else []
        ),
        f"  Track error over the workspace box: {number['track_predicted_rms_mm']:.3f} "
        "mm rms expected,",
        f"  of which {number['track_calibration_rms_mm']:.3f} from the calibration"
        + (
            f" (no choice of as many half-turns from {number['candidates']:.0f}: "
            f"below {number['relaxed_bound_mm']:.3f})"
            if "relaxed_bound_mm" in number
            else ""
        ),
        f"  Planes up to {number['plane_spread_deg']:.0f} deg apart; axes "
        f"{number['axis_spread']:.2f} of 1; rank {number['rank']:.0f} of "
        f"{number['unknowns']:.0f}; condition {number['condition']:.1e}",
        f"  Assumed: centres to {number['sigma_px']} px; cameras, rig and robot as the "
        "cell describes them",
        *(
            line
            for finding in plan.findings
            for line in wrap(finding, 86, initial_indent="  ", subsequent_indent="    ")
        ),
    ]
    sigmas = {
        "".join(_unit(name.removeprefix("sigma."))): value
        for name, value in number.items()
        if name.startswith("sigma.")
    }
    width = max(36, *map(len, sigmas))
    lines += ["", f"{'EXPECTED':<{width + 7}}+- (1 sd)"]
    lines += [
        f"  {label:<{width}}{value:>12.{digits(value)}f}"
        for label, value in sigmas.items()
    ]
    return "\n".join(lines)


def _unit(name: str) -> tuple[str, str]:
    for unit in ("px", "mm", "deg"):
        if name.endswith(f"_{unit}"):
            return name.removesuffix(f"_{unit}"), f", {unit}"
    return name, ""


def check_text(checked: Mapping[str, Any]) -> str:
    """A session judged again from its files.

    Args:
        checked: Its verdict, as in ``evaluation.json``, and what became of its files.
    """
    if checked["track"] is None:
        source = "SIMULATED" if checked["simulated"] else "REAL"
        lines = [
            f"VERDICT  {checked['verdict']}      {source}, not calibrated, no gate run",
            *wrapped(checked["sentence"]),
            *_findings(checked["findings"]),
        ]
    else:
        lines = _verdict(checked, [])
    lines += ["", f"FILES  {checked['files_verified']} as recorded (SHA-256)"]
    for stage in checked["stale"]:
        lines.append(f"STALE  {stage['stage']}: {stage['why']}; {stage['command']}")
    if checked["recorded_verdict"] not in (None, checked["verdict"]):
        lines.append(f"BEFORE evaluation.json says {checked['recorded_verdict']}")
    return "\n".join(lines)


def _verdict(evaluation: Mapping[str, Any], remarks: Sequence[str]) -> list[str]:
    track = evaluation["track"]
    gates = evaluation["gates"]
    ran = [gate for gate in gates if gate["verdict"] != "not run"]
    met = [gate for gate in ran if gate["verdict"] != "bad"]
    source = "SIMULATED" if evaluation["simulated"] else "REAL"
    lines = [
        f"VERDICT  {evaluation['verdict']}      {source}, {len(met)} of {len(ran)} "
        f"gates met, {len(gates) - len(ran)} not run",
        f"  {evaluation['sentence']}",
        f"  Track test, {tested_stations(track)}: "
        f"{track['mean_mm']:.3f} mm mean, {track['rms_mm']:.3f} rms "
        f"({track['predicted_rms_mm']:.3f} predicted),",
        f"  {track['max_mm']:.3f} worst (station {track['worst_station']}, "
        f"marker {track['worst_marker']}).",
        *(
            f"  {remark}"
            for remark in (against_prediction_text(track), *remarks)
            if remark
        ),
        f"  Nearest to failing: {evaluation['nearest']}.",
        f"  {'gate':<32}{'found':<16}{'limit':<16}{'verdict':<10}blind to",
    ]
    for number, gate in enumerate(gates, 1):
        lines.append(
            f"  {number} {gate['name']:<30}{gate['found']:<16}{gate['limit']:<16}"
            f"{gate['verdict']:<10}{gate['blind_to']}"
        )
    return lines + _findings(evaluation["findings"])


def _findings(findings: Sequence[Mapping[str, Any]]) -> list[str]:
    """What is wrong and what to do; what follows from it, without."""
    lines = []
    for finding in findings:
        said = f"{finding['cause']}; {finding['evidence']}"
        if finding["follows"]:
            lines += wrapped(
                f"{finding['code']}, likely from {finding['follows']}: {said}", 4
            )
        else:
            lines += wrapped(f"{finding['code']}: {said}")
            lines += wrapped(f"Do: {finding['remedy']}.", 4)
    return lines


def against_prediction_text(track: Mapping[str, Any]) -> str:
    """Whether the track is as good as predicted, a sentence; empty where not known."""
    found = track["against_prediction"]
    if found is None:
        return ""
    words = {
        "consistent": "Consistent with the prediction",
        "better": "Better than predicted",
        "worse": "Worse than predicted",
    }
    return (
        f"{words[found['outcome']]}: 95 % of such tests have "
        f"{found['low_mm']:.3f} to {found['high_mm']:.3f} mm rms."
    )


def tested_stations(track: Mapping[str, Any]) -> str:
    """Which stations the track test was made at, in words."""
    if track["source"] == "cross-validation":
        stations = counted(track["stations"], "station")
        return f"{stations}, each left out of its own calibration"
    return counted(track["stations"], "held-out station")


def cross_check_lines(evaluation: Mapping[str, Any]) -> list[str]:
    """Cross-validation and repeatability, a line each, from ``evaluation.json``."""
    checks = evaluation["cross_checks"]
    lines: list[str] = []
    validation = checks["cross_validation"]
    if "not_run" in validation:
        lines.append(f"Cross-validation not run: {validation['not_run']}")
    elif evaluation["track"]["source"] != "cross-validation":
        what = (
            "one half-turn left out at a time"
            if validation["folds"] == validation["groups"]
            else f"{validation['folds']} folds"
        )
        lines.append(
            f"Cross-validation, {what}: {validation['rms_mm']:.3f} mm rms "
            f"({validation['predicted_rms_mm']:.3f} predicted)."
        )
    drawn = checks["bootstrap"]
    if "not_run" in drawn:
        lines.append(f"Repeatability not run: {drawn['not_run']}")
    else:
        lines.append(
            f"Calibration's part: {drawn['track_calibration_by_covariance_mm']:.3f} mm "
            "by covariance, "
            f"{drawn['track_calibration_mm']:.3f} +- "
            f"{100 * drawn['relative_error']:.0f} % by drawing its "
            f"{drawn['drawn_from']} half-turns again."
        )
    return lines


def _result(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    known = any(row["error"] is not None for row in rows)
    lines = [
        f"{'RESULT':<34}{'value':>12}{'+- (1 sd)':>14}"
        + (f"{'truth - value':>16}" if known else "")
    ]
    for row in rows:
        places = digits(row["sigma"])
        line = (
            f"  {row['name'] + ', ' + row['unit'] if row['unit'] else row['name']:<32}"
            f"{row['value']:>12.{places}f}{row['sigma']:>14.{places}f}"
        )
        if row["error"] is not None:
            line += f"{-row['error']:>+16.{places}f}"
        lines.append(line)
    return lines


def _robot(robot: Mapping[str, Any]) -> list[str]:
    """Which errors of the robot were estimated, and which the data leave open."""
    if not robot["asked"]:
        return []
    found, left = robot["estimated"], robot["undetermined"]
    line = f"  {len(found)} of {len(found) + len(left)} errors of the robot estimated"
    if left:
        line += (
            f"; left at zero, since the data do not tell them: {', '.join(left)} "
            "(base and flange are those of a robot without them)"
        )
    return [line]


def _origin(parts: Mapping[str, float]) -> str:
    total = sum(value**2 for value in parts.values())
    shares = sorted(parts.items(), key=lambda item: -item[1])
    text = "  ".join(
        f"{name.replace('_', ' ')} {100 * value**2 / total:.0f} % ({value:.3f} mm)"
        for name, value in shares
    )
    return f"WHERE THE PREDICTED TRACK ERROR COMES FROM (share of its square)\n  {text}"


def result_rows(
    calibration: HandEyeCalibration, truth: GroundTruth | None
) -> list[dict[str, Any]]:
    """Everything estimated, in units for people, each with its standard deviation.

    Translations are along the axes of the frame named first, rotations are rotation
    vectors; unlike the covariance's tangents, both can be compared by subtraction.

    Args:
        calibration: The calibrated cell.
        truth: Where known, ``error`` is estimate less truth in the row's unit.

    Returns:
        Rows with name, unit, value, sigma, and error (None without truth).
    """
    rows: list[dict[str, Any]] = []
    covariance = calibration.covariance
    for i, camera in enumerate(calibration.cameras):
        true_camera = truth.cameras[i] if truth else None
        for label in covariance.labels:
            owner, quantity = label.rsplit(".", 1)
            if owner != camera.name:
                continue
            value = camera.parameter(quantity)
            unit = "px" if quantity in INTRINSIC_NAMES else ""
            error = value - true_camera.parameter(quantity) if true_camera else None
            rows.append(_row(label, unit, value, covariance.std(label), error))
    motions = [
        (
            f"base_from_{camera.name}",
            motion,
            truth.base_from_camera[i] if truth else None,
        )
        for i, (camera, motion) in enumerate(
            zip(calibration.cameras, calibration.base_from_camera, strict=True)
        )
    ]
    true_rigs: list[SE3 | None] = [None] * len(calibration.mounts)
    if truth:
        others = [mount.flange_from_triangle for mount in truth.other_mounts]
        true_rigs = [truth.flange_from_triangle, *others]
    # A mount that no station had is not estimated.
    for k, (mount, true_rig) in enumerate(
        zip(calibration.mounts, true_rigs, strict=False)
    ):
        motions.append((triangle_name(k), mount.flange_from_triangle, true_rig))
    for name, motion, true_motion in motions:
        block = covariance.block(motion_labels(name))
        rows += motion_rows(name, motion, block, true_motion)
    for label, value in calibration.robot.items():
        factor, unit = _ROBOT_UNITS.get(label.rsplit(".", 1)[1], (180 / np.pi, "deg"))
        sigma = factor * covariance.std(label)
        rows.append(_row(label, unit, factor * value, sigma, None))
    return rows


def _row(
    name: str, unit: str, value: float, sigma: float, error: float | None
) -> dict[str, Any]:
    return {
        "name": name,
        "unit": unit,
        "value": float(value),
        "sigma": float(sigma),
        "error": None if error is None else float(error),
    }


def motion_rows(
    name: str, motion: SE3, covariance: Floats, truth: SE3 | None
) -> list[dict[str, Any]]:
    """Six rows of a motion whose right tangent has this covariance, (6, 6)."""
    vector = so3_log(motion.rotation)
    # A right tangent moves t by R dt, and the rotation vector by J_l(-w)^-1 dw.
    by_tangent = np.zeros((6, 6))
    by_tangent[:3, :3] = motion.rotation
    by_tangent[3:, 3:] = so3_left_jacobian_inverse(-vector)
    sigma = np.sqrt(np.diagonal(by_tangent @ covariance @ by_tangent.T))
    value = np.concatenate([motion.translation, vector])
    error = None
    if truth is not None:
        # A difference of rotation vectors taken along the short way around.
        turned = so3_log(truth.rotation.T @ motion.rotation)
        error = np.concatenate(
            [motion.translation - truth.translation, by_tangent[3:, 3:] @ turned]
        )
    rows = []
    for k, quantity in enumerate(("x", "y", "z", "rx", "ry", "rz")):
        scale, unit = (1e3, "mm") if k < 3 else (180 / np.pi, "deg")
        rows.append(
            _row(
                f"{name}.{quantity}",
                unit,
                scale * value[k],
                scale * sigma[k],
                None if error is None else scale * error[k],
            )
        )
    return rows
