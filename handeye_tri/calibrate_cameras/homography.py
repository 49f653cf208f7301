"""One plane homography per half-turn, by maximum likelihood.

Before and after a half-turn about a normal or an edge, the three markers lie in one
plane, at six (normal) or four (edge) known places; the markers on an edge axis are
seen twice. The homography takes every observation with its covariance, is defined
where the axis passes through a marker (the formulas of Sec. III-A are not), and holds
all that the half-turn says of the camera: h1' w h2 = 0, h1' w h1 = h2' w h2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.half_turns import HalfTurnData
from handeye_tri.calibrate_cameras.least_squares import (
    Blocks,
    NormalEquations,
    minimise,
)
from handeye_tri.calibrate_cameras.special_motion import (
    conic_matrix,
    conic_row,
    diagonals_meet,
    homogeneous,
)
from handeye_tri.errors import DegenerateMotionError
from handeye_tri.se3 import hat

Floats = NDArray[np.float64]
OMode = Literal["shared", "free", "known"]


@dataclass(frozen=True, slots=True, eq=False)
class ImageScale:
    """Image coordinates with the image's middle at 0 and its longer side 1.

    Attributes:
        centre: Shape (2,), pixels.
        scale: Pixels per unit.
    """

    centre: Floats
    scale: float

    @classmethod
    def of(cls, image_size: tuple[int, int]) -> ImageScale:
        """For an image of (width, height) pixels."""
        size = np.asarray(image_size, dtype=float)
        return cls(0.5 * (size - 1.0), float(size.max()))

    def normalised(self, pixels: Floats) -> Floats:
        """Pixels (..., 2) in these coordinates."""
        return np.asarray((pixels - self.centre) / self.scale)

    @property
    def matrix(self) -> Floats:
        """Pixels from these coordinates, homogeneous, shape (3, 3)."""
        result = np.diag([self.scale, self.scale, 1.0])
        result[:2, 2] = self.centre
        return result


@dataclass(frozen=True, slots=True, eq=False)
class Homographies:
    """Plane to image, per half-turn, in coordinates of about unit size.

    Plane: (P - origin) / size, P in the triangle's frame. Image: :class:`ImageScale`.
    The third row's last element is 1: the origin, the centroid of the triangle, is
    in front of the camera.

    Attributes:
        matrix: Shape (n, 3, 3).
        covariance: Of the first eight elements, by rows, shape (n, 8, 8).
        o: Where each normal axis meets the plane, triangle's frame, (n, 2), metres.
        origin: Shape (2,), metres.
        size: Metres.
        image: The image coordinates.
        chi2: Sum of squared whitened residuals.
        residual_px: Root mean square residual of each half-turn, shape (n,), pixels.
        dof: Observations less unknowns.
    """

    matrix: Floats
    covariance: Floats
    o: Floats
    origin: Floats
    size: float
    image: ImageScale
    chi2: float
    residual_px: Floats
    dof: int


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    matrix: Floats
    o: Floats


def fit_homographies(
    data: HalfTurnData, o_mode: OMode, o: Floats | None
) -> Homographies:
    """Maximum-likelihood homographies of all half-turns.

    Args:
        data: The half-turns.
        o_mode: Whether O is known, one unknown for all, or free per half-turn.
        o: The known O, triangle's frame, shape (2,), metres; else None.

    Returns:
        The homographies with covariances that take a shared O into account.

    Raises:
        DegenerateMotionError: the images admit no homography.
    """
    image = ImageScale.of(data.image_size)
    observed = image.normalised(data.pixels)
    vertices = data.triangle.points[:, :2]
    origin = vertices.mean(axis=0)
    size = float(np.sqrt(((vertices - origin) ** 2).sum(axis=1).mean()))
    points = (vertices - origin) / size
    turn = data.rotation[:, :2, :2]
    # Where the centroid goes when O is at it, then plus twice O for a normal axis.
    still = (data.offset[:, :2] - origin + turn @ origin) / size
    reach = 2.0 * data.about_normal

    def plane(feet: Floats) -> Floats:
        """All six points in the plane, shape (n, 2, 3, 2), for O (n, 2)."""
        moved = points @ np.swapaxes(turn, 1, 2)
        moved += (still + reach[:, None] * feet / size)[:, None]
        return np.stack([np.broadcast_to(points, moved.shape), moved], axis=1)

    feet = _start_feet(data, observed, points, origin, size, o_mode, o)
    start = _State(_linear(plane(feet), observed), feet)
    whitener = data.whitener * image.scale
    estimated = o_mode != "known" and bool(data.about_normal.any())
    shared_o = estimated and o_mode == "shared"
    n = len(data)

    def evaluate(state: _State) -> Blocks | None:
        p = homogeneous(plane(state.o))
        matrix = state.matrix[:, None]
        mapped = p @ np.swapaxes(matrix, -1, -2)
        if (mapped[..., 2] <= 0).any():
            return None
        inverse = 1.0 / mapped[..., 2:]
        q = mapped[..., :2] * inverse
        by_matrix = np.zeros((n, 2, 3, 2, 8))
        by_matrix[..., 0, 0:3] = by_matrix[..., 1, 3:6] = p * inverse
        by_matrix[..., 6:] = -q[..., None] * (p[..., :2] * inverse)[..., None, :]
        own = (whitener @ by_matrix).reshape(n, 12, 8)
        shared = np.zeros((n, 12, 0))
        if estimated:
            by_plane = (
                matrix[:, :, None, :2, :2] - q[..., None] * matrix[:, :, None, 2:, :2]
            ) * inverse[..., None]
            by_plane[:, 0] = 0.0
            by_plane[:, 1] *= (reach / size)[:, None, None, None]
            by_o = (whitener @ by_plane).reshape(n, 12, 2)
            if shared_o:
                shared = by_o
            else:
                own = np.concatenate([own, by_o], axis=-1)
        residuals = (whitener @ (q - observed)[..., None]).reshape(n, 12)
        return Blocks(residuals, own, shared)

    def retract(state: _State, own: Floats, shared: Floats) -> _State:
        change = np.zeros((n, 9))
        change[:, :8] = own[:, :8]
        feet = state.o
        if estimated:
            feet = feet + (shared if shared_o else own[:, 8:])
        return _State(state.matrix + change.reshape(n, 3, 3), feet)

    rounding = float(np.finfo(float).eps * whitener.max())
    end = minimise(evaluate, retract, start, rounding, max_iterations=30)
    if end is None:
        depths = homogeneous(plane(start.o)) @ start.matrix[:, None, 2, :, None]
        worst = int(np.argmin(depths.min(axis=(1, 2, 3))))
        raise _no_plane(data, worst)
    try:
        covariance = NormalEquations.of(end.blocks).own_covariance()[:, :8, :8]
    except np.linalg.LinAlgError:
        worst = int(np.argmax((end.blocks.residuals**2).sum(axis=1)))
        raise _no_plane(data, worst) from None
    missed = np.linalg.solve(
        data.whitener, end.blocks.residuals.reshape(n, 2, 3, 2)[..., None]
    )
    normals = int(data.about_normal.sum())
    feet_unknown = (2 if shared_o else 2 * normals) if estimated else 0
    return Homographies(
        end.state.matrix,
        covariance,
        end.state.o,
        origin,
        size,
        image,
        end.cost,
        np.sqrt(np.mean(missed**2, axis=(1, 2, 3, 4))),
        max(12 * n - 8 * n - feet_unknown, 1),
    )


def _no_plane(data: HalfTurnData, worst: int) -> DegenerateMotionError:
    return DegenerateMotionError(
        f"half-turn {data.index[worst]} is no half-turn about {data.axes[worst]!r}: no "
        "plane maps to the images before and after it with every marker in front of "
        "the camera; check the axis, the triangle and the order of A, B, C"
    )


def _start_feet(
    data: HalfTurnData,
    observed: Floats,
    points: Floats,
    origin: Floats,
    size: float,
    o_mode: OMode,
    o: Floats | None,
) -> Floats:
    """O of each half-turn without knowing K, shape (n, 2), metres.

    In the image a half-turn about a normal is the harmonic homology
    x' ~ (o.l) x - 2 (l.x) o with the image o of O as centre and the vanishing line l
    of the plane as axis; given o it is linear in l. Depths are then as 1 / (l.x).
    """
    n = len(data)
    if o_mode == "known" or not data.about_normal.any():
        return np.tile(np.zeros(2) if o is None else o, (n, 1))
    about = np.flatnonzero(data.about_normal)
    seen = observed[about]
    meet, _ = diagonals_meet(seen[:, 0], seen[:, 1])
    x, moved, centre = homogeneous(seen[:, 0]), homogeneous(seen[:, 1]), meet
    o_image = homogeneous(centre)[:, None]
    system = (
        np.cross(moved, x)[..., None] * o_image[..., None, :]
        - 2.0 * np.cross(moved, o_image)[..., None] * x[..., None, :]
    ).reshape(-1, 9, 3)
    line = np.linalg.svd(system)[2][:, -1]
    scaled = x / (line[:, None] * x).sum(axis=-1, keepdims=True)
    # Image to plane, from the images of A, B, C with their depths.
    back = homogeneous(points).T @ np.linalg.inv(np.swapaxes(scaled, -1, -2))
    foot = (back @ o_image[:, 0, :, None])[..., 0]
    feet = origin + size * foot[:, :2] / foot[:, 2:]
    result = np.zeros((n, 2))
    result[about] = np.median(feet, axis=0) if o_mode == "shared" else feet
    if o_mode == "shared":
        result[:] = result[about[0]]
    return result


def _linear(plane: Floats, observed: Floats) -> Floats:
    """Direct linear homographies, shape (n, 3, 3), last element 1."""
    n = len(plane)
    p = homogeneous(plane).reshape(n, 6, 3)
    q = observed.reshape(n, 6, 2)
    system = np.zeros((n, 6, 2, 9))
    system[..., 0, 0:3] = system[..., 1, 3:6] = p
    system[..., 6:9] = -q[..., None] * p[..., None, :]
    rows = system.reshape(n, 12, 9)
    # Squared singular values keep half the digits: enough for a start.
    vector = np.linalg.eigh(np.swapaxes(rows, -1, -2) @ rows)[1][..., 0]
    return np.asarray((vector / vector[:, 8:]).reshape(n, 3, 3))


def conic_constraints(matrix: Floats) -> Floats:
    """The two rows that a homography puts on b, shape (n, 2, 6)."""
    h1, h2 = matrix[..., 0], matrix[..., 1]
    return np.stack([conic_row(h1, h2), conic_row(h1, h1) - conic_row(h2, h2)], axis=-2)


def constraint_derivative(matrix: Floats, b: Floats) -> Floats:
    """Derivative of the two constraint rows times b by a homography, (n, 2, 8).

    Args:
        matrix: Shape (n, 3, 3); its first eight elements, by rows, are the variables.
        b: Shape (6,).
    """
    w = conic_matrix(b)
    wh1, wh2 = matrix[..., 0] @ w, matrix[..., 1] @ w
    derivative = np.zeros((len(matrix), 2, 9))
    derivative[:, 0, 0::3], derivative[:, 0, 1::3] = wh2, wh1
    derivative[:, 1, 0::3], derivative[:, 1, 1::3] = 2.0 * wh1, -2.0 * wh2
    return derivative[..., :8]


def constraint_covariance(homographies: Homographies, b: Floats) -> Floats:
    """Covariance of the two constraint rows times b, shape (n, 2, 2)."""
    derivative = constraint_derivative(homographies.matrix, b)
    return np.asarray(
        derivative @ homographies.covariance @ np.swapaxes(derivative, -1, -2)
    )


def vanishing_lines(homographies: Homographies) -> tuple[Floats, Floats]:
    """Vanishing line (l1, l2, 1) of each plane, with the covariance of (l1, l2).

    The line's coordinates are those of :class:`ImageScale`; (0, 0, 1) is a plane
    parallel to the image. K is not needed: planes are parallel where lines are equal.

    Returns:
        Shapes (n, 2) and (n, 2, 2).
    """
    h1, h2 = homographies.matrix[..., 0], homographies.matrix[..., 1]
    line = np.cross(h1, h2)
    by_matrix = np.zeros((len(line), 3, 9))
    by_matrix[:, :, 0::3] = -hat(h2)
    by_matrix[:, :, 1::3] = hat(h1)
    ratio = line[:, :2] / line[:, 2:]
    derivative = (
        by_matrix[:, :2, :8] - ratio[..., None] * by_matrix[:, 2:, :8]
    ) / line[:, 2, None, None]
    covariance = derivative @ homographies.covariance @ np.swapaxes(derivative, -1, -2)
    return ratio, covariance
