"""What images alone give: epipolar geometry, and points and cameras up to a homography.

Coordinates are the images' own, moved and scaled so that they are about one in size
(one scale for all cameras, so that residuals keep their weight against each other).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.least_squares import Blocks, minimise
from handeye_tri.calibrate_cameras.special_motion import homogeneous
from handeye_tri.errors import DegenerateMotionError
from handeye_tri.se3 import hat, so3_exp

Floats = NDArray[np.float64]

# Fewer common points leave a fundamental matrix without residuals to judge it by.
MIN_COMMON = 9
_ROUNDS = 10


@dataclass(frozen=True, slots=True, eq=False)
class Epipolar:
    """Epipolar geometry of two cameras.

    Attributes:
        matrix: F of rank 2 with x2' F x1 = 0, shape (3, 3).
        noise: Root mean square of one image coordinate's error that explains the
            residuals: sqrt(sum of squared Sampson distances / (points - 7)).
        dof: points - 7.
    """

    matrix: Floats
    noise: float
    dof: int


@dataclass(frozen=True, slots=True, eq=False)
class _Factors:
    """F = u diag(cos a, sin a, 0) v', the seven unknowns of a fundamental matrix."""

    u: Floats
    v: Floats
    angle: float

    @property
    def middle(self) -> Floats:
        return np.diag([np.cos(self.angle), np.sin(self.angle), 0.0])

    @property
    def matrix(self) -> Floats:
        return np.asarray(self.u @ self.middle @ self.v.T)

    def derivatives(self) -> Floats:
        """Of the matrix by rotations of u, of v, and the angle; shape (7, 3, 3)."""
        generators = hat(np.eye(3))
        change = np.diag([-np.sin(self.angle), np.cos(self.angle), 0.0])
        return np.concatenate(
            [
                self.u @ generators @ self.middle @ self.v.T,
                -self.u @ self.middle @ generators @ self.v.T,
                (self.u @ change @ self.v.T)[None],
            ]
        )


def fundamental(first: Floats, second: Floats) -> Epipolar:
    """Maximum-likelihood fundamental matrix, to first order.

    The normalised eight-point algorithm (Hartley 1997, doi:10.1109/34.601246), then
    Sampson's distance minimised over the seven unknowns (Luong and Faugeras 1996,
    doi:10.1007/BF00127818).

    Args:
        first: Image points of the first camera, shape (n, 2).
        second: The same points in the second, shape (n, 2).

    Raises:
        DegenerateMotionError: there are too few points.
    """
    if len(first) < MIN_COMMON:
        raise DegenerateMotionError(
            f"two cameras share only {len(first)} points, and their epipolar geometry "
            f"needs at least {MIN_COMMON}; add stations that both see"
        )
    (a, to_a), (b, to_b) = _conditioned(first), _conditioned(second)
    rows = (b[:, :, None] * a[:, None, :]).reshape(-1, 9)
    linear = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3)
    u, s, vt = np.linalg.svd(to_b.T @ linear @ to_a)
    # Rotations on both sides: signs that do not matter are put into the third axis.
    u[:, 2] *= np.sign(np.linalg.det(u))
    vt[2] *= np.sign(np.linalg.det(vt))
    start = _Factors(u, vt.T, float(np.arctan2(s[1], s[0])))
    x, y = homogeneous(first), homogeneous(second)

    def evaluate(state: _Factors) -> Blocks:
        matrix, change = state.matrix, state.derivatives()
        line, back = x @ matrix.T, y @ matrix
        error = (y * line).sum(axis=1)
        square = (line[:, :2] ** 2 + back[:, :2] ** 2).sum(axis=1)
        length = np.sqrt(np.maximum(square, np.finfo(float).tiny))
        moved, moved_back = x @ np.swapaxes(change, 1, 2), y @ change
        by_error = (y * moved).sum(axis=-1)
        by_square = (line[:, :2] * moved[..., :2]).sum(axis=-1)
        by_square += (back[:, :2] * moved_back[..., :2]).sum(axis=-1)
        jacobian = (by_error - error * by_square / length**2) / length
        residuals = error / length
        n = len(residuals)
        return Blocks(residuals[None], np.zeros((1, n, 0)), jacobian.T[None])

    def retract(state: _Factors, own: Floats, shared: Floats) -> _Factors:
        del own
        return _Factors(
            state.u @ so3_exp(shared[:3]),
            state.v @ so3_exp(shared[3:6]),
            state.angle + float(shared[6]),
        )

    end = minimise(evaluate, retract, start, 1e-15, max_iterations=30)
    assert end is not None
    dof = len(first) - 7
    return Epipolar(end.state.matrix, float(np.sqrt(end.cost / dof)), dof)


def _conditioned(points: Floats) -> tuple[Floats, Floats]:
    """Homogeneous points, centred and of size sqrt(2), and the map to them."""
    centre = points.mean(axis=0)
    size = np.sqrt(2.0) / np.linalg.norm(points - centre, axis=1).mean()
    matrix = np.diag([size, size, 1.0])
    matrix[:2, 2] = -size * centre
    return homogeneous(points) @ matrix.T, matrix


def factorise(images: Floats, reference: int) -> tuple[Floats, Floats]:
    """Projective cameras and points by factorisation of the scaled measurements.

    W = [lambda x] of rank 4 (Zhao, Liu and Zhang 2008, Appendix A, Eqs. (29), (30)).
    Depths first by epipolar geometry with a reference camera, as Sturm and Triggs
    1996 (doi:10.1007/3-540-61123-1_183) have it, then by W's own rank-4 part.

    Args:
        images: Points that all m cameras see, shape (m, n, 2).
        reference: The camera whose depths are one at first, and P = [I 0] at the end.

    Returns:
        Cameras (m, 3, 4) and points (n, 4).

    Raises:
        DegenerateMotionError: cameras share too few points.
    """
    m, n = images.shape[:2]
    x = homogeneous(images)
    depths = np.ones((m, n))
    for i in range(m):
        if i == reference:
            continue
        matrix = fundamental(images[reference], images[i]).matrix
        epipole = np.linalg.svd(matrix)[0][:, 2]
        across = np.cross(epipole, x[i])
        line = x[reference] @ matrix.T
        depths[i] = (across * line).sum(axis=1) / (across**2).sum(axis=1)
    cameras, points = np.empty((3 * m, 4)), np.empty((4, n))
    for _ in range(_ROUNDS):
        # Equal weight to every camera and every point.
        for _ in range(3):
            depths /= np.linalg.norm(depths[..., None] * x, axis=(0, 2)) / np.sqrt(m)
            depths /= np.linalg.norm(depths[..., None] * x, axis=(1, 2))[:, None]
        scaled = (depths[..., None] * x).transpose(0, 2, 1).reshape(3 * m, n)
        u, s, vt = np.linalg.svd(scaled, full_matrices=False)
        cameras, points = u[:, :4] * s[:4], vt[:4]
        fitted = (cameras @ points).reshape(m, 3, n).transpose(0, 2, 1)
        depths = (fitted * x).sum(axis=-1) / (x * x).sum(axis=-1)
    # The frame in which the reference is [I 0].
    first = cameras.reshape(m, 3, 4)[reference]
    frame = np.vstack([first, np.linalg.svd(first)[2][3]])
    moved = cameras.reshape(m, 3, 4) @ np.linalg.inv(frame)
    return moved, (frame @ points).T
