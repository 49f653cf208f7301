"""The form of what stands behind a code of a finding."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Explanation:
    """The long text of a finding.

    Attributes:
        says: What was found.
        causes: What brings it about, the likeliest first.
        numbers: What the figures in its line are, and where the limit comes from.
        invalidates: What must not be used while it stands, and what still may.
        remedy: What to do, in order.
    """

    says: str
    causes: tuple[str, ...]
    numbers: str
    invalidates: str
    remedy: tuple[str, ...]
