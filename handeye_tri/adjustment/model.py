"""Cameras that watch three markers on a robot's flange: unknowns and predictions.

A marker p in the flange frame is seen at ``base_from_flange @ exp(xi) @ p``, where
``xi = root @ u`` is by how much the robot missed the pose it reports, ``u ~ N(0, I)``.
Each station's u is its own unknown; shared are the cameras, their places in the base,
the markers on each mount, and systematic errors of the robot. Stations come in blocks:
alone, or the two of a half-turn where detection errors correlate. Everything runs over
many stations at once; the only loops are over cameras and chunks, each of one mount.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from handeye_tri.adjustment.derivatives import in_camera, marker_points
from handeye_tri.adjustment.equations import ChunkedEquations, chunks
from handeye_tri.adjustment.problem import Sides, State, Stations
from handeye_tri.adjustment.robot import RobotParameters
from handeye_tri.adjustment.robust import Loss
from handeye_tri.camera import distort
from handeye_tri.se3 import se3_exp

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def _successive(counts: Sequence[int]) -> tuple[slice, ...]:
    """Slices of these lengths, one after the other."""
    stops = np.cumsum(counts).tolist()
    return tuple(
        slice(stop - count, stop) for count, stop in zip(counts, stops, strict=True)
    )


@dataclass(slots=True, eq=False)
class Workspace:
    """Arrays of the normal equations, made at first use, and what state they are of."""

    arrays: tuple[Floats, Floats, Floats] | None = None
    state: State | None = None
    equations: ChunkedEquations | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AdjustmentModel:
    """Measurements and the choice of unknowns.

    Shared unknowns, in order: for each camera its estimated intrinsics, lens
    coefficients and place (6); for each mount its markers (9, or 6 where the sides are
    exact); the robot's parameters.

    Attributes:
        stations: What was measured.
        intrinsics: Indices of the estimated intrinsics of each camera.
        lenses: Indices of the estimated lens coefficients of each camera.
        radii: Of the markers, shape (3,), metres.
        sides: What is known of the sides, on each mount anew.
        root: A square root of the covariance of the robot's error, (6, l).
        robot: Systematic errors as unknowns; None for none.
        loss: What replaces the square of a point's residual; None for the square.
        seen: Which markers each camera sees, (m, b, w, 3).
        parts: The blocks of each mount.
        columns: The shared unknowns of each camera.
        rigs: Those of each mount.
        extra: Those of the robot.
        workspace: Where normal equations are put.
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
    parts: tuple[slice, ...] = field(init=False)
    columns: tuple[slice, ...] = field(init=False)
    rigs: tuple[slice, ...] = field(init=False)
    extra: slice = field(init=False)
    workspace: Workspace = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Lay out the shared unknowns."""
        seen = self.stations.whitener.any(axis=(-2, -1))
        object.__setattr__(self, "seen", seen)
        parts = _successive(np.bincount(self.stations.mounts).tolist())
        object.__setattr__(self, "parts", parts)
        m = len(self.intrinsics)
        places = _successive(
            [
                len(inner) + len(lens) + 6
                for inner, lens in zip(self.intrinsics, self.lenses, strict=True)
            ]
            + [6 if self.sides.exact else 9] * len(parts)
            + [0 if self.robot is None else len(self.robot.labels)]
        )
        object.__setattr__(self, "columns", places[:m])
        object.__setattr__(self, "rigs", places[m:-1])
        object.__setattr__(self, "extra", places[-1])
        object.__setattr__(self, "workspace", Workspace())

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return len(self.stations.index)

    @property
    def own(self) -> int:
        """Own unknowns of a block."""
        return int(self.stations.index.shape[1]) * int(self.root.shape[1])

    @property
    def shared(self) -> int:
        """Number of shared unknowns."""
        return int(self.extra.stop)

    @property
    def present(self) -> int:
        """Number of stations."""
        return int((self.stations.index >= 0).sum())

    def chunks(self) -> Iterator[tuple[slice, int]]:
        """Chunks of blocks, each with its mount."""
        for mount, part in enumerate(self.parts):
            for chunk in chunks(part.stop, part.start):
                yield chunk, mount

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
        for chunk, mount in self.chunks():
            executed = poses[chunk] @ se3_exp(self.missed(state, chunk))
            points = marker_points(executed, state.markers[mount])
            for i in range(len(self.columns)):
                seen = self.seen[i, chunk]
                yield (
                    chunk,
                    i,
                    seen,
                    in_camera(state.base_from_camera[i], points, seen),
                )

    def outline_depth(self, depth: Floats) -> Floats:
        """Depth at which the centre of a sphere's outline is projected, (..., 3).

        The outline of a sphere at (X, Y, Z) has its centre where (X, Y, Z - r^2 / Z)
        projects, exactly so without a lens.
        """
        return np.asarray(depth - self.radii**2 / depth)

    def predicted(self, state: State, i: int, local: Floats, chunk: slice) -> Floats:
        """Centres of the markers' outlines, (c, w, 3, 2), pixels, from (3, c, w, 3)."""
        xy = np.moveaxis(local[:2] / self.outline_depth(local[2]), 0, -1)
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

    def prior_cost(self, state: State) -> float:
        """What the robot's errors and the sides add to the cost."""
        cost = float(np.vdot(state.missed, state.missed))
        if self.robot is not None:
            cost += float(((state.robot / self.robot.sigma) ** 2).sum())
        if self.sides.count:
            for markers in state.markers:
                cost += float((self.sides.residuals(markers)[0] ** 2).sum())
        return cost

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
        markers = state.markers.copy()
        for mount, rig in enumerate(self.rigs):
            if self.sides.exact:
                motion = se3_exp(shared[rig])
                markers[mount] = markers[mount] @ motion[:3, :3].T + motion[:3, 3]
            else:
                markers[mount] += shared[rig].reshape(3, 3)
        return State(
            intrinsics,
            tuple(lenses),
            places,
            markers,
            state.robot + shared[self.extra],
            state.missed + own,
        )
