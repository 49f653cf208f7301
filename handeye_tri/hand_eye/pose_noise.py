"""How large the noise of poses is, estimated from what AX = ZB leaves.

Five variances: the flange's position and orientation, the target's place across the
line of sight, along it, and its orientation. They differ in how they enter the
residuals: an orientation error at a distance moves the position, a depth error points
at the camera. Restricted maximum likelihood by Fisher scoring on their logarithms
(Harville 1977, doi:10.1080/01621459.1977.10480998); a weak prior that they are of the
size of the pooled residuals decides what few poses cannot.
"""

from __future__ import annotations

from math import lgamma

import numpy as np
from numpy.typing import NDArray

from handeye_tri.se3 import se3_adjoint, se3_inverse

Floats = NDArray[np.float64]

COMPONENTS = 5
# Of the logarithm of a variance: a factor 2 on a standard deviation.
_PRIOR_STD = 1.5
# Steps of a logarithm of a variance are cut to this.
_LARGEST_STEP = 1.5
# Degrees of freedom of the residuals' distribution that are compared; few poses
# cannot tell them apart.
TAILS = (3.0, 4.0, 6.0, 10.0, 20.0, np.inf)
_LEAST_FOR_TAILS = 8
# Variances of exact data, in squares of scene lengths and radians: rounding.
LEAST_LOG_VARIANCE = float(np.log(1e-24))


def noise_shapes(camera_from_target: Floats, x: Floats, *, eye_in_hand: bool) -> Floats:
    """What unit variances of the five components make of the residuals' covariance.

    The residual is ``log((A X)^-1 Z B)``, as in
    :func:`handeye_tri.hand_eye.refine.residuals_axzb`. Errors of the observed pose:
    the target's origin moves in the camera frame, the target turns about itself. As a
    right tangent of camera_from_target = (R, t) these are R'dt and dw; on its inverse
    the tangent is carried over by the adjoint.

    Args:
        camera_from_target: Shape (n, 4, 4).
        x: Shape (4, 4).
        eye_in_hand: Whether B is target_from_camera, else camera_from_target.

    Returns:
        Shape (5, n, 6, 6): robot translation, robot rotation, lateral, depth, rotation.
    """
    n = len(camera_from_target)
    rotation, place = camera_from_target[:, :3, :3], camera_from_target[:, :3, 3]
    distance = np.linalg.norm(place, axis=1, keepdims=True)
    ray = np.where(distance > 1e-9, place, (0.0, 0.0, 1.0))
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    seen = ray if eye_in_hand else np.einsum("nba,nb->na", rotation, ray)
    along = seen[:, :, None] * seen[:, None, :]
    shapes = np.zeros((COMPONENTS, n, 6, 6))
    adjoint = se3_adjoint(se3_inverse(x))
    for k, columns in enumerate((adjoint[:, :3], adjoint[:, 3:])):
        shapes[k] = columns @ columns.T
    shapes[2, :, :3, :3] = np.eye(3) - along
    shapes[3, :, :3, :3] = along
    if eye_in_hand:
        columns = se3_adjoint(camera_from_target)[:, :, 3:]
        shapes[4] = columns @ np.swapaxes(columns, 1, 2)
    else:
        shapes[4, :, 3:, 3:] = np.eye(3)
    return shapes


def pooled_start(residuals: Floats, unknowns: int) -> Floats:
    """Logarithms of the five variances from the residuals' two sizes.

    Args:
        residuals: Shape (n, 6).
        unknowns: How many numbers were fitted.
    """
    n = len(residuals)
    left = max(6 * n - unknowns, 1) / (6 * n)
    squares = (residuals**2).mean(axis=0).reshape(2, 3).mean(axis=1) / left
    translation, rotation = np.maximum(np.log(squares / 2 + 1e-300), LEAST_LOG_VARIANCE)
    return np.array([translation, rotation, translation, translation, rotation])


def score_step(
    log_variances: Floats,
    centre: Floats,
    shapes: Floats,
    inverse: Floats,
    squares: Floats,
) -> Floats:
    """One step of Fisher scoring, shape (k,).

    Args:
        log_variances: Where we are, shape (k,).
        centre: Of the prior, shape (k,).
        shapes: Shape (k, n, 6, 6), see :func:`noise_shapes`.
        inverse: Of the residuals' covariance, shape (n, 6, 6).
        squares: Weighted outer products of the residuals plus the covariance that
            the fit took from them (what makes the likelihood restricted), (n, 6, 6).
    """
    variances = np.exp(log_variances)
    scaled = variances[:, None, None, None] * shapes
    both = inverse @ scaled @ inverse
    covariance = scaled.sum(axis=0)
    gradient = 0.5 * np.einsum("knij,nij->k", both, squares - covariance)
    fisher = 0.5 * np.einsum("knij,lnij->kl", both, scaled)
    prior = 1 / _PRIOR_STD**2
    step = np.linalg.solve(
        fisher + prior * np.eye(len(shapes)),
        gradient - prior * (log_variances - centre),
    )
    return np.asarray(step * min(1.0, _LARGEST_STEP / max(np.abs(step).max(), 1e-300)))


def best_tail(distances: Floats, current: float) -> float:
    """Degrees of freedom of Student's distribution that fit best.

    Args:
        distances: Squared whitened residuals of six numbers each, shape (n,), with
            the scale found under ``current``.
        current: The degrees of freedom that scale belongs to.
    """
    if len(distances) < _LEAST_FOR_TAILS:
        return np.inf
    found = []
    for tail in TAILS:
        # A scale matrix fitted under one tail is larger or smaller under another; the
        # best factor follows from its own weights.
        factor = 1.0
        for _ in range(8):
            weights = tail_weights(distances / factor, tail)
            factor = max(float((weights * distances).mean()) / 6, 1e-300)
        found.append(_log_likelihood(distances / factor, tail) - 3 * np.log(factor))
    best = int(np.argmax(found))
    now = TAILS.index(current)
    return TAILS[best] if found[best] > found[now] + 1e-3 else current


def tail_weights(distances: Floats, tail: float) -> Floats:
    """Weights of Student's distribution, shape (n,); 1 for the normal one.

    Args:
        distances: Squared whitened residuals of six numbers each, shape (n,).
        tail: Degrees of freedom.
    """
    if np.isinf(tail):
        return np.ones(len(distances))
    return np.asarray((tail + 6) / (tail + distances))


def _log_likelihood(distances: Floats, tail: float) -> float:
    """Mean log density of six-dimensional Student's distribution, scale 1."""
    if np.isinf(tail):
        return float(-0.5 * distances.mean() - 3 * np.log(2 * np.pi))
    return float(
        lgamma((tail + 6) / 2)
        - lgamma(tail / 2)
        - 3 * np.log(tail * np.pi)
        - (tail + 6) / 2 * np.log1p(distances / tail).mean()
    )
