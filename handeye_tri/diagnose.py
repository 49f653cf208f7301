"""Gates and verdict: is this calibration fit for use, and how is that known.

A gate compares one figure with one limit and says what it sees and what it is
blind to. The verdict follows from the gates alone: PASS when every gate that ran
is met, FAIL when one is not, CANNOT TELL when the data cannot decide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from handeye_tri.records import HandEyeCalibration, Session, TrackEvaluation
from handeye_tri.se3 import so3_log

Floats = NDArray[np.float64]
GateVerdict = Literal["good", "marginal", "bad", "not run"]
Outcome = Literal["PASS", "FAIL", "CANNOT TELL"]

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
    """

    code: str
    cause: str
    evidence: str
    severity: Literal["note", "warning", "error"]
    remedy: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """The answer, first.

    Attributes:
        outcome: PASS, FAIL or CANNOT TELL.
        sentence: The headline in millimetres.
        gates: All gates, those not run included.
        nearest: The gate closest to failing (or failing most), in words.
        findings: What is wrong, worst first.
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
