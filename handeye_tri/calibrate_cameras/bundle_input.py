"""What the adjustment of several cameras is given, checked before any solver runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.camera import PinholeCamera
from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.records import HalfTurn

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]


def observations(
    m: int, pixels: ArrayLike, covariance: ArrayLike
) -> tuple[Floats, Floats]:
    """Read pixels and covariances.

    Args:
        m: Number of cameras.
        pixels: Shape (m, n, 3, 2), NaN where unseen.
        covariance: Shape (m, n, 3, 2, 2), px^2.

    Returns:
        Pixels, both coordinates NaN where one was; whiteners W with W'W the inverse
        covariance, 0 where unseen, (m, n, 3, 2, 2).

    Raises:
        InputError: a shape does not fit, or a covariance is none.
    """
    if m == 0:
        raise InputError("cameras is empty; give at least one")
    observed = np.array(pixels, dtype=float)
    if observed.ndim != 4 or observed.shape[0] != m or observed.shape[2:] != (3, 2):
        raise InputError(
            f"pixels must have shape ({m}, n, 3, 2) for {m} cameras, "
            f"got {observed.shape}"
        )
    matrix = np.asarray(covariance, dtype=float)
    if matrix.shape != (*observed.shape, 2):
        raise InputError(
            f"covariance must have shape {(*observed.shape, 2)}, got {matrix.shape}"
        )
    seen = np.asarray(np.isfinite(observed).all(axis=-1))
    observed[~seen] = np.nan
    matrix = np.where(seen[..., None, None], matrix, np.eye(2))
    symmetric = np.abs(matrix[..., 0, 1] - matrix[..., 1, 0]) <= 1e-9 * np.abs(
        matrix[..., 0, 0]
    )
    determinant = (
        matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0]
    )
    bad = np.argwhere(~(symmetric & (matrix[..., 0, 0] > 0) & (determinant > 0)))
    if len(bad):
        i, j, k = bad[0]
        raise InputError(
            f"covariance[{i}, {j}, {k}] must be symmetric and positive definite, got "
            f"{matrix[i, j, k].tolist()}"
        )
    whitener = np.linalg.inv(np.linalg.cholesky(matrix))
    return observed, whitener * seen[..., None, None]


def unknowns(
    cameras: Sequence[PinholeCamera],
    skew: bool | Sequence[bool],
    lenses: Sequence[Sequence[str]] | None,
) -> tuple[tuple[tuple[int, ...], ...], tuple[tuple[int, ...], ...]]:
    """Indices of the estimated intrinsics and lens coefficients of each camera.

    Raises:
        InputError: a number of entries does not fit, or a name is unknown.
    """
    m = len(cameras)
    skews = [skew] * m if isinstance(skew, bool) else list(skew)
    names = [()] * m if lenses is None else list(lenses)
    if len(skews) != m or len(names) != m:
        raise InputError(
            f"skew and lenses must have one entry for each of the {m} cameras, got "
            f"{len(skews)} and {len(names)}"
        )
    outer = []
    for camera, wanted in zip(cameras, names, strict=True):
        known = camera.lens.names
        if not set(wanted) <= set(known) or len(set(wanted)) < len(wanted):
            raise InputError(
                f"lenses of camera {camera.name!r} must be distinct names among "
                f"{', '.join(known)}, got {list(wanted)}"
            )
        outer.append(tuple(sorted(known.index(name) for name in wanted)))
    inner = tuple((0, 1, 2, 3, 4) if free else (0, 1, 3, 4) for free in skews)
    return inner, tuple(outer)


def check_links(names: Sequence[str], seen: NDArray[np.bool_]) -> None:
    """Refuse cameras that share no station, however indirectly, with the first.

    Args:
        names: Of the m cameras.
        seen: Which markers each camera sees at the usable stations, (m, n, 3).

    Raises:
        DegenerateMotionError: names the cameras without a link.
    """
    views = np.asarray(seen.any(axis=-1))
    reached = np.zeros(len(names), dtype=bool)
    reached[0] = True
    while True:
        stations = views[reached].any(axis=0)
        grown = reached | views[:, stations].any(axis=1)
        if (grown == reached).all():
            break
        reached = grown
    if not views[0].any() or not reached.all():
        lost = [name for name, is_in in zip(names, reached, strict=True) if not is_in]
        raise DegenerateMotionError(
            f"cameras {', '.join(lost or names[:1])} share no usable station with "
            f"camera {names[0]!r}, not even through others, so where they stand to it "
            "is undetermined; add stations that both see"
        )


def start_poses(poses: ArrayLike, n: int, used: Indices) -> Floats:
    """Read reference_from_triangle, (n, 4, 4).

    Raises:
        InputError: the shape does not fit, or a used station's start is not finite.
    """
    start = np.array(poses, dtype=float)
    if start.shape != (n, 4, 4):
        raise InputError(
            f"reference_from_triangle must have shape ({n}, 4, 4), got {start.shape}"
        )
    if not np.isfinite(start[used]).all():
        lost = used[~np.isfinite(start[used]).all(axis=(1, 2))]
        raise InputError(
            f"reference_from_triangle is not finite at stations {lost.tolist()}, where "
            "the markers are seen; give a start for each"
        )
    return start


def pairs(
    half_turns: Sequence[HalfTurn], used: Indices, n: int
) -> tuple[Indices, Indices]:
    """Blocks of stations: half-turns with both stations first, then single ones.

    Returns:
        Station indices, (b, 2), -1 for no second one; which half-turn each of the
        first blocks is.

    Raises:
        InputError: a station does not exist or belongs to two half-turns.
    """
    taken = np.zeros(n, dtype=int)
    for turn in half_turns:
        if not (0 <= turn.before < n and 0 <= turn.after < n):
            raise InputError(f"{turn} names a station beyond the {n} there are")
        taken[[turn.before, turn.after]] += 1
    if (taken > 1).any():
        raise InputError(
            f"stations {np.flatnonzero(taken > 1).tolist()} belong to several "
            "half_turns; one each is possible"
        )
    usable = set(used.tolist())
    members = [
        index
        for index, turn in enumerate(half_turns)
        if turn.before in usable and turn.after in usable
    ]
    blocks = [(half_turns[i].before, half_turns[i].after) for i in members]
    single = usable.difference(*blocks)
    blocks += [(station, -1) for station in sorted(single)]
    return (
        np.array(blocks, dtype=np.intp).reshape(-1, 2),
        np.array(members, dtype=np.intp),
    )
