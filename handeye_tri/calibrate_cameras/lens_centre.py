"""A lens about an uncertain centre: average over the centre instead of one maximum.

Distortion is about the principal point. As that moves, lens and poses follow on a
curve, which the covariance of the linearised problem takes for a straight line: it is
then too small along its short axes, and the maximum of the likelihood is off the
middle of what is likely. With the principal point given, the problem is nearly
linear. So the likelihood is integrated: over the principal point by Gauss-Hermite
quadrature; given that point, over the other intrinsics, lens and O by Laplace's
approximation, with the poses at their most likely (nested Laplace: Rue, Martino and
Chopin 2009, doi:10.1111/j.1467-9868.2008.00700.x). Mean and second moments of that
are the estimate and its covariance. Where the centre is well known both are the linear
ones.

With the centre given, what remains curved is the trade of focal length against the
highest radial coefficient. The mean would follow it away from the maximum and err more;
so the maximum stays the estimate, and the covariance is the second moments about it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.degeneracy import invert_information
from handeye_tri.calibrate_cameras.least_squares import (
    Blocks,
    Minimum,
    NormalEquations,
    minimise,
)
from handeye_tri.calibrate_cameras.refine import HalfTurnModel, State
from handeye_tri.camera import LENS_COEFFICIENTS

Floats = NDArray[np.float64]

# What the lens is centred at.
CENTRE = ("cx", "cy")
# Of the quadrature along each of cx and cy. Three are too few; more change NEES by a
# few hundredths at most where the noise is large (1 px, four coefficients).
_NODES = 5
# Predicted gain over chi2 / dof of a node's last step: far below the 1 that counts.
TOLERANCE = 1e-6
# Noise over the square of the rounding below which the likelihood has no shape.
ROUNDING = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Averaged:
    """What is left when the likelihood has been integrated over the lens's centre.

    Attributes:
        state: The camera at its mean, all else at its most likely given that.
        cost: Sum of squared residuals there.
        covariance: Of the shared unknowns, shape (g, g).
    """

    state: State
    cost: float
    covariance: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Moments:
    """Mean less the maximum, shape (g,), and covariance about the mean, (g, g)."""

    mean: Floats
    covariance: Floats


def average_over_centre(
    model: HalfTurnModel, end: Minimum[State, Blocks], noise: float
) -> Averaged | None:
    """Mean and covariance of the likelihood about its maximum.

    Args:
        model: Of the half-turns, with a lens.
        end: The maximum of the likelihood.
        noise: What chi2 is divided by: 1 for stated sigmas, else chi2 / dof.

    Returns:
        None where the principal point is known, where rounding hides the likelihood's
        shape, or where the mean puts a marker behind the camera.
    """
    centre = [k for k, name in enumerate(model.choice.names) if name in CENTRE]
    if not centre or noise <= ROUNDING * model.rounding**2:
        return None
    found = _moments(model, model.with_known(CENTRE), centre, end, noise)
    equations = NormalEquations.of(end.blocks)
    start = _moved(model, end.state, equations, found.mean)
    known = model.with_known(model.choice.names).with_lens(())
    best = minimise(known.evaluate, known.retract, start, model.rounding)
    if best is None:
        return None
    return Averaged(best.state, best.cost, found.covariance)


def covariance_about_maximum(
    model: HalfTurnModel, end: Minimum[State, Blocks], noise: float
) -> Floats | None:
    """Second moments of the likelihood about its maximum, the centre being given.

    Args:
        model: Of the half-turns, with a lens and a known principal point.
        end: The maximum of the likelihood.
        noise: What chi2 is divided by: 1 for stated sigmas, else chi2 / dof.

    Returns:
        Of the shared unknowns, shape (g, g); None where rounding hides the
        likelihood's shape.
    """
    if noise <= ROUNDING * model.rounding**2:
        return None
    size = len(end.state.lens)
    names = next(one for one in LENS_COEFFICIENTS.values() if len(one) == size)
    radial = [i for i in model.lens if names[i].startswith("k")]
    if not radial:
        return None
    rest = tuple(i for i in model.lens if i != radial[-1])
    place = len(model.choice.names) + model.lens.index(radial[-1])
    found = _moments(model, model.with_lens(rest), [place], end, noise)
    return found.covariance + np.outer(found.mean, found.mean)


def _moments(
    model: HalfTurnModel,
    part: HalfTurnModel,
    outer: list[int],
    end: Minimum[State, Blocks],
    noise: float,
) -> _Moments:
    """Moments of the likelihood, by quadrature over some shared unknowns.

    Args:
        model: Of the half-turns.
        part: The same with those unknowns known.
        outer: Their places among the shared unknowns.
        end: The maximum of the likelihood.
        noise: What chi2 is divided by.
    """
    equations = NormalEquations.of(end.blocks)
    linear = noise * invert_information(equations.reduced())[0]
    of_outer = linear[np.ix_(outer, outer)]
    root = np.linalg.cholesky(of_outer)
    # How the others follow a standard normal of those.
    follow: Floats = linear[:, outer] @ np.linalg.inv(root).T
    rest = [k for k in range(len(linear)) if k not in outer]
    units, gauss = centre_quadrature(len(outer))
    steps = np.zeros((len(units), len(linear)))
    covariances = np.zeros((len(units), *linear.shape))
    logarithms = np.full(len(units), -np.inf)
    for node, unit in enumerate(units):
        start = _moved(model, end.state, equations, follow @ unit)
        found = minimise(
            part.evaluate, part.retract, start, model.rounding, tolerance=TOLERANCE
        )
        if found is None or not found.converged:
            continue
        given, _ = invert_information(NormalEquations.of(found.blocks).reduced())
        covariances[node][np.ix_(rest, rest)] = noise * given
        steps[node] = _shared(model, found.state) - _shared(model, end.state)
        # The nodes are those of the linear problem: weigh by what is likely instead.
        likely = unit @ unit - (found.cost - end.cost) / noise
        logarithms[node] = 0.5 * (likely + np.linalg.slogdet(given)[1])
    mean, covariance = mean_and_covariance(steps, covariances, gauss, logarithms)
    return _Moments(mean, covariance)


def centre_quadrature(dimensions: int) -> tuple[Floats, Floats]:
    """Gauss-Hermite nodes (q, d) and weights (q,) for as many standard normals."""
    line, weight = np.polynomial.hermite_e.hermegauss(_NODES)
    weight = weight / weight.sum()
    places = np.array(list(product(range(_NODES), repeat=dimensions)))
    return np.asarray(line[places]), np.asarray(weight[places].prod(axis=-1))


def mean_and_covariance(
    steps: Floats, covariances: Floats, gauss: Floats, logarithms: Floats
) -> tuple[Floats, Floats]:
    """First two moments of a mixture over the nodes.

    Args:
        steps: Mean at each node, shape (..., q, g).
        covariances: About that, shape (..., q, g, g).
        gauss: Weights of the quadrature, shape (q,).
        logarithms: Of what is integrated over the normal density, (..., q); minus
            infinity for a node that does not count.

    Returns:
        Mean (..., g) and covariance (..., g, g).
    """
    highest = logarithms.max(axis=-1, keepdims=True)
    weights = gauss * np.exp(logarithms - highest)
    weights /= weights.sum(axis=-1, keepdims=True)
    mean: Floats = np.einsum("...q,...qi->...i", weights, steps)
    around = steps - mean[..., None, :]
    covariance = np.einsum("...q,...qij->...ij", weights, covariances)
    covariance += np.einsum("...q,...qi,...qj->...ij", weights, around, around)
    return mean, covariance


def _moved(
    model: HalfTurnModel, state: State, equations: NormalEquations, shared: Floats
) -> State:
    """A state after a step of the shared unknowns that the own ones follow."""
    right = (equations.cross @ shared)[..., None]
    own = np.asarray(-np.linalg.solve(equations.own, right)[..., 0], dtype=float)
    return model.retract(state, own, shared)


def _shared(model: HalfTurnModel, state: State) -> Floats:
    """The shared unknowns, shape (g,)."""
    inner = np.linalg.pinv(model.choice.basis) @ state.intrinsics
    lens = state.lens[list(model.lens)]
    return np.concatenate([inner, lens, state.o[0] if model.shared_o else ()])
