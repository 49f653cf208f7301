"""The way through all stops: in which order, and past what."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from handeye_tri.arm import Arm
from handeye_tri.plan.paths import can_go_round, way_round
from handeye_tri.plan.sequence import Stops, shortest_order, travel_time

Floats = NDArray[np.float64]

# Moves whose straight way is checked before an order is given up.
_STRAIGHT = 400
# Moves for which a way round about is searched.
_ROUND = 40


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """Stops in their order.

    Attributes:
        order: Options of the stops, as in Stops.
        via: Points to pass on the way to each, shapes (k, q), rad or m.
    """

    order: list[int]
    via: list[Floats]


class RoutePlanner:
    """Orders stops by time along ways that nothing stands in.

    Attributes:
        rejected: Counts straight ways that something stands in as "path", and orders
            that cannot be driven as "plane_spread".
    """

    def __init__(
        self, arm: Arm, acceleration_time: float, seed: int, rejected: Counter[str]
    ) -> None:
        """Store what moves cost."""
        self._arm = arm
        self._acceleration_time = acceleration_time
        self._seed = seed
        self.rejected = rejected

    def time(self, start: Floats, end: Floats) -> Floats:
        """Seconds of straight moves, shape (...), between joints (..., q)."""
        return travel_time(start, end, self._arm.speed, self._acceleration_time)

    def drive(
        self, stops: Stops, start: Floats, begin: Floats, end: Floats
    ) -> Route | None:
        """The order of least time, or None where there is none.

        Straight ways only, as long as they suffice; then ways round about, where
        OMPL is installed.

        Args:
            stops: What moves cost if their straight ways are free; moves that turn
                out not to be are changed in it.
            start: Where the arm comes from, shape (q,).
            begin: Joints at which options begin, shape (k, q).
            end: Joints at which they end, shape (k, q).
        """
        free: set[tuple[int, int]] = set()
        blocked: list[tuple[int, int]] = []
        round_about: dict[tuple[int, int], Floats] = {}
        empty = np.zeros((0, len(start)))
        while len(free) + len(blocked) < _STRAIGHT:
            order = shortest_order(stops)
            if order is None:
                if not blocked or not can_go_round():
                    break
                self._go_round(stops, start, begin, end, blocked, round_about)
                blocked = []
                continue
            moves = list(pairwise([-1, *order]))
            open_question = [m for m in moves if m not in free | set(round_about)]
            for a, b in open_question:
                origin = start if a < 0 else end[a]
                if self._arm.path_collision(origin, begin[b]) is None:
                    free.add((a, b))
                    continue
                self.rejected["path"] += 1
                blocked.append((a, b))
                self._set(stops, a, b, np.inf)
            if free.issuperset(open_question):
                return Route(order, [round_about.get(m, empty) for m in moves])
        self.rejected["plane_spread"] += not blocked
        return None

    def _go_round(
        self,
        stops: Stops,
        start: Floats,
        begin: Floats,
        end: Floats,
        blocked: list[tuple[int, int]],
        found: dict[tuple[int, int], Floats],
    ) -> None:
        """Search ways round about for the moves that were wanted first."""
        for a, b in blocked[:_ROUND]:
            origin = start if a < 0 else end[a]
            via = way_round(self._arm, origin, begin[b], self._seed)
            if via is None:
                continue
            found[a, b] = via
            points = np.concatenate([origin[None], via, begin[b][None]])
            self._set(stops, a, b, float(self.time(points[:-1], points[1:]).sum()))

    @staticmethod
    def _set(stops: Stops, a: int, b: int, seconds: float) -> None:
        if a < 0:
            stops.first[b] = seconds
        else:
            stops.times[a, b] = seconds
