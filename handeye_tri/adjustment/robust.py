"""Robust losses on the length of each point's whitened residual."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import InputError

Floats = NDArray[np.float64]
LossName = Literal["huber", "cauchy"]


@dataclass(frozen=True, slots=True)
class Loss:
    """What replaces the square of a residual of length e (in sigmas).

    "huber": e^2 up to the threshold c, then 2 c e - c^2 (Huber 1964,
    doi:10.1214/aoms/1177703732). "cauchy": c^2 log(1 + e^2 / c^2), which leaves gross
    errors without influence but has local minima: start well.

    Attributes:
        name: Which of them.
        threshold: c, in sigmas of a point.
    """

    name: LossName
    threshold: float

    def __post_init__(self) -> None:
        """Raise InputError where the name is unknown or the threshold not positive."""
        if self.name not in get_args(LossName):
            raise InputError(
                f"loss must be one of {', '.join(get_args(LossName))}, "
                f"got {self.name!r}"
            )
        if not (np.isfinite(self.threshold) and self.threshold > 0):
            raise InputError(
                f"a loss needs a positive threshold in sigmas, got {self.threshold}"
            )

    def weigh(self, square: Floats) -> tuple[float, Floats]:
        """Total loss, and the factors on the rows: roots of the loss's slope.

        Args:
            square: Squared lengths, any shape.
        """
        limit = self.threshold
        if self.name == "huber":
            length = np.sqrt(square)
            far = length > limit
            weight = np.where(far, np.sqrt(limit / np.where(far, length, 1.0)), 1.0)
            cost = np.where(far, limit * (2 * length - limit), square)
        else:
            scaled = square / limit**2
            weight = 1.0 / np.sqrt(1.0 + scaled)
            cost = limit**2 * np.log1p(scaled)
        return float(cost.sum()), weight


def apply_loss(rows: Floats, loss: Loss | None) -> float:
    """Cost of whitened rows (..., 2, q), the residual last; reweighs them in place."""
    residual = rows[..., -1]
    if loss is None:
        return float((residual * residual).sum())
    cost, weight = loss.weigh(np.einsum("...i,...i->...", residual, residual))
    rows *= weight[..., None, None]
    return cost
