"""Which spot is which marker: by what each may be, by sizes, levels and places."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.detect.markers import MarkerSpec, Reason
from handeye_tri.records import Floats
from handeye_tri.triangle import MIN_FACING, apparent_scales

Indices = NDArray[np.intp]

# Apparent sizes may differ from the true ones by unequal depths, as a logarithm.
_MAX_SPREAD = 0.35
# Balls of one paint have one level; what differs by more is something else.
_MAX_LEVEL_SPREAD = 40.0
# A second way to name the spots must be worse by this.
_MIN_MARGIN = 0.1
# By how much the triangle's size may differ from what the markers' sizes say, as a
# logarithm: perspective makes near markers larger and near sides longer.
_MAX_MISMATCH = 0.2


def assign(
    allowed: Sequence[tuple[int, ...]],
    centres: Floats,
    radii_px: Floats,
    markers: MarkerSpec,
    excess: Floats,
) -> tuple[list[int | None], Reason | None]:
    """Name spots as markers, as many markers as can be.

    Sizes in the image are radius over depth. The markers' depths are similar, so
    that the ratios of size in the image to radius agree within a few percent. They
    are the image's scale; in it the triangle, seen aslant, is as long as it is one
    way and shorter the other way (weak perspective). Of two markers, the distance is
    at most that of the triangle, and not much shorter.

    Args:
        allowed: For each of m spots the markers that it may be.
        centres: Of the spots, shape (m, 2), px.
        radii_px: Sizes of the spots, shape (m,), px.
        markers: Radii, and places in the triangle where they are known.
        excess: Level of each spot above what each marker should have, shape (m, 3):
            it must be much the same for all three.

    Returns:
        For each marker its spot or None; why spots remained unnamed: "ambiguous",
        they could be named in more than one way, "aslant", they would be a triangle
        seen nearly from its edge; None where nothing else could be a marker.
    """
    ratio = np.log(radii_px)[:, None] - np.log(markers.radii)
    unclear: Reason | None = None
    for count in (3, 2, 1):
        ways: list[tuple[float, tuple[int, ...], Indices]] = []
        for chosen in combinations(range(3), count):
            spots = _choices(allowed, chosen)
            ratios = ratio[spots, chosen]
            spread = np.ptp(ratios, axis=1)
            fits = np.ptp(excess[spots, chosen], axis=1) <= _MAX_LEVEL_SPREAD
            fits &= spread <= _MAX_SPREAD
            cost = spread
            if markers.points is not None and count > 1:
                scale = np.exp(ratios.mean(axis=1))
                points = markers.points[list(chosen)]
                mismatch, aslant = _mismatch(centres[spots], points, scale)
                fits &= mismatch < _MAX_MISMATCH
                if count == 3 and (fits & aslant).any():
                    unclear = "aslant"
                fits &= ~aslant
                cost = spread + mismatch
            ways += [(float(cost[k]), chosen, spots[k]) for k in np.flatnonzero(fits)]
        ways.sort(key=lambda way: way[0])
        if not ways:
            continue
        if len(ways) > 1 and ways[1][0] < ways[0][0] + _MIN_MARGIN:
            unclear = unclear or "ambiguous"
            continue
        named: list[int | None] = [None] * 3
        for marker, spot in zip(ways[0][1], ways[0][2], strict=True):
            named[marker] = int(spot)
        return named, unclear
    return [None] * 3, unclear


def _choices(allowed: Sequence[tuple[int, ...]], markers: Sequence[int]) -> Indices:
    """Every way to give different spots to markers, shape (ways, len(markers))."""
    lists = [[k for k, may in enumerate(allowed) if one in may] for one in markers]
    grid = np.stack(np.meshgrid(*lists, indexing="ij"), axis=-1)
    spots = grid.reshape(-1, len(markers)).astype(np.intp)
    ordered = np.sort(spots, axis=1)
    return np.asarray(spots[(ordered[:, 1:] != ordered[:, :-1]).all(axis=1)])


def _mismatch(
    centres: Floats, points: Floats, scale: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """How badly centres fit as images of points, as a logarithm of lengths.

    Args:
        centres: Of two or three spots, shape (w, 2 or 3, 2), px.
        points: Of the markers, shape (2 or 3, 2), metres.
        scale: Of the image by the markers' sizes, shape (w,), px per metre.

    Returns:
        Shape (w,); and where the triangle would be seen nearly from its edge.
    """
    true = points[1:] - points[:1]
    if len(true) == 1:
        side = np.linalg.norm(centres[:, 1] - centres[:, 0], axis=1)
        size = np.log(side / np.linalg.norm(true) / scale)
        # A side that lies along the line of sight is shorter, but not by so much.
        return np.maximum(size, 0.0), np.asarray(size <= np.log(MIN_FACING))
    long, short = apparent_scales(centres, true).T
    off = np.abs(np.log(np.maximum(long, 1e-9) / scale))
    return np.asarray(off), np.asarray(short <= MIN_FACING * long)
