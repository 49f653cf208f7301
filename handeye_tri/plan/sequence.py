"""In which order, and by which solution, the stations take the least time.

A generalised travelling salesman: every stop (a half-turn in one of its two senses,
by one of the inverse solutions; or a single station) is visited once by one of its
options. A dozen stops are ordered exactly by dynamic programming over subsets (Held
and Karp 1962, doi:10.1137/0110015); longer programmes by the same on a window that
slides along a greedy order until nothing improves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

# Stops that are ordered exactly at once.
_WINDOW = 8
_EXACT = 11
_PASSES = 20


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
class Stops:
    """Options of stops, and what it takes from one to the next.

    Attributes:
        stop: Which stop an option belongs to, shape (k,), ascending from 0.
        first: Seconds from the programme's start to each option, shape (k,).
        times: Seconds from option to option, shape (k, k); inf where forbidden.
    """

    stop: Ints
    first: Floats
    times: Floats

    @property
    def count(self) -> int:
        """Number of stops."""
        return int(self.stop.max()) + 1


def shortest_order(stops: Stops) -> list[int] | None:
    """Options in the order of least total time, one a stop, or None.

    Exact for up to eleven stops.
    """
    if stops.count <= _EXACT:
        none = np.zeros(len(stops.stop))
        return _exact(stops.stop, stops.first, stops.times, none)
    order = _greedy(stops)
    if order is None:
        return None
    best = _duration(stops, order)
    for _ in range(_PASSES):
        for begin in range(stops.count - _WINDOW + 1):
            order = _improved(stops, order, begin)
        now = _duration(stops, order)
        if now > best * (1 - 1e-9):
            break
        best = now
    return order


def _duration(stops: Stops, order: list[int]) -> float:
    moves = stops.times[order[:-1], order[1:]]
    return float(stops.first[order[0]] + moves.sum())


def _improved(stops: Stops, order: list[int], begin: int) -> list[int]:
    """Order the stops of one window exactly, what is around it held."""
    inside = order[begin : begin + _WINDOW]
    options = np.flatnonzero(np.isin(stops.stop, stops.stop[inside]))
    numbers = {stop: k for k, stop in enumerate(np.unique(stops.stop[options]))}
    stop = np.array([numbers[s] for s in stops.stop[options]])
    first = stops.times[order[begin - 1], options] if begin else stops.first[options]
    end = begin + _WINDOW
    last = (
        stops.times[options, order[end]] if end < len(order) else np.zeros(len(options))
    )
    found = _exact(stop, first, stops.times[np.ix_(options, options)], last)
    if found is None:
        return order
    return [*order[:begin], *(int(options[k]) for k in found), *order[end:]]


def _greedy(stops: Stops) -> list[int] | None:
    """Always on to the nearest, from the start at which that succeeds soonest."""
    for start in np.argsort(stops.first, kind="stable"):
        if not np.isfinite(stops.first[start]):
            return None
        order = [int(start)]
        left = stops.stop != stops.stop[start]
        while left.any():
            times = np.where(left, stops.times[order[-1]], np.inf)
            following = int(np.argmin(times))
            if not np.isfinite(times[following]):
                break
            order.append(following)
            left &= stops.stop != stops.stop[following]
        if not left.any():
            return order
    return None


def _exact(stop: Ints, first: Floats, times: Floats, last: Floats) -> list[int] | None:
    """Least total of first, times and last over all orders, by subsets.

    Args:
        stop: Shape (k,), ascending from 0.
        first: Shape (k,).
        times: Shape (k, k).
        last: Shape (k,): from an option to what follows.
    """
    count = int(stop.max()) + 1
    size = 1 << count
    member = 1 << stop
    best = np.full((size, len(stop)), np.inf)
    came = np.zeros((size, len(stop)), dtype=np.intp)
    best[member, np.arange(len(stop))] = first
    for subset in range(1, size):
        row = best[subset]
        ends = np.flatnonzero(np.isfinite(row))
        free = np.flatnonzero((subset & member) == 0)
        if len(ends) == 0 or len(free) == 0:
            continue
        totals = row[ends, None] + times[np.ix_(ends, free)]
        choice = totals.argmin(axis=0)
        best[subset | member[free], free] = totals[choice, np.arange(len(free))]
        came[subset | member[free], free] = ends[choice]
    totals = best[-1] + last
    end = int(np.argmin(totals))
    if not np.isfinite(totals[end]):
        return None
    order, subset = [end], size - 1
    while len(order) < count:
        previous = int(came[subset, order[-1]])
        subset &= ~int(member[order[-1]])
        order.append(previous)
    return order[::-1]
