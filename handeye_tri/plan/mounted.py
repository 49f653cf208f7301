"""The cell with one mount, as planning goes through it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from handeye_tri.arm import Arm
from handeye_tri.config import Cell
from handeye_tri.counting import counted
from handeye_tri.errors import InputError, NoPlanError
from handeye_tri.plan.candidates import Candidate, CandidateSearch, Prospect
from handeye_tri.plan.poses import View
from handeye_tri.plan.refusal import no_plan
from handeye_tri.plan.route import RoutePlanner

Floats = NDArray[np.float64]


def arms_by_mount(cell: Cell, arms: Arm | Sequence[Arm]) -> tuple[Arm, ...]:
    """The robot with each mount of a cell.

    Raises:
        InputError: there is not one for each.
    """
    found = tuple(arms) if isinstance(arms, Sequence) else (arms,)
    if len(found) != len(cell.mounted):
        raise InputError(
            f"arms must be one by mount: cell {cell.name!r} has "
            f"{counted(len(cell.mounted), 'mount')}, got {counted(len(found), 'arm')}"
        )
    return found


class Mounted:
    """What is searched for with one mount, and what stood in the way.

    Attributes:
        mount: Which, from 0.
        name: What a person calls it.
        view: Cameras and rig.
        arm: The robot with its holder.
        home: Where it starts, and waits for a tool change, shape (q,), rad or m.
        route: Orders stations.
        rejected: Rejected candidates by check.
        solids: What solids did that rejected one, in words; how often.
        drawn_held_out: Poses drawn for evaluation stations.
    """

    def __init__(self, cell: Cell, arm: Arm, mount: int, seed: int) -> None:
        """Start with nothing searched.

        Args:
            cell: The cell with all its mounts.
            arm: The robot with this one.
            mount: Which, from 0.
            seed: Same seed, same candidates.
        """
        self.mount = mount
        self.name = cell.mount_name(mount)
        self.view = View(cell.mounted[mount])
        self.arm = arm
        self.home = arm.home
        self.rejected: Counter[str] = Counter()
        self.solids: Counter[str] = Counter()
        self._seed = seed
        self._search = self._searching(0)
        self.drawn_held_out = 0
        self.route = RoutePlanner(
            arm, cell.arm.acceleration_time_s, seed, self.rejected, self.solids
        )

    def _searching(self, purpose: int) -> CandidateSearch:
        rng = np.random.default_rng([self._seed, 2 * self.mount + purpose])
        return CandidateSearch(
            self.view, self.arm, rng, self.rejected, self.solids, self.mount
        )

    @property
    def drawn(self) -> int:
        """Poses drawn for half-turns."""
        return self._search.drawn

    def touches(self, joints: Floats) -> bool:
        """Whether solids touch at joints of shape (q,); counted if so."""
        hit = self.arm.collision(joints)
        if hit is not None:
            self.rejected["path"] += 1
            self.solids[f"{hit[0]} touches {hit[1]}"] += 1
        return hit is not None

    def prospects(self, wanted: int, progress: Callable[[int], None]) -> list[Prospect]:
        """Half-turns that the cameras see and the arm reaches."""
        return self._search.prospects(wanted, progress)

    def free(self, prospect: Prospect, most: int) -> list[Candidate]:
        """Solutions of a half-turn that no solid forbids."""
        return self._search.free(prospect, most)

    def widened(self, prospect: Prospect, most: int) -> list[Candidate]:
        """The same after a longer search for solutions."""
        return self._search.free(self._search.widened(prospect), most)

    def held_out(self, wanted: int, solutions: int) -> list[list[Candidate]]:
        """Free solutions of stations, up to twice as many as wanted."""
        if wanted == 0:
            return []
        search = self._searching(1)
        found = search.find(2 * wanted, turns=False, solutions=solutions)
        self.drawn_held_out = search.drawn
        return found


def refused(
    failing: Sequence[Mounted],
    every: Sequence[Mounted],
    drawn: int,
    what: str,
    check: str | None = None,
) -> NoPlanError:
    """The error that says with which mount there is no plan.

    Args:
        failing: The mounts without one; empty: none by itself.
        every: All mounts.
        drawn: Candidates in all.
        what: What was not found.
        check: What stands most in the way; None: what let the smallest part pass.
    """
    counts, solids = Counter[str](), Counter[str]()
    for one in failing or every:
        counts.update(one.rejected)
        solids.update(one.solids)
    cell = every[0].view.cell.name
    if len(failing) == 1 < len(every):
        what += f" with {failing[0].name}"
    return no_plan(cell, counts, drawn, what, check, solids)
