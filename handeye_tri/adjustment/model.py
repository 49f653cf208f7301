"""Residuals and derivatives of cameras that watch three markers on a robot's flange.

A marker p in the flange frame is seen at ``base_from_flange @ exp(xi) @ p``, where
``xi = root @ u`` is by how much the robot missed the pose it reports, ``u ~ N(0, I)``.
Each station's u is its own unknown; shared are the cameras, their places in the base,
the markers, and systematic errors of the robot. Stations come in blocks: alone, or the
two of a half-turn where detection errors correlate. Everything runs over many stations
at once; the only loops are over cameras and chunks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from handeye_tri.adjustment.derivatives import (
    bent_rays,
    by_unknowns,
    in_camera,
    marker_points,
)
from handeye_tri.adjustment.equations import ChunkedEquations, chunks
from handeye_tri.adjustment.problem import Sides, State, Stations
from handeye_tri.adjustment.robot import RobotParameters, right_jacobian
from handeye_tri.adjustment.robust import Loss, apply_loss
from handeye_tri.camera import distort
from handeye_tri.se3 import se3_adjoint, se3_exp, se3_inverse

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

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
        return self.model.equations(self.state)


@dataclass(slots=True, eq=False)
class _Workspace:
    """Arrays of the normal equations, made at first use, and what state they are of."""

    arrays: tuple[Floats, Floats, Floats] | None = None
    state: State | None = None
    equations: ChunkedEquations | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AdjustmentModel:
    """Measurements and the choice of unknowns.

    Shared unknowns, in order: for each camera its estimated intrinsics, lens
    coefficients and place (6); the markers (9, or 6 where the sides are exact); the
    robot's parameters.

    Attributes:
        stations: What was measured.
        intrinsics: Indices of the estimated intrinsics of each camera.
        lenses: Indices of the estimated lens coefficients of each camera.
        radii: Of the markers, shape (3,), metres.
        sides: What is known of the sides.
        root: A square root of the covariance of the robot's error, (6, l).
        robot: Systematic errors as unknowns; None for none.
        loss: What replaces the square of a point's residual; None for the square.
    """

    stations: Stations
    intrinsics: tuple[tuple[int, ...], ...]
    lenses: tuple[tuple[int, ...], ...]
    radii: Floats
    sides: Sides
    root: Floats
    robot: RobotParameters | None = None
    loss: Loss | None = None
    seen: Bools = field(init=False)
    columns: tuple[slice, ...] = field(init=False)
    rig: slice = field(init=False)
    shared: int = field(init=False)
    _workspace: _Workspace = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Lay out the shared unknowns."""
        seen = self.stations.whitener.any(axis=(-2, -1))
        object.__setattr__(self, "seen", seen)
        columns, start = [], 0
        for inner, lens in zip(self.intrinsics, self.lenses, strict=True):
            stop = start + len(inner) + len(lens) + 6
            columns.append(slice(start, stop))
            start = stop
        object.__setattr__(self, "columns", tuple(columns))
        rig = slice(start, start + (6 if self.sides.exact else 9))
        object.__setattr__(self, "rig", rig)
        extra = 0 if self.robot is None else len(self.robot.labels)
        object.__setattr__(self, "shared", rig.stop + extra)
        object.__setattr__(self, "_workspace", _Workspace())

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return len(self.stations.index)

    @property
    def own(self) -> int:
        """Own unknowns of a block."""
        return int(self.stations.index.shape[1]) * int(self.root.shape[1])

    @property
    def present(self) -> int:
        """Number of stations."""
        return int((self.stations.index >= 0).sum())

    def robot_poses(self, state: State) -> tuple[Floats, Floats]:
        """Flange poses (b, w, 4, 4) before xi, and their derivative (b, w, 6, p)."""
        reported = self.stations.reported
        if self.robot is None:
            return reported, np.zeros((*reported.shape[:2], 6, 0))
        index = self.stations.index
        whole = np.tile(np.eye(4), (len(self.robot.jacobian), 1, 1))
        whole[index[index >= 0]] = reported[index >= 0]
        poses, jacobian = self.robot.poses(whole, state.robot)
        return poses[index], jacobian[index]

    def missed(self, state: State, chunk: slice) -> Floats:
        """By how much the robot missed, xi, shape (c, w, 6), m and rad."""
        width, size = self.stations.index.shape[1], self.root.shape[1]
        units = state.missed[chunk]
        units = units.reshape(len(units), width, size)
        return np.asarray(units @ self.root.T)

    def views(self, state: State) -> Iterator[tuple[slice, int, Bools, Floats]]:
        """Chunk of blocks, camera, what it sees (c, w, 3), and where (3, c, w, 3).

        Positions are x, y, z in the camera's frame, metres; on its axis where unseen.
        """
        poses, _ = self.robot_poses(state)
        for chunk in chunks(self.blocks):
            executed = poses[chunk] @ se3_exp(self.missed(state, chunk))
            points = marker_points(executed, state.markers)
            for i in range(len(self.columns)):
                seen = self.seen[i, chunk]
                yield (
                    chunk,
                    i,
                    seen,
                    in_camera(state.base_from_camera[i], points, seen),
                )

    def _outline_depth(self, depth: Floats) -> Floats:
        """Depth at which the centre of a sphere's outline is projected, (..., 3).

        The outline of a sphere at (X, Y, Z) has its centre where (X, Y, Z - r^2 / Z)
        projects, exactly so without a lens.
        """
        return np.asarray(depth - self.radii**2 / depth)

    def predicted(self, state: State, i: int, local: Floats, chunk: slice) -> Floats:
        """Centres of the markers' outlines, (c, w, 3, 2), pixels, from (3, c, w, 3)."""
        xy = np.moveaxis(local[:2] / self._outline_depth(local[2]), 0, -1)
        fx, fy, skew, cx, cy = state.intrinsics[i]
        bent = distort(state.lenses[i], xy) if state.lenses[i].any() else xy
        pixels = bent.reshape(-1, 2) @ np.array([[fx, 0.0], [skew, fy]]) + (cx, cy)
        pixels = pixels.reshape(bent.shape)
        if self.stations.bending is not None:
            pixels = pixels + self.stations.bending[i, chunk]
        return np.asarray(pixels)

    def residuals(self, state: State) -> Floats:
        """Detected less predicted pixels, (m, b, w, 3, 2), NaN where unseen."""
        result = np.full(self.stations.pixels.shape, np.nan)
        for chunk, i, seen, local in self.views(state):
            missed = self.stations.pixels[i, chunk] - self.predicted(
                state, i, local, chunk
            )
            result[i, chunk] = np.where(seen[..., None], missed, np.nan)
        return result

    def evaluate(self, state: State) -> Linearisation | None:
        """Cost at a state; None where a marker is behind a camera."""
        if state.intrinsics[:, :2].min() <= 0:
            return None
        cost = self.prior_cost(state)
        for chunk, i, seen, local in self.views(state):
            if (local[2] <= self.radii).any():
                return None
            missed = self.predicted(state, i, local, chunk)
            missed -= self.stations.pixels[i, chunk]
            whitened = self.stations.whitener[i, chunk] @ missed[..., None]
            cost += apply_loss(
                self.stations.decorrelated(whitened, chunk, seen), self.loss
            )
        extra = 0 if self.robot is None else len(self.robot.labels)
        priors = self.root.shape[1] * self.present + self.sides.count + extra
        return Linearisation(
            self,
            state,
            cost,
            2 * int(self.seen.sum()) + priors,
            self.root.shape[1] * self.present + self.shared,
        )

    def prior_cost(self, state: State) -> float:
        """What the robot's errors and the sides add to the cost."""
        cost = float(np.vdot(state.missed, state.missed))
        if self.robot is not None:
            cost += float(((state.robot / self.robot.sigma) ** 2).sum())
        if self.sides.count:
            cost += float((self.sides.residuals(state.markers)[0] ** 2).sum())
        return cost

    def rows(
        self, state: State
    ) -> Iterator[tuple[slice, int, NDArray[np.intp], Floats]]:
        """Whitened residuals (predicted less detected) with their derivatives.

        Yields:
            Chunk of blocks; camera; columns of the shared unknowns (s,); rows
            (c, w, 3, 2, own + s + 1): by own and those shared unknowns, residual last.
        """
        poses, by_robot = self.robot_poses(state)
        tail = np.arange(self.rig.start, self.shared)
        for chunk in chunks(self.blocks):
            xi = self.missed(state, chunk)
            step = se3_exp(xi)
            executed = poses[chunk] @ step
            back = se3_adjoint(se3_inverse(step)) @ by_robot[chunk]
            tangents = np.concatenate([right_jacobian(xi) @ self.root, back], axis=-1)
            points = marker_points(executed, state.markers)
            by_shared = by_unknowns(
                executed, state.markers, tangents, self.root.shape[1], self.sides.exact
            )
            for i, columns in enumerate(self.columns):
                seen = self.seen[i, chunk]
                local = in_camera(state.base_from_camera[i], points, seen)
                rows = self._camera_rows(state, i, chunk, local, by_shared)
                yield (
                    chunk,
                    i,
                    np.r_[columns, tail],
                    self.stations.decorrelated(rows, chunk, seen),
                )

    def _camera_rows(
        self, state: State, i: int, chunk: slice, local: Floats, by_shared: Floats
    ) -> Floats:
        """Rows of one camera, (c, w, 3, 2, q), see :meth:`rows`.

        Components come first in here, (2, ..., c, w, 3): sums over 2 or 3 components
        of long arrays cost a fraction of as many small matrix products.
        """
        size, width = self.root.shape[1], self.stations.index.shape[1]
        inner, free = list(self.intrinsics[i]), list(self.lenses[i])
        depth = self._outline_depth(local[2])
        xy = local[:2] / depth
        bent, by_xy, by_lens = bent_rays(state.lenses[i], xy, free)
        fx, fy, skew, cx, cy = state.intrinsics[i]
        by_xy = np.stack([fx * by_xy[0] + skew * by_xy[1], fy * by_xy[1]])
        by_point = np.empty((2, 3, *depth.shape))
        by_point[:, :2] = by_xy / depth
        by_point[:, 2] = -(by_point[:, 0] * xy[0] + by_point[:, 1] * xy[1])
        by_point[:, 2] *= 1.0 + (self.radii / local[2]) ** 2
        whitener = np.moveaxis(self.stations.whitener[i, chunk], (-2, -1), (0, 1))

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
        missed = predicted - np.moveaxis(self.stations.pixels[i, chunk], -1, 0)
        if self.stations.bending is not None:
            missed += np.moveaxis(self.stations.bending[i, chunk], -1, 0)
        column[:, -1] = white(missed[:, None])[:, 0]
        return rows

    def equations(self, state: State) -> ChunkedEquations:
        """Normal equations at a state, in arrays that the next call fills anew."""
        size, g = self.own, self.shared
        workspace = self._workspace
        if workspace.equations is not None and workspace.state is state:
            return workspace.equations
        if workspace.arrays is None:
            b = self.blocks
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
        for chunk, i, place, rows in self.rows(state):
            apply_loss(rows, self.loss)
            rows = rows.reshape(len(rows), -1, rows.shape[-1])
            product = np.swapaxes(rows[..., :size], -1, -2) @ rows
            camera = self.columns[i]
            count = camera.stop - camera.start
            own[chunk] += product[..., :size]
            cross[chunk, :, camera] += product[..., size : size + count]
            cross[chunk, :, self.rig.start :] += product[..., size + count : -1]
            own_gradient[chunk] += product[..., -1]
            flat = rows[..., size:].reshape(-1, rows.shape[-1] - size)
            total = flat.T @ flat
            shared[np.ix_(place, place)] += total[:-1, :-1]
            gradient[place] += total[:-1, -1]
        self._add_priors(state, shared, gradient)
        equations = ChunkedEquations(own, cross, shared, own_gradient, gradient)
        workspace.state, workspace.equations = state, equations
        return equations

    def _add_priors(self, state: State, shared: Floats, gradient: Floats) -> None:
        if self.robot is not None:
            extra = np.arange(self.rig.stop, self.shared)
            shared[extra, extra] += self.robot.sigma**-2
            gradient[extra] += state.robot / self.robot.sigma**2
        if self.sides.count:
            missed, slope = self.sides.residuals(state.markers)
            shared[self.rig, self.rig] += slope.T @ slope
            gradient[self.rig] += slope.T @ missed

    def retract(self, state: State, own: Floats, shared: Floats) -> State:
        """Move a state by steps of own (b, w l) and shared (g,) unknowns."""
        intrinsics, places = state.intrinsics.copy(), state.base_from_camera.copy()
        lenses = []
        for i, columns in enumerate(self.columns):
            step = shared[columns]
            inner, count = list(self.intrinsics[i]), len(self.intrinsics[i])
            intrinsics[i, inner] += step[:count]
            lens = state.lenses[i].copy()
            lens[list(self.lenses[i])] += step[count:-6]
            lenses.append(lens)
            places[i] = places[i] @ se3_exp(step[-6:])
        rig = shared[self.rig]
        if self.sides.exact:
            motion = se3_exp(rig)
            markers = state.markers @ motion[:3, :3].T + motion[:3, 3]
        else:
            markers = state.markers + rig.reshape(3, 3)
        return State(
            intrinsics,
            tuple(lenses),
            places,
            markers,
            state.robot + shared[self.rig.stop :],
            state.missed + own,
        )
