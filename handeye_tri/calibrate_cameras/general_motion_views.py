"""What the starts of several cameras read: images of one scale, and who sees what."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.homography import ImageScale
from handeye_tri.calibrate_cameras.projective import MIN_COMMON, fundamental
from handeye_tri.errors import DegenerateMotionError
from handeye_tri.triangle import TriangleRig

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Views that a start is computed from; the adjustment takes all.
_START_VIEWS = 80
# Sides that a start needs: nine unknowns of the frame, and some to spare.
LEAST_SIDES = 12
# Pairs of cameras that are listed at most.
_LISTED_PAIRS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Images in coordinates of about unit size, with what starts need of them.

    Attributes:
        images: Shape (m, n, 3, 2), NaN where unseen; each camera's middle at 0.
        scale: Pixels per unit, the same for all cameras.
        few: Indices of at most _START_VIEWS views, those that most cameras see.
        triangle: The rig.
        centres: Middles of the images, shape (m, 2), pixels.
    """

    images: Floats
    scale: float
    few: NDArray[np.intp]
    triangle: TriangleRig
    centres: Floats

    @classmethod
    def of(
        cls, observed: Floats, sizes: list[tuple[int, int]], triangle: TriangleRig
    ) -> Views:
        """Read pixels (m, n, 3, 2) of images of these sizes (width, height)."""
        scales = [ImageScale.of(size) for size in sizes]
        scale = max(one.scale for one in scales)
        centres = np.array([one.centre for one in scales])
        images = (observed - centres[:, None, None]) / scale
        count = np.isfinite(images).all(axis=-1).sum(axis=(0, 2))
        order = np.argsort(-count, kind="stable")
        n = len(order)
        rank = count[order]
        if n > _START_VIEWS:
            # Evenly among those that are seen as well as the last that is needed.
            enough = order[: int((rank >= rank[_START_VIEWS - 1]).sum())]
            order = enough[np.linspace(0, len(enough) - 1, _START_VIEWS).astype(int)]
        return cls(images, scale, np.sort(order), triangle, centres)

    def edges(self, seen: Bools) -> tuple[NDArray[np.intp], Floats]:
        """Sides of which both ends are seen, among markers (v, 3) in that order.

        Returns:
            Indices of the ends among the markers that are seen, (e, 2); lengths, m.
        """
        points = self.triangle.points
        index = np.cumsum(seen).reshape(seen.shape) - 1
        both: Bools = np.asarray(seen & np.roll(seen, -1, axis=1))
        sides = np.linalg.norm(points - np.roll(points, -1, axis=0), axis=1)
        ends = np.stack([index, np.roll(index, -1, axis=1)], axis=-1)
        return ends[both], np.broadcast_to(sides, both.shape)[both]

    def common(self, i: int, j: int) -> Bools:
        """Which markers both cameras see, shape (n, 3)."""
        both = np.isfinite(self.images[[i, j]]).all(axis=(0, -1))
        return np.asarray(both)

    def pair_views(self, i: int, j: int) -> NDArray[np.intp]:
        """At most _START_VIEWS views of which both see most."""
        count = self.common(i, j).sum(axis=1)
        seen: NDArray[np.intp] = np.flatnonzero(count)
        if len(seen) <= _START_VIEWS:
            return seen
        full = np.flatnonzero(count == 3)
        pool = full if len(full) >= _START_VIEWS else seen
        return np.asarray(pool[np.linspace(0, len(pool) - 1, _START_VIEWS).astype(int)])

    def ranked_pairs(self) -> list[tuple[int, int]]:
        """Pairs of cameras, those that see most sides together first.

        Equal ones in an order that does not repeat a camera more than it must.
        """
        seen: Bools = np.asarray(np.isfinite(self.images).all(axis=-1))
        both = seen & np.roll(seen, -1, axis=2)
        points, sides = (
            flat @ flat.T
            for flat in (a.reshape(len(a), -1).astype(float) for a in (seen, both))
        )
        table = points + sides
        pairs = [
            (i, j)
            for i, j in combinations(range(len(self.images)), 2)
            if points[i, j] >= MIN_COMMON and sides[i, j] >= LEAST_SIDES
        ]
        pairs.sort(key=lambda pair: -table[pair])
        chosen: list[tuple[int, int]] = []
        used = np.zeros(len(self.images))
        while pairs and len(chosen) < _LISTED_PAIRS:
            most = table[pairs[0]]
            alike = [pair for pair in pairs if table[pair] >= 0.9 * most]
            pick = min(alike, key=lambda pair: used[list(pair)].sum())
            used[list(pick)] += 1
            chosen.append(pick)
            pairs.remove(pick)
        return chosen


def epipolar_noise(views: Views, typical: float) -> tuple[float, int]:
    """Noise of one coordinate that pairs show, over ``typical``, and its freedom."""
    square, freedom = 0.0, 0
    taken: set[int] = set()
    for i, j in views.ranked_pairs():
        if i in taken or j in taken:
            # Pairs that share a camera are not independent.
            continue
        taken |= {i, j}
        rows = views.pair_views(i, j)
        both = views.common(i, j)[rows]
        found = fundamental(views.images[i, rows][both], views.images[j, rows][both])
        square += found.noise**2 * found.dof
        freedom += found.dof
    if freedom == 0:
        raise DegenerateMotionError(
            f"no two cameras share the {MIN_COMMON} points and {LEAST_SIDES} sides of "
            "the triangle that a start needs; add views that two cameras see"
        )
    return float(np.sqrt(square / freedom)) * views.scale / typical, freedom
