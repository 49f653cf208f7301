"""What the joint adjustment is given, and one value of what it looks for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.triangle import EDGES

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """One value of all unknowns.

    Attributes:
        intrinsics: fx, fy, skew, cx, cy of each camera, shape (m, 5), pixels.
        lenses: Lens coefficients of each camera, (5,) or (8,).
        base_from_camera: Shape (m, 4, 4), metres.
        markers: A, B, C in the flange frame on each of k mounts, (k, 3, 3), metres.
        robot: Systematic errors of the robot, shape (p,).
        missed: u of each block's stations, shape (b, w l).
    """

    intrinsics: Floats
    lenses: tuple[Floats, ...]
    base_from_camera: Floats
    markers: Floats
    robot: Floats
    missed: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Sides:
    """What is known of the triangle's sides AB, BC, CA before.

    Attributes:
        lengths: Shape (3,), metres.
        sigma: Of each; 0 for exact sides, infinite for unknown ones, metres.
    """

    lengths: Floats
    sigma: float

    @property
    def exact(self) -> bool:
        """Whether the markers can only move together."""
        return self.sigma == 0.0

    @property
    def count(self) -> int:
        """How many residuals they make."""
        return 3 if 0.0 < self.sigma < np.inf else 0

    def residuals(self, markers: Floats) -> tuple[Floats, Floats]:
        """Whitened residuals (3,) and derivatives by the markers (3, 9)."""
        found, slope = np.empty(3), np.zeros((3, 3, 3))
        for row, (start, end) in enumerate(EDGES.values()):
            side = markers[end] - markers[start]
            length = np.linalg.norm(side)
            found[row] = length
            slope[row, end], slope[row, start] = side / length, -side / length
        return (found - self.lengths) / self.sigma, slope.reshape(3, 9) / self.sigma


@dataclass(frozen=True, slots=True, eq=False)
class Stations:
    """What was measured, in blocks of w stations.

    Attributes:
        pixels: Shape (m, b, w, 3, 2); 0 where unseen.
        whitener: W with W'W the inverse covariance, (m, b, w, 3, 2, 2); 0 where unseen.
        reported: base_from_flange as reported, (b, w, 4, 4), metres; the identity
            where a block has no second station.
        index: Station of the session, shape (b, w); -1 for none.
        mounts: Which of the k mounts each block has, shape (b,), ascending.
        on_axis: Which markers a block's two stations see at the same place, since
            they lie on the axis of the half-turn, (b, 3); None for blocks of one.
        correlation: Of the detection errors of such a marker at the two.
        bending: By how much a lens moves the centre of a sphere's outline beyond what
            it moves the centre itself, (m, b, w, 3, 2), pixels; None for no lens.
    """

    pixels: Floats
    whitener: Floats
    reported: Floats
    index: NDArray[np.intp]
    mounts: NDArray[np.intp]
    on_axis: Bools | None = None
    correlation: float = 0.0
    bending: Floats | None = None

    def decorrelated(self, rows: Floats, chunk: slice, seen: Bools) -> Floats:
        """Whiten rows of a marker that both stations see at the same place.

        Args:
            rows: Each already whitened alone, shape (c, w, 3, 2, q).
            chunk: The c blocks.
            seen: What one camera sees of them, shape (c, w, 3).
        """
        if self.on_axis is None or self.correlation == 0.0:
            return rows
        twice = seen[:, 0] & seen[:, 1] & self.on_axis[chunk]
        # Inverse symmetric square root of [[1, c], [c, 1]].
        total = 1.0 / np.sqrt(1.0 + self.correlation)
        difference = 1.0 / np.sqrt(1.0 - self.correlation)
        same, other = 0.5 * (total + difference), 0.5 * (total - difference)
        mixing = np.where(
            twice[..., None, None], [[same, other], [other, same]], np.eye(2)
        )
        return np.asarray(np.einsum("bkuv,bvkpq->bukpq", mixing, rows))
