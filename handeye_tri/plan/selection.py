"""Choosing half-turns by what they tell, looking at solids only where it matters.

Whether a half-turn tells much costs microseconds, whether solids allow it costs
milliseconds. So the best choice is made first and checked then, until everything
that the choice and its bound rest on has passed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.plan.candidates import Candidate, Prospect
from handeye_tri.plan.design import Design

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Half-turns that are checked first, as drawn: where none of them passes, none will.
_PROBE = 60
# A fraction of a candidate that the bound rests on.
_SUPPORT = 1e-3
# Runners-up checked along with what is chosen, per half-turn wanted.
_RUNNERS_UP = 3
# Most half-turns that are checked; after that only those that passed count.
_MOST_CHECKS = 600


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The half-turns that tell most.

    Attributes:
        chosen: Indices of prospects, ascending.
        bound: No choice among the usable prospects costs less; see Design.
    """

    chosen: list[int]
    bound: float


class Selector:
    """Chooses among prospects; remembers which of them solids allow.

    Attributes:
        usable: Prospects not known to be blocked nor replaced, shape (n,).
        checked: How many were checked.
    """

    def __init__(
        self,
        design: Design,
        prospects: Sequence[Prospect],
        free: Callable[[Prospect, int], list[Candidate]],
        wanted: int,
        progress: Callable[[], None],
        tells: Callable[[Candidate], Floats],
    ) -> None:
        """Start with nothing known.

        Args:
            design: Of the prospects.
            prospects: At least ``wanted``.
            free: Up to so many of a prospect's candidates that solids allow.
            wanted: How many to choose.
            progress: Called after each check.
            tells: Information of a checked candidate, shape (p, p).
        """
        self._design = design
        self._prospects = prospects
        self._free = free
        self._wanted = wanted
        self._progress = progress
        self._tells = tells
        self._changed = 0
        self._found: dict[int, Candidate] = {}
        self.usable = np.ones(len(prospects), dtype=bool)
        self.checked = 0

    def candidate(self, index: int) -> Candidate:
        """A prospect that passed."""
        return self._found[index]

    def probe(self, among: NDArray[np.intp]) -> int:
        """Check the first of some prospects, shape (k,); returns how many passed."""
        return sum(self.passes(int(index)) for index in among[:_PROBE])

    def passes(self, index: int) -> bool:
        """Whether solids allow a prospect; looked at once."""
        if index in self._found:
            return True
        if not self.usable[index]:
            return False
        free = self._free(self._prospects[index], 1)
        self.checked += 1
        self._progress()
        if not free:
            self.usable[index] = False
            return False
        candidate = free[0]
        self._found[index] = candidate
        if (candidate.seen != self._prospects[index].seen).any():
            # Something hides the rig from a camera, but not from too many.
            self._changed += 1
            self._design.change(index, self._tells(candidate))
        if self.checked == _MOST_CHECKS:
            self.usable[:] = False
            self.usable[list(self._found)] = True
        return True

    def select(self, among: Flags | None = None) -> Selection | None:
        """The best choice, checked; None where too few prospects pass.

        Args:
            among: Which prospects are looked at, shape (n,); None: all.
        """
        among = np.ones(len(self.usable), dtype=bool) if among is None else among
        while self.enough(usable := self.usable & among):
            relaxation = self._design.relax(self._wanted, usable)
            chosen = self._rounded(relaxation.weights, usable)
            needed = np.flatnonzero(relaxation.weights > _SUPPORT)
            ahead = self._design.ranked(relaxation.weights, usable)
            ahead = ahead[: _RUNNERS_UP * self._wanted]
            before = int(self.usable.sum()) - self._changed
            blocked = [k for k in {*chosen, *needed} if not self.passes(int(k))]
            if not blocked and before == int(self.usable.sum()) - self._changed:
                return Selection(chosen, relaxation.bound)
            for k in ahead:
                self.passes(int(k))
        return None

    def enough(self, usable: Flags) -> bool:
        """Whether there are as many as wanted, and enough of each kind."""
        members = np.flatnonzero(usable)
        return len(members) >= self._wanted and not self._design.kinds.lacking(members)

    def cost(self, chosen: list[int]) -> float:
        """What a choice costs; see Design."""
        weights = np.zeros(len(self._prospects))
        weights[chosen] = 1.0
        return self._design.cost(weights)

    def swaps(self, chosen: list[int], place: int, limit: float) -> NDArray[np.intp]:
        """Usable prospects that may stand for one of the chosen; see Design."""
        return self._design.swaps(chosen, place, self.usable, limit)

    def replace(self, chosen: list[int], unwanted: int) -> list[int] | None:
        """The best choice without one of a choice's half-turns, checked."""
        self.usable[unwanted] = False
        chosen = [k for k in chosen if k != unwanted]
        while self.enough(self.usable):
            weights = np.zeros(len(self._prospects))
            weights[chosen] = 1.0
            ranked = self._design.ranked(weights, self.usable)
            chosen = self._design.kinds.filled(chosen, ranked, self._wanted)
            chosen = self._design.exchange(chosen, self.usable)
            free = [k for k in chosen if self.passes(k)]
            if len(free) == self._wanted:
                return chosen
            chosen = [k for k in free if self.usable[k]]
        return None

    def _rounded(self, weights: Floats, usable: Flags) -> list[int]:
        order = np.argsort(-weights, kind="stable")
        start = self._design.kinds.filled([], order[usable[order]], self._wanted)
        return self._design.exchange(start, usable)
