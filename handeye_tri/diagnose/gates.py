"""Gates and verdict: is this calibration fit for use, and how is that known.

A gate compares one figure with one limit and says what it sees and what it is
blind to. The verdict follows from the gates alone: PASS when every gate that ran
is met, FAIL when one is not, CANNOT TELL when the data cannot decide.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

GateVerdict = Literal["good", "marginal", "bad", "not run"]
Outcome = Literal["PASS", "FAIL", "CANNOT TELL"]
# Code, cause, what to do.
Remedy = tuple[str, str, str]

# Name of the gate that holds the held-out track against its prediction.
PREDICTION_GATE = "held-out track / predicted"
# Within this share of its limit a gate that is met is called marginal.
_MARGINAL = 0.85


@dataclass(frozen=True, slots=True)
class Gate:
    """One check with its limit.

    Attributes:
        name: What is compared.
        found: The figure with its unit.
        limit: The limit with its unit.
        verdict: "good", "marginal" (met, by less than 15 %), "bad" or "not run".
        sees: What makes this gate fail.
        blind_to: What it cannot see.
        use: Share of the limit that is used up; above 1 is failing.
        undecided: Whether failing means CANNOT TELL rather than FAIL.
    """

    name: str
    found: str
    limit: str
    verdict: GateVerdict
    sees: str
    blind_to: str
    use: float = 0.0
    undecided: bool = False


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that is wrong or doubtful.

    Attributes:
        code: Short name.
        cause: What is likely wrong.
        evidence: The numbers.
        severity: "note", "warning" or "error".
        remedy: What to do.
        stations: Indices of the stations that it is about; none where it is about all.
        camera: Name of the camera that it is about; "" where it is about all.
        follows: Code of the finding that it most likely follows from; "" for one that
            stands by itself.
    """

    code: str
    cause: str
    evidence: str
    severity: Literal["note", "warning", "error"]
    remedy: str
    stations: tuple[int, ...] = ()
    camera: str = ""
    follows: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The answer, first.

    Attributes:
        outcome: PASS, FAIL or CANNOT TELL.
        sentence: The headline in millimetres.
        gates: All gates, those not run included.
        nearest: The gate closest to failing (or failing most), in words.
        findings: What is wrong, worst first; what follows from others comes last.
    """

    outcome: Outcome
    sentence: str
    gates: tuple[Gate, ...]
    nearest: str
    findings: tuple[Finding, ...]


def graded(use: float) -> GateVerdict:
    """Grade a gate by the share of its limit that is used up."""
    if not np.isfinite(use) or use > 1:
        return "bad"
    return "marginal" if use > _MARGINAL else "good"


def half_turn_gate(found_px: float, expected_px: float) -> Gate:
    """Did the rig turn by 180 degrees about the axis that was asked for?

    Args:
        found_px: Worst half-turn's misfit in the images, px.
        expected_px: One standard deviation of that misfit from pixel noise and the
            robot's stated repeatability, px.
    """
    limit = 5 * expected_px
    use = found_px / limit
    return Gate(
        "half-turns as executed",
        f"{found_px:.2f} px",
        f"{limit:.2f} px",
        graded(use),
        "slip, swapped markers, a turn that is not 180 deg",
        "scale",
        use,
    )


def motion_gate(spread_deg: float, rank: int, needed_deg: float) -> Gate:
    """Do the motions determine everything (Proposition 1, Sec. III-F)?

    Args:
        spread_deg: Largest angle between two supporting planes, degrees.
        rank: Dimension that the rotation axes of the relative motions span.
        needed_deg: Least spread that is accepted, degrees.
    """
    use = needed_deg / spread_deg if spread_deg > 0 and rank >= 2 else np.inf
    return Gate(
        "motion determines everything",
        f"{spread_deg:.0f} deg, rank {rank}",
        f"{needed_deg:.0f} deg, rank 2",
        graded(use),
        "parallel planes, too little turning",
        "errors in the data",
        float(use),
        undecided=True,
    )


def loop_gate(ratio: float) -> Gate:
    """Are the loop's residuals as large as the stated noise makes them?

    Args:
        ratio: Root of chi2/dof of the hand-eye step.
    """
    use = max(ratio / 1.6, 0.6 / ratio if ratio > 0 else np.inf)
    return Gate(
        "loop residual / expected",
        f"{ratio:.2f}",
        "0.6-1.6",
        graded(use),
        "robot, cameras, pairing of poses",
        "a uniform scale",
        float(use),
    )


def scale_gate(scale: float, sigma: float) -> Gate:
    """Do robot and cameras agree on the metre?

    Args:
        scale: Robot's lengths over the cameras' lengths.
        sigma: Its standard deviation.
    """
    limit = 4 * sigma
    undecided = limit > 0.02
    use = np.inf if undecided else abs(scale - 1) / limit
    return Gate(
        "free scale",
        f"{scale:.5f}",
        f"1 +- {limit:.5f}",
        graded(float(use)),
        "wrong side length, wrong unit",
        "errors that keep lengths",
        float(use),
        undecided=undecided,
    )


def track_gate(worst_mm: float, limit_mm: float) -> Gate:
    """Is the held-out track good enough for the work?

    Args:
        worst_mm: Largest distance of reported and observed markers, mm.
        limit_mm: What the cell's description allows, mm.
    """
    use = worst_mm / limit_mm
    return Gate(
        "held-out track, worst",
        f"{worst_mm:.2f} mm",
        f"{limit_mm:.2f} mm",
        graded(use),
        "everything in view",
        "places not visited",
        use,
    )


def prediction_gate(ratio: float) -> Gate:
    """Is the held-out track as accurate as the covariances promised?

    Args:
        ratio: RMS of the held-out track over the RMS predicted for it.
    """
    use = ratio / 2.0
    return Gate(
        PREDICTION_GATE,
        f"{ratio:.2f}",
        "2.00",
        graded(use),
        "noise larger than stated, a wrong model",
        "too large a stated noise",
        use,
    )


def touch_gate() -> Gate:
    """The test that only the user can make."""
    return Gate("touch test", "-", "-", "not run", "the real task", "-")


_REMEDIES: dict[str, Remedy] = {
    "half-turns as executed": (
        "HALF_TURN",
        "a half-turn was not a turn by 180 degrees about the stated axis",
        "check the axis, that the rig is tight, and that no marker was mistaken",
    ),
    "motion determines everything": (
        "MOTION",
        "the planes of the half-turns are nearly parallel",
        "add half-turns tilted by 30 degrees about another axis",
    ),
    "loop residual / expected": (
        "LOOP",
        "robot poses and camera poses disagree by more (or less) than their noise",
        "check the stated repeatability and the pairing of poses; where joints or "
        "links of the robot may be off, estimate that too: handeye-tri calibrate "
        "--robot joint-offsets,link-corrections",
    ),
    "free scale": (
        "SCALE",
        "robot and cameras disagree on the metre, or the data cannot tell",
        "measure the triangle's sides again and check the unit of the poses",
    ),
    "held-out track, worst": (
        "TRACK",
        "the held-out track is worse than the cell allows",
        "see which findings stand beside this one; add half-turns, or mend the cause",
    ),
    PREDICTION_GATE: (
        "PREDICTION",
        "the held-out track is worse than its own prediction",
        "the noise is larger than stated or a model is wrong: look at the residuals",
    ),
}


def judge(
    gates: tuple[Gate, ...],
    sentence: str,
    remedies: Mapping[str, Remedy] | None = None,
) -> Verdict:
    """Draw the verdict from the gates.

    Args:
        gates: All gates, those not run included.
        sentence: The headline in millimetres, true whatever the outcome.
        remedies: Code, cause and remedy by the name of a gate; None takes those of a
            calibrated session.
    """
    known = _REMEDIES if remedies is None else remedies
    ran = [gate for gate in gates if gate.verdict != "not run"]
    bad = [gate for gate in ran if gate.verdict == "bad"]
    worst = max(ran, key=lambda gate: gate.use)
    outcome: Outcome = "PASS"
    if bad:
        outcome = "CANNOT TELL" if any(gate.undecided for gate in bad) else "FAIL"
    findings = tuple(
        Finding(
            known[gate.name][0],
            known[gate.name][1],
            f"{gate.name}: {gate.found} (limit {gate.limit})",
            "error",
            known[gate.name][2],
        )
        for gate in sorted(bad, key=lambda gate: -gate.use)
    )
    nearest = f"{worst.name} {worst.found} (limit {worst.limit})"
    return Verdict(outcome, sentence, gates, nearest, findings)
