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
        if self.model not in LENS_COEFFICIENTS:
            raise InputError(
                f"lens model {self.model!r} is not known; "
                f"use one of {', '.join(LENS_COEFFICIENTS)}"
            )
        values = np.array(self.coefficients, dtype=float)
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
            reached, jacobian = _distort_and_slope(self.coefficients, ideal)
            step = _solve_2x2(jacobian, target - reached)
            length = np.hypot(step[..., 0], step[..., 1])[..., None]
            ideal += step * np.minimum(
                1.0, _LONGEST_STEP / np.maximum(length, _LONGEST_STEP)
            )
            if not (length > _STEP_TOLERANCE).any():
                break
        reached, jacobian = _distort_and_slope(self.coefficients, ideal)
        # Beyond a fold the determinant is negative: the point has another origin.
        fits = (np.abs(reached - target) <= _FIT_TOLERANCE).all(axis=-1) & (
            _determinant(jacobian) > 0
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


def _radial(coefficients: Floats, square: Floats) -> tuple[Floats, Floats, Floats]:
    """Radial factor, its derivative by r^2, and its denominator."""
    k1, k2, _, _, k3 = coefficients[:5]
    numerator = 1 + square * (k1 + square * (k2 + square * k3))
    d_numerator = k1 + square * (2 * k2 + square * 3 * k3)
    if len(coefficients) == 5:
        return numerator, d_numerator, np.ones_like(square)
    k4, k5, k6 = coefficients[5:]
    denominator = 1 + square * (k4 + square * (k5 + square * k6))
    d_denominator = k4 + square * (2 * k5 + square * 3 * k6)
    ratio = numerator / denominator
    return ratio, (d_numerator - ratio * d_denominator) / denominator, denominator


def distort(coefficients: Floats, normalised: ArrayLike) -> Floats:
    """Apply lens coefficients, shape (5,) or (8,), to points, shape (..., 2)."""
    xy = np.asarray(normalised, dtype=float)
    square = (xy * xy).sum(axis=-1)
    return _bend(coefficients, xy, square, _radial(coefficients, square)[0])


def _bend(coefficients: Floats, xy: Floats, square: Floats, radial: Floats) -> Floats:
    x, y = xy[..., 0], xy[..., 1]
    p1, p2 = coefficients[2:4]
    result = np.empty_like(xy)
    result[..., 0] = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    result[..., 1] = y * radial + 2 * p2 * x * y + p1 * (square + 2 * y * y)
    return result


def _slope(coefficients: Floats, xy: Floats, radial: Floats, slope: Floats) -> Floats:
    """Derivative of the distorted by the ideal point, shape (..., 2, 2)."""
    x, y = xy[..., 0], xy[..., 1]
    p1, p2 = coefficients[2:4]
    result = np.empty((*xy.shape, 2))
    result[..., 0, 0] = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    result[..., 0, 1] = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    result[..., 1, 0] = result[..., 0, 1]
    result[..., 1, 1] = radial + 2 * y * y * slope + 2 * p2 * x + 6 * p1 * y
    return result


def _distort_and_slope(coefficients: Floats, xy: Floats) -> tuple[Floats, Floats]:
    square = (xy * xy).sum(axis=-1)
    radial, slope, _ = _radial(coefficients, square)
    return (
        _bend(coefficients, xy, square, radial),
        _slope(coefficients, xy, radial, slope),
    )


def distort_jacobians(
    coefficients: Floats, normalised: ArrayLike
) -> tuple[Floats, Floats, Floats]:
    """Distorted points with derivatives.

    Args:
        coefficients: Shape (5,) or (8,), or (5, ...) or (8, ...) for several lenses.
        normalised: Shape (..., 2), ideal normalised coordinates.

    Returns:
        Distorted points (..., 2); derivative by the ideal points (..., 2, 2);
        derivative by the coefficients (..., 2, 5 or 8).
    """
    xy = np.asarray(normalised, dtype=float)
    x, y = xy[..., 0], xy[..., 1]
    square = (xy * xy).sum(axis=-1)
    radial, slope, denominator = _radial(coefficients, square)
    by_lens = np.empty((*xy.shape, len(coefficients)))
    by_lens[..., 0] = xy * (square / denominator)[..., None]
    by_lens[..., 1] = by_lens[..., 0] * square[..., None]
    by_lens[..., 4] = by_lens[..., 1] * square[..., None]
    if len(coefficients) == 8:
        by_lens[..., 5:] = -radial[..., None, None] * by_lens[..., [0, 1, 4]]
    by_lens[..., 0, 2] = by_lens[..., 1, 3] = 2 * x * y
    by_lens[..., 0, 3] = square + 2 * x * x
    by_lens[..., 1, 2] = square + 2 * y * y
    return (
        _bend(coefficients, xy, square, radial),
        _slope(coefficients, xy, radial, slope),
        by_lens,
    )


def _determinant(matrix: Floats) -> Floats:
    return np.asarray(
        matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0]
    )


def _solve_2x2(matrix: Floats, right: Floats) -> Floats:
    """Solve many 2x2 systems by Cramer's rule; NaN where one is singular."""
    determinant = _determinant(matrix)
    safe = np.where(determinant == 0, np.nan, determinant)
    u, v = right[..., 0], right[..., 1]
    return np.stack(
        [
            (matrix[..., 1, 1] * u - matrix[..., 0, 1] * v) / safe,
            (matrix[..., 0, 0] * v - matrix[..., 1, 0] * u) / safe,
        ],
        axis=-1,
    )
