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
from handeye_tri.plan.certificate import MIN_AXIS_SPREAD, certify
from handeye_tri.plan.design import Design
from handeye_tri.plan.information import StationInformation
from handeye_tri.plan.poses import View, plane_angles
from handeye_tri.plan.refusal import no_plan
from handeye_tri.plan.route import RoutePlanner
from handeye_tri.plan.selection import Selector
from handeye_tri.plan.sequence import Stops
from handeye_tri.records import HalfTurn, Plan, Station
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]

# Half-turns to choose from, per half-turn wanted, and at most.
_POOL = 90
_LARGEST_POOL = 1000
# Selections that are tried before a cell is given up.
_SELECTIONS = 6
# Ways to reach a half-turn that the order may choose from, senses included.
_OPTIONS = 12


def plan_motions(
    cell: Cell,
    arm: Arm,
    seed: int,
    half_turns: int | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Plan half-turns joined by general motions, then evaluation stations.

    Every station is within the joint limits, free of collision with clearance, and
    shows all markers' outlines unhidden and with margin to two cameras or more (or to
    the only one), at an allowed tilt; the two stations of a half-turn differ by 180
    degrees about the flange's z axis; successive half-turns' planes enclose at least
    ``plan.min_plane_spread_deg`` (Zhao, Liu and Zhang 2008, Proposition 1,
    doi:10.1109/TIP.2008.2005562); ways from station to station are free, straight in
    joint space or past the points in ``via``. Among what passes, those half-turns
    are chosen that make the calibration's part of the predicted track error over the
    workspace box least, and the order that takes the least time.

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
            self.view,
            arm.base_from_world.matrix,
            cell.repeatability,
            cell.plan.expected_sigma_px,
        )
        self.pool_size = min(_POOL * wanted, _LARGEST_POOL)
        self.total = self.pool_size + wanted + self.held_out
        self.progress = progress
        self.done = -1
        self.rejected: Counter[str] = Counter()
        self.route = RoutePlanner(
            arm, cell.arm.acceleration_time_s, seed, self.rejected
        )

    def _done(self, done: int) -> None:
        if self.progress is not None and done > self.done:
            self.progress(done, self.total)
        self.done = max(done, self.done)

    def plan(self) -> Plan:
        """Search, choose, order, and add the evaluation stations."""
        search = self._search(0)
        # Half of the work is in what comes after the pool.
        pool = search.prospects(self.pool_size, progress=lambda n: self._done(n // 2))
        if len(pool) < self.wanted:
            raise self._no_plan(
                search.drawn, f"{len(pool)} of {self.wanted} half-turns found"
            )
        chosen, via, bound = self._choose_and_order(pool, search)
        self._done(self.pool_size + self.wanted)
        evaluation, further = self._evaluation(chosen[-1].joints[-1])
        plan = self._record(chosen, evaluation, [*via, *further], bound, len(pool))
        self._done(self.total)
        return plan

    def _search(self, stream: int) -> CandidateSearch:
        rng = np.random.default_rng([self.seed, stream])
        return CandidateSearch(self.view, self.arm, rng, self.rejected)

    def _choose_and_order(
        self, pool: Sequence[Prospect], search: CandidateSearch
    ) -> tuple[list[Candidate], list[Floats], float]:
        """The half-turns in their order, the ways there, the bound on their cost."""
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
            ),
            self.model.prior
            + self.model.of_stations(
                self.visited.base_from_flange, self.visited.seen
            ).sum(axis=0),
            self.model.workspace_cost,
        )

        def tells(candidate: Candidate) -> Floats:
            poses = candidate.base_from_flange[None]
            return np.asarray(self.model.of_half_turns(poses, candidate.seen[None])[0])

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
        chosen: list[int] | None = selection.chosen
        for _ in range(_SELECTIONS):
            if chosen is None:
                break
            order = self._order([search.all_free(pool[k]) for k in chosen])
            if not isinstance(order, int):
                return *order, selection.bound
            chosen = selector.replace(chosen, chosen[order])
        most = "path" if self.rejected["path"] else "plane_spread"
        raise self._no_plan(
            len(pool), "no order of half-turns drives free from one to the next", most
        )

    def _order(
        self, ways: list[list[Candidate]]
    ) -> tuple[list[Candidate], list[Floats]] | int:
        """The half-turns in the order of least time, or the one that is in the way.

        Planes of successive half-turns spread enough, and the way between them is
        free; each is driven in one of its two senses.

        Args:
            ways: Free solutions of each half-turn.
        """
        least = np.radians(self.cell.plan.min_plane_spread_deg)
        options = [
            each
            for some in ways
            for way in some[: _OPTIONS // 2]
            for each in (way, way.turned_round())
        ]
        stop = np.array(
            [k for k, some in enumerate(ways) for _ in some[: _OPTIONS // 2] * 2]
        )
        begin = np.array([c.joints[0] for c in options])
        end = np.array([c.joints[1] for c in options])
        normals = np.array([c.normal for c in options])
        spread = plane_angles(normals[:, None], normals[None]) >= least
        times = np.where(spread, self.route.time(end[:, None], begin[None]), np.inf)
        start = self.visited.joints
        first = self.route.time(start, begin)
        if len(self.visited.turns):
            before = self.visited.base_from_flange[self.visited.turns[-1, :1]]
            world = self.arm.base_from_world.inverse().matrix @ before
            apart = plane_angles(self.view.normals(world), normals)
            first = np.where(apart >= least, first, np.inf)
        stops = Stops(stop, first, times)
        route = self.route.drive(stops, start, begin, end)
        if route is not None:
            return [options[k] for k in route.order], route.via
        return int(np.argmin(np.bincount(stop, np.isfinite(times).sum(axis=1))))

    def _evaluation(self, start: Floats) -> tuple[list[Candidate], list[Floats]]:
        """Stations anywhere in the workspace, in the order of least time."""
        wanted = self.held_out
        if wanted == 0:
            return [], []
        search = self._search(1)
        # Some more than wanted: the way to one may be blocked.
        found = search.find(2 * wanted, turns=False)
        while len(found) >= wanted:
            joints = np.array([c.joints[0] for c in found[:wanted]])
            times = self.route.time(joints[:, None], joints[None])
            stops = Stops(np.arange(wanted), self.route.time(start, joints), times)
            route = self.route.drive(stops, start, joints, joints)
            if route is not None:
                return [found[k] for k in route.order], route.via
            found.pop(int(np.argmin(np.isfinite(times).sum(axis=0))))
        raise self._no_plan(
            search.drawn, f"{len(found)} of {wanted} evaluation stations found"
        )

    def _record(
        self,
        chosen: list[Candidate],
        evaluation: list[Candidate],
        ways: list[Floats],
        bound: float,
        pool: int,
    ) -> Plan:
        calibration = [
            Station(2 * k + step, "calibration", c.joints[step], SE3(pose))
            for k, c in enumerate(chosen)
            for step, pose in enumerate(c.base_from_flange)
        ]
        held_out = [
            Station(k, "evaluation", c.joints[0], SE3(c.base_from_flange[0]))
            for k, c in enumerate(evaluation, len(calibration))
        ]
        turns = tuple(
            HalfTurn(2 * k, 2 * k + 1, self.cell.rig.axis) for k in range(len(chosen))
        )
        seen = len(self.visited.base_from_flange)
        added = seen + np.arange(2 * len(chosen)).reshape(-1, 2)
        certified = certify(
            self.cell,
            self.model,
            np.concatenate(
                [self.visited.base_from_flange, *(c.base_from_flange for c in chosen)]
            ),
            np.concatenate(
                [self.visited.seen, *(np.stack([c.seen, c.seen]) for c in chosen)]
            ),
            np.concatenate([self.visited.turns, added]),
        )
        certificate = dict(certified.numbers)
        certificate["relaxed_bound_mm"] = float(1e3 * np.sqrt(bound))
        certificate["candidates"] = float(pool)
        via = self._via(ways, len(chosen))
        joints = [s.joints for s in (*calibration, *held_out)]
        route = np.array(
            [
                self.visited.joints,
                *(q for v, s in zip(via, joints, strict=True) for q in (*v, s)),
            ]
        )
        times = self.route.time(route[:-1], route[1:])
        certificate["cycle_time_s"] = float(times.sum())
        if certificate["axis_spread"] < MIN_AXIS_SPREAD:
            self.rejected["axis_spread"] += 1
            raise self._no_plan(1, "the rotations do not span 3-D", "axis_spread")
        return Plan(
            (*calibration, *held_out),
            turns,
            dict(self.rejected),
            certificate,
            self.seed,
            certified.outcome,
            certified.findings,
            via,
        )

    def _via(self, ways: list[Floats], half_turns: int) -> tuple[Floats, ...]:
        """Points to pass by station: a half-turn itself is driven straight."""
        straight = np.zeros((0, len(self.arm.home)))
        turns = [v for way in ways[:half_turns] for v in (way, straight)]
        return (*turns, *ways[half_turns:])

    def _no_plan(self, drawn: int, what: str, check: str | None = None) -> NoPlanError:
        return no_plan(self.cell.name, self.rejected, drawn, what, check)
