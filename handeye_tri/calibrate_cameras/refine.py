"""Maximum-likelihood refinement over half-turns (paper, Sec. III-E, completed).

The two images of a half-turn share one pose. With one pose per image, six unknowns
for six observations, every K fits without residual. Unknowns: K and lens, the pose of
the triangle before each half-turn, where a normal axis meets the plane (O: known,
one for all, or one per half-turn), and, for a robot whose half-turns are not exact,
the tangent xi of each, ``after = before @ half_turn @ exp(xi)``, with xi ~ N(0,
turn_covariance) in the triangle's frame as prior.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.half_turns import HalfTurnData
from handeye_tri.calibrate_cameras.homography import OMode
from handeye_tri.calibrate_cameras.intrinsic_choice import IntrinsicChoice
from handeye_tri.calibrate_cameras.least_squares import Blocks, Minimum, minimise
from handeye_tri.calibrate_cameras.robust_loss import Loss, soften
from handeye_tri.camera import distort_jacobians
from handeye_tri.se3 import hat, so3_exp, so3_left_jacobian

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """One value of all unknowns.

    Attributes:
        intrinsics: fx, fy, skew, cx, cy, shape (5,), pixels.
        lens: Lens coefficients, shape (5,) or (8,).
        poses: camera_from_triangle before each half-turn, (n, 4, 4), metres.
        o: Foot of each normal axis in the triangle's frame, (n, 2), metres.
        turn: Deviation of each half-turn in units of its prior, (n, 6) or (n, 0).
    """

    intrinsics: Floats
    lens: Floats
    poses: Floats
    o: Floats
    turn: Floats


def _cayley(rotation_vector: Floats) -> Floats:
    """Rotations that agree with exp to second order and cost a quarter of it."""
    skew = hat(0.5 * rotation_vector)
    square = 0.25 * np.einsum("ni,ni->n", rotation_vector, rotation_vector)
    factor = (2.0 / (1.0 + square))[:, None, None]
    return np.asarray(np.eye(3) + factor * (skew + skew @ skew))


class HalfTurnModel:
    """Residuals and analytic derivatives of n half-turns.

    Own unknowns of a half-turn, in order: pose (6, right perturbation, rotation and
    translation apart), O if free (2), turn in units of its prior (6). Shared:
    intrinsics (fx, fy, skew, cx, cy: those estimated), lens coefficients, O if shared.
    """

    def __init__(
        self,
        data: HalfTurnData,
        *,
        choice: IntrinsicChoice,
        lens: tuple[int, ...],
        o_mode: OMode,
        turn_covariance: Floats | None,
        loss: Loss | None = None,
    ) -> None:
        """Choose the unknowns.

        Args:
            data: The half-turns.
            choice: Which intrinsics are estimated.
            lens: Indices of the lens coefficients that are estimated.
            o_mode: How O is treated; without a normal axis it plays no part.
            turn_covariance: Shape (n, 6, 6), m and rad, positive semi-definite;
                None for exact half-turns.
            loss: Of each point's whitened residual; None for its square.
        """
        self.data = data
        self.loss = loss
        self.choice = choice
        self.lens = lens
        has_o = o_mode != "known" and bool(data.about_normal.any())
        self.shared_o = has_o and o_mode == "shared"
        self.free_o = has_o and o_mode == "free"
        self.turn_root: Floats | None = None
        if turn_covariance is not None:
            values, vectors = np.linalg.eigh(turn_covariance)
            self.turn_root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        self._hat_points = hat(data.points)

    @property
    def rounding(self) -> float:
        """Whitened residuals that are rounding only, root mean square."""
        largest = np.abs(self.data.pixels).max() * self.data.whitener.max()
        return float(np.finfo(float).eps * largest)

    @property
    def camera_unknowns(self) -> int:
        """Number of intrinsics and lens coefficients that are estimated."""
        return len(self.choice.names) + len(self.lens)

    @property
    def own_unknowns(self) -> int:
        """Number of unknowns of each half-turn."""
        return 6 + 2 * self.free_o + 6 * (self.turn_root is not None)

    @property
    def shared_unknowns(self) -> int:
        """Number of unknowns that all half-turns share."""
        return self.camera_unknowns + 2 * self.shared_o

    @property
    def dof(self) -> int:
        """Observations less unknowns; a prior counts as an observation."""
        feet = 2 * int(self.data.about_normal.sum()) if self.free_o else 0
        return 6 * len(self.data) - self.shared_unknowns - feet

    @property
    def turn_unknowns(self) -> int:
        """Unknowns of how far a half-turn misses: 6 or 0."""
        return 0 if self.turn_root is None else 6

    def with_camera_known(self) -> HalfTurnModel:
        """The same model with nothing but own unknowns, each half-turn by itself."""
        result = self.with_lens(())
        result.choice = IntrinsicChoice((), np.zeros((5, 0)), np.zeros(5), None)
        result.shared_o = False
        return result

    def with_known(self, names: Collection[str]) -> HalfTurnModel:
        """The same model with these intrinsics as they are in the state."""
        result = self.with_lens(self.lens)
        kept = [name not in names for name in self.choice.names]
        result.choice = replace(
            self.choice,
            names=tuple(compress(self.choice.names, kept)),
            basis=self.choice.basis[:, kept],
        )
        return result

    def with_lens(self, lens: tuple[int, ...]) -> HalfTurnModel:
        """The same model with these lens coefficients estimated."""
        result = object.__new__(HalfTurnModel)
        result.__dict__.update(self.__dict__)
        result.lens = lens
        return result

    def _turned(self, state: State) -> tuple[Floats, Floats | None]:
        """Markers after the turn in the frame before, (n, 3, 3); by turn (.., 6).

        exp(xi) is applied as rotation and translation apart: the difference is of
        second order, 1e-9 m at 0.03 mm and 0.005 degrees.
        """
        data = self.data
        points = data.points
        rotation, offset = data.rotation[:, None], data.translation(state.o)[:, None]
        if self.turn_root is None:
            return points @ np.swapaxes(data.rotation, -1, -2) + offset, None
        xi = (self.turn_root @ state.turn[..., None])[..., 0]
        turn = so3_exp(xi[:, 3:])
        moved = points @ np.swapaxes(turn, -1, -2) + xi[:, None, :3]
        right = so3_left_jacobian(-xi[:, 3:])
        by_xi = np.empty((len(data), 3, 3, 6))
        by_xi[..., :3] = rotation
        by_xi[..., 3:] = -rotation @ (turn[:, None] @ self._hat_points @ right[:, None])
        return (
            moved @ np.swapaxes(data.rotation, -1, -2) + offset,
            by_xi @ self.turn_root[:, None],
        )

    def predict(self, state: State) -> Floats:
        """Predicted pixels, shape (n, 2, 3, 2)."""
        turned, _ = self._turned(state)
        local = self._in_camera(state, turned)[1]
        xy = local[..., :2] / local[..., 2:]
        if state.lens.any():
            xy, _, _ = distort_jacobians(state.lens, xy)
        fx, fy, skew, cx, cy = state.intrinsics
        return np.stack(
            [fx * xy[..., 0] + skew * xy[..., 1] + cx, fy * xy[..., 1] + cy], axis=-1
        )

    def _in_camera(self, state: State, turned: Floats) -> tuple[Floats, Floats]:
        """Markers before and after, (n, 2, 3, 3): triangle's frame, camera frame."""
        points = np.empty((len(self.data), 2, 3, 3))
        points[:, 0] = self.data.points
        points[:, 1] = turned
        rotation = np.swapaxes(state.poses[:, None, :3, :3], -1, -2)
        return points, points @ rotation + state.poses[:, None, None, :3, 3]

    def evaluate(self, state: State) -> Blocks | None:
        """Whitened residuals (predicted less detected) and derivatives.

        Returns:
            Blocks of 12 rows, and 6 more of the turn prior where there is one; None
            where a marker is behind the camera or a focal length is not positive.
        """
        n = len(self.data)
        fx, fy, skew, cx, cy = state.intrinsics
        turned, by_turn = self._turned(state)
        points, local = self._in_camera(state, turned)
        depth = local[..., 2:]
        if fx <= 0 or fy <= 0 or depth.min() <= 0:
            return None
        inverse = 1.0 / depth
        xy = local[..., :2] * inverse
        upper = np.array([[fx, skew], [0.0, fy]])
        by_point = np.zeros((n, 2, 3, 2, 3))
        by_point[..., 0, 0] = by_point[..., 1, 1] = inverse[..., 0]
        by_point[..., 2] = -xy * inverse
        by_xy = upper
        if self.lens or state.lens.any():
            xy, by_lens_xy, by_lens = distort_jacobians(state.lens, xy)
            by_xy = upper @ by_lens_xy
        by_point = by_xy @ by_point @ state.poses[:, None, None, :3, :3]

        # Columns: own unknowns, shared unknowns, residual.
        size, count = self.own_unknowns, self.camera_unknowns
        columns = np.zeros((n, 2, 3, 2, size + self.shared_unknowns + 1))
        columns[..., :3] = by_point
        columns[..., 3:6] = -by_point @ hat(points)
        if self.shared_o or self.free_o:
            at = 6 if self.free_o else size + count
            reach = (2.0 * self.data.about_normal)[:, None, None, None]
            columns[:, 1, ..., at : at + 2] = by_point[:, 1, ..., :2] * reach
        if by_turn is not None:
            columns[:, 1, ..., size - 6 : size] = by_point[:, 1] @ by_turn
        inner = len(self.choice.names)
        by_inner = np.zeros((n, 2, 3, 2, 5))
        by_inner[..., 0, 0], by_inner[..., 1, 1] = xy[..., 0], xy[..., 1]
        by_inner[..., 0, 2] = xy[..., 1]
        by_inner[..., 0, 3] = by_inner[..., 1, 4] = 1.0
        columns[..., size : size + inner] = by_inner @ self.choice.basis
        if self.lens:
            start = size + inner
            columns[..., start : size + count] = upper @ by_lens[..., self.lens]
        columns[..., -1] = xy @ upper.T + (cx, cy) - self.data.pixels
        rows = self.data.whitener @ columns
        if self.loss is not None:
            soften(rows, self.loss)
        rows = rows.reshape(n, 12, -1)
        if self.turn_root is not None:
            prior = np.zeros((n, 6, rows.shape[-1]))
            prior[..., size - 6 : size] = np.eye(6)
            prior[..., -1] = state.turn
            rows = np.concatenate([rows, prior], axis=1)
        return Blocks(rows[..., -1], rows[..., :size], rows[..., size:-1])

    def by_angle(self, state: State, blocks: Blocks) -> Floats:
        """Derivatives of the residuals by the angle of each turn, (n, r), per radian.

        Args:
            state: Where they are taken.
            blocks: Residuals there.
        """
        through, along = self.data.axis_lines(state.o)
        arm = self._turned(state)[0] - through[:, None]
        moved = np.cross(along[:, None], arm)
        result = np.zeros_like(blocks.residuals)
        by_point = blocks.own[:, 6:12, :3].reshape(-1, 3, 2, 3)
        result[:, 6:12] = (by_point @ moved[..., None]).reshape(-1, 6)
        return result

    def retract(self, state: State, own: Floats, shared: Floats) -> State:
        """Move a state by steps of own (n, l) and shared (g,) unknowns."""
        poses = state.poses.copy()
        poses[:, :3, 3] += (poses[:, :3, :3] @ own[:, :3, None])[..., 0]
        poses[:, :3, :3] = poses[:, :3, :3] @ _cayley(own[:, 3:6])
        lens, o = state.lens, state.o
        count = len(self.choice.names)
        intrinsics = state.intrinsics + self.choice.basis @ shared[:count]
        if self.lens:
            lens = lens.copy()
            lens[list(self.lens)] += shared[count : self.camera_unknowns]
        if self.shared_o:
            o = o + shared[-2:]
        if self.free_o:
            o = o + own[:, 6:8]
        turn = state.turn
        if self.turn_root is not None:
            turn = turn + own[:, -6:]
        return State(intrinsics, lens, poses, o, turn)

    def after_poses(self, state: State) -> Floats:
        """camera_from_triangle after each half-turn, shape (n, 4, 4), metres."""
        n = len(self.data)
        motion = np.zeros((n, 4, 4))
        motion[:, :3, :3] = self.data.rotation
        motion[:, :3, 3] = self.data.translation(state.o)
        motion[:, 3, 3] = 1.0
        if self.turn_root is not None:
            xi = (self.turn_root @ state.turn[..., None])[..., 0]
            deviation = np.zeros((n, 4, 4))
            deviation[:, :3, :3] = so3_exp(xi[:, 3:])
            deviation[:, :3, 3] = xi[:, :3]
            deviation[:, 3, 3] = 1.0
            motion = motion @ deviation
        return np.asarray(state.poses @ motion)


def refine_from_starts(
    model: HalfTurnModel, starts: list[State]
) -> tuple[Minimum[State, Blocks], int] | None:
    """Minimise from every start and keep the lower cost.

    Thin, far or steep triangles have local minima, so that one start is not enough.
    The lens, where there is one, begins at zero once the pinhole camera has settled.

    Args:
        model: Residuals and unknowns.
        starts: States; those with a marker behind the camera are passed over.

    Returns:
        The minimum, its ``cost_start`` that of the start it came from; which start.
        None where no start has every marker in front of the camera.
    """
    rounding = model.rounding
    pinhole = model.with_lens(())
    best: Minimum[State, Blocks] | None = None
    chosen = 0
    for index, start in enumerate(starts):
        known = None if best is None else best.cost
        end = minimise(pinhole.evaluate, pinhole.retract, start, rounding, known)
        if end is None:
            continue
        if best is None or (end.converged, -end.cost) > (best.converged, -best.cost):
            best, chosen = end, index
    if best is None or not model.lens:
        return None if best is None else (best, chosen)
    end = minimise(model.evaluate, model.retract, best.state, rounding)
    return None if end is None else (replace(end, cost_start=best.cost_start), chosen)
