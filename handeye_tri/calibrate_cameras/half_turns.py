"""The observed half-turns as arrays, checked once, before any solver runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri import arguments
from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.records import numeric
from handeye_tri.triangle import AXES, EDGES, VERTICES, Axis, TriangleRig

Floats = NDArray[np.float64]

# Markers nearer to each other than this cannot have been told apart, and a marker
# off the axis that moved less has not been turned; pixels.
_MIN_DISTANCE = 0.5
# A triangle whose image is less high than this has no homography: rounding only.
_MIN_HEIGHT = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class HalfTurnData:
    """n complete half-turns of one triangle before one camera.

    Attributes:
        pixels: Shape (n, 2, 3, 2): half-turn, before and after, A B C, column row.
        whitener: Shape (n, 2, 3, 2, 2): W with W'W the inverse pixel covariance.
        triangle: The rig.
        points: Its A, B, C, shape (3, 3), metres.
        axes: The axis of each half-turn.
        rotation: Rotation of each half-turn in the triangle's frame, (n, 3, 3).
        offset: Its translation where O is the origin, shape (n, 3), metres.
        about_normal: Which half-turns depend on O, shape (n,), 1.0 or 0.0.
        image_size: (width, height), pixels.
        index: Which half-turn of the caller each is, shape (n,).
    """

    pixels: Floats
    whitener: Floats
    triangle: TriangleRig
    points: Floats
    axes: tuple[Axis, ...]
    rotation: Floats
    offset: Floats
    about_normal: Floats
    image_size: tuple[int, int]
    index: NDArray[np.intp]

    def __len__(self) -> int:
        """Number of half-turns."""
        return len(self.pixels)

    def take(self, rows: Sequence[int] | NDArray[np.intp]) -> HalfTurnData:
        """Some of the half-turns, in the order of ``rows``."""
        index = np.asarray(rows, dtype=np.intp)
        return HalfTurnData(
            self.pixels[index],
            self.whitener[index],
            self.triangle,
            self.points,
            tuple(self.axes[i] for i in index),
            self.rotation[index],
            self.offset[index],
            self.about_normal[index],
            self.image_size,
            self.index[index],
        )

    def translation(self, o: Floats) -> Floats:
        """Translation of each half-turn, shape (n, 3), metres.

        Args:
            o: Where each axis along a normal meets the plane, shape (n, 2), metres.
        """
        result = self.offset.copy()
        result[:, :2] += (2.0 * self.about_normal)[:, None] * o
        return result

    def axis_lines(self, o: Floats) -> tuple[Floats, Floats]:
        """A point on each axis, metres, and its unit direction, (n, 3) each.

        Args:
            o: Where each axis along a normal meets the plane, shape (n, 2), metres.
        """
        through, along = np.zeros((2, len(self), 3))
        for i, axis in enumerate(self.axes):
            if axis == "normal":
                through[i, :2], along[i, 2] = o[i], 1.0
            else:
                through[i], end = self.points[list(EDGES[axis])]
                along[i] = (end - through[i]) / np.linalg.norm(end - through[i])
        return through, along


def check_triangle(triangle: object) -> None:
    """Refuse what is no triangle, as lengths by themselves.

    Raises:
        InputError: says what was given and what is needed.
    """
    if not isinstance(triangle, TriangleRig):
        raise InputError(
            "triangle must be a TriangleRig(side_ab, side_ac, angle), in metres and "
            f"radians; got {triangle!r}"
        )


def read_half_turns(
    before: ArrayLike,
    after: ArrayLike,
    triangle: TriangleRig,
    image_size: tuple[int, int],
    axis: Axis | Sequence[Axis],
    sigma_px: float | None,
    covariance: ArrayLike | None,
    dropped: dict[int, str] | None = None,
) -> tuple[HalfTurnData, NDArray[np.intp]]:
    """Check what the caller gave and keep the complete half-turns.

    Args:
        before: Pixels of A, B, C before each half-turn, shape (n, 3, 2).
        after: After it, shape (n, 3, 2).
        triangle: The rig.
        image_size: (width, height), pixels.
        axis: One for all half-turns, or one each.
        sigma_px: Standard deviation of every pixel coordinate, or None.
        covariance: Covariance of every observed point, (n, 2, 3, 2, 2), or None.
        dropped: Takes half-turns whose pixels are no half-turn, and why, instead of
            an error; they are left out.

    Returns:
        The half-turns in which all six points are finite; their indices.

    Raises:
        InputError: triangle, shapes, names, weights or pixels cannot be used.
        DegenerateMotionError: markers coincide or are in line, or a marker that should
            move stays.
    """
    check_triangle(triangle)
    pixels = _pixels(before, after)
    n = len(pixels)
    axes = read_axes(axis, n)
    whitener = _whitener(sigma_px, covariance, n)
    complete = np.isfinite(pixels).all(axis=(1, 2, 3))
    complete &= np.isfinite(whitener).all(axis=(1, 2, 3, 4))
    used = np.flatnonzero(complete)
    if n and len(used) == 0:
        raise InputError(
            f"none of the {n} half-turns has all three markers found before and "
            "after it (the others hold NaN); check the detection"
        )
    kept = tuple(axes[i] for i in used)
    size = arguments.image_size("image_size", image_size)
    for i, error in _faults(pixels[used], kept, np.array(size), used):
        if dropped is None:
            raise error
        dropped.setdefault(int(i), str(error))
    if dropped:
        used = np.setdiff1d(used, np.array(list(dropped), dtype=np.intp))
        kept = tuple(axes[i] for i in used)
    motions = {
        name: triangle.half_turn(name, np.zeros(2) if name == "normal" else None)
        for name in set(kept)
    }
    data = HalfTurnData(
        pixels[used],
        whitener[used],
        triangle,
        triangle.points,
        kept,
        np.array([motions[name].rotation for name in kept]).reshape(-1, 3, 3),
        np.array([motions[name].translation for name in kept]).reshape(-1, 3),
        np.array([float(name == "normal") for name in kept]),
        size,
        used,
    )
    return data, used


def _pixels(before: ArrayLike, after: ArrayLike) -> Floats:
    both = []
    for name, value in (("before", before), ("after", after)):
        array = numeric(name, value)
        if array.ndim != 3 or array.shape[1:] != (3, 2):
            raise InputError(
                f"{name} must have shape (n, 3, 2): half-turn, marker A B C, (column, "
                f"row) in pixels; got {array.shape}"
            )
        both.append(array)
    if both[0].shape != both[1].shape:
        raise InputError(
            f"before and after must pair up, got {len(both[0])} views before and "
            f"{len(both[1])} after the half-turns"
        )
    return np.stack(both, axis=1)


def read_axes(axis: Axis | Sequence[Axis], n: int) -> tuple[Axis, ...]:
    """The axis of each of n half-turns.

    Raises:
        InputError: their number does not fit, or a name is unknown.
    """
    if not isinstance(axis, Sequence):
        raise InputError(
            f"axis must be one of {', '.join(AXES)}, or a sequence of them, one per "
            f"half-turn; got {arguments.shown(axis)}"
        )
    axes: tuple[Any, ...] = (axis,) * n if isinstance(axis, str) else tuple(axis)
    if len(axes) != n:
        raise InputError(
            f"axis must be one name or one per half-turn: got {len(axes)} for {n}"
        )
    unknown = next((name for name in axes if name not in AXES), None)
    if unknown is not None:
        raise InputError(f"axis must be one of {', '.join(AXES)}, got {unknown!r}")
    return axes


def read_sigma(sigma_px: float | None) -> float:
    """The standard deviation of pixel coordinates, one where it is not known.

    Raises:
        InputError: it is no positive number.
    """
    return 1.0 if sigma_px is None else arguments.positive("sigma_px", sigma_px)


def _whitener(sigma_px: float | None, covariance: ArrayLike | None, n: int) -> Floats:
    shape = (n, 2, 3, 2, 2)
    if covariance is None:
        return np.broadcast_to(np.eye(2) / read_sigma(sigma_px), shape).copy()
    if sigma_px is not None:
        raise InputError("give either sigma_px or covariance, not both")
    values = numeric("covariance", covariance)
    if values.shape != shape:
        raise InputError(
            f"covariance must have shape {shape}: half-turn, before and after, marker, "
            f"2 x 2 in px^2; got {values.shape}"
        )
    # Closed forms for 2 x 2, so that NaN (unseen) passes through to be dropped.
    xx, xy, yy = values[..., 0, 0], values[..., 0, 1], values[..., 1, 1]
    lopsided = np.abs(xy - values[..., 1, 0]) > 1e-9 * (np.abs(xx) + np.abs(yy))
    bad = np.argwhere((xx <= 0) | (xx * yy - xy * xy <= 0) | lopsided)
    if len(bad):
        i, j, k = bad[0]
        raise InputError(
            f"covariance of marker {VERTICES[k]} {('before', 'after')[j]} half-turn "
            f"{i} is not symmetric and positive definite: {values[i, j, k].tolist()}"
        )
    result = np.zeros(shape)
    result[..., 0, 0] = 1.0 / np.sqrt(xx)
    rest = 1.0 / np.sqrt(yy - xy * xy / xx)
    result[..., 1, 1] = rest
    result[..., 1, 0] = -rest * xy / xx
    return result


def _faults(
    pixels: Floats,
    axes: tuple[Axis, ...],
    size: NDArray[np.intp],
    used: NDArray[np.intp],
) -> Iterator[tuple[int, InputError | DegenerateMotionError]]:
    """Half-turns that no camera of this size can have seen like that, with errors."""
    outside = np.argwhere(((pixels < -0.5) | (pixels > size - 0.5)).any(axis=-1))
    for i, j, k in outside:
        u, v = pixels[i, j, k]
        yield (
            used[i],
            InputError(
                f"marker {VERTICES[k]} {('before', 'after')[j]} half-turn {used[i]} "
                f"lies at ({u:.1f}, {v:.1f}), outside the {size[0]} x {size[1]} image "
                f"({len(outside)} such points); check image_size and the order "
                "(column, row)"
            ),
        )
    apart = np.linalg.norm(pixels - np.roll(pixels, -1, axis=2), axis=-1)
    same = np.argwhere(apart < _MIN_DISTANCE)
    for i, j, k in same:
        yield (
            used[i],
            DegenerateMotionError(
                f"markers {VERTICES[k]} and {VERTICES[(k + 1) % 3]} "
                f"{('before', 'after')[j]} half-turn {used[i]} are "
                f"{apart[i, j, k]:.3f} px apart in the image: one of them was found "
                "twice, or the triangle is seen edge-on; drop this half-turn"
            ),
        )
    ab, ac = (pixels[:, :, k] - pixels[:, :, 0] for k in (1, 2))
    twice_area = np.abs(ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0])
    with np.errstate(invalid="ignore"):
        height = twice_area / apart.max(axis=-1)
    for i, j in np.argwhere(height < _MIN_HEIGHT):
        yield (
            used[i],
            DegenerateMotionError(
                f"markers A, B and C {('before', 'after')[j]} half-turn {used[i]} are "
                f"in line to within {height[i, j]:.2g} px: the triangle is seen "
                "edge-on, or a marker was taken for another; drop this half-turn"
            ),
        )
    moved = np.linalg.norm(pixels[:, 1] - pixels[:, 0], axis=-1)
    for i, axis in enumerate(axes):
        if np.sort(moved[i])[1 if axis == "normal" else 2] < _MIN_DISTANCE:
            yield (
                used[i],
                DegenerateMotionError(
                    f"half-turn {used[i]} about {axis!r} moved A, B, C by only "
                    f"{', '.join(f'{d:.3f}' for d in moved[i])} px: the image after it "
                    "shows the triangle unturned; check axis and order of the images"
                ),
            )
