"""A robot programme: informative half-turns in an order that the arm can drive."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.arm import Arm
from handeye_tri.config import Cell
from handeye_tri.errors import InputError, NoPlanError
from handeye_tri.plan.candidates import Prospect
from handeye_tri.plan.certificate import (
    MIN_AXIS_SPREAD,
    Certificate,
    certify,
    plane_spread_deg,
)
from handeye_tri.plan.choosing import Chooser
from handeye_tri.plan.information import StationInformation
from handeye_tri.plan.mounted import Mounted, arms_by_mount, refused
from handeye_tri.plan.route import unknown_speeds
from handeye_tri.plan.shortening import allowed
from handeye_tri.plan.tour import Part, Tour
from handeye_tri.records import HalfTurn, Plan, Station, ToolChange
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Progress = Callable[[int, int], None]

# Half-turns to choose from, per half-turn wanted, and at most.
_POOL = 90
_LARGEST_POOL = 1000
# Fewest half-turns with each of several mounts: two turn about more than one axis.
_LEAST = 2


def plan_motions(
    cell: Cell,
    arms: Arm | Sequence[Arm],
    seed: int,
    half_turns: int | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Plan half-turns joined by general motions, and evaluation stations.

    Every station is within the joint limits, free of collision with clearance, and
    shows all markers' outlines unhidden and with margin to two cameras or more (or to
    the only one), at an allowed tilt; the two stations of a half-turn differ by 180
    degrees about the flange's z axis, by the same solution of the arm; the largest
    angle between the triangle's planes at two half-turns is
    ``plan.min_plane_spread_deg`` or more (Zhao, Liu and Zhang 2008, Proposition 1,
    doi:10.1109/TIP.2008.2005562); ways from station to station are free, straight in
    joint space or past the points in ``via``. Among what passes, those half-turns are
    chosen that make the calibration's part of the predicted track error over the
    workspace box least, but for a hundredth that may be given for a shorter
    programme, and the order of all stations that takes the least time: the two of a
    half-turn may be apart, and evaluation stations lie among the others.

    In a cell with two mounts the half-turns of both are chosen together, at least two
    with each, evaluation stations are shared evenly, and the order is that of least
    time with each mount: all stations with the first, back home for the tool change,
    then all with the other.

    The certificate holds what :func:`~handeye_tri.plan.certificate.certify` predicts
    from the stations, and

    * ``relaxed_bound_mm``: no choice among the candidates has a lower one,
    * ``candidates``: half-turns that were chosen from,
    * ``cycle_time_s``: of all moves, from the arm's home, without what it stands
      still at the stations.

    Args:
        cell: The cell.
        arms: The robot in it, by mount; alone where there is one.
        seed: Same seed, same plan.
        half_turns: Number of half-turns; the cell's own where None.
        progress: Called with (done, total) as the search goes on.

    Raises:
        InputError: fewer than two half-turns are asked for, or two by mount; or the
            arms do not fit the cell.
        NoPlanError: no plan was found; says which check rejected how many.
    """
    wanted = cell.plan.half_turns if half_turns is None else half_turns
    if wanted < 2:
        raise InputError(
            f"half_turns must be at least 2, got {wanted}: one plane leaves the "
            "cameras undetermined"
        )
    mounts = len(cell.mounted)
    if mounts > 1 and wanted < _LEAST * mounts:
        raise InputError(
            f"half_turns must be at least {_LEAST * mounts}, got {wanted}: {_LEAST} "
            f"with each of {mounts} mounts"
        )
    return _Planner(cell, arms_by_mount(cell, arms), seed, wanted, progress).plan()


@dataclass(frozen=True, slots=True, eq=False)
class Visited:
    """Stations that the cameras have seen already.

    Attributes:
        base_from_flange: Shape (n, 4, 4), metres.
        seen: Which cameras saw all markers there, shape (n, m).
        mounts: Which mount held the triangle there, shape (n,).
        turns: Which of them make half-turns, shape (k, 2).
        joints: Where the arm stands now, shape (q,), rad or m.
        mount: Which mount it carries.
    """

    base_from_flange: Floats
    seen: NDArray[np.bool_]
    mounts: Ints
    turns: Ints
    joints: Floats
    mount: int = 0


def plan_next(
    cell: Cell,
    arms: Arm | Sequence[Arm],
    visited: Visited,
    seed: int,
    half_turns: int,
    progress: Progress | None = None,
) -> Plan:
    """Plan the half-turns that add most to what was seen already.

    The certificate is that of all stations together; the cycle time that of the new
    ones, from where the arm stands. The tool is changed only where a choice with the
    mount that the arm carries would cost more than the hundredth that a shorter
    programme may.

    Args:
        cell: The cell.
        arms: The robot in it, by mount; alone where there is one.
        visited: What was seen.
        seed: Same seed, same plan.
        half_turns: How many to add, at least 1.
        progress: Called with (done, total) as the search goes on.

    Returns:
        The new stations alone.

    Raises:
        InputError: no half-turn is asked for, or the arms do not fit the cell.
        NoPlanError: no plan was found; says which check rejected how many.
    """
    if half_turns < 1:
        raise InputError(f"half_turns must be at least 1, got {half_turns}")
    arms = arms_by_mount(cell, arms)
    return _Planner(cell, arms, seed, half_turns, progress, visited).plan()


class _Planner:
    def __init__(
        self,
        cell: Cell,
        arms: Sequence[Arm],
        seed: int,
        wanted: int,
        progress: Progress | None,
        visited: Visited | None = None,
    ) -> None:
        self.cell = cell
        self.seed = seed
        self.wanted = wanted
        # What more is planned for needs no stations of its own to test it.
        self.held_out = 0 if visited else cell.plan.evaluation_stations
        # Each of several mounts has its own markers to determine.
        self.least = 0 if visited or len(arms) == 1 else _LEAST
        self.may_stay = visited is not None
        self.visited = visited or Visited(
            np.zeros((0, 4, 4)),
            np.zeros((0, len(cell.cameras)), dtype=bool),
            np.zeros(0, dtype=np.intp),
            np.zeros((0, 2), dtype=np.intp),
            arms[0].home,
        )
        self.model = StationInformation(
            cell,
            arms[0].base_from_world.matrix,
            cell.repeatability,
            cell.plan.expected_sigma_px,
        )
        self.sides = [Mounted(cell, arm, k, seed) for k, arm in enumerate(arms)]
        self.pool_size = min(_POOL * wanted, _LARGEST_POOL)
        self.total = self.pool_size + wanted + self.held_out
        self.progress = progress
        self.done = -1

    def _done(self, done: int) -> None:
        if self.progress is not None and done > self.done:
            self.progress(done, self.total)
        self.done = max(done, self.done)

    def plan(self) -> Plan:
        """Search, choose, and order."""
        self._check_start()
        visited = self.model.of_stations(
            self.visited.base_from_flange, self.visited.seen, self.visited.mounts
        ).sum(axis=0)
        chooser = Chooser(self.sides, self.model, self.wanted, self.least, self._done)
        pool = chooser.pool(self.pool_size)
        selector, selection = chooser.choose(pool, visited)
        limit = allowed(selector.cost(selection.chosen))
        chosen = selection.chosen
        if self.may_stay:
            chosen = chooser.staying(pool, selector, chosen, self.visited.mount, limit)
        self._done(self.pool_size + self.wanted)
        tour = Tour(
            sorted(self.sides, key=lambda side: side.mount != self.visited.mount),
            pool,
            selector,
            self.visited.joints,
            lambda indices: self._check_spread([pool[k] for k in indices], len(pool)),
        )
        parts = tour.parts(chosen, limit, self.held_out)
        plan = self._record(parts, selection.bound, len(pool))
        self._done(self.total)
        return plan

    def _check_start(self) -> None:
        """Raise where the arm touches something before it moves."""
        touching = [
            side
            for side in self.sides
            if side.touches(
                self.visited.joints if side.mount == self.visited.mount else side.home
            )
        ]
        if touching:
            what = "the arm cannot leave where it stands"
            raise refused(touching, self.sides, 1, what, "path")

    def _check_spread(self, chosen: Sequence[Prospect], pool: int) -> None:
        """Raise where all half-turns' planes are nearly parallel."""
        seen = self.visited.turns[:, 0]
        poses = np.concatenate(
            [
                self.visited.base_from_flange[seen],
                [p.base_from_flange[0] for p in chosen],
            ]
        )
        mounts = np.concatenate([self.visited.mounts[seen], [p.mount for p in chosen]])
        spread = plane_spread_deg(self.model, poses, mounts)
        if len(poses) > 1 and spread < self.cell.plan.min_plane_spread_deg:
            what = f"planes differ by {spread:.0f} degrees only"
            raise self._too_alike("plane_spread", pool, what)

    def _too_alike(self, check: str, drawn: int, what: str) -> NoPlanError:
        """Refuse all half-turns together; no mount by itself fails."""
        self.sides[0].rejected[check] += 1
        return refused(self.sides, self.sides, drawn, what, check)

    def _record(self, parts: Sequence[Part], bound: float, candidates: int) -> Plan:
        stations: list[Station] = []
        via: list[Floats] = []
        pairs: list[tuple[int, int]] = []
        seen: list[NDArray[np.bool_]] = []
        change = None
        seconds = 0.0
        for part in parts:
            visits: dict[int, list[int]] = {}
            way = [part.start[None]]
            for candidate, stop in part.stops:
                if stop.place < part.turns:
                    visits.setdefault(stop.place, []).append(len(stations))
                stations.append(
                    Station(
                        len(stations),
                        "calibration" if stop.place < part.turns else "evaluation",
                        stop.joints,
                        SE3(candidate.base_from_flange[stop.step]),
                        part.mount,
                    )
                )
                seen.append(candidate.seen)
                via.append(stop.via)
                way += [stop.via, stop.joints[None]]
            pairs += sorted((a, b) for a, b in visits.values())
            if part.end is not None:
                change = ToolChange(len(stations), part.end, part.back)
                way += [part.back, part.end[None]]
            points = np.concatenate(way)
            route = self.sides[part.mount].route
            seconds += float(route.time(points[:-1], points[1:]).sum())
        certified = self._certified(stations, seen, pairs)
        rejected = Counter[str]()
        for side in self.sides:
            rejected.update(side.rejected)
        return Plan(
            tuple(stations),
            tuple(HalfTurn(a, b, self.cell.axes[stations[a].mount]) for a, b in pairs),
            dict(rejected),
            {
                **certified.numbers,
                "relaxed_bound_mm": float(1e3 * np.sqrt(bound)),
                "candidates": float(candidates),
                "cycle_time_s": seconds,
            },
            self.seed,
            certified.outcome,
            (*certified.findings, *unknown_speeds(self.sides[0].arm)),
            tuple(via),
            change,
        )

    def _certified(
        self,
        stations: Sequence[Station],
        seen: Sequence[NDArray[np.bool_]],
        pairs: Sequence[tuple[int, int]],
    ) -> Certificate:
        """What all stations tell, those visited before among them."""
        visited = self.visited
        used = [s.index for s in stations if s.kind == "calibration"]
        before = len(visited.base_from_flange)
        certified = certify(
            self.cell,
            self.model,
            np.concatenate(
                [
                    visited.base_from_flange,
                    [stations[k].base_from_flange.matrix for k in used],
                ]
            ),
            np.concatenate([visited.seen, [seen[k] for k in used]]),
            np.concatenate([visited.mounts, [stations[k].mount for k in used]]),
            np.concatenate([visited.turns, before + np.searchsorted(used, pairs)]),
        )
        if certified.numbers["axis_spread"] < MIN_AXIS_SPREAD:
            raise self._too_alike("axis_spread", 1, "the rotations do not span 3-D")
        return certified
