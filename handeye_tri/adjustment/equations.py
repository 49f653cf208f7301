"""Normal equations of very many stations, eliminated in chunks.

What a station shares with all others is 6 x g numbers, most of what is stored; a step
makes no second copy of them, so that memory and time grow in proportion to the
stations (Schur complement; Triggs et al. 1999, doi:10.1007/3-540-44480-7_21).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.least_squares import NormalEquations

Floats = NDArray[np.float64]

# Blocks at a time: the temporaries of a chunk stay in a core's cache.
CHUNK = 512


def chunks(stop: int, start: int = 0) -> Iterator[slice]:
    """Slices that cover ``range(start, stop)``."""
    for first in range(start, stop, CHUNK):
        yield slice(first, min(first + CHUNK, stop))


@dataclass(frozen=True, slots=True, eq=False)
class ChunkedEquations(NormalEquations):
    """The same equations as its base; own blocks must be positive definite."""

    def step(self, damping: float) -> tuple[Floats, Floats, float]:
        """Damped step of own (n, l) and shared (g,) unknowns; its predicted gain.

        Raises:
            numpy.linalg.LinAlgError: the damped equations are singular.
        """
        g = len(self.shared_gradient)
        eliminated = self._eliminated(damping)
        diagonal = np.diagonal(self.shared)
        matrix = self.shared + damping * np.diag(diagonal) - eliminated[:g, :g]
        scale = 1.0 / np.sqrt(diagonal)
        d_shared = -scale * np.linalg.solve(
            matrix * np.outer(scale, scale),
            scale * (self.shared_gradient - eliminated[:g, g]),
        )
        d_own = np.empty_like(self.own_gradient)
        damped = 0.0
        for chunk in chunks(len(self.own)):
            own = self._damped(chunk, damping)
            right = self.own_gradient[chunk] + self.cross[chunk] @ d_shared
            d_own[chunk] = -np.linalg.solve(own, right[..., None])[..., 0]
            damped += float(np.einsum("nii,ni,ni->", own, d_own[chunk], d_own[chunk]))
        gain = (
            damping / (1.0 + damping) * damped
            + damping * float(diagonal @ d_shared**2)
            - float(np.vdot(d_own, self.own_gradient))
            - float(d_shared @ self.shared_gradient)
        )
        return d_own, d_shared, gain

    def reduced(self) -> Floats:
        """Information on the shared unknowns alone, shape (g, g)."""
        g = len(self.shared_gradient)
        return np.asarray(self.shared - self._eliminated(0.0)[:g, :g])

    def log_determinant(self) -> float:
        """Sum over the own blocks, undamped."""
        total = 0.0
        for chunk in chunks(len(self.own)):
            total += float(np.linalg.slogdet(self.own[chunk])[1].sum())
        return total

    def _damped(self, chunk: slice, damping: float) -> Floats:
        own = self.own[chunk].copy()
        np.einsum("nii->ni", own)[:] *= 1.0 + damping
        return own

    def _eliminated(self, damping: float) -> Floats:
        """What eliminating the own unknowns takes off, gradient last, (g+1, g+1)."""
        size, g = self.cross.shape[1:]
        total = np.zeros((g + 1, g + 1))
        for chunk in chunks(len(self.own)):
            own = self._damped(chunk, damping)
            root = np.linalg.inv(np.linalg.cholesky(own))
            whole = np.empty((len(own), size, g + 1))
            np.matmul(root, self.cross[chunk], out=whole[..., :g])
            np.matmul(root, self.own_gradient[chunk, :, None], out=whole[..., g:])
            flat = whole.reshape(-1, g + 1)
            total += flat.T @ flat
        return total
