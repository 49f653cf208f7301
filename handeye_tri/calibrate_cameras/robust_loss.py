"""Losses that grow slower than the square, as least squares of changed residuals.

A point's whitened residual e of length d becomes e sqrt(rho(d)) / d, whose square is
the loss rho, so that the minimiser need not know of it. Limits are those at which each
loss keeps 95 % of the efficiency on normal noise in the plane.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Loss = Literal["huber", "cauchy"]

LOSSES: tuple[Loss, ...] = ("huber", "cauchy")
# Whitened distance of a point, sigmas.
_LIMITS = {"huber": 1.8, "cauchy": 3.0}


def soften(rows: Floats, loss: Loss) -> None:
    """Apply a loss to whitened rows with their residual last, in place.

    Huber (1964, doi:10.1214/aoms/1177703732): d^2 up to the limit c, then 2 c d -
    c^2. Cauchy: c^2 log(1 + d^2 / c^2).

    Args:
        rows: Shape (..., 2, q): the two coordinates of a point, derivatives and, last,
            the residual.
        loss: Which.
    """
    limit = _LIMITS[loss]
    e = rows[..., -1].copy()
    d = np.maximum(np.sqrt((e**2).sum(axis=-1)), 1e-12)
    if loss == "huber":
        root = np.where(
            d > limit, np.sqrt(2 * limit * np.maximum(d, limit) - limit**2), d
        )
        slope = np.where(d > limit, limit / root, 1.0)
    else:
        square = (d / limit) ** 2
        # log1p(x) / x goes to one where x does to zero.
        root = d * np.sqrt(np.log1p(square) / np.maximum(square, 1e-24))
        slope = d / (root * (1.0 + square))
    scale = (root / d)[..., None, None]
    unit = e / d[..., None]
    along = (unit[..., None, :] @ rows)[..., 0, :]
    rows *= scale
    radial = (slope - root / d)[..., None, None] * unit[..., :, None]
    rows += radial * along[..., None, :]
    rows[..., -1] = e * scale[..., 0]
