"""Levenberg-Marquardt over many independent trials, each with its own damping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.trial_equations import Equations
from handeye_tri.calibrate_cameras.trial_model import TrialModel, TrialState

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Depth and focal length are nearly one unknown: more damping would hold them back.
_START_DAMPING = 1e-7
_MIN_DAMPING, _MAX_DAMPING = 1e-12, 1e12
# (step / sigma)^2 of the last step taken; the one after would be its square.
RELATIVE_TOLERANCE = 1e-8


@dataclass(frozen=True, slots=True, eq=False)
class TrialMinima:
    """Where the iterations ended.

    Attributes:
        state: The unknowns.
        equations: There.
        cost_start: Shape (c,).
        iterations: Evaluations after the first, shape (c,).
        converged: Whether the last step was negligible against its sigma, shape (c,).
    """

    state: TrialState
    equations: Equations
    cost_start: Floats
    iterations: NDArray[np.intp]
    converged: Bools

    @property
    def cost(self) -> Floats:
        """Sum of squared residuals, shape (c,); NaN where there was no start."""
        return self.equations.cost

    def put(
        self, rows: NDArray[np.intp], other: TrialMinima, of: NDArray[np.intp] | Bools
    ) -> None:
        """Overwrite trials ``rows``, shape (r,), by the trials ``of`` another."""
        self.state.put(rows, other.state.take(of))
        self.equations.own[..., rows] = other.equations.own[..., of]
        self.equations.shared[..., rows] = other.equations.shared[..., of]
        self.cost_start[rows] = other.cost_start[of]
        self.iterations[rows] = other.iterations[of]
        self.converged[rows] = other.converged[of]


def minimise_trials(
    model: TrialModel,
    start: TrialState,
    freedom: Floats,
    floor: Floats,
    tolerance: float = RELATIVE_TOLERANCE,
    max_iterations: int = 100,
) -> TrialMinima:
    """Levenberg-Marquardt with Nielsen's damping rule, each trial with its own damping.

    Args:
        model: The trials.
        start: Where to begin.
        freedom: Degrees of freedom of each trial, shape (c,).
        floor: Cost of each trial that is rounding only, shape (c,).
        tolerance: Predicted gain over cost and freedom of a step that is the last.
        max_iterations: Upper limit of evaluations.
    """
    c = model.weight.shape[1]
    first = model.evaluate(start)
    cost_start = first.cost.copy()
    result = TrialMinima(
        start.take(np.arange(c)),
        first.take(np.arange(c)),
        cost_start,
        np.zeros(c, dtype=np.intp),
        np.zeros(c, dtype=bool),
    )
    active = np.flatnonzero(np.isfinite(cost_start))
    if len(active) < c:
        model, start, first = model.take(active), start.take(active), first.take(active)
    state, equations = start, first
    damping, growth = np.full(len(active), _START_DAMPING), np.full(len(active), 2.0)
    slot = 0
    for iteration in range(1, max_iterations + 1):
        if not len(active):
            break
        own, shared, gain = equations.step(damping)
        cost = equations.cost.copy()
        limit = np.maximum(tolerance * cost / freedom[active], floor[active])
        negligible = gain <= limit
        tried_state = model.retract(state, own, shared)
        slot = 1 - slot
        tried = model.evaluate(tried_state, slot)
        better = tried.cost <= cost
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.where(gain > 0, (cost - tried.cost) / gain, 1.0)
        if better.all():
            state, equations = tried_state, tried
        else:
            state = state.take(np.arange(len(active)))
            state.put(better, tried_state.take(better))
            equations.put(better, tried)
            slot = 1 - slot
        fall = np.maximum(0.1, 1.0 - (2.0 * np.where(better, ratio, 1.0) - 1.0) ** 3)
        damping = np.maximum(damping * np.where(better, fall, growth), _MIN_DAMPING)
        growth = np.where(better, 2.0, 2.0 * growth)
        result.iterations[active] = iteration
        # A strongly damped step is short for that reason alone.
        settled = negligible & (damping < 1.0)
        done = settled | (damping >= _MAX_DAMPING)
        if done.any():
            ended = active[done]
            result.converged[active[settled]] = True
            result.state.put(ended, state.take(done))
            result.equations.own[..., ended] = equations.own[..., done]
            result.equations.shared[..., ended] = equations.shared[..., done]
            kept = ~done
            active, damping, growth = active[kept], damping[kept], growth[kept]
            model, state = model.take(kept), state.take(kept)
            equations = equations.take(kept)
    if len(active):
        result.state.put(active, state)
        result.equations.own[..., active] = equations.own
        result.equations.shared[..., active] = equations.shared
    return result
