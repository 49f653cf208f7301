"""Half-turns that tell nearly as much, and lie where the arm passes anyway.

The choice that tells most is one of many that tell almost as much. A half-turn is
exchanged for another as long as that shortens the programme and all that the
exchanges cost stays within a limit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.plan.candidates import Prospect
from handeye_tri.plan.route import RoutePlanner
from handeye_tri.plan.selection import Selector

Floats = NDArray[np.float64]

# What the calibration's part of the track error may grow by for a shorter programme.
_WORSE = 1.01
# How often all half-turns are gone through, and how many others are tried for each.
_SWEEPS = 2
_TRIES = 4
# An exchange must save as much, seconds.
_LEAST_GAIN = 0.02
# Rounds of the search for an order: of what was chosen first, and after an exchange.
_FIRST_ROUNDS = 500
_ROUNDS = 150


@dataclass(frozen=True, slots=True)
class Shortening:
    """What exchanges need to know.

    Attributes:
        route: Orders stations.
        selector: Knows what half-turns tell and which are free.
        pool: The half-turns to choose from.
        solutions: Joints by which a place is visited, shapes (2, q), by index.
    """

    route: RoutePlanner
    selector: Selector
    pool: Sequence[Prospect]
    solutions: Callable[[int], Sequence[Floats]]

    def exchanged(
        self, chosen: list[int], others: Sequence[Sequence[Floats]], start: Floats
    ) -> list[int]:
        """Exchange half-turns while that shortens the programme.

        Args:
            chosen: Indices of the half-turns that tell most.
            others: Solutions of the stations visited besides.
            start: Where the arm comes from, shape (q,).

        Returns:
            As many indices; the cost grew by no more than the limit.
        """
        limit = _WORSE**2 * self.selector.cost(chosen)

        def ordered(indices: list[int], rounds: int) -> tuple[float, list[int], Floats]:
            places = [*(self.solutions(k) for k in indices), *others]
            seconds, stops = self.route.order(places, start, rounds)
            joints = np.array([start, *(stop.joints for stop in stops)])
            return seconds, [-1, *(stop.place for stop in stops)], joints

        now, visited, joints = ordered(chosen, _FIRST_ROUNDS)
        for _ in range(_SWEEPS):
            before = now
            for place in range(len(chosen)):
                rest = joints[np.array(visited) != place]
                for other in self._nearer(chosen, place, rest, limit, now):
                    if not self.selector.passes(other):
                        continue
                    changed = [*chosen[:place], other, *chosen[place + 1 :]]
                    # A camera's sight of it may have turned out blocked.
                    if self.selector.cost(changed) > limit:
                        continue
                    found = ordered(changed, _ROUNDS)
                    if found[0] < now:
                        chosen, (now, visited, joints) = changed, found
                        break
            if now == before:
                break
        return chosen

    def _nearer(
        self, chosen: list[int], place: int, rest: Floats, limit: float, now: float
    ) -> list[int]:
        """What may stand for one half-turn and promises a shorter programme."""
        able = self.selector.swaps(chosen, place, limit)
        if len(able) == 0:
            return []
        pairs = [self.route.pairs(self.pool[k].joints) for k in able]
        owner = np.repeat(np.arange(len(able)), [len(each) for each in pairs])
        added = inserted(self.route.time, rest, np.concatenate(pairs))
        least = np.full(len(able), np.inf)
        np.minimum.at(least, owner, added)
        total = self.route.time(rest[:-1], rest[1:]).sum() + least
        best = np.argsort(total, kind="stable")[:_TRIES]
        return [int(able[k]) for k in best if total[k] < now - _LEAST_GAIN]


def inserted(
    time: Callable[[Floats, Floats], Floats], rest: Floats, pairs: Floats
) -> Floats:
    """Least seconds that two more stations add to an order.

    Args:
        time: Of moves between joints (..., q).
        rest: The order, shape (n, q); the first is where it starts.
        pairs: Joints at both stations, shape (w, 2, q).

    Returns:
        Shape (w,).
    """
    now = np.append(time(rest[:-1], rest[1:]), 0.0)
    arrive = [time(rest, pairs[:, [step]]) for step in (0, 1)]
    # Nothing follows the last: leaving it costs nothing.
    end = np.zeros((len(pairs), 1))
    leave = [np.concatenate([one[:, 1:], end], axis=1) for one in arrive]
    together = time(pairs[:, 0], pairs[:, 1])[:, None] - now
    forth = arrive[0] + together + leave[1]
    back = arrive[1] + together + leave[0]
    least = np.minimum(forth, back).min(axis=1)
    if len(rest) > 1:
        # Apart: each where it adds least, one of them elsewhere if that is the same.
        added = [one + other - now for one, other in zip(arrive, leave, strict=True)]
        gaps = [np.argsort(one, axis=1)[:, :2] for one in added]
        (a, a2), (b, b2) = (
            np.take_along_axis(one, gap, axis=1).T
            for one, gap in zip(added, gaps, strict=True)
        )
        same = gaps[0][:, 0] == gaps[1][:, 0]
        apart = np.where(same, np.minimum(a + b2, a2 + b), a + b)
        least = np.minimum(least, apart)
    return np.asarray(least)
