"""A model's cost at one state, and its derivatives as normal equations."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.adjustment.derivatives import (
    bent_rays,
    by_unknowns,
    in_camera,
    marker_points,
)
from handeye_tri.adjustment.equations import ChunkedEquations
from handeye_tri.adjustment.model import AdjustmentModel
from handeye_tri.adjustment.problem import State
from handeye_tri.adjustment.robot import right_jacobian
from handeye_tri.adjustment.robust import apply_loss
from handeye_tri.se3 import se3_adjoint, se3_exp, se3_inverse

Floats = NDArray[np.float64]

# By fx, fy, skew, cx, cy: which pixel coordinate moves, by which part of the ray.
_INTRINSICS = ((0, 0), (1, 1), (0, 1), (0, None), (1, None))


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """The cost at one state, and on demand its normal equations.

    Attributes:
        model: What is adjusted.
        state: Where.
        cost: Sum of squared whitened residuals (their robust loss, if one is asked).
        observations: Number of residuals, priors included.
        unknowns: Number of unknowns.
    """

    model: AdjustmentModel
    state: State
    cost: float
    observations: int
    unknowns: int

    def equations(self) -> ChunkedEquations:
        """The normal equations at this state.

        Their arrays belong to the model and are filled anew by its next call: at
        100,000 stations they are most of the memory.
        """
        return normal_equations(self.model, self.state)


def evaluate(model: AdjustmentModel, state: State) -> Linearisation | None:
    """Cost at a state; None where a marker is behind a camera."""
    if state.intrinsics[:, :2].min() <= 0:
        return None
    cost = model.prior_cost(state)
    for chunk, i, seen, local in model.views(state):
        if (local[2] <= model.radii).any():
            return None
        missed = model.predicted(state, i, local, chunk)
        missed -= model.stations.pixels[i, chunk]
        whitened = model.stations.whitener[i, chunk] @ missed[..., None]
        cost += apply_loss(
            model.stations.decorrelated(whitened, chunk, seen), model.loss
        )
    extra = 0 if model.robot is None else len(model.robot.labels)
    sides = len(model.rigs) * model.sides.count
    priors = model.root.shape[1] * model.present + sides + extra
    return Linearisation(
        model,
        state,
        cost,
        2 * int(model.seen.sum()) + priors,
        model.root.shape[1] * model.present + model.shared,
    )


def whitened_rows(
    model: AdjustmentModel, state: State
) -> Iterator[tuple[slice, int, int, Floats]]:
    """Whitened residuals (predicted less detected) with their derivatives.

    Yields:
        Chunk of blocks; camera; mount; rows (c, w, 3, 2, own + s + 1): by own
        unknowns, the camera's, the mount's and the robot's, residual last.
    """
    poses, by_robot = model.robot_poses(state)
    for chunk, mount in model.chunks():
        markers = state.markers[mount]
        xi = model.missed(state, chunk)
        step = se3_exp(xi)
        executed = poses[chunk] @ step
        back = se3_adjoint(se3_inverse(step)) @ by_robot[chunk]
        tangents = np.concatenate([right_jacobian(xi) @ model.root, back], axis=-1)
        points = marker_points(executed, markers)
        by_shared = by_unknowns(
            executed, markers, tangents, model.root.shape[1], model.sides.exact
        )
        for i in range(len(model.columns)):
            seen = model.seen[i, chunk]
            local = in_camera(state.base_from_camera[i], points, seen)
            rows = _camera_rows(model, state, i, chunk, local, by_shared)
            yield chunk, i, mount, model.stations.decorrelated(rows, chunk, seen)


def _camera_rows(
    model: AdjustmentModel,
    state: State,
    i: int,
    chunk: slice,
    local: Floats,
    by_shared: Floats,
) -> Floats:
    """Rows of one camera, (c, w, 3, 2, q), see :func:`whitened_rows`.

    Components come first in here, (2, ..., c, w, 3): sums over 2 or 3 components
    of long arrays cost a fraction of as many small matrix products.
    """
    size, width = model.root.shape[1], model.stations.index.shape[1]
    inner, free = list(model.intrinsics[i]), list(model.lenses[i])
    depth = model.outline_depth(local[2])
    xy = local[:2] / depth
    bent, by_xy, by_lens = bent_rays(state.lenses[i], xy, free)
    fx, fy, skew, cx, cy = state.intrinsics[i]
    by_xy = np.stack([fx * by_xy[0] + skew * by_xy[1], fy * by_xy[1]])
    by_point = np.empty((2, 3, *depth.shape))
    by_point[:, :2] = by_xy / depth
    by_point[:, 2] = -(by_point[:, 0] * xy[0] + by_point[:, 1] * xy[1])
    by_point[:, 2] *= 1.0 + (model.radii / local[2]) ** 2
    whitener = np.moveaxis(model.stations.whitener[i, chunk], (-2, -1), (0, 1))

    def white(pair: Floats) -> Floats:
        """Whiten (2, k, ...) along its first axis."""
        return np.asarray(whitener[:, :1] * pair[0] + whitener[:, 1:] * pair[1])

    by_point = white(by_point)
    turned = state.base_from_camera[i, :3, :3]
    by_base = (turned @ by_point.reshape(2, 3, -1)).reshape(by_point.shape)
    moved = np.moveaxis(by_base, (0, 1), (-2, -1)) @ by_shared
    tail = moved.shape[-1] - size
    start = width * size
    count = start + len(inner) + len(free) + 6 + tail + 1
    rows = np.zeros((*depth.shape, 2, count))
    for station in range(width):
        own = slice(station * size, (station + 1) * size)
        rows[:, station, ..., own] = moved[:, station, ..., :size]
    column = np.moveaxis(rows, (-2, -1), (0, 1))
    # By fx, fy, skew, cx, cy: pixels are K times the bent ray.
    for k in inner:
        of_row, factor = _INTRINSICS[k]
        column[:, start] = whitener[:, of_row]
        if factor is not None:
            column[:, start] *= bent[factor]
        start += 1
    if by_lens is not None:
        upper = np.stack([fx * by_lens[0] + skew * by_lens[1], fy * by_lens[1]])
        column[:, start : start + len(free)] = white(upper)
        start += len(free)
    column[:, start : start + 3] = -by_point
    # A row b of derivatives by the point turns into b x p.
    for k in range(3):
        one, two = (k + 1) % 3, (k + 2) % 3
        column[:, start + 3 + k] = (
            by_point[:, one] * local[two] - by_point[:, two] * local[one]
        )
    start += 6
    rows[..., start : start + tail] = moved[..., size:]
    predicted = np.stack([fx * bent[0] + skew * bent[1] + cx, fy * bent[1] + cy])
    missed = predicted - np.moveaxis(model.stations.pixels[i, chunk], -1, 0)
    if model.stations.bending is not None:
        missed += np.moveaxis(model.stations.bending[i, chunk], -1, 0)
    column[:, -1] = white(missed[:, None])[:, 0]
    return rows


def normal_equations(model: AdjustmentModel, state: State) -> ChunkedEquations:
    """Normal equations at a state, in arrays that the next call fills anew."""
    size, g = model.own, model.shared
    workspace = model.workspace
    if workspace.equations is not None and workspace.state is state:
        return workspace.equations
    if workspace.arrays is None:
        b = model.blocks
        workspace.arrays = (
            np.empty((b, size, size)),
            np.empty((b, size, g)),
            np.empty((b, size)),
        )
    own, cross, own_gradient = workspace.arrays
    shared, gradient = np.zeros((g, g)), np.zeros(g)
    own[:] = np.eye(size)
    cross[:] = 0.0
    own_gradient[:] = state.missed
    for chunk, i, mount, rows in whitened_rows(model, state):
        apply_loss(rows, model.loss)
        rows = rows.reshape(len(rows), -1, rows.shape[-1])
        product = np.swapaxes(rows[..., :size], -1, -2) @ rows
        own[chunk] += product[..., :size]
        stop = size
        for columns in (model.columns[i], model.rigs[mount], model.extra):
            start, stop = stop, stop + columns.stop - columns.start
            cross[chunk, :, columns] += product[..., start:stop]
        own_gradient[chunk] += product[..., -1]
        place = np.r_[model.columns[i], model.rigs[mount], model.extra]
        flat = rows[..., size:].reshape(-1, rows.shape[-1] - size)
        total = flat.T @ flat
        shared[np.ix_(place, place)] += total[:-1, :-1]
        gradient[place] += total[:-1, -1]
    _add_priors(model, state, shared, gradient)
    equations = ChunkedEquations(own, cross, shared, own_gradient, gradient)
    workspace.state, workspace.equations = state, equations
    return equations


def _add_priors(
    model: AdjustmentModel, state: State, shared: Floats, gradient: Floats
) -> None:
    if model.robot is not None:
        extra = np.arange(model.extra.start, model.extra.stop)
        shared[extra, extra] += model.robot.sigma**-2
        gradient[extra] += state.robot / model.robot.sigma**2
    if model.sides.count:
        for rig, markers in zip(model.rigs, state.markers, strict=True):
            missed, slope = model.sides.residuals(markers)
            shared[rig, rig] += slope.T @ slope
            gradient[rig] += slope.T @ missed
