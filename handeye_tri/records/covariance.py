"""Covariances whose rows have names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from handeye_tri.errors import InputError
from handeye_tri.records.arrays import Floats, locked
from handeye_tri.triangle import VERTICES


@dataclass(frozen=True, slots=True, eq=False)
class Covariance:
    """A covariance matrix whose rows have names.

    Attributes:
        labels: Camera and quantity, such as "left.fx" or "base_from_left.x".
        matrix: Shape (p, p); units of the labelled quantities (px, m, rad).
    """

    labels: tuple[str, ...]
    matrix: Floats

    def __post_init__(self) -> None:
        """Lock; raise InputError unless labels fit and the matrix is a covariance."""
        n = len(self.labels)
        matrix = locked("covariance matrix", self.matrix, (n, n))
        object.__setattr__(self, "labels", tuple(self.labels))
        object.__setattr__(self, "matrix", matrix)
        if len(set(self.labels)) != n:
            raise InputError("covariance labels must differ from each other")
        variance = np.diagonal(matrix)
        if (variance < 0).any():
            worst = int(np.argmin(variance))
            raise InputError(
                f"the variance of {self.labels[worst]!r} is negative: "
                f"{variance[worst]:g}"
            )
        scale = np.sqrt(np.outer(variance, variance))
        if (np.abs(matrix - matrix.T) > 1e-6 * scale).any():
            raise InputError("a covariance matrix must be symmetric")

    def _index(self, label: str) -> int:
        try:
            return self.labels.index(label)
        except ValueError:
            raise InputError(
                f"no quantity {label!r} in this covariance; it has "
                f"{', '.join(self.labels)}"
            ) from None

    def std(self, label: str) -> float:
        """Standard deviation of one quantity, in its unit."""
        i = self._index(label)
        return float(np.sqrt(self.matrix[i, i]))

    def block(self, labels: Sequence[str]) -> Floats:
        """Covariance of some quantities in the order asked, shape (q, q)."""
        rows = [self._index(label) for label in labels]
        return np.array(self.matrix[np.ix_(rows, rows)])

    def correlation(self) -> Floats:
        """Correlation matrix, shape (p, p); 0 beside a quantity without spread."""
        std = np.sqrt(np.diagonal(self.matrix))
        scale = np.where(std > 0, std, np.inf)
        result: Floats = self.matrix / np.outer(scale, scale)
        np.fill_diagonal(result, 1.0)
        return result


MOTION_QUANTITIES = ("x", "y", "z", "rx", "ry", "rz")


def motion_labels(name: str) -> tuple[str, ...]:
    """Labels of a motion's tangent, in order: x y z (m), rx ry rz (rad).

    The tangent is on the right: ``true = estimate @ SE3.exp(tangent)``.
    """
    return tuple(f"{name}.{quantity}" for quantity in MOTION_QUANTITIES)


def _suffix(mount: int) -> str:
    """What names a mount; the first, mostly the only one, goes without."""
    return f"_{mount + 1}" if mount else ""


def triangle_name(mount: int = 0) -> str:
    """Name of the motion that says how a mount, from 0, holds the triangle."""
    return f"flange_from_triangle{_suffix(mount)}"


def marker_labels(mount: int = 0) -> tuple[str, ...]:
    """Labels of A, B, C in the flange frame, metres, on a mount, from 0.

    The error is estimate less truth.
    """
    return tuple(
        f"marker_{k}{_suffix(mount)}.{axis}" for k in VERTICES for axis in "xyz"
    )


MARKER_LABELS = marker_labels()
