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


def allowed(cost: float) -> float:
    """What a choice may cost for a shorter programme, the best one costing so much."""
    return _WORSE**2 * cost


@dataclass(frozen=True, slots=True, eq=False)
class Trip:
    """All stations with one mount, to be ordered.

    Attributes:
        mount: Which, from 0.
        route: Orders stations.
        others: Solutions of the stations visited besides half-turns, shapes (1, q).
        start: Where the arm comes from, shape (q,).
        end: Where it goes to from the last station, shape (q,); None: nowhere.
    """

    mount: int
    route: RoutePlanner
    others: Sequence[Sequence[Floats]]
    start: Floats
    end: Floats | None


@dataclass(frozen=True, slots=True, eq=False)
class _Gap:
    """A trip with one of its half-turns left out.

    Attributes:
        place: Which of the chosen ones.
        rest: Joints where the arm starts, and at the other stations, shape (n, q).
        seconds: What the trip takes with it.
    """

    place: int
    rest: Floats
    seconds: float


@dataclass(frozen=True, slots=True)
class Shortening:
    """What exchanges need to know.

    Attributes:
        selector: Knows what half-turns tell and which are free.
        pool: The half-turns to choose from.
        solutions: Joints by which a place is visited, shapes (2, q), by index.
    """

    selector: Selector
    pool: Sequence[Prospect]
    solutions: Callable[[int], Sequence[Floats]]

    def exchanged(self, chosen: list[int], trip: Trip, limit: float) -> list[int]:
        """Exchange half-turns with one mount while that shortens its trip.

        Args:
            chosen: Indices of half-turns, with whichever mount.
            trip: The stations to be ordered besides.
            limit: What the choice may cost at most.

        Returns:
            As many indices, as many with each mount.
        """

        def ordered(indices: list[int], rounds: int) -> tuple[float, list[int], Floats]:
            places = [*(self.solutions(k) for k in indices), *trip.others]
            seconds, stops = trip.route.order(places, trip.start, trip.end, rounds)
            joints = np.array([trip.start, *(stop.joints for stop in stops)])
            return seconds, [-1, *(stop.place for stop in stops)], joints

        own = [k for k in chosen if self.pool[k].mount == trip.mount]
        if not own:
            return chosen
        now, visited, joints = ordered(own, _FIRST_ROUNDS)
        for _ in range(_SWEEPS):
            before = now
            for place, current in enumerate(own):
                rest = joints[np.array(visited) != place]
                gap = _Gap(chosen.index(current), rest, now)
                for other in self._nearer(chosen, trip, gap, limit):
                    if not self.selector.passes(other):
                        continue
                    changed = [other if k == current else k for k in chosen]
                    # A camera's sight of it may have turned out blocked.
                    if self.selector.cost(changed) > limit:
                        continue
                    mine = [*own[:place], other, *own[place + 1 :]]
                    found = ordered(mine, _ROUNDS)
                    if found[0] < now:
                        chosen, own = changed, mine
                        now, visited, joints = found
                        break
            if now == before:
                break
        return chosen

    def _nearer(
        self, chosen: list[int], trip: Trip, gap: _Gap, limit: float
    ) -> list[int]:
        """What may stand for one half-turn and promises a shorter trip."""
        able = [
            k
            for k in self.selector.swaps(chosen, gap.place, limit)
            if self.pool[k].mount == trip.mount
        ]
        if len(able) == 0:
            return []
        route, rest = trip.route, gap.rest
        pairs = [route.pairs(self.pool[k].joints) for k in able]
        owner = np.repeat(np.arange(len(able)), [len(each) for each in pairs])
        added = inserted(route.time, rest, np.concatenate(pairs), trip.end)
        least = np.full(len(able), np.inf)
        np.minimum.at(least, owner, added)
        total = route.time(rest[:-1], rest[1:]).sum() + least
        if trip.end is not None:
            total += route.time(rest[-1], trip.end)
        best = np.argsort(total, kind="stable")[:_TRIES]
        return [int(able[k]) for k in best if total[k] < gap.seconds - _LEAST_GAIN]


def inserted(
    time: Callable[[Floats, Floats], Floats],
    rest: Floats,
    pairs: Floats,
    end: Floats | None = None,
) -> Floats:
    """Least seconds that two more stations add to an order.

    Args:
        time: Of moves between joints (..., q).
        rest: The order, shape (n, q); the first is where it starts.
        pairs: Joints at both stations, shape (w, 2, q).
        end: Where the order ends after its last station, shape (q,); None: there.

    Returns:
        Shape (w,).
    """
    # Where nothing follows the last, leaving it costs nothing.
    now = np.append(
        time(rest[:-1], rest[1:]), 0.0 if end is None else time(rest[-1], end)
    )
    arrive = [time(rest, pairs[:, [step]]) for step in (0, 1)]
    after = np.zeros((2, len(pairs), 1))
    if end is not None:
        after[..., 0] = time(pairs, end).T
    leave = [
        np.concatenate([one[:, 1:], last], axis=1)
        for one, last in zip(arrive, after, strict=True)
    ]
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
