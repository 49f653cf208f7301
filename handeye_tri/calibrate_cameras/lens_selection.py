"""Which lens coefficients to estimate, where those asked for cannot be told apart."""

from __future__ import annotations

from scipy.special import chdtri

from handeye_tri.calibrate_cameras.degeneracy import (
    MAX_CONDITION,
    invert_information,
)
from handeye_tri.calibrate_cameras.least_squares import (
    Blocks,
    Minimum,
    NormalEquations,
    minimise,
)
from handeye_tri.calibrate_cameras.refine import (
    HalfTurnModel,
    State,
    refine_from_starts,
)
from handeye_tri.camera import LENS_COEFFICIENTS, LensModel

# Chance that a coefficient that is not there is advised.
_CHANCE = 0.01


def lens_advice(
    model: HalfTurnModel,
    starts: list[State],
    lens_model: LensModel,
    noise_known: bool,
) -> str | None:
    """Say which of the wanted coefficients the data determine.

    Forward selection: from no lens on, the coefficient that lowers chi2 most is added,
    as long as it lowers it by more than noise does in 1 of 100 data sets, and the
    result is determined.

    Args:
        model: With all wanted coefficients.
        starts: States to start from.
        lens_model: Whose coefficients they are.
        noise_known: Whether the data's whiteners are absolute.

    Returns:
        A sentence; None where not even the pinhole camera can be had.
    """
    pinhole = model.with_lens(())
    found = refine_from_starts(pinhole, starts)
    if found is None or not found[0].converged:
        return None
    best = found[0]
    chosen: tuple[int, ...] = ()
    while len(chosen) < len(model.lens):
        tried = [
            (end, lens)
            for index in model.lens
            if index not in chosen
            for lens in [tuple(sorted((*chosen, index)))]
            for end in [_fitted(model.with_lens(lens), best.state)]
            if end is not None
        ]
        if not tried:
            break
        end, lens = min(tried, key=lambda one: one[0].cost)
        noise = 1.0 if noise_known else end.cost / (model.dof + len(model.lens))
        if best.cost - end.cost <= noise * float(chdtri(1, _CHANCE)):
            break
        best, chosen = end, lens
    names = LENS_COEFFICIENTS[lens_model]
    dof = model.with_lens(chosen).dof
    fit = f"chi2 is then {best.cost:.4g} for {dof} degrees of freedom"
    if not chosen:
        return f"The data determine no coefficient of the lens: leave it out; {fit}"
    listed = ", ".join(f'"{names[index]}"' for index in chosen)
    return f"The data determine distortion=({listed},); {fit}"


def _fitted(model: HalfTurnModel, start: State) -> Minimum[State, Blocks] | None:
    """Its minimum from a start, None where that is none or not determined."""
    end = minimise(model.evaluate, model.retract, start, model.rounding)
    if end is None or not end.converged:
        return None
    _, condition = invert_information(NormalEquations.of(end.blocks).reduced())
    return end if condition <= MAX_CONDITION else None
