"""Residuals and derivatives of m cameras that see one triangle at many stations.

Stations come in blocks: alone, or the two of a half-turn. A block's own unknowns are
the pose of its first station and, for a half-turn, by how much the turn missed:
``after = before @ half_turn @ exp(root @ turn)`` with ``turn ~ N(0, I)``, or free. The
line of the half-turns in the triangle's frame is shared and unknown, so that neither an
inexact robot nor an inexact rig is taken for exact. Everything runs over blocks at
once; the only loop is over cameras.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.least_squares import NormalEquations
from handeye_tri.camera import project_jacobians
from handeye_tri.se3 import (
    hat,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_left_jacobian_inverse,
)

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# A half-turn about the z axis of a line's frame, and what of a tangent of that frame
# changes it: the foot (x, y) and the direction (rotations about x, y).
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
_LINE_TANGENT = (se3_adjoint(_HALF_TURN) - np.eye(6))[:, (0, 1, 3, 4)]
_LINE_UNKNOWNS = 4


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """One value of all unknowns.

    Attributes:
        intrinsics: fx, fy, skew, cx, cy of each camera, shape (m, 5), pixels.
        lenses: Lens coefficients of each camera, (5,) or (8,).
        reference_from_camera: Shape (m, 4, 4), metres; the first stays put.
        first: reference_from_triangle at each block's first station, (b, 4, 4).
        turn: Deviation of each half-turn in units of its prior, (b, 6) or (b, 0).
        lines: triangle_from_line, whose z axis the half-turns turn about; one for each
            kind of axis, (a, 4, 4), metres.
    """

    intrinsics: Floats
    lenses: tuple[Floats, ...]
    reference_from_camera: Floats
    first: Floats
    turn: Floats
    lines: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """What ties the two stations of a block together.

    Attributes:
        paired: Whether the block has a second station, shape (b,).
        kind: Index of each block's line, shape (b,).
        root: Square root of the covariance of each turn's tangent, (6, 6), m, rad; None
            where the two poses are independent and only detection errors tie them.
        correlation: Of the detection errors of one marker before and after, (b, 3).
    """

    paired: Bools
    kind: NDArray[np.intp]
    root: Floats | None
    correlation: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """Normal equations at one state.

    Attributes:
        cost: Sum of squared whitened residuals (their robust loss, if one is asked).
        observations: Number of residuals, priors included.
        unknowns: Number of unknowns.
        normal: The equations.
        residuals: Predicted less detected, (m, b, w, 3, 2), px, 0 where unseen.
    """

    cost: float
    observations: int
    unknowns: int
    normal: NormalEquations
    residuals: Floats

    def equations(self) -> NormalEquations:
        """The normal equations at this state."""
        return self.normal


@dataclass(frozen=True, slots=True, eq=False)
class BundleModel:
    """Measurements and the choice of unknowns.

    Shared unknowns, in order: for each camera its estimated intrinsics, lens
    coefficients, and, after the first camera, its place (6); then 4 for each line.

    Attributes:
        points: A, B, C in the triangle's frame, (3, 3), metres.
        pixels: Shape (m, b, w, 3, 2): camera, block, station in the block, marker; 0
            where unseen.
        whitener: W with W'W the inverse covariance, (m, b, w, 3, 2, 2); 0 where unseen.
        intrinsics: Indices of the estimated intrinsics of each camera.
        lenses: Indices of the estimated lens coefficients of each camera.
        turns: What ties the two stations of a block, w = 2; None with w = 1.
        huber: Whitened distance beyond which a point counts linearly; inf for none.
    """

    points: Floats
    pixels: Floats
    whitener: Floats
    intrinsics: tuple[tuple[int, ...], ...]
    lenses: tuple[tuple[int, ...], ...]
    turns: Turns | None = None
    huber: float = np.inf
    seen: Bools = field(init=False)
    columns: tuple[slice, ...] = field(init=False)
    shared: int = field(init=False)

    def __post_init__(self) -> None:
        """Lay out the shared unknowns."""
        seen = np.abs(self.whitener).sum(axis=(-2, -1)) > 0
        object.__setattr__(self, "seen", seen)
        columns, start = [], 0
        for i, (inner, lens) in enumerate(
            zip(self.intrinsics, self.lenses, strict=True)
        ):
            stop = start + len(inner) + len(lens) + (6 if i else 0)
            columns.append(slice(start, stop))
            start = stop
        object.__setattr__(self, "columns", tuple(columns))
        lines = int(self.turns.kind.max()) + 1 if self.turns and self.tied else 0
        object.__setattr__(self, "shared", start + _LINE_UNKNOWNS * lines)

    @property
    def own(self) -> int:
        """Own unknowns of a block."""
        return 6 if self.turns is None else 12

    @property
    def tied(self) -> bool:
        """Whether the poses of a half-turn's two stations depend on each other."""
        return self.turns is not None and self.turns.root is not None

    @property
    def cameras_stop(self) -> int:
        """Number of shared unknowns that belong to cameras."""
        return int(self.columns[-1].stop)

    def _turned(self, state: State, turns: Turns) -> tuple[Floats, Floats, Floats]:
        """Second stations, and how their tangents follow from the unknowns.

        Returns:
            reference_from_triangle (b, 4, 4); derivative of its tangent by the block's
            own unknowns (b, 6, 12) and by those of its line (b, 6, 4).
        """
        line = state.lines[turns.kind]
        motion = line @ _HALF_TURN @ se3_inverse(line)
        root = np.eye(6) if turns.root is None else turns.root
        xi = state.turn @ root.T
        missed = se3_exp(xi)
        after = motion @ missed
        by_own = np.empty((len(xi), 6, 12))
        by_own[..., :6] = se3_adjoint(se3_inverse(after))
        by_own[..., 6:] = np.linalg.inv(se3_left_jacobian_inverse(-xi)) @ root
        by_line = se3_adjoint(se3_inverse(missed) @ line) @ _LINE_TANGENT
        return state.first @ after, by_own, by_line

    def poses(self, state: State) -> Floats:
        """reference_from_triangle at every station, shape (b, w, 4, 4), metres."""
        if self.turns is None:
            return state.first[:, None]
        return np.stack([state.first, self._turned(state, self.turns)[0]], axis=1)

    def station_covariance(self, state: State, own: Floats, cross: Floats) -> Floats:
        """Covariance of each station's tangent, shape (b, w, 6, 6).

        Args:
            state: Where to linearise.
            own: Covariance of each block's own unknowns, (b, l, l).
            cross: With the unknowns of the lines, (b, l, 4 a), and below it theirs:
                shape (b, l + 4 a, 4 a).
        """
        if self.turns is None:
            return own[:, None]
        _, by_own, by_line = self._turned(state, self.turns)
        blocks, size = len(own), own.shape[-1]
        rows = np.zeros((blocks, 6, size + cross.shape[-1]))
        rows[..., :size] = by_own
        if not self.tied:
            by_line = by_line[..., :0]
        place = _LINE_UNKNOWNS * self.turns.kind[:, None] + np.arange(by_line.shape[-1])
        place = np.repeat(size + place[:, None], 6, axis=1)
        np.put_along_axis(rows, place, by_line, axis=2)
        whole = np.empty((blocks, rows.shape[-1], rows.shape[-1]))
        whole[:, :size, :size] = own
        whole[:, :, size:] = cross
        whole[:, size:, :size] = np.swapaxes(cross[:, :size], -1, -2)
        after = rows @ whole @ np.swapaxes(rows, -1, -2)
        return np.stack([own[:, :6, :6], after], axis=1)

    def evaluate(self, state: State) -> Linearisation | None:
        """Normal equations at a state; None where a marker is behind a camera."""
        blocks, width = self.pixels.shape[1:3]
        size, g = self.own, self.shared
        by_own = by_line = mixing = None
        stations = state.first[:, None]
        if self.turns is not None:
            second, by_own, by_line = self._turned(state, self.turns)
            stations = np.stack([state.first, second], axis=1)
            if self.turns.correlation.any():
                mixing = _mixing(self.turns.correlation)
        rotation = stations[..., :3, :3]
        points = (
            self.points @ np.swapaxes(rotation, -1, -2) + stations[..., None, :3, 3]
        )
        by_turning = -rotation[:, :, None] @ hat(self.points)
        own = np.zeros((blocks, size, size))
        own_gradient = np.zeros((blocks, size))
        cross = np.zeros((blocks, size, g))
        shared, shared_gradient = np.zeros((g, g)), np.zeros(g)
        cost = 0.0
        missed = np.zeros(self.pixels.shape)
        for i, columns in enumerate(self.columns):
            camera = state.reference_from_camera[i]
            seen = self.seen[i]
            local = (points - camera[:3, 3]) @ camera[:3, :3]
            local = np.where(seen[..., None], local, (0.0, 0.0, 1.0))
            if state.intrinsics[i, :2].min() <= 0 or local[..., 2].min() <= 0:
                return None
            predicted, by_point, by_inner, by_lens = project_jacobians(
                state.intrinsics[i], state.lenses[i], local
            )
            missed[i] = np.where(seen[..., None], predicted - self.pixels[i], 0.0)
            whitener = self.whitener[i]
            by_point = whitener @ by_point
            by_reference = by_point @ camera[:3, :3].T
            parts = [
                by_reference @ rotation[:, :, None],
                by_reference @ by_turning,
                whitener @ by_inner[..., self.intrinsics[i]],
                whitener @ by_lens[..., self.lenses[i]],
            ]
            if i:
                parts += [-by_point, by_point @ hat(local)]
            parts.append(whitener @ missed[i][..., None])
            rows = np.concatenate(parts, axis=-1)
            place = np.r_[columns]
            if by_own is not None and by_line is not None:
                rows = self._chain(rows, by_own, by_line, g - self.cameras_stop)
                place = np.r_[columns, self.cameras_stop : g]
            if mixing is not None:
                both = (seen[:, 0] & seen[:, 1])[:, :, None, None]
                mixed = np.where(both, mixing, np.eye(2))
                rows = np.einsum("bkuv,bvkpq->bukpq", mixed, rows)
            cost += _robust(rows, self.huber)
            rows = rows.reshape(blocks, width * 6, -1)
            product = np.swapaxes(rows[..., :size], -1, -2) @ rows
            own += product[..., :size]
            cross[..., place] += product[..., size:-1]
            own_gradient += product[..., -1]
            flat = rows[..., size:].reshape(-1, rows.shape[-1] - size)
            total = flat.T @ flat
            shared[np.ix_(place, place)] += total[:-1, :-1]
            shared_gradient[place] += total[:-1, -1]
        observations = 2 * int(self.seen.sum())
        unknowns = 6 * blocks + g
        if self.turns is not None:
            paired = self.turns.paired
            unknowns += 6 * int(paired.sum())
            # Without a second station nothing depends on the turn: it stays zero.
            own[~paired, 6:, 6:] = np.eye(6)
            if self.tied:
                cost += float(np.vdot(state.turn, state.turn))
                own[paired, 6:, 6:] += np.eye(6)
                own_gradient[:, 6:] += state.turn
                observations += 6 * int(paired.sum())
        return Linearisation(
            cost,
            observations,
            unknowns,
            NormalEquations(own, cross, shared, own_gradient, shared_gradient),
            missed,
        )

    def _chain(
        self, rows: Floats, by_own: Floats, by_line: Floats, lines: int
    ) -> Floats:
        """From the two stations' tangents to the block's own unknowns and the lines'.

        Args:
            rows: Shape (b, 2, 3, 2, 6 + c + 1): station, camera, residual.
            by_own: Shape (b, 6, 12).
            by_line: Shape (b, 6, 4).
            lines: Number of the lines' unknowns.

        Returns:
            Shape (b, 2, 3, 2, 12 + c + lines + 1).
        """
        assert self.turns is not None
        result = np.zeros((*rows.shape[:-1], rows.shape[-1] + 6 + lines))
        tangent = rows[:, 1, ..., :6]
        result[:, 0, ..., :6] = rows[:, 0, ..., :6]
        result[:, 1, ..., :12] = tangent @ by_own[:, None]
        result[..., 12 : -lines - 1] = rows[..., 6:-1]
        moved = tangent @ by_line[:, None]
        for kind in range(lines // _LINE_UNKNOWNS):
            mine = self.turns.kind == kind
            start = result.shape[-1] - 1 - lines + _LINE_UNKNOWNS * kind
            result[mine, 1, ..., start : start + _LINE_UNKNOWNS] = moved[mine]
        result[..., -1] = rows[..., -1]
        return result

    def retract(self, state: State, own: Floats, shared: Floats) -> State:
        """Move a state by steps of own (b, l) and shared (g,) unknowns."""
        intrinsics, places = state.intrinsics.copy(), state.reference_from_camera.copy()
        lenses = []
        for i, columns in enumerate(self.columns):
            step = shared[columns]
            inner, count = list(self.intrinsics[i]), len(self.intrinsics[i])
            intrinsics[i, inner] += step[:count]
            lens = state.lenses[i].copy()
            lens[list(self.lenses[i])] += step[count : count + len(self.lenses[i])]
            lenses.append(lens)
            if i:
                places[i] = places[i] @ se3_exp(step[-6:])
        lines, turn = state.lines, state.turn
        if self.turns is not None:
            turn = turn + own[:, 6:]
        if self.tied:
            tangent = np.zeros((len(lines), 6))
            tangent[:, (0, 1, 3, 4)] = shared[self.cameras_stop :].reshape(-1, 4)
            lines = lines @ se3_exp(tangent)
        first = state.first @ se3_exp(own[:, :6])
        return State(intrinsics, tuple(lenses), places, first, turn, lines)


def _mixing(correlation: Floats) -> Floats:
    """Inverse symmetric square roots of [[1, c], [c, 1]], shape (..., 2, 2)."""
    total = 1.0 / np.sqrt(1.0 + correlation)
    difference = 1.0 / np.sqrt(1.0 - correlation)
    same, other = 0.5 * (total + difference), 0.5 * (total - difference)
    return np.stack([np.stack([same, other], -1), np.stack([other, same], -1)], -2)


def _robust(rows: Floats, limit: float) -> float:
    """Cost of whitened rows (..., 2, q), the residual last; reweights in place.

    Huber's loss on the length of each point's residual: e^2 up to the limit, then
    2 limit e - limit^2 (Huber 1964, doi:10.1214/aoms/1177703732).
    """
    square = (rows[..., -1] ** 2).sum(axis=-1)
    if not np.isfinite(limit):
        return float(square.sum())
    length = np.sqrt(square)
    far = length > limit
    weight = np.where(far, np.sqrt(limit / np.where(far, length, 1.0)), 1.0)
    rows *= weight[..., None, None]
    return float(np.where(far, limit * (2 * length - limit), square).sum())
