"""Intrinsics and the pinhole camera behind a lens."""

from __future__ import annotations

from dataclasses import dataclass, field
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri import arguments
from handeye_tri.camera.lens import LENS_COEFFICIENTS, Lens, distort_jacobians
from handeye_tri.errors import InputError

Floats = NDArray[np.float64]

INTRINSIC_NAMES = ("fx", "fy", "skew", "cx", "cy")


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """The five numbers of K, in pixels.

    Attributes:
        fx: Focal length along the rows (the paper's fu).
        fy: Focal length along the columns (the paper's fv).
        skew: Skew factor s.
        cx: Principal point, column (the paper's u0).
        cy: Principal point, row (the paper's v0).
    """

    fx: float
    fy: float
    skew: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        """Raise InputError where a value is not finite or a focal length <= 0."""
        given = [getattr(self, name) for name in INTRINSIC_NAMES]
        if not all(isinstance(value, Real) for value in given):
            raise InputError(f"intrinsics must be numbers, got {given}")
        values = self.vector
        if not np.isfinite(values).all() or self.fx <= 0 or self.fy <= 0:
            raise InputError(
                "intrinsics must be finite with fx > 0 and fy > 0, got "
                + ", ".join(
                    f"{n}={v:g}" for n, v in zip(INTRINSIC_NAMES, values, strict=True)
                )
            )

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Intrinsics:
        """Read K, shape (3, 3), pixels; any overall scale.

        Raises:
            InputError: not an upper triangular 3x3 matrix with a last entry.
        """
        k = np.asarray(matrix, dtype=float)
        if k.shape != (3, 3):
            raise InputError(f"K has shape (3, 3), got {k.shape}")
        below = np.abs(k[[1, 2, 2], [0, 0, 1]]).max()
        if k[2, 2] == 0 or not below <= 1e-9 * np.abs(k).max():
            raise InputError(
                "K must be upper triangular with a non-zero last entry, "
                f"got {k.tolist()}"
            )
        k = k / k[2, 2]
        return cls.from_vector((k[0, 0], k[1, 1], k[0, 1], k[0, 2], k[1, 2]))

    @classmethod
    def from_vector(cls, vector: ArrayLike) -> Intrinsics:
        """Read (fx, fy, skew, cx, cy), shape (5,), pixels.

        Raises:
            InputError: there are not five numbers.
        """
        values = np.asarray(vector, dtype=float)
        if values.shape != (5,):
            raise InputError(
                f"intrinsics are five numbers ({' '.join(INTRINSIC_NAMES)}), "
                f"got shape {values.shape}"
            )
        return cls(*(float(v) for v in values))

    @property
    def vector(self) -> Floats:
        """Shape (5,): fx, fy, skew, cx, cy, pixels."""
        return np.array([self.fx, self.fy, self.skew, self.cx, self.cy], dtype=float)

    @property
    def matrix(self) -> Floats:
        """K, shape (3, 3), pixels."""
        return np.array(
            [[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        )


@dataclass(frozen=True, slots=True, eq=False)
class PinholeCamera:
    """One camera.

    Attributes:
        name: What the camera is called in sessions and covariance labels.
        intrinsics: K in pixels.
        image_size: (width, height), pixels.
        lens: Distortion; the identity where the camera has none.
    """

    name: str
    intrinsics: Intrinsics
    image_size: tuple[int, int]
    lens: Lens = field(default_factory=Lens)

    def __post_init__(self) -> None:
        """Raise InputError where name or image size is none."""
        arguments.title("name", self.name)
        size = arguments.image_size(
            f"camera {self.name!r}: image_size", self.image_size
        )
        object.__setattr__(self, "image_size", size)

    def project(self, points: ArrayLike) -> Floats:
        """Pixels, shape (..., 2), of points in the camera frame, (..., 3), metres.

        Points at or behind the camera (z <= 0) project to NaN.
        """
        p = np.asarray(points, dtype=float)
        depth = np.where(p[..., 2:] > 0, p[..., 2:], np.nan)
        return self.pixels(p[..., :2] / depth)

    def pixels(self, normalised: ArrayLike) -> Floats:
        """Pixels, shape (..., 2), of ideal normalised coordinates, (..., 2)."""
        return _to_pixels(self.intrinsics.vector, self.lens.distort(normalised))

    def normalised(self, pixels: ArrayLike) -> Floats:
        """Ideal normalised coordinates, shape (..., 2), of pixels, (..., 2).

        Raises:
            InputError: the lens cannot be inverted at one of the pixels.
        """
        p = np.asarray(pixels, dtype=float)
        k = self.intrinsics
        y = (p[..., 1] - k.cy) / k.fy
        x = (p[..., 0] - k.cx - k.skew * y) / k.fx
        return self.lens.undistort(np.stack([x, y], axis=-1))

    def parameter(self, name: str) -> float:
        """An intrinsic, px, or lens coefficient by name; 0 where the lens lacks it.

        Raises:
            InputError: no lens has a coefficient of this name.
        """
        if name in INTRINSIC_NAMES:
            return float(getattr(self.intrinsics, name))
        if name in self.lens.names:
            return float(self.lens.coefficients[self.lens.names.index(name)])
        if not any(name in names for names in LENS_COEFFICIENTS.values()):
            raise InputError(f"a camera has no parameter {name!r}")
        return 0.0

    def project_jacobians(
        self, points: ArrayLike
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Pixels with derivatives.

        Args:
            points: Shape (..., 3), camera frame, metres, z > 0.

        Returns:
            Pixels (..., 2); derivative by the points (..., 2, 3), px/m; by
            (fx, fy, skew, cx, cy) (..., 2, 5); by the lens (..., 2, 5 or 8).
        """
        return project_jacobians(self.intrinsics.vector, self.lens.coefficients, points)


def _to_pixels(intrinsics: Floats, distorted: Floats) -> Floats:
    fx, fy, skew, cx, cy = intrinsics
    result = np.empty_like(distorted)
    result[..., 0] = fx * distorted[..., 0] + skew * distorted[..., 1] + cx
    result[..., 1] = fy * distorted[..., 1] + cy
    return result


def project_jacobians(
    intrinsics: Floats, coefficients: Floats, points: ArrayLike
) -> tuple[Floats, Floats, Floats, Floats]:
    """:meth:`PinholeCamera.project_jacobians` on bare parameter vectors.

    Args:
        intrinsics: Shape (5,): fx, fy, skew, cx, cy.
        coefficients: Shape (5,) or (8,): the lens.
        points: Shape (..., 3), camera frame, metres, z > 0.

    Returns:
        As :meth:`PinholeCamera.project_jacobians`.
    """
    p = np.asarray(points, dtype=float)
    fx, fy, skew, _, _ = intrinsics
    inverse_depth = 1.0 / p[..., 2]
    xy = p[..., :2] * inverse_depth[..., None]
    distorted, by_xy, by_lens = distort_jacobians(coefficients, xy)
    upper = np.array([[fx, skew], [0.0, fy]])
    by_xy = upper @ by_xy
    by_point = np.empty((*p.shape[:-1], 2, 3))
    by_point[..., :2] = by_xy * inverse_depth[..., None, None]
    by_point[..., 2] = -(by_point[..., :2] @ xy[..., None])[..., 0]
    by_intrinsics = np.zeros((*p.shape[:-1], 2, 5))
    by_intrinsics[..., 0, 0] = distorted[..., 0]
    by_intrinsics[..., 1, 1] = distorted[..., 1]
    by_intrinsics[..., 0, 2] = distorted[..., 1]
    by_intrinsics[..., 0, 3] = by_intrinsics[..., 1, 4] = 1.0
    return _to_pixels(intrinsics, distorted), by_point, by_intrinsics, upper @ by_lens
