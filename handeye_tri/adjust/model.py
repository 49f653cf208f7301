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

from handeye_tri.adjust.equations import ChunkedEquations, chunks
from handeye_tri.adjust.problem import Sides, State, Stations
from handeye_tri.adjust.robot import RobotParameters, right_jacobian
from handeye_tri.adjust.robust import Loss, apply_loss
from handeye_tri.camera import distort, project_jacobians
from handeye_tri.se3 import hat, se3_adjoint, se3_exp, se3_inverse

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


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
    _buffers: list[Floats] = field(init=False, repr=False)

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
        object.__setattr__(self, "_buffers", [])

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
        """Chunk of blocks, camera, what it sees (c, w, 3), and where (c, w, 3, 3).

        Positions are in the camera's frame, metres; on its axis where unseen.
        """
        poses, _ = self.robot_poses(state)
        for chunk in chunks(self.blocks):
            executed = poses[chunk] @ se3_exp(self.missed(state, chunk))
            points = _points(executed, state.markers)
            for i in range(len(self.columns)):
                seen = self.seen[i, chunk]
                yield chunk, i, seen, self._local(state, i, points, seen)

    def _local(self, state: State, i: int, points: Floats, seen: Bools) -> Floats:
        """Markers in the frame of camera i, (c, w, 3, 3); on its axis where unseen."""
        camera = state.base_from_camera[i]
        local = (points - camera[:3, 3]) @ camera[:3, :3]
        return np.where(seen[..., None], local, (0.0, 0.0, 1.0))

    def predicted(self, state: State, i: int, local: Floats, chunk: slice) -> Floats:
        """Centres of the markers' outlines, (c, w, 3, 2), pixels.

        The outline of a sphere at (X, Y, Z) has its centre where (X, Y, Z - r^2 / Z)
        projects, exactly so without a lens.
        """
        depth = local[..., 2] - self.radii**2 / local[..., 2]
        xy = local[..., :2] / depth[..., None]
        fx, fy, skew, cx, cy = state.intrinsics[i]
        bent = distort(state.lenses[i], xy) if state.lenses[i].any() else xy
        pixels = bent @ np.array([[fx, 0.0], [skew, fy]]) + (cx, cy)
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
            if (local[..., 2] <= self.radii).any():
                return None
            missed = self.predicted(state, i, local, chunk)
            missed -= self.stations.pixels[i, chunk]
            whitened = self.stations.whitener[i, chunk] @ missed[..., None]
            cost += apply_loss(self._mixed(whitened, chunk, seen), self.loss)
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

    def _mixed(self, rows: Floats, chunk: slice, seen: Bools) -> Floats:
        """Decorrelate whitened rows (c, w, 3, 2, q) of one marker seen twice."""
        if self.stations.on_axis is None or self.stations.correlation == 0.0:
            return rows
        twice = seen[:, 0] & seen[:, 1] & self.stations.on_axis[chunk]
        # Inverse symmetric square root of [[1, c], [c, 1]].
        total = 1.0 / np.sqrt(1.0 + self.stations.correlation)
        difference = 1.0 / np.sqrt(1.0 - self.stations.correlation)
        same, other = 0.5 * (total + difference), 0.5 * (total - difference)
        mixing = np.where(
            twice[..., None, None], [[same, other], [other, same]], np.eye(2)
        )
        return np.asarray(np.einsum("bkuv,bvkpq->bukpq", mixing, rows))

    def rows(
        self, state: State
    ) -> Iterator[tuple[slice, int, NDArray[np.intp], Floats]]:
        """Whitened residuals (predicted less detected) with their derivatives.

        Yields:
            Chunk of blocks; camera; columns of the shared unknowns (s,); rows
            (c, w, 3, 2, own + s + 1): by own and those shared unknowns, residual last.
        """
        poses, by_robot = self.robot_poses(state)
        by_rig = _by_rig(state.markers, self.sides.exact)
        tail = np.arange(self.rig.start, self.shared)
        for chunk in chunks(self.blocks):
            xi = self.missed(state, chunk)
            step = se3_exp(xi)
            executed = poses[chunk] @ step
            back = se3_adjoint(se3_inverse(step)) @ by_robot[chunk]
            tangents = np.concatenate([right_jacobian(xi) @ self.root, back], axis=-1)
            points = _points(executed, state.markers)
            by_shared = _by_unknowns(
                executed, state.markers, tangents, by_rig, self.root.shape[1]
            )
            for i, columns in enumerate(self.columns):
                seen = self.seen[i, chunk]
                rows = self._camera_rows(state, i, chunk, points, by_shared, seen)
                yield (
                    chunk,
                    i,
                    np.r_[columns, tail],
                    self._mixed(rows, chunk, seen),
                )

    def _camera_rows(
        self,
        state: State,
        i: int,
        chunk: slice,
        points: Floats,
        by_shared: Floats,
        seen: Bools,
    ) -> Floats:
        """Rows of one camera, (c, w, 3, 2, q), see :meth:`rows`."""
        size = self.root.shape[1]
        local = self._local(state, i, points, seen)
        axial = local.copy()
        axial[..., 2] -= self.radii**2 / local[..., 2]
        predicted, by_point, by_inner, by_lens = project_jacobians(
            state.intrinsics[i], state.lenses[i], axial
        )
        by_point[..., 2] *= (1.0 + (self.radii / local[..., 2]) ** 2)[..., None]
        if self.stations.bending is not None:
            predicted = predicted + self.stations.bending[i, chunk]
        whitener = self.stations.whitener[i, chunk]
        by_point = whitener @ by_point
        by_base = by_point @ state.base_from_camera[i, :3, :3].T
        moved = by_base @ by_shared
        inner, lens = list(self.intrinsics[i]), list(self.lenses[i])
        own = moved[..., :size]
        if self.stations.index.shape[1] == 2:
            own = np.zeros((*moved.shape[:-1], 2 * size))
            own[:, 0, ..., :size] = moved[:, 0, ..., :size]
            own[:, 1, ..., size:] = moved[:, 1, ..., :size]
        missed = predicted - self.stations.pixels[i, chunk]
        return np.concatenate(
            [
                own,
                whitener @ by_inner[..., inner],
                whitener @ by_lens[..., lens],
                -by_point,
                by_point @ hat(local),
                moved[..., size:],
                whitener @ missed[..., None],
            ],
            axis=-1,
        )

    def equations(self, state: State) -> ChunkedEquations:
        """Normal equations at a state, in arrays that the next call fills anew."""
        size, g = self.own, self.shared
        if not self._buffers:
            shapes = ((size, size), (size, g), (size,))
            self._buffers.extend(np.empty((self.blocks, *shape)) for shape in shapes)
        own, cross, own_gradient = self._buffers
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
        return ChunkedEquations(own, cross, shared, own_gradient, gradient)

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


def _points(executed: Floats, markers: Floats) -> Floats:
    """Markers in the base, shape (c, w, 3, 3), metres."""
    rotation = np.swapaxes(executed[..., :3, :3], -1, -2)
    return np.asarray(markers @ rotation + executed[..., None, :3, 3])


def _by_rig(markers: Floats, exact: bool) -> Floats:
    """Derivative of each marker in the flange by the rig's unknowns, (3, 3, 6 or 9)."""
    if exact:
        eye = np.broadcast_to(np.eye(3), (3, 3, 3))
        return np.concatenate([eye, -hat(markers)], axis=-1)
    return np.asarray(np.eye(9).reshape(3, 3, 9))


def _by_unknowns(
    executed: Floats, markers: Floats, tangents: Floats, by_rig: Floats, own: int
) -> Floats:
    """Derivative of the markers in the base by all but the cameras.

    Args:
        executed: base_from_flange, (c, w, 4, 4).
        markers: In the flange, (3, 3).
        tangents: Derivative of the flange's right tangent by l own unknowns and p
            parameters of the robot, (c, w, 6, l + p).
        by_rig: Derivative of the markers by r unknowns, (3, 3, r).
        own: The number l.

    Returns:
        By own unknowns, the rig's, the robot's: shape (c, w, 3, 3, l + r + p).
    """
    rotation = executed[..., None, :3, :3]
    moved = tangents[..., None, :3, :] - hat(markers) @ tangents[..., None, 3:, :]
    rig = np.broadcast_to(by_rig, (*executed.shape[:2], *by_rig.shape))
    whole = np.concatenate([moved[..., :own], rig, moved[..., own:]], axis=-1)
    return np.asarray(rotation @ whole)
