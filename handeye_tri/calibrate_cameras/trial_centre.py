"""The average over a lens's centre of :mod:`lens_centre`, for many trials at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.lens_centre import (
    CENTRE,
    ROUNDING,
    TOLERANCE,
    centre_quadrature,
    mean_and_covariance,
)
from handeye_tri.calibrate_cameras.trial_equations import inverses
from handeye_tri.calibrate_cameras.trial_minimise import minimise_trials
from handeye_tri.calibrate_cameras.trial_model import TrialModel, TrialState
from handeye_tri.camera import INTRINSIC_NAMES

Floats = NDArray[np.float64]

_CENTRE = tuple(INTRINSIC_NAMES.index(name) for name in CENTRE)


def average_trials_over_centre(
    model: TrialModel,
    state: TrialState,
    cost: Floats,
    covariance: Floats,
    noise: Floats,
) -> tuple[TrialState, Floats, Floats]:
    """Mean and covariance of each trial's likelihood about its maximum.

    Args:
        model: The trials.
        state: The maxima.
        cost: There, shape (c,), px^2.
        covariance: Of the k estimated intrinsics and lens coefficients by the linear
            problem, shape (c, k, k).
        noise: Variance of each pixel coordinate, shape (c,), px^2.

    Returns:
        State with the camera at its mean, cost there, and covariance; what was given
        where rounding hides the likelihood's shape or the mean cannot be evaluated.
    """
    rounding = np.finfo(float).eps * np.abs(model.pixels).max(initial=0.0)
    rows = np.flatnonzero(noise > ROUNDING * rounding**2)
    if not len(rows):
        return state, cost, covariance
    part, start, spread = model.take(rows), state.take(rows), noise[rows]
    step, second = _moments(part, start, cost[rows], covariance[rows], spread)
    mean = replace(start, intrinsics=start.intrinsics.copy(), lens=start.lens.copy())
    inner = len(model.intrinsics)
    mean.intrinsics[list(model.intrinsics)] += step[:, :inner].T
    mean.lens[list(model.lens)] += step[:, inner:].T
    known = replace(part, intrinsics=(), lens=())
    freedom, floor = cost[rows] / spread, np.zeros(len(rows))
    best = minimise_trials(known, mean, freedom, floor)
    rows, good = rows[best.converged], best.converged
    state = state.take(np.arange(len(cost)))
    state.put(rows, best.state.take(good))
    cost, covariance = cost.copy(), covariance.copy()
    cost[rows], covariance[rows] = best.cost[good], second[good]
    return state, cost, covariance


def _moments(
    model: TrialModel,
    state: TrialState,
    cost: Floats,
    covariance: Floats,
    noise: Floats,
) -> tuple[Floats, Floats]:
    """Mean less maximum, (c, k), and covariance, (c, k, k), of camera and lens."""

    def estimated(of: TrialState) -> Floats:
        """What is estimated of the camera, shape (..., k)."""
        inner, lens = list(model.intrinsics), list(model.lens)
        return np.concatenate([of.intrinsics[inner], of.lens[lens]]).T

    c, k = covariance.shape[:2]
    centre = [model.intrinsics.index(i) for i in _CENTRE]
    rest = [i for i in range(k) if i not in centre]
    units, gauss = centre_quadrature(len(centre))
    q = len(units)
    repeat = np.repeat(np.arange(c), q)
    start = state.take(repeat)
    root = np.linalg.cholesky(covariance[:, centre][:, :, centre])
    # The others follow in the first step.
    start.intrinsics[list(_CENTRE)] += np.einsum("cij,qj->icq", root, units).reshape(
        2, -1
    )
    part = replace(
        model.take(repeat),
        intrinsics=tuple(i for i in model.intrinsics if i not in _CENTRE),
    )
    freedom = (cost / noise)[repeat]
    found = minimise_trials(part, start, freedom, np.zeros(c * q), TOLERANCE)
    given, _ = inverses(found.equations.information() / noise[repeat, None, None])
    counts = found.converged & np.isfinite(given).all(axis=(1, 2))
    given[~counts] = np.eye(given.shape[-1])
    likely = np.linalg.slogdet(given)[1] - (found.cost - cost[repeat]) / noise[repeat]
    likely = likely.reshape(c, q) + (units**2).sum(axis=-1)
    logarithms = np.where(counts.reshape(c, q), 0.5 * likely, -np.inf)
    about = np.zeros((c * q, k, k))
    place = part.places[: len(rest)]
    about[:, np.array(rest)[:, None], rest] = given[:, place][:, :, place]
    steps = estimated(found.state) - estimated(state)[repeat]
    steps[~counts] = 0.0
    return mean_and_covariance(
        steps.reshape(c, q, k), about.reshape(c, q, k, k), gauss, logarithms
    )
