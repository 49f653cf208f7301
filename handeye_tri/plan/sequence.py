"""In which order, and by which solution, the stations take the least time.

A generalised travelling salesman: every place (the two stations of a half-turn, or a
single station) is visited by one of its ways, which say for each of its stations
which joints the arm takes there. The stations of a place need not follow each other.
Large neighbourhood search, as GLNS does it (Smith and Imeson 2017,
doi:10.1016/j.cor.2017.05.010): some places are taken out and put back where they
cost least, and stretches are turned round (2-opt) while that shortens the whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

# Most places that are taken out at once.
_MOST_OUT = 6
# A worse order is gone on from if it is worse by less than this part, at the start.
_TOLERANCE = 0.02
# What is put back may cost more than the least by this part of a mean move.
_HAZE = 1.0
# Stands for a forbidden move, seconds: longer than any programme.
_FORBIDDEN = 1e6


def travel_time(
    start: Floats, end: Floats, speed: Floats, acceleration_time: float
) -> Floats:
    """Least time of straight joint moves from rest to rest, in seconds.

    Each joint speeds up evenly, travels at its speed limit if it gets there, and
    slows down evenly; the slowest joint sets the pace of all.

    Args:
        start: Shape (..., q), rad or m.
        end: Shape (..., q), rad or m.
        speed: Shape (q,), rad/s or m/s.
        acceleration_time: From rest to full speed, seconds.
    """
    cruise = np.abs(end - start) / speed
    short = 2 * np.sqrt(cruise * acceleration_time)
    full = cruise + acceleration_time
    times = np.where(cruise >= acceleration_time, full, short)
    return np.asarray(times.max(axis=-1))


@dataclass(frozen=True, slots=True, eq=False)
class Visits:
    """Ways to visit places, and what it takes from one station to the next.

    A station that is reached by certain joints is an option, 0 to k - 1.

    Attributes:
        ways: For each place its ways, shape (w, s): an option for each of its s
            stations, one or two.
        first: Seconds from the programme's start to each option, shape (k,).
        last: Seconds from each option to where the programme ends, shape (k,); 0
            where it ends at its last station.
        times: Seconds from option to option, shape (k, k), symmetric; inf where
            forbidden.
    """

    ways: Sequence[Ints]
    first: Floats
    last: Floats
    times: Floats


@dataclass(frozen=True, slots=True)
class Order:
    """Options in the order visited.

    Attributes:
        options: One for each station.
        seconds: Of all moves; inf where a forbidden one could not be avoided.
    """

    options: list[int]
    seconds: float


def shortest_order(
    visits: Visits, seed: int, rounds: int, found: Order | None = None
) -> Order:
    """Visit every place once, in the least time that the search finds.

    Args:
        visits: What there is to visit.
        seed: Same seed, same order.
        rounds: How often places are taken out and put back.
        found: Where to go on from; None: from places put in one by one.
    """
    search = _Search(visits)
    rng = np.random.default_rng(seed)
    places = len(visits.ways)
    if found is None:
        here: list[int] = []
        for place in rng.permutation(places):
            here = search.with_place(here, place, rng)
        here = search.turned_round(here)
    else:
        here = found.options
    cost = search.seconds(here)
    best, least = here, cost
    for k in range(rounds):
        out = search.some(rng, here)
        changed = [option for option in here if search.place[option] not in out]
        haze = _HAZE * (cost % _FORBIDDEN) / len(here) * rng.integers(2)
        for place in out:
            changed = search.with_place(changed, place, rng, haze)
        changed = search.turned_round(changed)
        now = search.seconds(changed)
        tolerance = _TOLERANCE * (1 - k / rounds) * rng.random()
        if now <= cost + tolerance * (cost % _FORBIDDEN):
            here, cost = changed, now
        if now < least * (1 - 1e-9):
            best, least = changed, now
    return Order(best, least if least < _FORBIDDEN else np.inf)


class _Search:
    """Changes of an order, a list of options, that make it shorter."""

    def __init__(self, visits: Visits) -> None:
        k = len(visits.first)
        # Two more options: where the programme starts, and where it ends.
        times = np.zeros((k + 2, k + 2))
        times[:k, :k] = visits.times
        times[k, :k] = visits.first
        times[:k, k + 1] = visits.last
        self.times = np.where(np.isfinite(times), times, _FORBIDDEN)
        self.start, self.end = k, k + 1
        self.ways = visits.ways
        self.place = np.zeros(k, dtype=np.intp)
        for place, ways in enumerate(visits.ways):
            self.place[ways] = place

    def seconds(self, order: list[int]) -> float:
        between = self.times[[self.start, *order[:-1]], order].sum()
        return float(between + self.times[order[-1], self.end])

    def some(self, rng: np.random.Generator, order: list[int]) -> list[int]:
        """Places to take out: any, or those of successive stations."""
        most = min(_MOST_OUT, len(self.ways))
        count = int(rng.integers(1, most, endpoint=True))
        if rng.random() < 0.5:
            return [int(p) for p in rng.permutation(len(self.ways))[:count]]
        begin = int(rng.integers(len(order)))
        stretch = self.place[order[begin : begin + count]]
        return [int(p) for p in rng.permutation(np.unique(stretch))]

    def with_place(
        self,
        order: list[int],
        place: int,
        rng: np.random.Generator,
        haze: float = 0.0,
    ) -> list[int]:
        """Put a place in, by the way and where it costs least.

        Args:
            order: Without the place.
            place: Which.
            rng: Draws the haze.
            haze: Up to how many seconds are added to every choice, so that others
                than the best come to their turn.
        """
        before = np.array([self.start, *order])
        after = np.array([*order, self.end])
        now = self.times[before, after]
        ways = self.ways[place]
        # Seconds that the first, or the last, station of each way adds in each gap.
        arrive = self.times[before[:, None], ways.T[:, None]].transpose(0, 2, 1)
        leave = self.times[ways.T[:, :, None], after]
        added = arrive + leave - now
        first, last = ways[:, 0], ways[:, -1]
        if ways.shape[1] == 1:
            costs = added[0] + haze * rng.random(added[0].shape)
            way, gap = np.unravel_index(costs.argmin(), costs.shape)
            return [*order[:gap], int(first[way]), *order[gap:]]
        both = added[0][:, :, None] + added[1][:, None, :]
        between = self.times[first, last][:, None] - now
        forward, back = arrive[0] + between + leave[1], arrive[1] + between + leave[0]
        gaps = np.arange(len(now))
        both[:, gaps, gaps] = np.minimum(forward, back)
        both += haze * rng.random(both.shape)
        way, one, other = np.unravel_index(both.argmin(), both.shape)
        stops = [int(first[way]), int(last[way])]
        if one > other or (one == other and back[way, one] < forward[way, one]):
            one, other = min(one, other), max(one, other)
            stops.reverse()
        return [*order[:one], stops[0], *order[one:other], stops[1], *order[other:]]

    def turned_round(self, order: list[int]) -> list[int]:
        """Turn stretches round while that shortens the order."""
        count = len(order)
        while True:
            whole = np.array([self.start, *order, self.end])
            times = self.times[whole[:, None], whole]
            step = np.diagonal(times, 1)
            # Of the stretch from row to column: new ends less old ones.
            gain = times[:-2, 1:-1] + times[1:-1, 2:] - step[:-1, None] - step[1:]
            gain = np.triu(gain, 1)
            row, column = divmod(int(gain.argmin()), count)
            if gain[row, column] > -1e-9:
                return order
            turned = order[row : column + 1][::-1]
            order = [*order[:row], *turned, *order[column + 1 :]]
