"""What one camera's calibration ends with: at the closed form, or refined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.closed_form import ClosedForm
from handeye_tri.calibrate_cameras.degeneracy import (
    check_determined,
    check_turns,
    invert_information,
    least_noise,
    plane_spread_deg,
    weaknesses,
)
from handeye_tri.calibrate_cameras.homography import Homographies
from handeye_tri.calibrate_cameras.least_squares import NormalEquations
from handeye_tri.calibrate_cameras.lens_centre import (
    CENTRE,
    average_over_centre,
    covariance_about_maximum,
)
from handeye_tri.calibrate_cameras.refine import (
    HalfTurnModel,
    State,
    refine_from_starts,
)
from handeye_tri.calibrate_cameras.starts import pinhole_state
from handeye_tri.errors import ConvergenceError, DegenerateMotionError

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A calibrated camera before it is put on record.

    Attributes:
        state: Camera, poses, feet of the axes, deviations of the half-turns.
        covariance: Of what is estimated of the camera, shape (p, p).
        chi2: Sum of squared whitened residuals.
        condition: Of the scaled information.
        cost_start: chi2 at the closed form, else at the generic start.
        start: Name of the start.
        iterations: Of the refinement.
        weaknesses: What makes the focal lengths uncertain, and the remedy.
    """

    state: State
    covariance: Floats
    chi2: float
    condition: float
    cost_start: float
    start: str
    iterations: int
    weaknesses: tuple[str, ...]


def at_closed_form(
    model: HalfTurnModel,
    zero: State,
    first: ClosedForm,
    homographies: Homographies,
    noise_known: bool,
) -> Outcome:
    """Stop at the closed form, with the poses of Sec. III-D.

    Args:
        model: Of the half-turns.
        zero: Lens and feet of the axes; camera and poses are filled in.
        first: The closed form.
        homographies: One per half-turn.
        noise_known: Whether the data's whiteners are absolute.

    Raises:
        DegenerateMotionError: a marker is behind the camera, or the focal length is
            not determined.
    """
    state = pinhole_state(model, zero, first.k, first.poses)
    blocks = model.evaluate(state)
    if blocks is None:
        raise DegenerateMotionError(
            "the closed form puts a marker behind the camera "
            f"(fx {first.k[0, 0]:.1f} px, fy {first.k[1, 1]:.1f} px): the views are "
            "too weak for it; use refine=True, or planes 20 degrees or more apart"
        )
    noise = homographies.chi2 / homographies.dof
    chosen = model.choice.basis
    covariance = chosen.T @ first.covariance @ chosen
    _, condition = invert_information(NormalEquations.of(blocks).reduced())
    sigma = _focal_sigma(model, covariance, least_noise(noise, noise_known))
    normals = state.poses[:, :3, 2]
    focal = state.intrinsics[:2]
    check_determined(
        condition,
        focal,
        sigma,
        plane_spread_deg(normals),
        model.data,
        len(model.lens),
    )
    return Outcome(
        state,
        covariance * (1.0 if noise_known else noise),
        blocks.cost,
        condition,
        blocks.cost,
        "closed form",
        0,
        weaknesses(model.data, normals, focal, sigma, condition),
    )


def refined(
    model: HalfTurnModel, starts: dict[str, State], noise_known: bool
) -> Outcome:
    """Refine by maximum likelihood (Sec. III-E) from several starts.

    With a lens the likelihood is then averaged over its centre.

    Args:
        model: Of the half-turns.
        starts: By name.
        noise_known: Whether the data's whiteners are absolute.

    Raises:
        DegenerateMotionError: the half-turns are none, or determine no camera.
        ConvergenceError: the refinement did not settle.
    """
    found = refine_from_starts(model, list(starts.values()))
    if found is None:
        raise DegenerateMotionError(
            "no start has all markers in front of the camera: before and after do not "
            "show half-turns of this triangle; check axis, triangle and marker order"
        )
    end, chosen = found
    state = end.state
    if model.lens:
        # With the lens there is no more excuse than without one.
        missed = model.data.pixels - model.predict(state)
        check_turns(model.data, np.sqrt((missed**2).mean(axis=(1, 2, 3))))
    equations = NormalEquations.of(end.blocks)
    covariance, condition = invert_information(equations.reduced())
    noise = end.cost / model.dof
    normals, focal = state.poses[:, :3, 2], state.intrinsics[:2]
    sigma = _focal_sigma(model, covariance, least_noise(noise, noise_known))
    check_determined(
        condition,
        focal,
        sigma,
        plane_spread_deg(normals),
        model.data,
        len(model.lens),
    )
    if not end.converged:
        raise ConvergenceError(
            f"the refinement did not settle in {end.iterations} iterations (chi2 "
            f"{end.cost_start:.4g} to {end.cost:.4g} for {model.dof} degrees of "
            "freedom); check the triangle's sides and the axis, add half-turns, or "
            "estimate fewer lens coefficients"
        )
    closed = starts.get("closed form")
    closed_cost = None if closed is None else model.evaluate(closed)
    scale = 1.0 if noise_known else noise
    covariance, chi2 = covariance * scale, end.cost
    if model.lens and set(CENTRE) & set(model.choice.names):
        averaged = average_over_centre(model, end, scale)
        if averaged is not None:
            state, chi2, covariance = averaged.state, averaged.cost, averaged.covariance
    elif model.lens:
        about = covariance_about_maximum(model, end, scale)
        covariance = covariance if about is None else about
    count = model.camera_unknowns
    return Outcome(
        state,
        covariance[:count, :count],
        chi2,
        condition,
        end.cost_start if closed_cost is None else closed_cost.cost,
        list(starts)[chosen],
        end.iterations,
        weaknesses(model.data, normals, focal, sigma, condition),
    )


def _focal_sigma(model: HalfTurnModel, covariance: Floats, noise: float) -> Floats:
    """Standard deviations of fx and fy, 0 where known, shape (2,), pixels."""
    by_free = model.choice.basis[:2]
    of_free = covariance[: by_free.shape[1], : by_free.shape[1]]
    if not np.isfinite(of_free).all():
        return np.full(2, np.inf)
    variance = np.einsum("ik,kl,il->i", by_free, of_free, by_free)
    return np.asarray(np.sqrt(noise * variance))
