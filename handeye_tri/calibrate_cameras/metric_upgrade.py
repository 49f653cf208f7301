"""From a projective to a metric frame, by the triangle's known sides.

Zhao, Liu and Zhang 2008 (doi:10.1109/TIP.2008.2005562), Appendix A. With the first
camera at [I 0], the homography H = [K1 0; v' 1] makes the frame metric. With p =
-K1^-T v the points are K1^-1 x / (x4 + p.x) for projective points (x, x4), whose
distances are the sides up to one scale: nine unknowns, three equations for a view
that is seen whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.least_squares import Blocks, minimise
from handeye_tri.errors import DegenerateMotionError

Floats = NDArray[np.float64]

# Standard deviations of the soft priors on a camera in coordinates of about its focal
# length (Pollefeys et al. 2004, doi:10.1023/B:VISI.0000025798.50602.3a, Sec. 6.2):
# f^2 - 1, aspect, skew, principal point.
_PRIORS = (9.0, 0.2, 0.01, 0.1)
# Side over known side that is this far from one counts half.
_ROBUST = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Upgrade:
    """A metric frame.

    Attributes:
        k: K of the first camera, shape (3, 3), in the unit of the images.
        plane: The p of the plane at infinity (p, 1), shape (3,).
        scale: Metres per unit of K1^-1 x / (x4 + p.x); positive.
        cost: Sum of robust squares of side / known - 1.
    """

    k: Floats
    plane: Floats
    scale: float
    cost: float

    def points(self, projective: Floats) -> Floats:
        """Metric points in the first camera's frame, (..., 3), m, from (..., 4)."""
        ray = projective[..., :3] @ np.linalg.inv(self.k).T
        last = projective[..., 3] + projective[..., :3] @ self.plane
        return np.asarray(self.scale * ray / last[..., None])

    def cameras(self, projective: Floats) -> Floats:
        """Camera matrices (m, 3, 4) for metric points in metres."""
        frame = np.zeros((4, 4))
        frame[:3, :3] = self.k / self.scale
        frame[3, :3] = -self.plane @ self.k / self.scale
        frame[3, 3] = 1.0
        return np.asarray(projective @ frame)


def quadric_start(cameras: Floats) -> tuple[Floats, Floats]:
    """K1 and p from the dual absolute quadric Q, with w_i* ~ P_i Q P_i'.

    Linear in Q with soft priors on every camera, weighted again by the depth P3 Q P3'
    that the last solution gave; then the nearest Q of rank 3.

    Args:
        cameras: Shape (m, 3, 4), the first [I 0], in coordinates in which focal
            lengths are about one and principal points about zero.

    Returns:
        Shapes (3, 3) and (3,).

    Raises:
        DegenerateMotionError: Q is no quadric of a camera.
    """
    upper = np.triu_indices(4)
    double = np.where(upper[0] == upper[1], 1.0, 2.0)

    def entry(i: int, j: int) -> Floats:
        outer = cameras[:, i, :, None] * cameras[:, j, None, :]
        both = 0.5 * (outer + np.swapaxes(outer, 1, 2))
        return np.asarray(both[:, upper[0], upper[1]] * double)

    size = np.linalg.norm(cameras[:, 2], axis=1)
    cameras = cameras / size[:, None, None]
    focal, aspect, skew, centre = _PRIORS
    rows = np.stack(
        [
            (entry(0, 0) - entry(2, 2)) / focal,
            (entry(1, 1) - entry(2, 2)) / focal,
            (entry(0, 0) - entry(1, 1)) / aspect,
            entry(0, 1) / skew,
            entry(0, 2) / centre,
            entry(1, 2) / centre,
        ],
        axis=1,
    )
    weight = np.ones(len(cameras))
    quadric = np.zeros((4, 4))
    for _ in range(5):
        weighted = (weight[:, None, None] * rows).reshape(-1, 10)
        vector = np.linalg.svd(weighted, full_matrices=False)[2][-1]
        quadric[upper] = vector
        quadric.T[upper] = vector
        depth = np.abs(np.einsum("mi,ij,mj->m", cameras[:, 2], quadric, cameras[:, 2]))
        weight = 1.0 / np.maximum(depth, 1e-3 * depth.max())
    values, vectors = np.linalg.eigh(quadric)
    if values.sum() < 0:
        values = -values
    nearest = int(np.argmin(np.abs(values)))
    plane = vectors[:, nearest]
    kept = np.delete(values, nearest)
    conic = (np.delete(vectors, nearest, axis=1) * kept) @ np.delete(
        vectors, nearest, axis=1
    ).T
    if kept.min() <= 0 or abs(plane[3]) < 1e-12:
        raise DegenerateMotionError(
            "the dual absolute quadric is not positive (eigenvalues "
            f"{', '.join(f'{v:.2g}' for v in values)}): no cameras with principal "
            "points near the image's middle fit these views"
        )
    return upper_factor(conic[:3, :3]), plane[:3] / plane[3]


def upper_factor(conic: Floats) -> Floats:
    """Upper triangular K with K K' ~ conic and K33 = 1, shape (3, 3)."""
    lower = np.linalg.cholesky(np.linalg.inv(conic))
    k = np.linalg.inv(lower.T)
    return np.asarray(k / k[2, 2])


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    inverse: Floats
    plane: Floats
    log_scale: float


def upgrade(ends: Floats, lengths: Floats, k: Floats, plane: Floats) -> Upgrade:
    """Least squares of side / known - 1 over the nine unknowns, robustly.

    Args:
        ends: Both ends of every side seen, projective, shape (e, 2, 4).
        lengths: Lengths of those sides, shape (e,), metres.
        k: K of the first camera to start from, shape (3, 3).
        plane: p to start from, shape (3,).
    """
    x = ends[..., :3]
    inner = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2)]
    start_inverse: Floats = np.asarray(np.linalg.inv(k))

    def shape(state: _State) -> tuple[Floats, Floats, Floats, Floats]:
        ray = x @ state.inverse.T
        last = ends[..., 3] + x @ state.plane
        tiny = 1e-9 * np.abs(last).max()
        last = np.where(np.abs(last) < tiny, tiny, last)
        metric = ray / last[..., None]
        along = metric[:, 0] - metric[:, 1]
        return metric, last, along, np.linalg.norm(along, axis=-1)

    def evaluate(state: _State) -> Blocks:
        metric, last, along, length = shape(state)
        ratio = np.exp(state.log_scale) * length / lengths
        residual = ratio - 1.0
        direction = along / np.maximum(length, 1e-300)[..., None]
        changes = np.empty((*residual.shape, 9))
        by_point = np.empty((*x.shape, 8))
        for column, (i, j) in enumerate(inner):
            moved = np.zeros(x.shape)
            moved[..., i] = x[..., j] / last
            by_point[..., column] = moved
        by_point[..., 5:] = (
            -metric[..., :, None] * x[..., None, :] / last[..., None, None]
        )
        difference = by_point[:, 0] - by_point[:, 1]
        changes[..., :8] = (direction[..., None] * difference).sum(axis=-2) * (
            np.exp(state.log_scale) / lengths
        )[:, None]
        changes[..., 8] = ratio
        # Geman and McClure: rho(r) = r^2 / (1 + r^2 / c^2), as a residual.
        square = 1.0 + (residual / _ROBUST) ** 2
        robust = residual / np.sqrt(square)
        changes *= (square**-1.5)[..., None]
        n = robust.size
        return Blocks(
            robust.reshape(1, n), np.zeros((1, n, 0)), changes.reshape(1, n, 9)
        )

    def retract(state: _State, own: Floats, shared: Floats) -> _State:
        del own
        inverse = state.inverse.copy()
        for column, (i, j) in enumerate(inner):
            inverse[i, j] += shared[column]
        return _State(
            inverse, state.plane + shared[5:8], state.log_scale + float(shared[8])
        )

    blank = _State(start_inverse, plane, 0.0)
    length = shape(blank)[3]
    start = _State(start_inverse, plane, -float(np.log(np.median(length / lengths))))
    end = minimise(evaluate, retract, start, 1e-14, max_iterations=60)
    assert end is not None
    found: Floats = np.asarray(np.linalg.inv(end.state.inverse))
    return Upgrade(found, end.state.plane, float(np.exp(end.state.log_scale)), end.cost)
