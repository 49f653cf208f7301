"""Levenberg-Marquardt for residuals in blocks with own and shared unknowns.

Every residual belongs to one block (here a half-turn), which has l unknowns of its
own; g unknowns are shared by all. The own unknowns are eliminated block by block
(Schur complement; Triggs et al. 1999, doi:10.1007/3-540-44480-7_21), so that cost
grows in proportion to the blocks. Unknowns that no residual depends on stay put.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from handeye_tri.threads import one_thread

Floats = NDArray[np.float64]

_START_DAMPING = 1e-4
_MAX_DAMPING = 1e12
# (step / sigma)^2 of the last step taken; the one after would be its square.
RELATIVE_TOLERANCE = 1e-9
# Relative rounding of a cost, a sum of very many squares.
_COST_ROUNDING = 1e-12
# The most that glibc takes as a threshold is 32 MiB, its own header included.
_KEPT_BYTES = 32_000_000
# Minima whose costs differ by a smaller part than this are one minimum.
_SAME_COST = 1e-3


class Linearised(Protocol):
    """Residuals at one state, with what a step needs to know of them."""

    @property
    def cost(self) -> float:
        """Sum of squared residuals."""

    @property
    def observations(self) -> int:
        """Number of residuals."""

    @property
    def unknowns(self) -> int:
        """Number of unknowns, own and shared."""

    def equations(self) -> NormalEquations:
        """The normal equations at this state."""


State = TypeVar("State")
Rows = TypeVar("Rows", bound=Linearised)


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Residuals and derivatives at one state.

    Attributes:
        residuals: Whitened, shape (n, r).
        own: Derivatives by each block's own unknowns, shape (n, r, l).
        shared: Derivatives by the shared unknowns, shape (n, r, g).
    """

    residuals: Floats
    own: Floats
    shared: Floats

    @property
    def cost(self) -> float:
        """Sum of squared residuals."""
        return float(np.vdot(self.residuals, self.residuals))

    @property
    def observations(self) -> int:
        """Number of residuals."""
        return int(self.residuals.size)

    @property
    def unknowns(self) -> int:
        """Number of unknowns, own and shared."""
        return int(self.own[:, 0].size + self.shared.shape[-1])

    def equations(self) -> NormalEquations:
        """The normal equations at this state."""
        return NormalEquations.of(self)


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """J'J and J'r of :class:`Blocks`, by parts.

    Attributes:
        own: Shape (n, l, l).
        cross: Shape (n, l, g).
        shared: Shape (g, g).
        own_gradient: Shape (n, l).
        shared_gradient: Shape (g,).
    """

    own: Floats
    cross: Floats
    shared: Floats
    own_gradient: Floats
    shared_gradient: Floats

    @classmethod
    def of(cls, blocks: Blocks) -> NormalEquations:
        """Multiply out."""
        size: int = blocks.own.shape[-1]
        joined = np.concatenate(
            [blocks.own, blocks.shared, blocks.residuals[..., None]], axis=-1
        )
        product = np.swapaxes(joined, -1, -2) @ joined
        total = product[:, size:, size:].sum(axis=0)
        own = product[:, :size, :size]
        diagonal = np.einsum("nii->ni", own)
        diagonal[diagonal == 0.0] = 1.0
        return cls(
            own,
            product[:, :size, size:-1],
            total[:-1, :-1],
            product[:, :size, -1],
            total[:-1, -1],
        )

    def step(self, damping: float) -> tuple[Floats, Floats, float]:
        """Damped step of own (n, l) and shared (g,) unknowns; its predicted gain.

        Raises:
            numpy.linalg.LinAlgError: the damped equations are singular.
        """
        g = len(self.shared_gradient)
        own, shared = self.own.copy(), self.shared.copy()
        own_diagonal = np.einsum("nii->ni", own)
        shared_diagonal = np.einsum("ii->i", shared)
        own_scale, shared_scale = own_diagonal.copy(), shared_diagonal.copy()
        own_diagonal *= 1.0 + damping
        shared_diagonal *= 1.0 + damping
        # With L L' = own, L^-1 of the right sides makes what is subtracted a square,
        # of which only one half need be multiplied out.
        inverse = np.linalg.inv(np.linalg.cholesky(own))
        right = np.concatenate([self.cross, self.own_gradient[..., None]], axis=-1)
        rows = (inverse @ right).reshape(-1, g + 1)
        reduced = rows.T @ rows
        d_shared = -np.linalg.solve(
            shared - reduced[:g, :g], self.shared_gradient - reduced[:g, g]
        )
        rest = (rows[:, g] + rows[:, :g] @ d_shared).reshape(*inverse.shape[:2], 1)
        d_own = -(np.swapaxes(inverse, -1, -2) @ rest)[..., 0]
        gain = (
            damping * float(np.vdot(own_scale, d_own**2))
            + damping * float(shared_scale @ d_shared**2)
            - float(np.vdot(d_own, self.own_gradient))
            - float(d_shared @ self.shared_gradient)
        )
        return d_own, d_shared, gain

    def reduced(self) -> Floats:
        """Information on the shared unknowns alone, shape (g, g)."""
        solved = np.linalg.solve(self.own, self.cross)
        eliminated = np.tensordot(self.cross, solved, axes=((0, 1), (0, 1)))
        return np.asarray(self.shared - eliminated)

    def own_covariance(self) -> Floats:
        """Covariance of each block's own unknowns, shape (n, l, l)."""
        inverse = np.linalg.inv(self.own)
        if len(self.shared_gradient) == 0:
            return np.asarray(inverse)
        solved = inverse @ self.cross
        covariance = np.linalg.inv(self.reduced())
        return np.asarray(inverse + solved @ covariance @ np.swapaxes(solved, -1, -2))


@dataclass(frozen=True, slots=True, eq=False)
class Minimum(Generic[State, Rows]):
    """Where the iteration ended.

    Attributes:
        state: The unknowns.
        blocks: Residuals and derivatives there.
        cost: Sum of squared residuals.
        cost_start: The same at the start.
        iterations: Evaluations after the first.
        converged: Whether the last step was negligible against its own sigma.
    """

    state: State
    blocks: Rows
    cost: float
    cost_start: float
    iterations: int
    converged: bool


def minimise(
    evaluate: Callable[[State], Rows | None],
    retract: Callable[[State, Floats, Floats], State],
    start: State,
    rounding: float,
    known: float | None = None,
    max_iterations: int = 100,
    tolerance: float = RELATIVE_TOLERANCE,
    damping: float = _START_DAMPING,
    foresee: bool = False,
    take_last: bool = True,
) -> Minimum[State, Rows] | None:
    """Levenberg-Marquardt with Nielsen's damping rule (IMM-REP-1999-05).

    Args:
        evaluate: Residuals and derivatives at a state; None where it is no camera.
        retract: Moves a state by steps (n, l) and (g,).
        start: Where to begin.
        rounding: Root mean square of whitened residuals that is rounding only.
        known: Cost of a minimum found before. The iteration ends, not converged,
            where a short step is predicted to reach the same cost.
        max_iterations: Upper limit of evaluations.
        tolerance: Predicted gain over cost per degree of freedom of a last step.
        damping: Of the first step.
        foresee: Apply ``tolerance`` to the step after the last one, which gains less
            by at least the factor by which the last gains less than the one before.
        take_last: Whether to take the last step, too, and not just to know it.

    Returns:
        The minimum; None where the start cannot be evaluated.
    """
    _keep_pages()
    # Many products of small matrices: threads cost more than they bring.
    with one_thread():
        return _minimise(
            evaluate,
            retract,
            start,
            rounding,
            known,
            max_iterations,
            tolerance,
            damping,
            foresee,
            take_last,
        )


@cache
def _keep_pages() -> None:
    """Let the allocator keep the pages of freed arrays, up to 32 MB each.

    Fresh pages cost as much as what is computed in them. glibc gives arrays back to the
    system unless it has seen a larger one freed (mallopt(3), M_MMAP_THRESHOLD).
    """
    np.empty(_KEPT_BYTES, dtype=np.uint8)


def _minimise(
    evaluate: Callable[[State], Rows | None],
    retract: Callable[[State, Floats, Floats], State],
    start: State,
    rounding: float,
    known: float | None,
    max_iterations: int,
    tolerance: float,
    damping: float,
    foresee: bool,
    take_last: bool,
) -> Minimum[State, Rows] | None:
    blocks = evaluate(start)
    if blocks is None:
        return None
    state, cost = start, blocks.cost
    cost_start = cost
    freedom = max(blocks.observations - blocks.unknowns, 1)
    floor = blocks.observations * rounding**2
    growth = 2.0
    equations = blocks.equations()
    converged = False
    iteration = 0
    before = 0.0
    while iteration < max_iterations and damping < _MAX_DAMPING:
        iteration += 1
        try:
            d_own, d_shared, gain = equations.step(damping)
        except np.linalg.LinAlgError:
            damping, growth = damping * growth, 2 * growth
            continue
        last = gain
        if foresee and 0.0 < gain < before and damping < _START_DAMPING:
            last = gain * (gain / before)
        negligible = last <= max(tolerance * cost / freedom, floor)
        if negligible and damping < 1.0 and not take_last:
            iteration, converged = iteration - 1, True
            break
        if (
            known is not None
            and gain < 0.1 * known
            and abs(cost - gain - known) < _SAME_COST * known
        ):
            break
        candidate = retract(state, d_own, d_shared)
        tried = evaluate(candidate)
        tried_cost = np.inf if tried is None else tried.cost
        # A last step gains less than the cost is rounded by: it is taken all the same.
        rounded = _COST_ROUNDING * cost if negligible else 0.0
        if tried is not None and tried_cost <= cost + rounded:
            ratio = max((cost - tried_cost) / gain, 0.0) if gain > 0 else 1.0
            state, blocks, cost, before = candidate, tried, tried_cost, gain
            damping *= max(0.1, 1.0 - (2.0 * ratio - 1.0) ** 3)
            growth = 2.0
            equations = blocks.equations()
        else:
            # Residuals that are rounded leave the cost no finer than this.
            negligible = bool(negligible or gain <= 2.0 * np.sqrt(cost) * rounding)
            damping, growth, before = damping * growth, 2 * growth, 0.0
        # A strongly damped step is short for that reason alone.
        if negligible and damping < 1.0:
            converged = True
            break
    return Minimum(state, blocks, cost, cost_start, iteration, converged)
