"""What a plan would be without choosing: random feasible half-turns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.arm import Arm
from handeye_tri.config import Cell
from handeye_tri.plan.candidates import Candidate, CandidateSearch
from handeye_tri.plan.design import Design
from handeye_tri.plan.information import StationInformation
from handeye_tri.records import HalfTurn, Station
from handeye_tri.se3 import SE3

# Feasible half-turns that random plans are drawn from, of all mounts.
_FEASIBLE = 250


@dataclass(frozen=True, slots=True, eq=False)
class RandomPlans:
    """The sampler, written down.

    Half-turns are drawn without replacement from the first 250 that are feasible of
    ``CandidateSearch.find``: the rig's centre uniform in the workspace box, the
    triangle's tilt and spin uniform in what the cell allows, every check of a plan
    passed (views, reach, limits, solids). Of a cell with two mounts, from the first 125
    with each, as many with one as with the other; one more with the first if odd.

    Attributes:
        candidates: The feasible half-turns.
        design: What they tell.
    """

    candidates: list[Candidate]
    design: Design

    @classmethod
    def of(cls, arms: Sequence[Arm], model: StationInformation) -> RandomPlans:
        """Search once; what is drawn later is from the same half-turns."""
        found = []
        for mount, (view, arm) in enumerate(zip(model.views, arms, strict=True)):
            rng = np.random.default_rng(1 + mount)
            search = CandidateSearch(view, arm, rng, mount=mount)
            places = search.find(_FEASIBLE // len(arms), turns=True)
            found += [first for first, *_ in places]
        information = model.of_half_turns(
            np.array([c.base_from_flange for c in found]),
            np.array([c.seen for c in found]),
            np.array([c.mount for c in found]),
        )
        return cls(found, Design(information, model.prior, model.workspace_cost))

    def draw(self, rng: np.random.Generator, half_turns: int) -> NDArray[np.intp]:
        """Indices of one random plan's half-turns."""
        mounts = np.array([c.mount for c in self.candidates])
        count = int(mounts.max()) + 1
        drawn = [
            rng.choice(
                np.flatnonzero(mounts == mount),
                len(range(mount, half_turns, count)),
                replace=False,
            )
            for mount in range(count)
        ]
        return np.concatenate(drawn)

    def track_mm(self, chosen: NDArray[np.intp]) -> float:
        """Calibration's part of the predicted track error over the workspace, mm."""
        weights = np.zeros(len(self.candidates))
        weights[chosen] = 1.0
        return float(1e3 * np.sqrt(self.design.cost(weights)))

    def programme(
        self, chosen: NDArray[np.intp], cell: Cell
    ) -> tuple[tuple[Station, ...], tuple[HalfTurn, ...]]:
        """Stations and half-turns of a plan."""
        stations = tuple(
            Station(
                2 * k + step,
                "calibration",
                candidate.joints[step],
                SE3(pose),
                candidate.mount,
            )
            for k, candidate in enumerate(self.candidates[c] for c in chosen)
            for step, pose in enumerate(candidate.base_from_flange)
        )
        turns = tuple(
            HalfTurn(2 * k, 2 * k + 1, cell.axes[self.candidates[c].mount])
            for k, c in enumerate(chosen)
        )
        return stations, turns
