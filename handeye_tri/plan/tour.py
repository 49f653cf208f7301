"""All stations in an order that the arm can drive, mount by mount."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import NoPlanError
from handeye_tri.plan.candidates import Candidate, Prospect
from handeye_tri.plan.mounted import Mounted, refused
from handeye_tri.plan.route import Route, Stop
from handeye_tri.plan.selection import Selector
from handeye_tri.plan.shortening import Shortening, Trip

Floats = NDArray[np.float64]

# Selections that are tried before a cell is given up.
_SELECTIONS = 6
# Solutions of a place that the order may choose from.
_SOLUTIONS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """All stations with one mount, in their order.

    Attributes:
        mount: Which, from 0.
        start: Where the arm comes from, shape (q,), rad or m.
        stops: What is visited, and how.
        turns: How many of the places are half-turns; they come first.
        end: Where the arm goes to for the tool change, shape (q,); None: this is the
            last part.
        back: Points to pass on the way there, shape (k, q), rad or m.
    """

    mount: int
    start: Floats
    stops: list[tuple[Candidate, Stop]]
    turns: int
    end: Floats | None
    back: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _HeldOut:
    """Evaluation stations with one mount.

    Attributes:
        found: Free solutions of each; those that no way leads to are taken out.
        wanted: How many are visited.
    """

    found: list[list[Candidate]]
    wanted: int

    @property
    def taken(self) -> list[list[Candidate]]:
        """Those that are visited."""
        return self.found[: self.wanted]


@dataclass(frozen=True, slots=True, eq=False)
class _Leg:
    """What is to be visited with one mount.

    Attributes:
        side: The mount.
        held_out: Its evaluation stations.
        start: Where the arm comes from, shape (q,).
        end: Where it goes to afterwards, shape (q,); None: nowhere.
    """

    side: Mounted
    held_out: _HeldOut
    start: Floats
    end: Floats | None


class Tour:
    """Orders the stations of a choice; replaces what no free way leads to."""

    def __init__(
        self,
        sides: Sequence[Mounted],
        pool: Sequence[Prospect],
        selector: Selector,
        start: Floats,
        check: Callable[[list[int]], None],
    ) -> None:
        """Store what is chosen from.

        Args:
            sides: All mounts, in the order driven.
            pool: The half-turns.
            selector: Chooses among them.
            start: Where the arm stands, with the first of the mounts, shape (q,).
            check: Raises NoPlanError where a choice of half-turns will not do.
        """
        self._sides = sides
        self._pool = pool
        self._selector = selector
        self._start = start
        self._check = check

    def parts(self, chosen: list[int], limit: float, held_out: int) -> list[Part]:
        """The stations in the order of least time, the first mount's first.

        Args:
            chosen: Indices of half-turns.
            limit: What a choice may cost for a shorter programme.
            held_out: Evaluation stations, shared evenly between the mounts.

        Raises:
            NoPlanError: no order drives free from station to station.
        """
        others = self._held_out(held_out)
        legs = self._legs(chosen, others)
        shorter: list[int] | None = self._shorter(chosen, legs, limit)
        blocked = self._sides[0]
        for _ in range(_SELECTIONS):
            if shorter is None or any(len(one.found) < one.wanted for one in others):
                break
            self._check(shorter)
            parts: list[Part] = []
            for leg in self._legs(shorter, others):
                own = self._own(leg, shorter)
                driven = self._driven(leg, own)
                if isinstance(driven, int):
                    blocked = leg.side
                    if driven < len(own):
                        shorter = self._selector.replace(shorter, own[driven])
                    else:
                        leg.held_out.found.pop(driven - len(own))
                    break
                parts.append(driven)
            else:
                return parts
        raise self._blocked(blocked)

    def _own(self, leg: _Leg, chosen: Sequence[int]) -> list[int]:
        """The half-turns that are visited on a leg."""
        return [k for k in chosen if self._pool[k].mount == leg.side.mount]

    def _held_out(self, count: int) -> list[_HeldOut]:
        """Evaluation stations to choose from, by mount.

        Raises:
            NoPlanError: there are too few.
        """
        every = []
        for number, side in enumerate(self._sides):
            wanted = len(range(number, count, len(self._sides)))
            every.append(_HeldOut(side.held_out(wanted, _SOLUTIONS), wanted))
        short = [
            (side, one)
            for side, one in zip(self._sides, every, strict=True)
            if len(one.found) < one.wanted
        ]
        if short:
            found = sum(len(one.found) for _, one in short)
            raise refused(
                [side for side, _ in short],
                self._sides,
                sum(side.drawn_held_out for side, _ in short),
                f"{found} of {sum(one.wanted for _, one in short)} evaluation stations "
                "found",
            )
        return every

    def _legs(self, chosen: Sequence[int], others: Sequence[_HeldOut]) -> list[_Leg]:
        """From the mount that the arm carries to the last one that is needed."""
        mounts = {self._pool[k].mount for k in chosen}
        last = max(n for n, side in enumerate(self._sides) if side.mount in mounts)
        return [
            _Leg(
                side,
                one,
                self._start if number == 0 else side.home,
                side.home if number < last else None,
            )
            for number, (side, one) in enumerate(zip(self._sides, others, strict=True))
            if number <= last
        ]

    def _driven(self, leg: _Leg, own: list[int]) -> Part | int:
        """A leg in order, or the place on it that is most in the way."""
        places = [self._solutions(k) for k in own] + leg.held_out.taken
        route: Route | int = Route([], np.zeros((0, len(leg.start))))
        if places:
            joints = [[c.joints for c in solutions] for solutions in places]
            route = leg.side.route.drive(joints, leg.start, leg.end)
        elif leg.end is not None:
            back = leg.side.route.way(leg.start, leg.end)
            if back is None:
                raise self._blocked(leg.side)
            route = Route([], back)
        if isinstance(route, int):
            return route
        stops = [(places[s.place][s.solution], s) for s in route.stops]
        return Part(leg.side.mount, leg.start, stops, len(own), leg.end, route.back)

    def _solutions(self, index: int) -> list[Candidate]:
        """Free solutions of a half-turn."""
        prospect = self._pool[index]
        side = next(side for side in self._sides if side.mount == prospect.mount)
        return side.widened(prospect, _SOLUTIONS)

    def _shorter(
        self, chosen: list[int], legs: Sequence[_Leg], limit: float
    ) -> list[int]:
        """Half-turns that tell nearly as much and take less time."""
        found: dict[int, list[Floats]] = {}

        def solutions(index: int) -> list[Floats]:
            if index not in found:
                found[index] = [c.joints for c in self._solutions(index)]
            return found[index]

        shortening = Shortening(self._selector, self._pool, solutions)
        trips = []
        for leg in legs:
            others = [[c.joints for c in one] for one in leg.held_out.taken]
            trips.append(
                Trip(leg.side.mount, leg.side.route, others, leg.start, leg.end)
            )
        # None takes all that may be given: first a like part for each of them.
        least = self._selector.cost(chosen)
        for number, trip in enumerate(trips[:-1], 1):
            part = (limit / least) ** (number / len(trips))
            chosen = shortening.exchanged(chosen, trip, least * part)
        for trip in reversed(trips):
            chosen = shortening.exchanged(chosen, trip, limit)
        return chosen

    def _blocked(self, side: Mounted) -> NoPlanError:
        return refused(
            [side],
            self._sides,
            len(self._pool),
            "no order of stations drives free from one to the next",
            "path",
        )
