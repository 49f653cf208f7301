"""Cameras: intrinsics, lens, projection with derivatives, triangulation.

Camera frames are optical: z forward, x right, y down. Pixel (0, 0) is the
*centre* of the first pixel. A point goes through: normalised plane (x/z, y/z),
lens (Brown-Conrady or rational), then K = [fx skew cx; 0 fy cy; 0 0 1].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.errors import InputError
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]
LensModel = Literal["radtan", "rational"]

LENS_COEFFICIENTS: dict[str, tuple[str, ...]] = {
    "radtan": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
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
        """Read K, shape (3, 3), pixels; any overall scale."""
        k = np.asarray(matrix, dtype=float)
        k = k / k[2, 2]
        return cls.from_vector((k[0, 0], k[1, 1], k[0, 1], k[0, 2], k[1, 2]))

    @classmethod
    def from_vector(cls, vector: ArrayLike) -> Intrinsics:
        """Read (fx, fy, skew, cx, cy), shape (5,), pixels."""
        return cls(*(float(v) for v in np.asarray(vector, dtype=float)))

    @property
    def vector(self) -> Floats:
        """Shape (5,): fx, fy, skew, cx, cy, pixels."""
        return np.array([self.fx, self.fy, self.skew, self.cx, self.cy])

    @property
    def matrix(self) -> Floats:
        """K, shape (3, 3), pixels."""
        return np.array(
            [[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """Lens distortion; OpenCV's order and meaning of the coefficients.

    radial = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),
    x_d = x radial + 2 p1 x y + p2 (r^2 + 2 x^2), y_d alike (Brown 1971; rational:
    Claus and Fitzgibbon 2005, doi:10.1109/CVPR.2005.43).

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

        Newton's method with the analytic Jacobian, to rounding.

        Raises:
            InputError: a point lies where this lens has no inverse.
        """
        target = np.asarray(distorted, dtype=float)
        if self.is_identity:
            return target.copy()
        ideal = target.copy()
        for _ in range(50):
            reached, jacobian, _ = distort_jacobians(self.coefficients, ideal)
            step = np.linalg.solve(jacobian, (target - reached)[..., None])[..., 0]
            # A step of more than 0.5 leaves the model's domain: shorten it.
            length = np.linalg.norm(step, axis=-1, keepdims=True)
            ideal += step * np.minimum(1.0, 0.5 / np.maximum(length, 1e-300))
            if np.nanmax(length, initial=0.0) < 1e-14:
                break
        missed = np.abs(self.distort(ideal) - target)
        if np.nanmax(missed, initial=0.0) > 1e-10:
            raise InputError(
                f"the lens {dict(zip(self.names, self.coefficients, strict=True))} "
                f"cannot be inverted at normalised radius "
                f"{np.nanmax(np.linalg.norm(target, axis=-1)):.3f}; "
                "the coefficients fold the image there"
            )
        return ideal


def _radial(coefficients: Floats, square: Floats) -> tuple[Floats, Floats]:
    """Radial factor and its derivative by r^2."""
    k1, k2, _, _, k3 = coefficients[:5]
    numerator = 1 + square * (k1 + square * (k2 + square * k3))
    d_numerator = k1 + square * (2 * k2 + square * 3 * k3)
    if len(coefficients) == 5:
        return numerator, d_numerator
    k4, k5, k6 = coefficients[5:]
    denominator = 1 + square * (k4 + square * (k5 + square * k6))
    d_denominator = k4 + square * (2 * k5 + square * 3 * k6)
    ratio = numerator / denominator
    return ratio, (d_numerator - ratio * d_denominator) / denominator


def distort(coefficients: Floats, normalised: ArrayLike) -> Floats:
    """Apply lens coefficients, shape (5,) or (8,), to points, shape (..., 2)."""
    xy = np.asarray(normalised, dtype=float)
    x, y = xy[..., 0], xy[..., 1]
    p1, p2 = coefficients[2:4]
    square = x * x + y * y
    radial, _ = _radial(coefficients, square)
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + 2 * p2 * x * y + p1 * (square + 2 * y * y),
        ],
        axis=-1,
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
    x, y = xy[..., 0], xy[..., 1]
    p1, p2 = coefficients[2:4]
    square = x * x + y * y
    radial, slope = _radial(coefficients, square)
    by_point = np.empty((*xy.shape, 2))
    by_point[..., 0, 0] = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    by_point[..., 0, 1] = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    by_point[..., 1, 0] = by_point[..., 0, 1]
    by_point[..., 1, 1] = radial + 2 * y * y * slope + 2 * p2 * x + 6 * p1 * y
    by_lens = np.empty((*xy.shape, len(coefficients)))
    powers = np.stack([square, square**2, square**3], axis=-1)
    denominator = np.ones_like(square)
    if len(coefficients) == 8:
        denominator = 1 + powers @ coefficients[5:]
    columns = powers / denominator[..., None]
    by_lens[..., [0, 1, 4]] = xy[..., :, None] * columns[..., None, :]
    if len(coefficients) == 8:
        by_lens[..., 5:] = -radial[..., None, None] * by_lens[..., [0, 1, 4]]
    by_lens[..., 0, 2] = 2 * x * y
    by_lens[..., 0, 3] = square + 2 * x * x
    by_lens[..., 1, 2] = square + 2 * y * y
    by_lens[..., 1, 3] = 2 * x * y
    return distort(coefficients, xy), by_point, by_lens


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
        """Raise InputError where the image size is not two positive integers."""
        if len(self.image_size) != 2 or min(self.image_size) < 1:
            raise InputError(
                f"camera {self.name!r}: image_size must be (width, height) in pixels, "
                f"got {self.image_size}"
            )

    def project(self, points: ArrayLike) -> Floats:
        """Pixels, shape (..., 2), of points in the camera frame, (..., 3), metres.

        Points at or behind the camera (z <= 0) project to NaN.
        """
        p = np.asarray(points, dtype=float)
        depth = np.where(p[..., 2:] > 0, p[..., 2:], np.nan)
        return self.pixels(p[..., :2] / depth)

    def pixels(self, normalised: ArrayLike) -> Floats:
        """Pixels, shape (..., 2), of ideal normalised coordinates, (..., 2)."""
        d = self.lens.distort(normalised)
        k = self.intrinsics
        return np.stack(
            [
                k.fx * d[..., 0] + k.skew * d[..., 1] + k.cx,
                k.fy * d[..., 1] + k.cy,
            ],
            axis=-1,
        )

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
    fx, fy, skew, cx, cy = intrinsics
    inverse_depth = 1.0 / p[..., 2]
    xy = p[..., :2] * inverse_depth[..., None]
    d, by_xy, by_lens = distort_jacobians(coefficients, xy)
    pixels = np.stack(
        [fx * d[..., 0] + skew * d[..., 1] + cx, fy * d[..., 1] + cy], axis=-1
    )
    upper = np.array([[fx, skew], [0.0, fy]])
    xy_by_point = np.zeros((*p.shape[:-1], 2, 3))
    xy_by_point[..., 0, 0] = xy_by_point[..., 1, 1] = inverse_depth
    xy_by_point[..., :, 2] = -xy * inverse_depth[..., None]
    by_point = upper @ by_xy @ xy_by_point
    by_intrinsics = np.zeros((*p.shape[:-1], 2, 5))
    by_intrinsics[..., 0, 0] = d[..., 0]
    by_intrinsics[..., 1, 1] = d[..., 1]
    by_intrinsics[..., 0, 2] = d[..., 1]
    by_intrinsics[..., 0, 3] = by_intrinsics[..., 1, 4] = 1.0
    return pixels, by_point, by_intrinsics, upper @ by_lens


def triangulate(
    cameras: Sequence[PinholeCamera],
    world_from_camera: Sequence[SE3],
    pixels: ArrayLike,
    covariance: ArrayLike,
    iterations: int = 20,
) -> tuple[Floats, Floats]:
    """Maximum-likelihood points from two or more views.

    Starts at the point nearest to all rays, then Gauss-Newton on the whitened
    reprojection error (Hartley and Zisserman, Multiple View Geometry, Sec. 12.3).

    Args:
        cameras: m cameras.
        world_from_camera: m motions.
        pixels: Shape (m, n, 2); NaN where a camera did not see the point.
        covariance: Pixel covariances, shape (m, n, 2, 2), px^2.
        iterations: Upper limit of Gauss-Newton steps.

    Returns:
        Points in the world frame (n, 3), metres, NaN where fewer than two cameras
        saw the point; their covariances (n, 3, 3), m^2.

    Raises:
        InputError: the shapes do not fit each other.
    """
    seen_pixels = np.asarray(pixels, dtype=float)
    cov = np.asarray(covariance, dtype=float)
    m = len(cameras)
    if seen_pixels.ndim != 3 or seen_pixels.shape[0] != m or seen_pixels.shape[2] != 2:
        raise InputError(
            f"pixels must have shape ({m}, n, 2) for {m} cameras, "
            f"got {seen_pixels.shape}"
        )
    if cov.shape != (*seen_pixels.shape, 2) or len(world_from_camera) != m:
        raise InputError(
            f"covariance must have shape {(*seen_pixels.shape, 2)} and there must be "
            f"{m} motions; got {cov.shape} and {len(world_from_camera)}"
        )
    n = seen_pixels.shape[1]
    seen = np.isfinite(seen_pixels).all(axis=-1)
    enough = seen.sum(axis=0) >= 2
    points = np.full((n, 3), np.nan)
    result_cov = np.full((n, 3, 3), np.nan)
    if not enough.any():
        return points, result_cov
    used = np.where(enough)[0]
    rotation = np.array([motion.rotation for motion in world_from_camera])
    centre = np.array([motion.translation for motion in world_from_camera])
    projector = np.zeros((m, len(used), 3, 3))
    for i, camera in enumerate(cameras):
        visible = seen[i, used]
        xy = camera.normalised(seen_pixels[i, used[visible]])
        ray = np.concatenate([xy, np.ones((len(xy), 1))], axis=-1) @ rotation[i].T
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        projector[i, visible] = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    x = np.linalg.solve(
        projector.sum(axis=0), np.einsum("ikab,ib->ka", projector, centre)[..., None]
    )[..., 0]
    identity = np.eye(2)
    weight = np.zeros((m, len(used), 2, 2))
    for i in range(m):
        visible = seen[i, used]
        weight[i, visible] = np.linalg.solve(
            cov[i, used[visible]], np.broadcast_to(identity, (visible.sum(), 2, 2))
        )
    for _ in range(iterations):
        normal = np.zeros((len(used), 3, 3))
        gradient = np.zeros((len(used), 3))
        for i, camera in enumerate(cameras):
            visible = seen[i, used]
            local = (x[visible] - centre[i]) @ rotation[i]
            predicted, by_point, _, _ = camera.project_jacobians(local)
            jacobian = by_point @ rotation[i].T
            residual = seen_pixels[i, used[visible]] - predicted
            weighted = np.swapaxes(jacobian, -1, -2) @ weight[i, visible]
            normal[visible] += weighted @ jacobian
            gradient[visible] += (weighted @ residual[..., None])[..., 0]
        step = np.linalg.solve(normal, gradient[..., None])[..., 0]
        x = x + step
        if np.abs(step).max() < 1e-13:
            break
    points[used] = x
    result_cov[used] = np.linalg.inv(normal)
    return points, result_cov


@dataclass(frozen=True, slots=True, eq=False)
class StereoRig:
    """Two cameras that stand fixed to each other.

    Attributes:
        left: First camera; its frame is the rig's frame.
        right: Second camera.
        left_from_right: Where the right camera is in the left frame.
    """

    left: PinholeCamera
    right: PinholeCamera
    left_from_right: SE3

    @property
    def baseline(self) -> float:
        """Distance of the two centres, metres."""
        return float(np.linalg.norm(self.left_from_right.translation))

    def triangulate(
        self, pixels: ArrayLike, covariance: ArrayLike
    ) -> tuple[Floats, Floats]:
        """Points in the left frame; see :func:`triangulate`, with m = 2."""
        return triangulate(
            (self.left, self.right),
            (SE3.identity(), self.left_from_right),
            pixels,
            covariance,
        )
