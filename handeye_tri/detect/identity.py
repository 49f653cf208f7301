"""Which spot is which marker: by what each may be, and by sizes and levels."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product

import numpy as np

from handeye_tri.records import Floats

# Apparent sizes may differ from the true ones by unequal depths, as a logarithm.
_MAX_SPREAD = 0.35
# Balls of one paint have one level; what differs by more is something else.
_MAX_LEVEL_SPREAD = 40.0
# A second way to name the spots must be worse by this.
_MIN_MARGIN = 0.1


def assign(
    allowed: Sequence[tuple[int, ...]],
    radii_px: Floats,
    radii: Floats,
    excess: Floats,
) -> tuple[list[int | None], bool]:
    """Name spots as markers, as many markers as can be.

    Sizes in the image are radius over depth. The markers' depths are similar, so
    that the ratios of size in the image to radius agree within a few percent.

    Args:
        allowed: For each of m spots the markers that it may be.
        radii_px: Sizes of the spots, shape (m,), px.
        radii: Radii of the markers, shape (3,), metres.
        excess: Level of each spot above what each marker should have, shape (m, 3):
            it must be much the same for all three.

    Returns:
        For each marker its spot or None; whether spots remained unnamed since they
        could be named in more than one way.
    """
    ratio = np.log(radii_px)[:, None] - np.log(radii)
    unclear = False
    for count in (3, 2, 1):
        ways = []
        for markers in combinations(range(3), count):
            choices = [
                [spot for spot, may in enumerate(allowed) if marker in may]
                for marker in markers
            ]
            for spots in product(*choices):
                if len(set(spots)) < count:
                    continue
                pairs = (list(spots), list(markers))
                if np.ptp(excess[pairs]) <= _MAX_LEVEL_SPREAD:
                    ways.append((float(np.ptp(ratio[pairs])), markers, spots))
        ways.sort()
        if not ways or ways[0][0] > _MAX_SPREAD:
            continue
        if len(ways) > 1 and ways[1][0] < ways[0][0] + _MIN_MARGIN:
            unclear = True
            continue
        named: list[int | None] = [None] * 3
        for marker, spot in zip(ways[0][1], ways[0][2], strict=True):
            named[marker] = spot
        return named, unclear
    return [None] * 3, unclear
