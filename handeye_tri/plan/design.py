"""Which candidates to choose: the best few, and how good any choice could be.

The calibration's information is a sum over the chosen candidates, and what it is
worth is a linear function of the inverse of that sum: an L-optimal design (Pukelsheim
2006, Optimal Design of Experiments, ch. 2). Choosing is combinatorial; allowing
fractions of candidates makes it convex and bounds every choice from below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Relative gap between the cost of a fractional design and its lower bound.
_GAP = 2e-3
# Factor by which the barrier's weight falls from one centring to the next.
_BARRIER = 0.15
# Candidates in the first restricted problem, per candidate wanted; how many of
# those that would improve it join in a round.
_FIRST = 16
_JOIN = 8
_ROUNDS = 20
# Most rounds of exchange; three or four suffice.
_EXCHANGES = 12
# Least relative gain for which a candidate is exchanged.
_GAIN = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Relaxation:
    """A fractional design.

    Attributes:
        weights: Fraction of each candidate, shape (n,), 0 to 1; the sum is the
            number wanted.
        bound: No choice of that number has a lower cost.
    """

    weights: Floats
    bound: float


@dataclass(frozen=True, slots=True, eq=False)
class Kinds:
    """Of which kind candidates are, and how many of each a choice has at least.

    Attributes:
        of: Kind of each candidate, shape (n,).
        least: By kind.
    """

    of: NDArray[np.intp]
    least: tuple[int, ...]

    def lacking(self, members: NDArray[np.intp] | list[int]) -> list[int]:
        """Kinds that candidates, shape (k,), have too few of."""
        counts = np.bincount(
            self.of[np.asarray(members, dtype=np.intp)], minlength=len(self.least)
        )
        return [k for k, least in enumerate(self.least) if counts[k] < least]

    def instead(self, chosen: list[int], current: int) -> Flags:
        """Candidates that may stand for one of the chosen, shape (n,)."""
        kind = self.of[current]
        if kind in self.lacking([k for k in chosen if k != current]):
            return np.asarray(self.of == kind)
        return np.ones(len(self.of), dtype=bool)

    def filled(
        self, chosen: list[int], ranked: NDArray[np.intp], wanted: int
    ) -> list[int]:
        """The first of ranked candidates, shape (k,), join a choice of too few."""
        chosen = list(chosen)
        others = [int(k) for k in ranked if k not in chosen]
        for kind, least in enumerate(self.least):
            missing = least - int((self.of[chosen] == kind).sum()) if chosen else least
            own = [k for k in others if self.of[k] == kind]
            chosen += own[: max(missing, 0)]
        others = [k for k in others if k not in chosen]
        return chosen + others[: wanted - len(chosen)]


class Design:
    """Candidates, what they tell, and what a covariance costs.

    Works in coordinates in which the information of all candidates together is the
    identity: pixels, metres and radians differ by many orders.
    """

    def __init__(
        self,
        information: Floats,
        prior: Floats,
        cost: Floats,
        kinds: Kinds | None = None,
    ) -> None:
        """Scale the problem.

        Args:
            information: Of every candidate, shape (n, p, p), positive semidefinite.
            prior: Information known before, shape (p, p), positive definite.
            cost: The cost of a covariance is ``trace(cost @ covariance)``; shape
                (p, p), positive semidefinite.
            kinds: How many of which candidates a choice must have; None: any will do.
        """
        alike = np.zeros(len(information), dtype=np.intp)
        self.kinds = Kinds(alike, (0,)) if kinds is None else kinds
        total = prior + information.sum(axis=0)
        scale = 1.0 / np.sqrt(np.diag(total))
        root = np.linalg.cholesky(total * scale[:, None] * scale)
        to = scale[:, None] * np.linalg.inv(root).T
        self._to = to
        self._information = to.T @ information @ to
        self._prior = to.T @ prior @ to
        self._cost = to.T @ cost @ to
        self._flat = self._information.reshape(len(information), -1)

    def __len__(self) -> int:
        return len(self._information)

    def change(self, candidate: int, information: Floats) -> None:
        """Correct what one candidate tells.

        Args:
            candidate: Its index.
            information: Shape (p, p).
        """
        self._information[candidate] = self._to.T @ information @ self._to

    def cost(self, weights: Floats) -> float:
        """Cost of a design, shape (n,) of fractions or zeros and ones."""
        return float((self._cost * self._covariance(weights)).sum())

    def _total(self, weights: Floats) -> Floats:
        size = len(self._prior)
        return np.asarray(self._prior + (weights @ self._flat).reshape(size, size))

    def _covariance(self, weights: Floats) -> Floats:
        return np.asarray(np.linalg.inv(self._total(weights)))

    def _slopes(self, covariance: Floats, members: NDArray[np.intp]) -> Floats:
        """Derivative of the cost by the weights of some candidates."""
        slope = covariance @ self._cost @ covariance
        return np.asarray(-self._flat[members] @ slope.ravel())

    def relax(self, wanted: int, usable: Flags) -> Relaxation:
        """The best fractional design and a lower bound on any choice.

        A barrier method on the candidates that matter; others join as long as
        they improve the bound. The bound is the linearised cost's minimum (the
        Frank-Wolfe dual), which holds wherever it is taken.

        Args:
            wanted: Sum of the weights.
            usable: Which candidates may be chosen, shape (n,), at least ``wanted``.
        """
        members = np.flatnonzero(usable)
        weights = np.zeros(len(self))
        weights[members] = wanted / len(members)
        bound = 0.0
        slopes = self._slopes(self._covariance(weights), members)
        inner = members[np.argsort(slopes, kind="stable")[: _FIRST * wanted]]
        for _ in range(_ROUNDS):
            weights = np.zeros(len(self))
            weights[inner] = self._centre(inner, wanted)
            covariance = self._covariance(weights)
            value = float((self._cost * covariance).sum())
            slopes = self._slopes(covariance, members)
            steepest = np.sort(slopes)[:wanted].sum()
            bound = max(bound, value - float(slopes @ weights[members] - steepest))
            if value - bound <= _GAP * value:
                break
            outside = ~np.isin(members, inner)
            ranked = members[outside][np.argsort(slopes[outside], kind="stable")]
            if len(ranked) == 0:
                break
            inner = np.concatenate([inner, ranked[: _JOIN * wanted]])
        return Relaxation(weights, bound)

    def _centre(self, members: NDArray[np.intp], wanted: int) -> Floats:
        """Weights of some candidates by Newton's method with a log barrier."""
        n = len(members)
        if n <= wanted:
            return np.ones(n)
        information = self._information[members]
        weights = np.full(n, wanted / n)
        barrier = self.cost(_spread(weights, members, len(self))) / n
        while True:
            for _ in range(8):
                step, decrement = self._newton(weights, information, barrier)
                towards = np.where(step < 0, -weights, 1 - weights)
                with np.errstate(divide="ignore", invalid="ignore"):
                    room = np.where(step != 0, towards / step, np.inf)
                weights = weights + min(1.0, 0.95 * float(room.min())) * step
                if decrement < 0.05 * barrier:
                    break
            value = self.cost(_spread(weights, members, len(self)))
            if 2 * n * barrier < 0.25 * _GAP * value:
                return weights
            barrier *= _BARRIER

    def _newton(
        self, weights: Floats, information: Floats, barrier: float
    ) -> tuple[Floats, float]:
        """Newton's step on the sum's plane, and half the squared decrement."""
        n = len(weights)
        total = self._prior + np.tensordot(weights, information, 1)
        root = np.linalg.inv(np.linalg.cholesky(total))
        local = (root @ information @ root.T).reshape(n, -1)
        cost = root @ self._cost @ root.T
        slopes = -local @ cost.ravel() - barrier * (1 / weights - 1 / (1 - weights))
        weighted = (local.reshape(information.shape) @ cost).reshape(n, -1)
        curvature = weighted @ local.T
        curvature += curvature.T
        curvature[range(n), range(n)] += barrier * (
            1 / weights**2 + 1 / (1 - weights) ** 2
        )
        both = np.linalg.solve(curvature, np.stack([slopes, np.ones(n)], axis=1))
        step = -both[:, 0] + both[:, 1] * both[:, 0].sum() / both[:, 1].sum()
        return step, float(-0.5 * slopes @ step)

    def ranked(self, weights: Floats, usable: Flags) -> NDArray[np.intp]:
        """Usable candidates, those first that would lower a design's cost most.

        Args:
            weights: The design, shape (n,).
            usable: Shape (n,).

        Returns:
            Indices, one for each usable candidate.
        """
        members = np.flatnonzero(usable)
        slopes = self._slopes(self._covariance(weights), members)
        return np.asarray(members[np.argsort(slopes, kind="stable")])

    def exchange(self, chosen: list[int], usable: Flags) -> list[int]:
        """Replace one candidate at a time as long as that lowers the cost.

        Fedorov's exchange (Fedorov 1972, Theory of Optimal Experiments, ch. 3).

        Args:
            chosen: Where to start, with enough of each kind.
            usable: Which candidates may be chosen, shape (n,).

        Returns:
            As many candidates, ascending.
        """
        chosen = list(chosen)
        weights = np.zeros(len(self))
        weights[chosen] = 1.0
        total = self._total(weights)
        for _ in range(_EXCHANGES):
            before = list(chosen)
            for place, current in enumerate(chosen):
                without = total - self._information[current]
                able = usable & self.kinds.instead(chosen, current)
                able[chosen] = False
                others = np.flatnonzero(able)
                best = self._best(without, others, current)
                if best != current:
                    chosen[place] = best
                    total = without + self._information[best]
            if chosen == before:
                break
        return sorted(chosen)

    def swaps(
        self, chosen: list[int], place: int, usable: Flags, limit: float
    ) -> NDArray[np.intp]:
        """What one of the chosen may be replaced by at a cost below a limit.

        Args:
            chosen: The choice.
            place: Which of them goes.
            usable: Which candidates may come, shape (n,).
            limit: Of the cost then.

        Returns:
            Indices, ascending.
        """
        weights = np.zeros(len(self))
        weights[chosen] = 1.0
        without = self._total(weights) - self._information[chosen[place]]
        able = usable & self.kinds.instead(chosen, chosen[place])
        able[chosen] = False
        hopeful, costs = self._costs(without, np.flatnonzero(able), limit)
        return np.asarray(hopeful[costs < limit])

    def _costs(
        self, without: Floats, others: NDArray[np.intp], limit: float
    ) -> tuple[NDArray[np.intp], Floats]:
        """Candidates that may cost less than a limit, and what each then costs.

        The cost is convex: its slope bounds it from below without an inverse.
        """
        covariance = np.asarray(np.linalg.inv(without))
        value = float((self._cost * covariance).sum())
        hopeful = others[value + self._slopes(covariance, others) < limit]
        inverses = np.linalg.inv(without + self._information[hopeful])
        return hopeful, np.einsum("ab,nab->n", self._cost, inverses)

    def _best(self, without: Floats, others: NDArray[np.intp], current: int) -> int:
        """The candidate that lowers the cost most, the current one if none does."""
        now = np.linalg.inv(without + self._information[current])
        limit = float((self._cost * now).sum()) * (1 - _GAIN)
        hopeful, costs = self._costs(without, others, limit)
        if len(hopeful) == 0:
            return current
        best = int(np.argmin(costs))
        if costs[best] >= limit:
            return current
        return int(hopeful[best])


def _spread(values: Floats, members: NDArray[np.intp], size: int) -> Floats:
    result = np.zeros(size)
    result[members] = values
    return result
