"""Lens distortion in the normalised plane, with derivatives and inverse.

radial = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),
x_d = x radial + 2 p1 x y + p2 (r^2 + 2 x^2), y_d alike with p1 and p2 swapped
(Brown 1971; rational: Claus and Fitzgibbon 2005, doi:10.1109/CVPR.2005.43). The
coefficients have OpenCV's order and meaning.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri import arguments
from handeye_tri.errors import InputError

Floats = NDArray[np.float64]
LensModel = Literal["radtan", "rational"]

LENS_COEFFICIENTS: dict[str, tuple[str, ...]] = {
    "radtan": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
# Newton's steps in the normalised plane end here, and what they reach must fit
# this well: a ten-millionth of a pixel at any focal length in use.
_STEP_TOLERANCE = 1e-14
_FIT_TOLERANCE = 1e-11
# A longer step leaves the domain in which the linearisation means anything.
_LONGEST_STEP = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """Lens distortion.

    Attributes:
        model: "radtan" (k1 k2 p1 p2 k3) or "rational" (and k4 k5 k6).
        coefficients: Shape (5,) or (8,), in the order of ``names``.
    """

    model: LensModel = "radtan"
    coefficients: Floats = field(default_factory=lambda: np.zeros(5))

    def __post_init__(self) -> None:
        """Lock the coefficients; raise InputError where their number is wrong."""
        if not isinstance(self.model, str) or self.model not in LENS_COEFFICIENTS:
            raise InputError(
                f"lens model {self.model!r} is not known; "
                f"use one of {', '.join(LENS_COEFFICIENTS)}"
            )
        try:
            values = np.array(self.coefficients, dtype=float)
        except (TypeError, ValueError):
            raise InputError(
                "coefficients of a lens must be numbers, got "
                + arguments.shown(self.coefficients)
            ) from None
        if values.shape != (len(self.names),) or not np.isfinite(values).all():
            raise InputError(
                f"a {self.model} lens takes {len(self.names)} finite coefficients "
                f"({' '.join(self.names)}), got {values.tolist()}"
            )
        values.setflags(write=False)
        object.__setattr__(self, "coefficients", values)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients, in order."""
        return LENS_COEFFICIENTS[self.model]

    @property
    def is_identity(self) -> bool:
        """Whether the lens changes nothing."""
        return not self.coefficients.any()

    def distort(self, normalised: ArrayLike) -> Floats:
        """Map ideal to distorted normalised coordinates, shape (..., 2)."""
        return distort(self.coefficients, normalised)

    def undistort(self, distorted: ArrayLike) -> Floats:
        """Map distorted to ideal normalised coordinates, shape (..., 2).

        Newton's method with the analytic Jacobian, to rounding; NaN stays NaN.

        Raises:
            InputError: a point lies where this lens has no inverse.
        """
        target = np.asarray(distorted, dtype=float)
        if self.is_identity or target.size == 0:
            return target.copy()
        ideal = target.copy()
        for _ in range(50):
            reached = distort_components(
                self.coefficients, ideal[..., 0], ideal[..., 1]
            )
            step = _newton_step(reached, target)
            length = np.hypot(step[..., 0], step[..., 1])[..., None]
            ideal += step * np.minimum(
                1.0, _LONGEST_STEP / np.maximum(length, _LONGEST_STEP)
            )
            if not (length > _STEP_TOLERANCE).any():
                break
        reached = distort_components(self.coefficients, ideal[..., 0], ideal[..., 1])
        # Beyond a fold the determinant is negative: the point has another origin.
        fits = (
            (np.abs(reached.x - target[..., 0]) <= _FIT_TOLERANCE)
            & (np.abs(reached.y - target[..., 1]) <= _FIT_TOLERANCE)
            & (_determinant(reached) > 0)
        )
        missed = np.isfinite(target).all(axis=-1) & ~fits
        if missed.any():
            radius = np.linalg.norm(target[missed], axis=-1).min()
            values = ", ".join(
                f"{name}={value:g}"
                for name, value in zip(self.names, self.coefficients, strict=True)
            )
            raise InputError(
                f"the lens ({values}) has no inverse at normalised radius "
                f"{radius:.3f}: it folds the image there; use coefficients that "
                "cover the whole image, or only points nearer to the centre"
            )
        return ideal


def _radial(
    coefficients: Floats, square: Floats
) -> tuple[Floats, Floats, Floats | None]:
    """Radial factor, its derivative by r^2, and its denominator, None for one."""
    k1, k2, _, _, k3 = coefficients[:5]
    numerator = 1 + square * (k1 + square * (k2 + square * k3))
    d_numerator = k1 + square * (2 * k2 + square * (3 * k3))
    if len(coefficients) == 5:
        return numerator, d_numerator, None
    k4, k5, k6 = coefficients[5:]
    denominator = 1 + square * (k4 + square * (k5 + square * k6))
    d_denominator = k4 + square * (2 * k5 + square * (3 * k6))
    ratio = numerator / denominator
    return ratio, (d_numerator - ratio * d_denominator) / denominator, denominator


def distort(coefficients: Floats, normalised: ArrayLike) -> Floats:
    """Apply lens coefficients, shape (5,) or (8,), to points, shape (..., 2)."""
    xy = np.asarray(normalised, dtype=float)
    x, y = xy[..., 0], xy[..., 1]
    p1, p2 = coefficients[2:4]
    square = (xy * xy).sum(axis=-1)
    radial, _, _ = _radial(coefficients, square)
    result = np.empty_like(xy)
    result[..., 0] = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    result[..., 1] = y * radial + 2 * p2 * x * y + p1 * (square + 2 * y * y)
    return result


@dataclass(frozen=True, slots=True, eq=False)
class Distorted:
    """Distorted points with derivatives, every number in an array of its own.

    Attributes:
        x: Distorted, shape (...).
        y: Likewise.
        x_by_x: Derivative of x by the ideal x; of y by the ideal y: ``y_by_y``.
        x_by_y: Of x by the ideal y, and of y by the ideal x.
        y_by_y: See ``x_by_x``.
        by_lens: Derivatives of x and y by each coefficient, shape (2, 5 or 8, ...).
    """

    x: Floats
    y: Floats
    x_by_x: Floats
    x_by_y: Floats
    y_by_y: Floats
    by_lens: Floats


def distort_components(coefficients: Floats, x: Floats, y: Floats) -> Distorted:
    """Distort points given by coordinate, which is several times faster.

    Args:
        coefficients: Shape (5,) or (8,), or (5, ...) or (8, ...) for several lenses.
        x: Ideal normalised coordinates, shape (...).
        y: Likewise.
    """
    p1, p2 = coefficients[2:4]
    xx, yy, xy = x * x, y * y, x * y
    square = xx + yy
    radial, slope, denominator = _radial(coefficients, square)
    slope = slope + slope
    by_lens = np.empty((2, len(coefficients), *square.shape))
    twice = np.add(xy, xy, out=by_lens[0, 2, ...])
    by_lens[1, 3] = twice
    by_p1 = np.add(square + xx, xx, out=by_lens[0, 3, ...])
    by_p2 = np.add(square + yy, yy, out=by_lens[1, 2, ...])
    power = square if denominator is None else square / denominator
    for k in (0, 1, 4):
        np.multiply(x, power, out=by_lens[0, k, ...])
        np.multiply(y, power, out=by_lens[1, k, ...])
        power = power * square
    if len(coefficients) == 8:
        np.multiply(-radial, by_lens[:, [0, 1, 4]], out=by_lens[:, 5:, ...])
    tilt = p1 * y + p2 * x
    tilt += tilt
    middle = radial + tilt
    return Distorted(
        x * radial + p1 * twice + p2 * by_p1,
        y * radial + p2 * twice + p1 * by_p2,
        middle + xx * slope + 4 * p2 * x,
        xy * slope + 2 * (p1 * x + p2 * y),
        middle + yy * slope + 4 * p1 * y,
        by_lens,
    )


def distort_jacobians(
    coefficients: Floats, normalised: ArrayLike
) -> tuple[Floats, Floats, Floats]:
    """Distorted points with derivatives.

    Args:
        coefficients: Shape (5,) or (8,).
        normalised: Shape (..., 2), ideal normalised coordinates.

    Returns:
        Distorted points (..., 2); derivative by the ideal points (..., 2, 2);
        derivative by the coefficients (..., 2, 5 or 8).
    """
    xy = np.asarray(normalised, dtype=float)
    found = distort_components(coefficients, xy[..., 0], xy[..., 1])
    by_ideal = np.empty((*xy.shape, 2))
    by_ideal[..., 0, 0], by_ideal[..., 1, 1] = found.x_by_x, found.y_by_y
    by_ideal[..., 0, 1] = by_ideal[..., 1, 0] = found.x_by_y
    by_lens = np.moveaxis(found.by_lens, (0, 1), (-2, -1))
    return np.stack([found.x, found.y], axis=-1), by_ideal, by_lens


def _determinant(at: Distorted) -> Floats:
    return np.asarray(at.x_by_x * at.y_by_y - at.x_by_y * at.x_by_y)


def _newton_step(at: Distorted, target: Floats) -> Floats:
    """Step of the ideal points, by Cramer's rule; NaN where that is singular."""
    determinant = _determinant(at)
    safe = np.where(determinant == 0, np.nan, determinant)
    u, v = target[..., 0] - at.x, target[..., 1] - at.y
    return np.stack(
        [
            (at.y_by_y * u - at.x_by_y * v) / safe,
            (at.x_by_x * v - at.x_by_y * u) / safe,
        ],
        axis=-1,
    )
