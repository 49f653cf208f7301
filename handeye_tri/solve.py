"""Bare pose pairs from file to verdict: what ``handeye-tri solve`` prints."""

from __future__ import annotations

from dataclasses import dataclass
from textwrap import wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri import arguments
from handeye_tri.counting import counted
from handeye_tri.diagnose import Verdict, assess_pose_pairs
from handeye_tri.errors import ConvergenceError
from handeye_tri.hand_eye import (
    PairMethod,
    PoseSolution,
    Reading,
    free_scale_of,
    solve_pose_pairs,
    solve_readings,
)
from handeye_tri.records import Floats, PosePairs, motion_labels
from handeye_tri.se3 import SE3, quaternion_wxyz, se3_adjoint
from handeye_tri.summary import LINE_WIDTH, digits, motion_rows, wrapped

# Poses whose residuals are listed at most, unless more were dropped.
_LISTED = 60
# Digits after the point that mean something: nanometres.
_PLACES = 6
# An open shift moves a coordinate by at least this share of its length, or leaves it.
_MOVED = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class SolvedPairs:
    """A solution with what speaks for and against it.

    Attributes:
        pairs: What was stated.
        solution: Its solution.
        readings: The stated reading and the others, each solved.
        scale: Free scale and its standard deviation; None where it is not asked.
        verdict: The answer.
    """

    pairs: PosePairs
    solution: PoseSolution
    readings: tuple[Reading, ...]
    scale: tuple[float, float] | None
    verdict: Verdict


def solve_and_judge(
    pairs: PosePairs,
    *,
    method: PairMethod = "likelihood",
    shift_along_axis: float | None = None,
    limit_position: float = 0.01,
    limit_angle: float = float(np.radians(1.0)),
    seed: int = 0,
) -> SolvedPairs:
    """Solve pose pairs, solve their other readings too, and draw the verdict.

    Args:
        pairs: The poses.
        method: See :func:`handeye_tri.hand_eye.solve_pose_pairs`.
        shift_along_axis: See there, metres.
        limit_position: Largest accepted RMS position residual, metres.
        limit_angle: Largest accepted RMS orientation residual, radians.
        seed: Of the random samples.

    Raises:
        InputError: a limit is not positive; see
            :func:`handeye_tri.hand_eye.solve_pose_pairs`.
        DegenerateMotionError: see there.
        ConvergenceError: see there.
    """
    arguments.positive("limit_position", limit_position)
    arguments.positive("limit_angle", limit_angle)
    solution = solve_pose_pairs(
        pairs, method=method, shift_along_axis=shift_along_axis, seed=seed
    )
    readings = solve_readings(solution, pairs, seed)
    asked = pairs.metric and solution.noise is not None and len(solution.poses) > 3
    try:
        scale = free_scale_of(solution) if asked else None
    except ConvergenceError:
        # Under a wrong reading there may be no optimum to find; the readings tell.
        scale = None
    verdict = assess_pose_pairs(
        pairs,
        solution,
        readings,
        scale,
        limit_position=limit_position,
        limit_angle=limit_angle,
    )
    return SolvedPairs(pairs, solution, readings, scale, verdict)


def _motions(solution: PoseSolution) -> list[tuple[str, SE3, Floats]]:
    """X, Z and their inverses with the covariances of their right tangents."""
    found = []
    for name, motion in zip(solution.names, (solution.x, solution.z), strict=True):
        covariance = solution.covariance.block(motion_labels(name))
        found.append((name, motion, covariance))
        # (M exp(d))^-1 = M^-1 exp(-Ad(M) d).
        adjoint = se3_adjoint(motion.matrix)
        inverse = "_from_".join(reversed(name.split("_from_")))
        found.append((inverse, motion.inverse(), adjoint @ covariance @ adjoint.T))
    return found


def solved_text(solved: SolvedPairs) -> str:
    """The result for a terminal, verdict first."""
    return "\n".join(
        [
            *_verdict_lines(solved),
            "",
            *_motion_lines(solved),
            "",
            *_noise_lines(solved.solution),
            "",
            *_residual_lines(solved.solution),
        ]
    )


def _verdict_lines(solved: SolvedPairs) -> list[str]:
    verdict, solution = solved.verdict, solved.solution
    ran = [gate for gate in verdict.gates if gate.verdict != "not run"]
    met = [gate for gate in ran if gate.verdict != "bad"]
    gates = verdict.gates
    name, found, limit = (
        max(len(getattr(gate, key)) for gate in gates) + 2
        for key in ("name", "found", "limit")
    )
    lines = [
        f"VERDICT  {verdict.outcome}      {counted(len(solution.poses), 'pose')}, "
        f"{solved.pairs.mounting.replace('_', '-')}, {len(met)} of {len(ran)} gates "
        f"met, {len(gates) - len(ran)} not run",
        *wrapped(verdict.sentence),
        *wrapped(f"Nearest to failing: {verdict.nearest}."),
        f"  {'gate':<{name + 3}}{'found':<{found}}{'limit':<{limit}}{'verdict':<10}"
        "blind to",
    ]
    for number, gate in enumerate(gates, 1):
        lines.append(
            f"  {number:>2} {gate.name:<{name}}{gate.found:<{found}}"
            f"{gate.limit:<{limit}}{gate.verdict:<10}{gate.blind_to}"
        )
    for finding in verdict.findings:
        lines += wrapped(f"{finding.code}: {finding.cause}; {finding.evidence}")
        lines += wrapped(f"Do: {finding.remedy}.", 4)
    lines += ["", "READINGS  of the same numbers, each solved (medians over all poses)"]
    for reading in solved.readings:
        numbers = (
            f"{1e3 * reading.position:>12.3f} mm {np.degrees(reading.angle):>9.4f} deg"
        )
        first, *rest = wrap(f"{reading.key}: {reading.meaning}", LINE_WIDTH - 32)
        lines.append(f"{numbers}   {first}")
        lines += [" " * 34 + line for line in rest]
    return lines


def _open_rows(solution: PoseSolution, motion: SE3, name: str) -> NDArray[np.bool_]:
    """Which of x, y, z, rx, ry, rz an undetermined direction changes, shape (6,)."""
    rows = np.zeros(6, bool)
    inverse = name not in solution.names
    of_x = name.startswith("flange_from") or name.endswith("from_flange")
    for one in solution.undetermined:
        if one.kind == "shift":
            axis = one.axis_in_flange if of_x else one.axis_in_base
            # (R, t)^-1 has R' for its rotation and -R't for its place.
            axis = motion.rotation @ axis if inverse else axis
            rows[:3] |= np.abs(axis) > _MOVED
        else:
            rows |= np.repeat([True, one.kind == "turn"], 3)
    return rows


def _number(value: float, sigma: float) -> str:
    """A value and its standard deviation in two columns."""
    places = min(digits(sigma), _PLACES)
    rounded = f"{sigma:.{places}f}" if sigma >= 10**-_PLACES else f"{sigma:.0e}"
    return f"{value:>14.{places}f}{rounded:>14}"


def _motion_lines(solved: SolvedPairs) -> list[str]:
    solution = solved.solution
    lines = [f"RESULT    by {solution.method}"]
    lines.append(f"  {'':<30}{'value':>14}{'+- (1 sd)':>14}")
    for name, motion, covariance in _motions(solution):
        left = _open_rows(solution, motion, name)
        rows = motion_rows(name, motion, covariance, None)
        for row, is_open in zip(rows, left, strict=True):
            number = _number(row["value"], row["sigma"])
            if is_open:
                number = f"{row['value']:>14.3f}{'OPEN':>14}"
            lines.append(f"  {row['name'] + ', ' + row['unit']:<30}{number}")
        w, x, y, z = quaternion_wxyz(motion.rotation)
        lines.append(f"    quaternion w {w:.7f}  x {x:.7f}  y {y:.7f}  z {z:.7f}")
    if not solved.pairs.metric:
        sigma = solution.scale * solution.covariance.std("log_scale")
        open_scale = any(one.kind == "scale" for one in solution.undetermined)
        number = (
            f"{solution.scale:>14.6g}{'OPEN':>14}"
            if open_scale
            else _number(solution.scale, sigma)
        )
        lines.append(f"  {'metres per observed unit':<30}{number}")
    if solution.clock_offset is not None:
        sigma = 1e3 * solution.covariance.std("clock_offset")
        number = _number(1e3 * solution.clock_offset, sigma)
        lines.append(f"  {'camera clock - robot clock, ms':<30}{number}")
    for one in solution.undetermined:
        lines += wrapped(f"OPEN: {one.text}")
    return lines


def _noise_lines(solution: PoseSolution) -> list[str]:
    if solution.noise is None:
        return ["NOISE     not estimated by this method; sigmas by leaving poses out"]
    noise = solution.noise
    origin = "as stated" if solution.noise_is_stated else "estimated from the residuals"
    tail = (
        ""
        if solution.tail is None or np.isinf(solution.tail)
        else f"; heavy tails (Student, {solution.tail:g} degrees of freedom)"
    )
    if solution.correlation > 0:
        tail += f"; successive errors correlate by {solution.correlation:.2f}"
    return [
        f"NOISE     one sd, {origin}{tail}",
        f"  robot {1e3 * noise.robot_translation:.3g} mm, "
        f"{np.degrees(noise.robot_rotation):.3g} deg; camera "
        f"{1e3 * noise.lateral:.3g} mm across, {1e3 * noise.depth:.3g} mm along its "
        f"sight, {np.degrees(noise.rotation):.3g} deg",
    ]


def _residual_lines(solution: PoseSolution) -> list[str]:
    positions = 1e3 * solution.residual_positions
    angles = np.degrees(solution.residual_angles)
    used = solution.used
    lines = [
        f"RESIDUALS per pose; of those used {np.mean(positions[used]):.3f} mm, "
        f"{np.mean(angles[used]):.4f} deg mean"
    ]
    # Those dropped first, then the worst.
    order = np.lexsort((-positions, used))
    shown = max(_LISTED, len(solution.dropped))
    for i in order[:shown]:
        mark = "" if used[i] else "   DROPPED: noise cannot explain it"
        lines.append(
            f"  {solution.poses[i]:<20}{positions[i]:>10.3f} mm {angles[i]:>9.4f} deg"
            f"{mark}"
        )
    if len(order) > shown:
        lines.append(
            f"  and {len(order) - shown} more, of at most "
            f"{positions[order[shown:]].max():.3f} mm; --json has all"
        )
    return lines


def solved_json(solved: SolvedPairs) -> dict[str, Any]:
    """The result for programs; units are in the keys."""
    solution, verdict = solved.solution, solved.verdict
    motions = {}
    for name, motion, covariance in _motions(solution):
        sigma = np.sqrt(np.diagonal(covariance))
        w, x, y, z = quaternion_wxyz(motion.rotation).tolist()
        motions[name] = {
            "translation_m": motion.translation.tolist(),
            "quaternion": {"w": w, "x": x, "y": y, "z": z},
            "matrix": motion.matrix.tolist(),
            "sigma_translation_m": sigma[:3].tolist(),
            "sigma_rotation_rad": sigma[3:].tolist(),
            "covariance_of_right_tangent_m_rad": covariance.tolist(),
        }
    return {
        "schema": "handeye-tri solution 1",
        "verdict": verdict.outcome,
        "sentence": verdict.sentence,
        "nearest": verdict.nearest,
        "gates": [
            {
                "name": gate.name,
                "found": gate.found,
                "limit": gate.limit,
                "verdict": gate.verdict,
                "sees": gate.sees,
                "blind_to": gate.blind_to,
            }
            for gate in verdict.gates
        ],
        "findings": [
            {
                "code": finding.code,
                "cause": finding.cause,
                "evidence": finding.evidence,
                "remedy": finding.remedy,
            }
            for finding in verdict.findings
        ],
        "readings": [
            {
                "reading": one.key,
                "meaning": one.meaning,
                "position_median_mm": 1e3 * one.position,
                "angle_median_deg": float(np.degrees(one.angle)),
                "scale": one.scale,
            }
            for one in solved.readings
        ],
        "method": solution.method,
        "mounting": solved.pairs.mounting,
        "motions": motions,
        "scale_m_per_unit": solution.scale,
        "free_scale": None
        if solved.scale is None
        else {"value": solved.scale[0], "sigma": _finite(solved.scale[1])},
        "clock_offset_s": solution.clock_offset,
        "undetermined": [
            {
                "kind": one.kind,
                "axis_in_flange": one.axis_in_flange.tolist(),
                "axis_in_base": one.axis_in_base.tolist(),
            }
            for one in solution.undetermined
        ],
        "noise": None
        if solution.noise is None
        else {
            "stated": solution.noise_is_stated,
            **{
                f"{name}_{unit}": value
                for (name, value), unit in zip(
                    solution.noise.items(), ("m", "rad", "m", "m", "rad"), strict=True
                )
            },
        },
        "residuals": [
            {
                "pose": name,
                "position_mm": float(1e3 * position),
                "angle_deg": float(np.degrees(angle)),
                "used": bool(used),
            }
            for name, position, angle, used in zip(
                solution.poses,
                solution.residual_positions,
                solution.residual_angles,
                solution.used,
                strict=True,
            )
        ],
        "dropped": list(solution.dropped),
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
