"""From solved pose pairs to their verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from handeye_tri.diagnose.assess import radius_95
from handeye_tri.diagnose.gates import (
    Gate,
    Remedy,
    Verdict,
    graded,
    judge,
    loop_gate,
    touch_gate,
)
from handeye_tri.hand_eye.hypotheses import Reading
from handeye_tri.hand_eye.pose_solution import PoseSolution, Undetermined
from handeye_tri.records import PosePairs
from handeye_tri.se3 import so3_log

# Fewer poses leave so few redundant numbers that wrong input can fit by chance.
_LEAST_POSES = 6
_FEWEST = 3
_MOST_DROPPED = 0.3
# Robots that calibrate move by this much, metres; else the unit is doubtful.
PLAUSIBLE_SPREAD = (0.005, 10.0)
# Another reading must fit this many times worse to be ruled out.
_CLEARLY = 2.0
# Robot and camera may disagree on the metre by this much before it is a wrong input.
_SCALE_TOLERANCE = 0.02
# Factors between units that could be confused lie within these.
_UNITS = (1e-4, 1e4)
# Beyond this standard deviation the poses cannot tell a unit.
_VAGUE_SCALE = 0.1
_LEAST_CORRELATION = 0.5
# Exact data leave rounding, of which no ratio can be taken, metres.
_FLOOR = 1e-9
_CONSEQUENCES = ("RESIDUAL", "DROPPED", "LOOP")


def assess_pose_pairs(
    pairs: PosePairs,
    solution: PoseSolution,
    readings: tuple[Reading, ...],
    scale: tuple[float, float] | None,
    *,
    limit_position: float = 0.01,
    limit_angle: float = float(np.radians(1.0)),
) -> Verdict:
    """Judge solved pose pairs: is the input what it says, and is it enough.

    Args:
        pairs: What was stated.
        solution: Its solution.
        readings: The stated reading first, then the others.
        scale: Free scale and its standard deviation; None where it cannot be asked.
        limit_position: Largest accepted RMS position residual, metres.
        limit_angle: Largest accepted RMS orientation residual, radians.
    """
    used = solution.used
    misread = _better_reading(readings)
    unlike = "" if misread else _unlike_turns(solution, limit_angle)
    # Under a wrong reading no pose is wrong by itself.
    count = len(used) if misread else int(used.sum())
    gates = [
        _motion_gate(solution, misread is not None or unlike != ""),
        Gate(
            "enough poses",
            f"{count}",
            f"{_LEAST_POSES}",
            graded(_LEAST_POSES / max(count, 1)),
            "wrong input that fits by chance",
            "errors in the data",
            _LEAST_POSES / max(count, 1),
            undecided=True,
        ),
        *([] if misread else [_size_gate(pairs, solution)]),
        _residual_gate(
            "position residual, rms",
            float(np.sqrt(np.mean(solution.residual_positions[used] ** 2))),
            limit_position,
            1e3,
            "mm",
        ),
        _residual_gate(
            "orientation residual, rms",
            float(np.sqrt(np.mean(solution.residual_angles[used] ** 2))),
            limit_angle,
            float(np.degrees(1)),
            "deg",
        ),
    ]
    if solution.noise_is_stated and solution.chi2 is not None and solution.dof:
        gates.append(loop_gate(float(np.sqrt(solution.chi2 / solution.dof))))
    share = len(solution.dropped) / (_MOST_DROPPED * len(used))
    gates += [
        Gate(
            "dropped poses",
            f"{len(solution.dropped)} of {len(used)}",
            f"{_MOST_DROPPED:.0%}",
            graded(round(share, 9)),
            "wrong poses, mixed-up pairs",
            "errors common to all poses",
            share,
        ),
        # In a wrong unit no other reading is at its best either.
        *([] if misread and misread.key == "scaled" else [_reading_gate(readings)]),
    ]
    if misread is not None and misread.key == "scaled":
        gates.append(_scale_gate(misread.scale, 0.0))
    elif scale is not None and misread is None and not unlike:
        gates.append(_scale_gate(*scale))
    if solution.clock_correlation is not None:
        use = _LEAST_CORRELATION / max(solution.clock_correlation, 1e-9)
        gates.append(
            Gate(
                "clocks' correlation",
                f"{solution.clock_correlation:.2f}",
                f"{_LEAST_CORRELATION}",
                graded(use),
                "streams that do not belong together",
                "jitter",
                use,
                undecided=True,
            )
        )
    gates.append(touch_gate())
    if misread is not None:
        sentence = f"The poses contradict what is stated about them: {misread.meaning}."
    elif unlike:
        sentence = f"The poses contradict each other: {unlike}."
    else:
        sentence = _sentence(solution)
    verdict = judge(tuple(gates), sentence, _remedies(solution, readings, unlike))
    # Causes before what follows from them; so few poses that anything fits are one,
    # unless another reading stands out.
    few = "" if misread is not None and count > _FEWEST else "FEW"
    findings = sorted(
        verdict.findings, key=lambda one: (one.code != few, one.code in _CONSEQUENCES)
    )
    return replace(verdict, findings=tuple(findings))


def _better_reading(readings: tuple[Reading, ...]) -> Reading | None:
    """The reading that fits clearly better than the stated one, if any."""
    stated, *others = readings
    best = min(others, key=lambda one: one.misfit)
    if best.key == "scaled":
        near_one = abs(best.scale - 1) < _SCALE_TOLERANCE
        # Shrinking one side to a point fits whatever does not turn enough.
        collapsed = not _UNITS[0] < best.scale < _UNITS[1]
        if near_one or collapsed:
            return None
    floor = _FLOOR
    return best if stated.misfit + floor > _CLEARLY * (best.misfit + floor) else None


def _unlike_turns(solution: PoseSolution, limit: float) -> str:
    """In words, that the two sides do not turn by the same angles; empty if they do.

    Whatever X and Z are, between two poses both sides turn by one angle.
    """
    used = solution.used
    angles = []
    for poses in (solution.base_from_flange[used], solution.b[used]):
        rotations = poses[:, :3, :3]
        way = so3_log(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
        angles.append(np.linalg.norm(way, axis=1))
    # Each of the two poses may be off by the limit, noise by three times that.
    if np.median(np.abs(angles[0] - angles[1])) < 6 * limit:
        return ""
    robot, observed = np.degrees(np.median(angles, axis=1))
    return (
        "robot and target do not turn alike, from pose to pose by "
        f"{robot:.3g} deg and by {observed:.3g} deg (medians)"
    )


def _motion_gate(solution: PoseSolution, misread: bool) -> Gate:
    open_ones = solution.undetermined
    if misread:
        # The residuals of a wrong reading pass for noise and hide every direction.
        return Gate(
            "motion determines everything", "-", "1 x noise", "not run", "-", "-"
        )
    certainty = solution.certainty
    # A stated shift closes the only open direction.
    use = np.inf if open_ones else min(1 / max(certainty, 1e-9), 1.0)
    found = (
        f"open: {_kinds(open_ones)}"
        if open_ones
        else f"{min(certainty, 9999):.3g} x noise"
    )
    return Gate(
        "motion determines everything",
        found,
        "1 x noise",
        graded(use),
        "parallel axes, too little turning",
        "errors in the data",
        use,
        undecided=True,
    )


def _kinds(open_ones: tuple[Undetermined, ...]) -> str:
    """Such as "1 turn, 1 shift"."""
    kinds = [one.kind for one in open_ones]
    return ", ".join(
        f"{kinds.count(kind)} {kind}{'s' if kinds.count(kind) > 1 else ''}"
        for kind in dict.fromkeys(kinds)
    )


def _size_gate(pairs: PosePairs, solution: PoseSolution) -> Gate:
    extents = [
        float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)))
        for poses in (solution.base_from_flange, solution.b)
    ]
    extent = max(extents if pairs.metric else extents[:1])
    least, most = PLAUSIBLE_SPREAD
    use = max(least / max(extent, 1e-12), extent / most)
    return Gate(
        "poses spread over",
        f"{extent:.4g} m",
        f"{least:g}-{most:g} m",
        graded(use),
        "both sides in a wrong unit",
        "one side in a wrong unit",
        use,
        undecided=True,
    )


def _residual_gate(
    name: str, found: float, limit: float, factor: float, unit: str
) -> Gate:
    use = found / limit
    return Gate(
        name,
        f"{factor * found:.3g} {unit}",
        f"{factor * limit:.3g} {unit}",
        graded(use),
        "wrong input, a bad robot or camera",
        "errors common to all poses",
        use,
    )


def _reading_gate(readings: tuple[Reading, ...]) -> Gate:
    stated, *others = (one for one in readings if one.key != "scaled")
    best = min(others, key=lambda one: one.misfit)
    ratio = (stated.misfit + _FLOOR) / (best.misfit + _FLOOR)
    return Gate(
        "no other reading fits",
        f"{best.key}: {1 / ratio:.3g} x worse"
        if ratio < 1
        else f"{best.key}: {ratio:.3g} x better",
        f"{_CLEARLY:g} x worse",
        graded(_CLEARLY * ratio),
        "inverted poses, other mounting, shifted pairs",
        "both sides inverted",
        _CLEARLY * ratio,
        undecided=ratio < _CLEARLY,
    )


def _scale_gate(scale: float, sigma: float) -> Gate:
    vague = not sigma < _VAGUE_SCALE * max(scale, 1e-12)
    off = abs(scale - 1)
    use = np.inf if vague else max(off - 3 * sigma, 0.0) / _SCALE_TOLERANCE
    return Gate(
        "free scale",
        f"{scale:.5g} +- {sigma:.2g}",
        "1 +- 2 % + 3 sd",
        graded(use),
        "a wrong unit or target size",
        "both sides in a wrong unit",
        float(use),
        undecided=vague,
    )


def _sentence(solution: PoseSolution) -> str:
    if solution.undetermined:
        return (
            f"The poses leave {_kinds(solution.undetermined)} open: no accuracy can be "
            "stated."
        )
    radius = 1e3 * float(np.mean(radius_95(solution.placing() + 1e-30 * np.eye(3))))
    return (
        f"Calibration alone places an observed target in the robot's base within "
        f"{radius:.2g} mm (95 %)."
    )


def _remedies(
    solution: PoseSolution, readings: tuple[Reading, ...], unlike: str
) -> dict[str, Remedy]:
    others = [one for one in readings[1:] if one.key != "scaled"]
    best = min(others, key=lambda one: one.misfit)
    scaled = [one for one in readings if one.key == "scaled"]
    unit = scaled[0].meaning if scaled else "the target's size is unknown"
    return {
        "motion determines everything": (
            "MOTION",
            "; ".join(one.text for one in solution.undetermined)
            or "the poses hardly turn",
            "add poses that turn by 20 degrees or more about another axis, or measure "
            "an open shift and state it (--shift-along-axis-mm)",
        ),
        "enough poses": (
            "FEW",
            "so few poses fit wrong input by chance",
            "record 15 poses or more",
        ),
        "poses spread over": (
            "UNIT",
            "no robot calibrates over such a distance; both sides' unit may be wrong",
            "check translation_m against translation_mm in the file",
        ),
        "position residual, rms": (
            "RESIDUAL",
            "robot and camera contradict each other",
            "see the other readings below; then check the robot, the target's size and "
            "the camera's calibration",
        ),
        "orientation residual, rms": (
            "RESIDUAL",
            unlike or "robot and camera contradict each other in orientation",
            "check the rotations' format (degrees or radians, order of a quaternion or "
            "of Euler angles), and see the other readings below",
        ),
        "loop residual / expected": (
            "LOOP",
            "the residuals are not of the stated noise's size",
            "check the stated noise, the robot, and the pairing",
        ),
        "dropped poses": (
            "DROPPED",
            "many poses contradict the others",
            "see which ones below and record them again",
        ),
        "no other reading fits": (
            "READING",
            f"another reading fits as well or better: {best.meaning}",
            "find out which is true, and correct the file; nothing is converted",
        ),
        "free scale": (
            "SCALE",
            f"both sides disagree on lengths: {unit}",
            "check the unit of both sides and the target's size; nothing is converted",
        ),
        "clocks' correlation": (
            "CLOCKS",
            "the two streams hardly turn alike",
            "check that both are of the same motion and turn fast and slow",
        ),
    }
