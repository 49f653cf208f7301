"""The way through all stations: in which order, by which joints, and past what."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from handeye_tri.arm import UNKNOWN_SPEED, Arm
from handeye_tri.plan.paths import can_go_round, way_round
from handeye_tri.plan.sequence import Visits, shortest_order, travel_time

Floats = NDArray[np.float64]

# How long an order is searched for at first, and after moves turned out blocked.
_ROUNDS = 1000
_MORE_ROUNDS = 100
# Orders that are tried before it is given up.
_ORDERS = 80


def unknown_speeds(arm: Arm) -> tuple[str, ...]:
    """A sentence where a programme's times rest on speeds that nobody stated."""
    if not arm.without_speed:
        return ()
    return (
        f"the model states no speed for {', '.join(arm.without_speed)}: times are for "
        f"{UNKNOWN_SPEED:g} rad/s or m/s; state it in the model (URDF: velocity, MJCF: "
        '<numeric name="speed:JOINT">)',
    )


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """All stations of a programme in their order.

    Attributes:
        stops: The stations.
        back: Points to pass on the way from the last one to where the programme ends,
            shape (k, q), rad or m; none where it ends there.
    """

    stops: list[Stop]
    back: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Stop:
    """A station on the way.

    Attributes:
        place: Which place it belongs to.
        step: Which of the place's stations it is.
        solution: By which of the place's solutions the arm stands there.
        joints: Shape (q,), rad or m.
        via: Points to pass on the way there, shape (k, q), rad or m.
    """

    place: int
    step: int
    solution: int
    joints: Floats
    via: Floats


class RoutePlanner:
    """Orders stations by time along ways that nothing stands in.

    Attributes:
        rejected: Counts straight ways that something stands in, as "path".
        solids: What touched on them, in words; how often.
    """

    def __init__(
        self,
        arm: Arm,
        acceleration_time: float,
        seed: int,
        rejected: Counter[str],
        solids: Counter[str],
    ) -> None:
        """Store what moves cost."""
        self._arm = arm
        self._acceleration_time = acceleration_time
        self._seed = seed
        self.rejected = rejected
        self.solids = solids

    def time(self, start: Floats, end: Floats) -> Floats:
        """Seconds of straight moves, shape (...), between joints (..., q)."""
        return travel_time(start, end, self._arm.speed, self._acceleration_time)

    def drive(
        self,
        places: Sequence[Sequence[Floats]],
        start: Floats,
        end: Floats | None = None,
    ) -> Route | int:
        """All stations of all places in the order of least time.

        The stations of a place may be apart in the order, but are reached by the
        same solution: what the arm's model has wrong is then alike in both. The last
        joint may be a whole turn off where its limits allow. Straight ways only, as
        long as they suffice; then ways round about, where OMPL is installed.

        Args:
            places: For each its solutions, shapes (s, q): the joints at its s
                stations.
            start: Where the arm comes from, shape (q,).
            end: Where it goes to from the last station, shape (q,); None: nowhere.

        Returns:
            The stations in their order, or the place that is most in the way.
        """
        stops, joints, visits = self._visits(places, start, end)
        # Configurations: the options, then where the programme starts and ends.
        ends = [start] if end is None else [start, end]
        moves = _Moves(
            self._arm, np.concatenate([joints, ends]), self._seed, self.solids
        )
        first, last = len(stops), len(stops) + 1
        order = shortest_order(visits, self._seed, _ROUNDS)
        for _ in range(_ORDERS):
            wanted = list(pairwise([first, *order.options]))
            if end is not None:
                wanted.append((order.options[-1], last))
            blocked = [move for move in wanted if not moves.free(*move)]
            if not blocked:
                found = [
                    replace(stops[b], via=moves.via[a, b])
                    for a, b in wanted[: len(order.options)]
                ]
                none = np.zeros((0, len(start)))
                return Route(found, moves.via.get((order.options[-1], last), none))
            if np.isfinite(order.seconds):
                self.rejected["path"] += len(blocked)
            elif not any([moves.lead_round(*move) for move in blocked]):
                # No order does without them, and there is no way round.
                near = {stops[k].place for move in blocked for k in move if k < first}
                barred = np.isinf(visits.times).sum(axis=1) + np.isinf(visits.first)
                barred += np.isinf(visits.last)
                return max(
                    near, key=lambda place: int(barred[visits.ways[place]].max())
                )
            for a, b in blocked:
                seconds = self._seconds(moves, a, b)
                if a == first:
                    visits.first[b] = seconds
                elif b == last:
                    visits.last[a] = seconds
                else:
                    visits.times[a, b] = visits.times[b, a] = seconds
            order = shortest_order(visits, self._seed, _MORE_ROUNDS, order)
        return stops[order.options[-1]].place

    def way(self, start: Floats, end: Floats) -> Floats | None:
        """Points to pass on a free way, shape (k, q); None where none is found."""
        moves = _Moves(self._arm, np.array([start, end]), self._seed, self.solids)
        if not moves.free(0, 1):
            self.rejected["path"] += 1
            if not moves.lead_round(0, 1):
                return None
        return moves.via[0, 1]

    def order(
        self,
        places: Sequence[Sequence[Floats]],
        start: Floats,
        end: Floats | None,
        rounds: int,
    ) -> tuple[float, list[Stop]]:
        """Seconds and stations of a short order; whether ways are free is not asked.

        Args:
            places: As for :meth:`drive`.
            start: Where the arm comes from, shape (q,).
            end: Where it goes to from the last station, shape (q,); None: nowhere.
            rounds: How long to search.
        """
        stops, _, visits = self._visits(places, start, end)
        order = shortest_order(visits, self._seed, rounds)
        return order.seconds, [stops[k] for k in order.options]

    def pairs(self, solutions: Floats) -> Floats:
        """Every way to stand at two stations, (w, 2, q), by solutions (k, 2, q)."""
        return np.array(
            [
                both
                for before, after in solutions
                for both in product(self._turned(before), self._turned(after))
            ]
        )

    def _visits(
        self,
        places: Sequence[Sequence[Floats]],
        start: Floats,
        end: Floats | None,
    ) -> tuple[list[Stop], Floats, Visits]:
        """Every way to stand at every station, its joints, and what moves take."""
        stops, ways = self._options(places)
        joints = np.array([stop.joints for stop in stops])
        visits = Visits(
            ways,
            self.time(start, joints),
            np.zeros(len(joints)) if end is None else self.time(joints, end),
            self.time(joints[:, None], joints[None]),
        )
        return stops, joints, visits

    def _options(
        self, places: Sequence[Sequence[Floats]]
    ) -> tuple[list[Stop], list[NDArray[np.intp]]]:
        """Every way to stand at every station, and those that go together."""
        stops: list[Stop] = []
        ways = []
        none = np.zeros((0, len(self._arm.home)))
        for place, solutions in enumerate(places):
            together: list[tuple[int, ...]] = []
            for solution, stations in enumerate(solutions):
                numbers = []
                for step, joints in enumerate(stations):
                    variants = self._turned(joints)
                    numbers.append(range(len(stops), len(stops) + len(variants)))
                    stops += [Stop(place, step, solution, q, none) for q in variants]
                together += product(*numbers)
            ways.append(np.array(together))
        return stops, ways

    def _turned(self, joints: Floats) -> list[Floats]:
        """The same with the last joint turned round wholly, within its limits."""
        arm = self._arm
        if arm.slides[-1]:
            return [joints]
        turns = np.zeros((3, len(joints)))
        turns[:, -1] = (0.0, -2 * np.pi, 2 * np.pi)
        inside = ((joints + turns >= arm.lower) & (joints + turns <= arm.upper)).all(1)
        return list((joints + turns)[inside | (turns[:, -1] == 0)])

    def _seconds(self, moves: _Moves, a: int, b: int) -> float:
        via = moves.via.get((a, b))
        if via is None:
            return np.inf
        points = np.concatenate([moves.joints[[a]], via, moves.joints[[b]]])
        return float(self.time(points[:-1], points[1:]).sum())


class _Moves:
    """Which moves between configurations are free, looked at once.

    Attributes:
        joints: Configurations, shape (k, q), rad or m.
        via: Points to pass, by free move, shapes (p, q).
    """

    def __init__(
        self, arm: Arm, joints: Floats, seed: int, solids: Counter[str]
    ) -> None:
        self._arm = arm
        self._seed = seed
        self._solids = solids
        self._blocked: set[tuple[int, int]] = set()
        self._hopeless: set[tuple[int, int]] = set()
        self.joints = joints
        self.via: dict[tuple[int, int], Floats] = {}

    def free(self, a: int, b: int) -> bool:
        """Whether a move is known to be free, or is free where it is straight."""
        if (a, b) not in self.via and (a, b) not in self._blocked:
            hit = self._arm.path_collision(self.joints[a], self.joints[b])
            if hit is None:
                self._keep(a, b, np.zeros((0, self.joints.shape[1])))
            else:
                self._blocked |= {(a, b), (b, a)}
                self._solids[f"{hit[0]} touches {hit[1]}"] += 1
        return (a, b) in self.via

    def lead_round(self, a: int, b: int) -> bool:
        """Search a way round about; whether there is one."""
        if (a, b) in self._hopeless or not can_go_round():
            return False
        via = way_round(self._arm, self.joints[a], self.joints[b], self._seed)
        if via is None:
            self._hopeless |= {(a, b), (b, a)}
            return False
        self._keep(a, b, via)
        return True

    def _keep(self, a: int, b: int, via: Floats) -> None:
        self.via[a, b], self.via[b, a] = via, via[::-1]
