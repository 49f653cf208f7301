"""Kinematics of a serial chain in plain numpy, many configurations at once.

Every joint turns about, or slides along, the z axis of its own frame; the
placements between the frames come from the engine's model (see arm.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.errors import ConvergenceError, InputError
from handeye_tri.se3 import se3_exp

Floats = NDArray[np.float64]

# Residual (m and rad) at which an inverse solution counts as reached. Newton's
# step after it is quadratic, so that what is returned is exact to rounding.
_TOLERANCE = 1e-8
_POLISH_TOLERANCE = 1e-11
# Most solutions take 4-8 steps; a start that needs more is worth less than
# another start.
_STEPS = 10
# Damping per squared residual: of 0.001-1 the value that converged soonest.
_DAMPING = 0.05
# Configurations to start from. Larger tables start closer but take longer to
# search: 600-1500 were the fastest of 500-6000, for 6 joints and for 7.
_TABLE_SIZE = 800
# Solutions closer than this in every joint are one.
_SAME = 1e-4


def _turn_between(first: Floats, second: Floats) -> Floats:
    """Rotation vectors in the base from frames to frames, shape (3, n).

    Args:
        first: Columns of rotations, shape (3 columns, 3, n).
        second: Likewise.
    """
    turn = np.zeros(first.shape[1:])
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        turn[a] = 0.5 * (
            (first[:, b] * second[:, c]).sum(axis=0)
            - (first[:, c] * second[:, b]).sum(axis=0)
        )
    sine = np.sqrt((turn * turn).sum(axis=0))
    angle = np.arctan2(sine, 0.5 * ((first * second).sum(axis=(0, 1)) - 1))
    # At a half-turn the sine vanishes and any axis leads away from there.
    opposite = (sine < 1e-7) & (angle > 1.0)
    if opposite.any():
        turn[:, opposite], sine[opposite] = first[0][:, opposite], 1.0
    return np.asarray(turn * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1))


def _solve_positive(matrix: Floats, right: Floats) -> Floats:
    """Solutions of positive definite systems side by side, by Cholesky.

    Five times as fast as a batched LAPACK call for six unknowns.

    Args:
        matrix: Shape (p, p, n), overwritten.
        right: Shape (p, n).

    Returns:
        Shape (p, n).
    """
    size = len(matrix)
    x = right.copy()
    for i in range(size):
        row = matrix[i, :i]
        matrix[i, i] = np.sqrt(matrix[i, i] - (row * row).sum(axis=0))
        x[i] = (x[i] - (row * x[:i]).sum(axis=0)) / matrix[i, i]
        for k in range(i + 1, size):
            below = matrix[k, i] - (matrix[k, :i] * row).sum(axis=0)
            matrix[k, i] = below / matrix[i, i]
    for i in reversed(range(size)):
        after = (matrix[i + 1 :, i] * x[i + 1 :]).sum(axis=0)
        x[i] = (x[i] - after) / matrix[i, i]
    return x


@dataclass(frozen=True, slots=True, eq=False)
class InverseSolutions:
    """What inverse kinematics found for n targets.

    Attributes:
        joints: For each target its distinct solutions within the limits, shape
            (s, q), rad or m; s = 0 where none was found. Hinge angles that differ
            by whole turns are one solution.
        beyond_limits: Whether a solution was found, but only outside the joint
            limits, shape (n,).
    """

    joints: tuple[Floats, ...]
    beyond_limits: NDArray[np.bool_]


class SerialChain:
    """Hinges and slides in a row from a base frame to a flange frame.

    Attributes:
        placements: Frame of each joint at value 0 in that of the joint before
            (the first: in the base), shape (q, 4, 4), metres.
        slides: Which joints slide, shape (q,).
        last_from_flange: The flange in the last joint's frame, shape (4, 4).
        lower: Lower limits, shape (q,), rad or m; may be -inf.
        upper: Upper limits, shape (q,), rad or m; may be inf.
    """

    def __init__(
        self,
        placements: Floats,
        slides: NDArray[np.bool_],
        last_from_flange: Floats,
        lower: Floats,
        upper: Floats,
    ) -> None:
        """Store the chain."""
        self.placements = placements
        self.slides = slides
        self.last_from_flange = last_from_flange
        self.lower = lower
        self.upper = upper

    def __len__(self) -> int:
        return len(self.placements)

    @cached_property
    def reach(self) -> float:
        """Longest distance of the flange from the first joint's origin, metres."""
        lengths = np.linalg.norm(self.placements[1:, :3, 3], axis=1).sum()
        travel = np.maximum(np.abs(self.lower), np.abs(self.upper))[self.slides]
        travel = np.where(np.isfinite(travel), travel, 1.0)
        total = lengths + travel.sum() + np.linalg.norm(self.last_from_flange[:3, 3])
        return float(max(total, 1e-3))

    def joint_frames(self, q: ArrayLike) -> tuple[Floats, Floats]:
        """Frames that move with each joint, in the base.

        Args:
            q: Shape (..., q), rad or m.

        Returns:
            Rotations, shape (..., q, 3, 3), and origins, shape (..., q, 3), metres.
        """
        values = np.asarray(q, dtype=float)
        if values.shape[-1:] != (len(self),):
            raise InputError(
                f"joint values must have shape (..., {len(self)}), got {values.shape}"
            )
        batch = values.shape[:-1]
        columns, origins = self._sweep(values.reshape(-1, len(self)).T)
        return (
            columns.transpose(3, 0, 2, 1).reshape(*batch, len(self), 3, 3),
            origins.transpose(2, 0, 1).reshape(*batch, len(self), 3),
        )

    def _sweep(self, q: Floats) -> tuple[Floats, Floats]:
        """Joint frames with the configurations along the last axis, for speed.

        Args:
            q: Shape (q, n).

        Returns:
            Columns of the rotations, shape (q, 3 columns, 3, n), and origins,
            shape (q, 3, n), metres.
        """
        count, n = q.shape
        columns = np.empty((count, 3, 3, n))
        origins = np.empty((count, 3, n))
        cosine, sine = np.cos(q), np.sin(q)
        before = np.repeat(np.eye(3), n).reshape(3, 3, n)
        origin = np.zeros((3, n))
        for i, placement in enumerate(self.placements):
            # Rows: the three columns of the placement's rotation, its translation.
            moved = (placement[:3].T @ before.reshape(3, 3 * n)).reshape(4, 3, n)
            origin = origin + moved[3]
            x, y, z = moved[:3]
            if self.slides[i]:
                origin += q[i] * z
                columns[i] = moved[:3]
            else:
                columns[i, 0] = cosine[i] * x + sine[i] * y
                columns[i, 1] = cosine[i] * y - sine[i] * x
                columns[i, 2] = z
            origins[i] = origin
            before = columns[i]
        return columns, origins

    def forward(self, q: ArrayLike) -> Floats:
        """``base_from_flange``, shape (..., 4, 4), of joints (..., q)."""
        rotations, origins = self.joint_frames(q)
        return self._flange(rotations[..., -1, :, :], origins[..., -1, :])

    def _flange(self, rotation: Floats, origin: Floats) -> Floats:
        result = np.zeros((*rotation.shape[:-2], 4, 4))
        result[..., :3, :3] = rotation @ self.last_from_flange[:3, :3]
        result[..., :3, 3] = origin + rotation @ self.last_from_flange[:3, 3]
        result[..., 3, 3] = 1.0
        return result

    def jacobian(self, q: ArrayLike) -> Floats:
        """Derivative of the flange's right perturbation by the joints.

        ``forward(q + dq) ~ forward(q) @ exp(jacobian @ dq)``.

        Args:
            q: Shape (..., q), rad or m.

        Returns:
            Shape (..., 6, q): rows translation (m) and rotation (rad).
        """
        rotations, origins = self.joint_frames(q)
        flange = self._flange(rotations[..., -1, :, :], origins[..., -1, :])
        along = rotations[..., 2]
        slides = self.slides[:, None]
        turning = np.where(slides, 0.0, along)
        lever = flange[..., None, :3, 3] - origins
        moving = np.cross(turning, lever) + np.where(slides, along, 0.0)
        back = np.swapaxes(flange[..., :3, :3], -1, -2)
        return np.concatenate(
            [
                back @ np.swapaxes(moving, -1, -2),
                back @ np.swapaxes(turning, -1, -2),
            ],
            axis=-2,
        )

    def _descend(self, q: Floats, target: Floats, steps: int) -> tuple[Floats, Floats]:
        """Damped Gauss-Newton; the damping follows the squared residual.

        Sugihara 2011 (doi:10.1109/TRO.2011.2148230): far away and at
        singularities the step is short, near a solution it is Newton's. Works in
        the base frame with the configurations along the last axis.

        Args:
            q: Where to start, shape (n, q).
            target: Shape (n, 4, 4).
            steps: At most.

        Returns:
            Joints, shape (n, q), and their last residual norms, shape (n,).
        """
        q = q.T.copy()
        norm = np.full(q.shape[1], np.inf)
        active = np.arange(q.shape[1])
        goal = np.ascontiguousarray(target[:, :3].transpose(2, 1, 0))
        # Rotation in metres at the flange's lever, so that one number weighs both.
        lever = 0.5 * self.reach
        for step in range(steps + 1):
            columns, origins = self._sweep(q[:, active])
            n = len(active)
            flange = self.last_from_flange[:3].T @ columns[-1].reshape(3, 3 * n)
            flange = flange.reshape(4, 3, n)
            flange[3] += origins[-1]
            residual = np.empty((6, n))
            residual[:3] = goal[3][:, active] - flange[3]
            residual[3:] = _turn_between(flange[:3], goal[:3][..., active])
            norm[active] = np.abs(residual).max(axis=0)
            finished = norm[active] < _POLISH_TOLERANCE
            if step == steps or finished.all():
                break
            if finished.any():
                keep = ~finished
                active = active[keep]
                columns, origins = columns[..., keep], origins[..., keep]
                flange, residual = flange[..., keep], residual[:, keep]
            residual[3:] *= lever
            jacobian = self._weighted_jacobian(columns, origins, flange[3], lever)
            normal = np.einsum("ajn,bjn->abn", jacobian, jacobian)
            damping = _DAMPING * np.einsum("an,an->n", residual, residual) + 1e-13
            normal[range(6), range(6)] += damping
            solved = _solve_positive(normal, residual)
            q[:, active] += np.einsum("ajn,an->jn", jacobian, solved)
        return q.T, norm

    def _weighted_jacobian(
        self, columns: Floats, origins: Floats, flange: Floats, lever: float
    ) -> Floats:
        """Flange velocity in the base by joints, turn rates times lever, (6, q, n)."""
        along = columns[:, 2]
        arm = flange - origins
        result = np.empty((6, *origins.shape[::2]))
        for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            result[a] = along[:, b] * arm[:, c] - along[:, c] * arm[:, b]
        result[3:] = lever * along.transpose(1, 0, 2)
        for i in np.flatnonzero(self.slides):
            result[:3, i], result[3:, i] = along[i], 0.0
        return result

    @cached_property
    def _range(self) -> tuple[Floats, Floats]:
        """Where starts are drawn: within the limits, at most one turn of a hinge."""
        lower = np.where(np.isfinite(self.lower), self.lower, -np.pi)
        upper = np.where(np.isfinite(self.upper), self.upper, np.pi)
        wide = ~self.slides & (upper - lower > 2 * np.pi)
        centre = np.clip(0.0, lower + np.pi, np.maximum(upper - np.pi, lower + np.pi))
        return (
            np.where(wide, centre - np.pi, lower),
            np.where(wide, centre + np.pi, upper),
        )

    def random(self, rng: np.random.Generator, shape: int | tuple[int, ...]) -> Floats:
        """Configurations within the limits, uniform by joint, shape (*shape, q)."""
        lower, upper = self._range
        batch = (shape,) if isinstance(shape, int) else shape
        return rng.uniform(lower, upper, (*batch, len(self)))

    @cached_property
    def _table(self) -> tuple[Floats, Floats]:
        """Configurations that cover the joint space, and their features."""
        q = self.random(np.random.default_rng(0), _TABLE_SIZE)
        return q, self._features(self.forward(q))

    def _features(self, flange: Floats) -> Floats:
        """Position and two axes, shape (n, 9): near poses have near features."""
        axes = 0.5 * self.reach * flange[:, :3, :2].reshape(-1, 6)
        return np.concatenate([flange[:, :3, 3], axes], axis=1)

    def wrapped(self, q: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Bring hinges into their limits by whole turns where that is possible.

        Args:
            q: Shape (n, q), rad or m.

        Returns:
            The joints, each hinge at the value nearest to the middle of the range
            that starts are drawn from, shape (n, q); which configurations are
            within the limits, shape (n,).
        """
        lower, upper = self._range
        turns = np.round((q - 0.5 * (lower + upper)) / (2 * np.pi))
        result = np.where(self.slides, q, q - 2 * np.pi * turns)
        slack = 1e-9
        inside = (result >= self.lower - slack) & (result <= self.upper + slack)
        return np.clip(result, self.lower, self.upper), np.asarray(inside.all(axis=1))

    def inverse(
        self,
        base_from_flange: ArrayLike,
        rng: np.random.Generator,
        *,
        starts: int = 48,
        first: bool = False,
    ) -> InverseSolutions:
        """Inverse kinematics of any serial arm, by damped Gauss-Newton.

        Args:
            base_from_flange: Targets, shape (n, 4, 4), metres.
            rng: Draws every third start; the others are the nearest of a table.
            starts: How many starts a target gets.
            first: Stop at a target's first solution.

        Returns:
            Solutions by target.
        """
        target = np.asarray(base_from_flange, dtype=float).reshape(-1, 4, 4)
        found: list[list[Floats]] = [[] for _ in target]
        beyond = np.zeros(len(target), dtype=bool)
        ends = [e for e in (1, 3, 7, 15, 31) if first and e < starts] + [starts]
        unsolved = np.arange(len(target))
        begin = 0
        for end in ends:
            start = self._starts(target[unsolved], rng, begin, end)
            owner = np.repeat(unsolved, end - begin)
            q, norm = self._descend(start, target[owner], _STEPS)
            near = (norm < _TOLERANCE) & (norm > _POLISH_TOLERANCE)
            q[near], norm[near] = self._descend(q[near], target[owner[near]], 2)
            q, inside = self.wrapped(q)
            reached = norm < _TOLERANCE
            beyond[owner[reached & ~inside]] = True
            for row in np.flatnonzero(reached & inside):
                known = found[owner[row]]
                if not known or (not first and self._differ(q[row], np.array(known))):
                    known.append(q[row])
            unsolved = np.array([j for j in unsolved if not found[j]], dtype=np.intp)
            begin = end
            if len(unsolved) == 0:
                break
        return InverseSolutions(
            tuple(np.array(rows).reshape(-1, len(self)) for rows in found),
            beyond & np.array([not rows for rows in found], dtype=bool),
        )

    def _starts(
        self, target: Floats, rng: np.random.Generator, begin: int, end: int
    ) -> Floats:
        """Starts ``begin`` to ``end`` of every target, target by target, (n, q)."""
        table, features = self._table
        distance = (features**2).sum(axis=1) - 2 * self._features(target) @ features.T
        if end == 1:
            return np.asarray(table[np.argmin(distance, axis=1)])
        near = np.argpartition(distance, end - 1, axis=1)[:, :end]
        ranked = np.take_along_axis(
            near, np.argsort(np.take_along_axis(distance, near, 1), axis=1), 1
        )
        chosen = table[ranked[:, begin:end]]
        # Every third start is drawn at random: the table's nearest may share a
        # branch of solutions that the limits forbid.
        chosen[:, 2::3] = self.random(rng, chosen[:, 2::3].shape[:2])
        return chosen.reshape(-1, len(self))

    def _differ(self, q: Floats, known: Floats) -> bool:
        gap = np.abs(known - q)
        gap = np.where(self.slides, gap, np.minimum(gap, np.abs(2 * np.pi - gap)))
        return bool((gap.max(axis=1) > _SAME).all())

    def perturbed(self, q: ArrayLike, tangent: ArrayLike) -> Floats:
        """Joints whose flange is displaced by a small tangent.

        Args:
            q: Shape (..., q), rad or m.
            tangent: Shape (..., 6), metres and radians, on the right.

        Returns:
            Shape (..., q), with ``forward(result) == forward(q) @ exp(tangent)``,
            the solution next to ``q``; limits are not looked at.

        Raises:
            ConvergenceError: a displaced pose cannot be reached from q.
        """
        start = np.asarray(q, dtype=float)
        target = self.forward(start) @ se3_exp(tangent)
        flat = np.broadcast_to(start, (*target.shape[:-2], len(self)))
        shape = flat.shape
        solved, norm = self._descend(
            flat.reshape(-1, len(self)), target.reshape(-1, 4, 4), 40
        )
        if len(norm) and norm.max() > _TOLERANCE:
            worst = int(np.argmax(norm))
            raise ConvergenceError(
                f"joints for displaced pose {worst} were not found: "
                f"{norm[worst]:.2g} m or rad are left; the arm is at a singularity "
                "or the displacement leaves its reach"
            )
        return solved.reshape(shape)
