"""Normal equations of many independent trials, and their elimination.

Every number of a trial is in the last axis of contiguous arrays.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class Scratch:
    """Large arrays that are used again and again.

    The allocator returns arrays of this size to the system as soon as they are freed,
    and getting their pages back costs more than what is computed in them.
    """

    def __init__(self) -> None:
        self._buffers: dict[str, Floats] = {}

    def array(self, name: str, shape: tuple[int, ...]) -> Floats:
        """An array with any content, valid until the next one of this name."""
        size = prod(shape)
        if name not in self._buffers or self._buffers[name].size < size:
            self._buffers[name] = np.empty(size)
        return self._buffers[name][:size].reshape(shape)


@dataclass(frozen=True, slots=True, eq=False)
class Equations:
    """Normal equations of c trials, upper triangles.

    Attributes:
        own: J'J by rows of own unknowns, then J'r, shape (l, l + g + 1, n, c).
        shared: The same of the shared unknowns, with r'r last, (g + 1, g + 1, c).
        scratch: For intermediate results.
    """

    own: Floats
    shared: Floats
    scratch: Scratch

    @property
    def cost(self) -> Floats:
        """Sum of squared residuals of each trial, shape (c,)."""
        return np.asarray(self.shared[-1, -1])

    def take(self, rows: NDArray[np.intp] | Bools) -> Equations:
        """Some of the trials, by index or mask, shape (c,)."""
        return Equations(self.own[..., rows], self.shared[..., rows], self.scratch)

    def put(self, rows: Bools, other: Equations) -> None:
        """Overwrite some of the trials, by mask, shape (c,)."""
        np.copyto(self.own, other.own, where=rows)
        np.copyto(self.shared, other.shared, where=rows)

    def step(self, damping: Floats) -> tuple[Floats, Floats, Floats]:
        """Damped steps and their predicted gain; NaN where the equations are singular.

        Args:
            damping: Of each trial, shape (c,).

        Returns:
            Own (l, n, c), shared (g, c) and gain (c,).
        """
        size, g = len(self.own), len(self.shared) - 1
        own = self._own_copy()
        own_scale = np.stack([own[k, k].copy() for k in range(size)])
        for k in range(size):
            own[k, k] *= 1.0 + damping
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            eliminate(own, size)
            shared = self._without_own(own)
            shared_scale = np.einsum("kkc->kc", self.shared[:g, :g]).copy()
            for k in range(g):
                shared[k, k] += damping * shared_scale[k]
            eliminate(shared, g)
            d_shared = np.empty((g, shared.shape[-1]))
            for k in reversed(range(g)):
                rest = shared[k, -1] + _dot(shared[k, k + 1 : g], d_shared[k + 1 :])
                d_shared[k] = -rest / shared[k, k]
            d_own = np.empty((size, *own.shape[2:]))
            for k in reversed(range(size)):
                rest = own[k, -1] + _dot(own[k, size:-1], d_shared[:, None])
                rest += _dot(own[k, k + 1 : size], d_own[k + 1 :])
                d_own[k] = -rest / own[k, k]
            gain = damping * _dot(own_scale, d_own**2).sum(axis=0)
            gain += damping * _dot(shared_scale, d_shared**2)
            gain -= _dot(d_own, self.own[:, -1]).sum(axis=0)
            gain -= _dot(d_shared, self.shared[:-1, -1])
        return d_own, d_shared, gain

    def _own_copy(self) -> Floats:
        result = self.scratch.array("eliminated", self.own.shape)
        result[:] = self.own
        return result

    def _without_own(self, eliminated: Floats) -> Floats:
        """Equations of the shared unknowns alone, upper triangle."""
        size = len(eliminated)
        shared = self.shared.copy()
        for k in range(len(shared)):
            rows = eliminated[:, size + k :]
            shared[k, k:] -= np.einsum("inc,ijnc->jc", rows[:, 0], rows)
        return shared

    def information(self) -> Floats:
        """Information on the shared unknowns, (c, g, g); NaN where singular."""
        own = self._own_copy()
        with np.errstate(invalid="ignore", divide="ignore"):
            eliminate(own, len(own))
            upper = np.moveaxis(self._without_own(own)[:-1, :-1], -1, 0)
        return np.asarray(np.triu(upper) + np.swapaxes(np.triu(upper, 1), 1, 2))


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray((a * b).sum(axis=0))


def eliminate(rows: Floats, count: int) -> None:
    """Cholesky's elimination of the first unknowns of symmetric systems, in place.

    Args:
        rows: Upper triangles by rows, then right sides, shape (>= count, q, ...); the
            first rows become those of the factor.
        count: How many unknowns to eliminate.
    """
    for k in range(count):
        rows[k, k:] *= 1.0 / np.sqrt(rows[k, k])
        for i in range(k + 1, count):
            rows[i, i:] -= rows[k, i] * rows[k, i:]


def inverses(information: Floats) -> tuple[Floats, Floats]:
    """Inverses of information matrices (c, g, g), scaled to unit diagonal first.

    Returns:
        Inverses, NaN where singular; products of the Frobenius norms of scaled matrix
        and inverse, which bound the condition number from above.
    """
    diagonal = np.einsum("cgg->cg", information)
    sound = np.isfinite(information).all(axis=(1, 2)) & (diagonal > 0).all(axis=1)
    scale = np.where(sound[:, None], np.sqrt(np.abs(diagonal)), 1.0)
    scaled = information / (scale[:, :, None] * scale[:, None, :])
    scaled[~sound] = np.eye(scaled.shape[-1])
    # An exactly singular matrix would stop the others, too.
    sound &= np.linalg.slogdet(scaled)[0] > 0
    scaled[~sound] = np.eye(scaled.shape[-1])
    inverse = np.linalg.inv(scaled)
    condition = np.sqrt((scaled**2).sum(axis=(1, 2)) * (inverse**2).sum(axis=(1, 2)))
    inverse = 0.5 * (inverse + np.swapaxes(inverse, 1, 2))
    inverse /= scale[:, :, None] * scale[:, None, :]
    inverse[~sound], condition[~sound] = np.nan, np.inf
    return inverse, condition
