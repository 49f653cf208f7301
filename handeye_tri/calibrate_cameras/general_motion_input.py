"""What the calibration under general motions is given, checked before it runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri import arguments
from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.records import numeric
from handeye_tri.triangle import VERTICES

Floats = NDArray[np.float64]

# Markers that are nearer in most views cannot have been told apart, pixels.
_MIN_DISTANCE = 0.5


def read_points(points: ArrayLike) -> Floats:
    """Pixels of m >= 2 cameras, shape (m, n, 3, 2), both NaN where one was.

    Raises:
        InputError: the shape does not fit, or two markers are at one place.
    """
    observed = numeric("points", points)
    if observed.ndim != 4 or observed.shape[2:] != (3, 2):
        raise InputError(
            "points must have shape (m, n, 3, 2): camera, view, marker A B C, (column, "
            f"row) in pixels; got {observed.shape}"
        )
    if len(observed) < 2:
        raise InputError(
            f"points has {len(observed)} cameras, and general motions need at least 2; "
            "for one camera turn the triangle by 180 degrees and use calibrate_camera"
        )
    observed[~np.isfinite(observed).all(axis=-1)] = np.nan
    apart = np.abs(observed - np.roll(observed, -1, axis=2)).max(axis=-1)
    same = np.argwhere(apart == 0)
    if len(same):
        i, j, k = same[0]
        raise InputError(
            f"points[{i}, {j}] has markers {VERTICES[k]} and {VERTICES[(k + 1) % 3]} "
            f"at the same pixel {observed[i, j, k].tolist()} ({len(same)} such pairs): "
            "one of them was found twice; put NaN where a marker was not found"
        )
    for i, k in np.ndindex(len(observed), 3):
        seen = apart[i, :, k][np.isfinite(apart[i, :, k])]
        if len(seen) and np.median(seen) < _MIN_DISTANCE:
            raise InputError(
                f"points[{i}] has markers {VERTICES[k]} and {VERTICES[(k + 1) % 3]} "
                f"less than {_MIN_DISTANCE} px apart in most of its {len(seen)} views "
                f"(median {np.median(seen):.3f}): they are one marker found twice, or "
                "the camera is too far away"
            )
    return observed


def read_cameras(
    m: int,
    names: Sequence[str] | None,
    image_sizes: tuple[int, int] | Sequence[tuple[int, int]],
    observed: Floats,
) -> tuple[list[str], list[tuple[int, int]]]:
    """Names and image sizes of m cameras that observed pixels, shape (m, n, 3, 2).

    Raises:
        InputError: there are not m, names repeat, or a point is outside its image.
    """
    labels = [f"camera{i}" for i in range(m)]
    if names is not None:
        labels = arguments.titles("names", names, m)
    size = arguments.image_sizes("image_sizes", image_sizes, m)
    limit = np.array(size)[:, None, None] - 0.5
    outside = np.argwhere(((observed < -0.5) | (observed > limit)).any(axis=-1))
    if len(outside):
        i, j, k = outside[0]
        u, v = observed[i, j, k]
        raise InputError(
            f"points[{i}, {j}, {k}] (camera {labels[i]!r}, marker {VERTICES[k]}) lies "
            f"at ({u:.1f}, {v:.1f}), outside the {size[i][0]} x {size[i][1]} image "
            f"({len(outside)} such points); check image_sizes and the order (column, "
            "row)"
        )
    return labels, size


def check_enough(labels: Sequence[str], observed: Floats) -> None:
    """Refuse cameras that saw nothing, in pixels (m, n, 3, 2), and too few views.

    Raises:
        InputError: a camera saw nothing.
        DegenerateMotionError: fewer observations than unknowns; says how many.
    """
    seen = np.isfinite(observed).all(axis=-1)
    for label, count in zip(labels, seen.sum(axis=(1, 2)), strict=True):
        if count == 0:
            raise InputError(
                f"camera {label!r} saw no marker in any of the {observed.shape[1]} "
                "views (all are NaN); leave it out or check its detection"
            )
    m = len(observed)
    views = int((seen.sum(axis=0) >= 1).all(axis=-1).sum())
    count, unknowns = 2 * int(seen.sum()), 11 * m - 6 + 6 * views
    least = 4 if m == 2 else 3
    if views < least or count <= unknowns:
        raise DegenerateMotionError(
            f"{views} views in which every marker is seen, with {count} pixel "
            f"coordinates for {unknowns} unknowns, do not determine {m} cameras; at "
            f"least {least} views are needed, and 10 or more are advised"
        )
