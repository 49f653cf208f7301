"""The half-turns that tell most, of all mounts together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import NoPlanError
from handeye_tri.plan.candidates import Candidate, Prospect
from handeye_tri.plan.design import Design, Kinds
from handeye_tri.plan.information import StationInformation
from handeye_tri.plan.mounted import Mounted, refused
from handeye_tri.plan.selection import Selection, Selector

Floats = NDArray[np.float64]


class Chooser:
    """Searches with each mount and chooses among what is found with all of them."""

    def __init__(
        self,
        sides: Sequence[Mounted],
        model: StationInformation,
        wanted: int,
        least: int,
        progress: Callable[[int], None],
    ) -> None:
        """Start with nothing searched.

        Args:
            sides: The mounts, in their order.
            model: Predicts what half-turns tell.
            wanted: How many to choose.
            least: How many with each mount at least.
            progress: Told how much is done, of the pool's size.
        """
        self.sides = sides
        self.model = model
        self.wanted = wanted
        self.least = least
        self._done = progress
        self._count = 0

    def _fatal(self, failing: Sequence[Mounted]) -> bool:
        """Whether there is no plan without these mounts."""
        return bool(failing) and (len(failing) == len(self.sides) or self.least > 0)

    def _needed(self, failing: Sequence[Mounted]) -> int:
        """How many half-turns are needed with these mounts."""
        return self.wanted if len(failing) == len(self.sides) else self.least

    def pool(self, count: int) -> list[Prospect]:
        """Half-turns with each mount, as many with one as with another.

        Args:
            count: How many in all.

        Raises:
            NoPlanError: too few are seen and reached.
        """
        self._count = count
        size = count // len(self.sides)
        pool: list[Prospect] = []
        short = []
        for number, side in enumerate(self.sides):

            def progress(found: int, before: int = number * size) -> None:
                # Half of the work is in what comes after the pool.
                self._done((before + found) // 2)

            found = side.prospects(size, progress)
            pool += found
            if len(found) < max(self.least, 1):
                short.append(side)
        fatal = self._fatal(short)
        failing = short if fatal else self.sides
        mounts = [side.mount for side in failing]
        found_there = sum(p.mount in mounts for p in pool)
        needed = self._needed(failing)
        if fatal or found_there < needed:
            raise refused(
                failing,
                self.sides,
                sum(side.drawn for side in failing),
                f"{found_there} of {needed} half-turns found",
            )
        return pool

    def choose(
        self, pool: Sequence[Prospect], visited: Floats
    ) -> tuple[Selector, Selection]:
        """The half-turns that tell most, free of solids.

        Args:
            pool: What is chosen from.
            visited: Information of what was seen already, shape (p, p).

        Raises:
            NoPlanError: solids leave too few.
        """
        checks = 0

        def checked() -> None:
            nonlocal checks
            checks += 1
            half = self._count // 2
            self._done(half + int((1 - np.exp(-checks / 200)) * half))

        def free(prospect: Prospect, most: int) -> list[Candidate]:
            return self.sides[prospect.mount].free(prospect, most)

        def tells(candidate: Candidate) -> Floats:
            return np.asarray(
                self.model.of_half_turns(
                    candidate.base_from_flange[None],
                    candidate.seen[None],
                    np.array([candidate.mount]),
                )[0]
            )

        without_solids = [Counter(side.rejected) for side in self.sides]
        mounts = np.array([p.mount for p in pool])
        there = [mounts == side.mount for side in self.sides]
        design = Design(
            self.model.of_half_turns(
                np.array([p.base_from_flange for p in pool]),
                np.array([p.seen for p in pool]),
                mounts,
            ),
            self.model.prior + visited,
            self.model.workspace_cost,
            Kinds(mounts, (self.least,) * len(self.sides)),
        )
        selector = Selector(design, pool, free, self.wanted, checked, tells)

        def refusal(failing: Sequence[Mounted], what: str) -> NoPlanError:
            by_solids = Counter[str]()
            for side in failing:
                by_solids += side.rejected - without_solids[side.mount]
            drawn = sum(side.drawn for side in failing)
            most = by_solids.most_common(1)
            return refused(
                failing, self.sides, drawn, what, most[0][0] if most else None
            )

        blocked, looked_at = [], 0
        for side, members in zip(self.sides, there, strict=True):
            before = selector.checked
            if selector.probe(np.flatnonzero(members)) == 0:
                selector.usable[members] = False
                blocked.append(side)
                looked_at += selector.checked - before
        if self._fatal(blocked):
            raise refusal(blocked, f"0 of {looked_at} half-turns are free")
        selection = selector.select()
        if selection is None:
            usable = [int((selector.usable & members).sum()) for members in there]
            few = [s for s, n in zip(self.sides, usable, strict=True) if n < self.least]
            failing = few or self.sides
            passed = sum(usable[side.mount] for side in failing)
            what = f"{passed} of {self._needed(failing)} half-turns are free"
            raise refusal(failing, what)
        return selector, selection

    def staying(
        self,
        pool: Sequence[Prospect],
        selector: Selector,
        chosen: list[int],
        mount: int,
        limit: float,
    ) -> list[int]:
        """Half-turns without a tool change, where they tell nearly as much.

        Args:
            pool: What is chosen from.
            selector: Chooses.
            chosen: The choice with tool changes.
            mount: The one that the arm carries.
            limit: What a choice may cost.
        """
        if len(self.sides) == 1:
            return chosen
        carried = np.array([p.mount == mount for p in pool])
        staying = selector.select(carried)
        if staying is None or selector.cost(staying.chosen) > limit:
            return chosen
        # Nor may what is exchanged later need one.
        selector.usable &= carried
        return staying.chosen
