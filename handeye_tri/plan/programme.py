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
from handeye_tri.plan.candidates import Candidate, CandidateSearch, Prospect
from handeye_tri.plan.certificate import MIN_AXIS_SPREAD, certify, plane_spread_deg
from handeye_tri.plan.design import Design
from handeye_tri.plan.information import StationInformation
from handeye_tri.plan.poses import View
from handeye_tri.plan.refusal import no_plan
from handeye_tri.plan.route import RoutePlanner, Stop, unknown_speeds
from handeye_tri.plan.selection import Selection, Selector
from handeye_tri.plan.shortening import Shortening
from handeye_tri.records import HalfTurn, Plan, Station
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]

# Half-turns to choose from, per half-turn wanted, and at most.
_POOL = 90
_LARGEST_POOL = 1000
# Selections that are tried before a cell is given up.
_SELECTIONS = 6
# Solutions of a place that the order may choose from.
_SOLUTIONS = 8


def plan_motions(
    cell: Cell,
    arm: Arm,
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

    The certificate holds what :func:`~handeye_tri.plan.certificate.certify` predicts
    from the stations, and

    * ``relaxed_bound_mm``: no choice among the candidates has a lower one,
    * ``candidates``: half-turns that were chosen from,
    * ``cycle_time_s``: of all moves, from the arm's home, without what it stands
      still at the stations.

    Args:
        cell: The cell.
        arm: The robot in it.
        seed: Same seed, same plan.
        half_turns: Number of half-turns; the cell's own where None.
        progress: Called with (done, total) as the search goes on.

    Raises:
        InputError: fewer than two half-turns are asked for.
        NoPlanError: no plan was found; says which check rejected how many.
    """
    wanted = cell.plan.half_turns if half_turns is None else half_turns
    if wanted < 2:
        raise InputError(
            f"half_turns must be at least 2, got {wanted}: one plane leaves the "
            "cameras undetermined"
        )
    return _Planner(cell, arm, seed, wanted, progress).plan()


@dataclass(frozen=True, slots=True, eq=False)
class Visited:
    """Stations that the cameras have seen already.

    Attributes:
        base_from_flange: Shape (n, 4, 4), metres.
        seen: Which cameras saw all markers there, shape (n, m).
        turns: Which of them make half-turns, shape (k, 2).
        joints: Where the arm stands now, shape (q,), rad or m.
    """

    base_from_flange: Floats
    seen: NDArray[np.bool_]
    turns: NDArray[np.intp]
    joints: Floats


def plan_next(
    cell: Cell,
    arm: Arm,
    visited: Visited,
    seed: int,
    half_turns: int,
    progress: Progress | None = None,
) -> Plan:
    """Plan the half-turns that add most to what was seen already.

    The certificate is that of all stations together; the cycle time that of the new
    ones, from where the arm stands.

    Args:
        cell: The cell.
        arm: The robot in it.
        visited: What was seen.
        seed: Same seed, same plan.
        half_turns: How many to add, at least 1.
        progress: Called with (done, total) as the search goes on.

    Returns:
        The new stations alone.

    Raises:
        InputError: no half-turn is asked for.
        NoPlanError: no plan was found; says which check rejected how many.
    """
    if half_turns < 1:
        raise InputError(f"half_turns must be at least 1, got {half_turns}")
    return _Planner(cell, arm, seed, half_turns, progress, visited).plan()


class _Planner:
    def __init__(
        self,
        cell: Cell,
        arm: Arm,
        seed: int,
        wanted: int,
        progress: Progress | None,
        visited: Visited | None = None,
    ) -> None:
        self.cell = cell
        self.arm = arm
        self.seed = seed
        self.wanted = wanted
        # What more is planned for needs no stations of its own to test it.
        self.held_out = 0 if visited else cell.plan.evaluation_stations
        self.visited = visited or Visited(
            np.zeros((0, 4, 4)),
            np.zeros((0, len(cell.cameras)), dtype=bool),
            np.zeros((0, 2), dtype=np.intp),
            arm.home,
        )
        self.view = View(cell)
        self.model = StationInformation(
            cell,
            arm.base_from_world.matrix,
            cell.repeatability,
            cell.plan.expected_sigma_px,
        )
        self.pool_size = min(_POOL * wanted, _LARGEST_POOL)
        self.total = self.pool_size + wanted + self.held_out
        self.progress = progress
        self.done = -1
        self.rejected: Counter[str] = Counter()
        self.solids: Counter[str] = Counter()
        self.route = RoutePlanner(
            arm, cell.arm.acceleration_time_s, seed, self.rejected, self.solids
        )

    def _done(self, done: int) -> None:
        if self.progress is not None and done > self.done:
            self.progress(done, self.total)
        self.done = max(done, self.done)

    def plan(self) -> Plan:
        """Search, choose, and order."""
        touching = self.arm.collision(self.visited.joints)
        if touching is not None:
            self.rejected["path"] += 1
            self.solids[f"{touching[0]} touches {touching[1]}"] += 1
            raise self._no_plan(1, "the arm cannot leave where it stands", "path")
        search = self._search(0)
        # Half of the work is in what comes after the pool.
        pool = search.prospects(self.pool_size, progress=lambda n: self._done(n // 2))
        if len(pool) < self.wanted:
            raise self._no_plan(
                search.drawn, f"{len(pool)} of {self.wanted} half-turns found"
            )
        selector, selection = self._choose(pool, search)
        route = self._route(pool, search, selector, selection.chosen)
        plan = self._record(route, selection.bound, len(pool))
        self._done(self.total)
        return plan

    def _search(self, stream: int) -> CandidateSearch:
        rng = np.random.default_rng([self.seed, stream])
        return CandidateSearch(self.view, self.arm, rng, self.rejected, self.solids)

    def _choose(
        self, pool: Sequence[Prospect], search: CandidateSearch
    ) -> tuple[Selector, Selection]:
        """The half-turns that tell most, free of solids."""
        checks = 0

        def checked() -> None:
            nonlocal checks
            checks += 1
            half = self.pool_size // 2
            self._done(half + int((1 - np.exp(-checks / 200)) * half))

        without_solids = Counter(self.rejected)
        design = Design(
            self.model.of_half_turns(
                np.array([p.base_from_flange for p in pool]),
                np.array([p.seen for p in pool]),
                np.zeros(len(pool), dtype=np.intp),
            ),
            self.model.prior
            + self.model.of_stations(
                self.visited.base_from_flange,
                self.visited.seen,
                np.zeros(len(self.visited.seen), dtype=np.intp),
            ).sum(axis=0),
            self.model.workspace_cost,
        )

        def tells(candidate: Candidate) -> Floats:
            poses = candidate.base_from_flange[None]
            return np.asarray(
                self.model.of_half_turns(poses, candidate.seen[None], np.zeros(1, int))[
                    0
                ]
            )

        selector = Selector(design, pool, search, self.wanted, checked, tells)
        if selector.probe() == 0:
            by_solids = self.rejected - without_solids
            raise self._no_plan(
                search.drawn,
                f"0 of {selector.checked} half-turns are free",
                by_solids.most_common(1)[0][0],
            )
        selection = selector.select()
        if selection is None:
            by_solids = self.rejected - without_solids
            raise self._no_plan(
                search.drawn,
                f"{selector.usable.sum()} of {self.wanted} half-turns are free",
                by_solids.most_common(1)[0][0],
            )
        return selector, selection

    def _route(
        self,
        pool: Sequence[Prospect],
        search: CandidateSearch,
        selector: Selector,
        chosen: list[int],
    ) -> list[tuple[Candidate, Stop]]:
        """Stations of half-turns and of evaluation in the order of least time.

        What no free way leads to is replaced.
        """
        self._done(self.pool_size + self.wanted)
        held_out = self._held_out()
        found: dict[int, list[Candidate]] = {}

        def solutions(k: int) -> list[Candidate]:
            if k not in found:
                found[k] = search.free(search.widened(pool[k]), _SOLUTIONS)
            return found[k]

        shortening = Shortening(
            self.route, selector, pool, lambda k: [c.joints for c in solutions(k)]
        )
        usual: list[int] | None = shortening.exchanged(
            chosen,
            [[c.joints for c in one] for one in held_out[: self.held_out]],
            self.visited.joints,
        )
        for _ in range(_SELECTIONS):
            if usual is None or len(held_out) < self.held_out:
                break
            self._check_spread(pool, usual)
            places = [search.free(search.widened(pool[k]), _SOLUTIONS) for k in usual]
            places += held_out[: self.held_out]
            joints = [[c.joints for c in solutions] for solutions in places]
            route = self.route.drive(joints, self.visited.joints)
            if not isinstance(route, int):
                return [(places[s.place][s.solution], s) for s in route]
            if route < self.wanted:
                usual = selector.replace(usual, usual[route])
            else:
                held_out.pop(route - self.wanted)
        raise self._no_plan(
            len(pool), "no order of stations drives free from one to the next", "path"
        )

    def _check_spread(self, pool: Sequence[Prospect], chosen: list[int]) -> None:
        """Raise where all half-turns' planes are nearly parallel."""
        poses = np.concatenate(
            [
                self.visited.base_from_flange[self.visited.turns[:, 0]],
                [pool[k].base_from_flange[0] for k in chosen],
            ]
        )
        spread = plane_spread_deg(
            self.model, poses, np.zeros(len(poses), dtype=np.intp)
        )
        if len(poses) > 1 and spread < self.cell.plan.min_plane_spread_deg:
            self.rejected["plane_spread"] += 1
            raise self._no_plan(
                len(pool), f"planes differ by {spread:.0f} degrees only", "plane_spread"
            )

    def _held_out(self) -> list[list[Candidate]]:
        """Stations anywhere in the workspace, some more than wanted."""
        if self.held_out == 0:
            return []
        search = self._search(1)
        found = search.find(2 * self.held_out, turns=False, solutions=_SOLUTIONS)
        if len(found) < self.held_out:
            raise self._no_plan(
                search.drawn,
                f"{len(found)} of {self.held_out} evaluation stations found",
            )
        return found

    def _record(
        self, route: list[tuple[Candidate, Stop]], bound: float, pool: int
    ) -> Plan:
        stations = tuple(
            Station(
                k,
                "calibration" if stop.place < self.wanted else "evaluation",
                stop.joints,
                SE3(candidate.base_from_flange[stop.step]),
            )
            for k, (candidate, stop) in enumerate(route)
        )
        visits: dict[int, list[int]] = {}
        for k, (_, stop) in enumerate(route):
            visits.setdefault(stop.place, []).append(k)
        pairs = sorted(pair for place, pair in visits.items() if place < self.wanted)
        used = [k for k, s in enumerate(stations) if s.kind == "calibration"]
        before = len(self.visited.base_from_flange)
        certified = certify(
            self.cell,
            self.model,
            np.concatenate(
                [
                    self.visited.base_from_flange,
                    [route[k][0].base_from_flange[route[k][1].step] for k in used],
                ]
            ),
            np.concatenate([self.visited.seen, [route[k][0].seen for k in used]]),
            np.zeros(before + len(used), dtype=np.intp),
            np.concatenate(
                [self.visited.turns, before + np.searchsorted(used, np.array(pairs))]
            ),
        )
        certificate = dict(certified.numbers)
        certificate["relaxed_bound_mm"] = float(1e3 * np.sqrt(bound))
        certificate["candidates"] = float(pool)
        via = tuple(stop.via for _, stop in route)
        points = np.concatenate(
            [
                self.visited.joints[None],
                *(np.concatenate([stop.via, stop.joints[None]]) for _, stop in route),
            ]
        )
        times = self.route.time(points[:-1], points[1:])
        certificate["cycle_time_s"] = float(times.sum())
        if certificate["axis_spread"] < MIN_AXIS_SPREAD:
            self.rejected["axis_spread"] += 1
            raise self._no_plan(1, "the rotations do not span 3-D", "axis_spread")
        return Plan(
            stations,
            tuple(HalfTurn(a, b, self.cell.rig.axis) for a, b in pairs),
            dict(self.rejected),
            certificate,
            self.seed,
            certified.outcome,
            (*certified.findings, *unknown_speeds(self.arm)),
            via,
        )

    def _no_plan(self, drawn: int, what: str, check: str | None = None) -> NoPlanError:
        return no_plan(self.cell.name, self.rejected, drawn, what, check, self.solids)
