"""Kinematics of a serial chain in plain numpy, many configurations at once.

Every joint turns about, or slides along, the z axis of its own frame; the
placements between the frames come from the engine's model (see arm.py).
"""

from __future__ import annotations

from functools import cached_property
from itertools import count

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.errors import ConvergenceError, InputError
from handeye_tri.kinematics.systems import columns_of, solve_positive, turn_between
from handeye_tri.se3 import se3_exp

Floats = NDArray[np.float64]

# Residual (m and rad) at which an inverse solution counts as reached. Newton's
# step after it is quadratic, so that what is returned is exact to rounding.
REACHED = 1e-8
_SETTLED = 1e-11
# Damping per squared residual: of 0.001-1 the value that converged soonest.
_DAMPING = 0.05


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

    @property
    def lever(self) -> float:
        """Weighs a turn against a shift: turns count in metres at this distance."""
        return 0.5 * self.reach

    @cached_property
    def strides(self) -> Floats:
        """How far a joint goes for as much as a radian of the others, shape (q,).

        A slide's range counts as a whole turn, else the shortest step would rather
        leave it than turn a hinge.
        """
        lower, upper = self._range
        return np.where(self.slides, (upper - lower) / (2 * np.pi), 1.0)

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
        columns, origins = self.sweep(values.reshape(-1, len(self)).T)
        return (
            columns.transpose(3, 0, 2, 1).reshape(*batch, len(self), 3, 3),
            origins.transpose(2, 0, 1).reshape(*batch, len(self), 3),
        )

    def sweep(self, q: Floats) -> tuple[Floats, Floats]:
        """Joint frames with the configurations along the last axis, for speed.

        Args:
            q: Shape (q, n).

        Returns:
            Columns of the rotations, shape (q, 3 columns, 3, n), and origins,
            shape (q, 3, n), metres.
        """
        joints, n = q.shape
        columns = np.empty((joints, 3, 3, n))
        origins = np.empty((joints, 3, n))
        cosine, sine = np.cos(q), np.sin(q)
        before = np.repeat(np.eye(3), n).reshape(3, 3, n)
        origin = np.zeros((3, n))
        for i, placement in enumerate(self.placements):
            # Rows: the three columns of the placement's rotation, its translation.
            moved = (placement[:3].T @ before.reshape(3, 3 * n)).reshape(4, 3, n)
            origin = np.add(origin, moved[3], out=origins[i])
            if self.slides[i]:
                origin += q[i] * moved[2]
                columns[i] = moved[:3]
            else:
                np.multiply(cosine[i], moved[:2], out=columns[i, :2])
                moved[:2] *= sine[i]
                columns[i, 0] += moved[1]
                columns[i, 1] -= moved[0]
                columns[i, 2] = moved[2]
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

    def descend(self, q: Floats, target: Floats, steps: int) -> tuple[Floats, Floats]:
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
        result, norm = np.empty_like(q), np.empty(q.shape[1])
        active = np.arange(q.shape[1])
        goal = columns_of(target)
        for step in count():
            columns, origins = self.sweep(q)
            flange = self.flange_of(columns, origins)
            residual = np.empty((6, len(active)))
            np.subtract(goal[3], flange[3], out=residual[:3])
            residual[3:] = turn_between(flange[:3], goal[:3])
            size = np.abs(residual).max(axis=0)
            ended = size < _SETTLED
            if step >= steps:
                # What has all but settled is worth two steps more.
                ended |= (size >= REACHED) | (step == steps + 2)
            if ended.any():
                done = np.flatnonzero(ended)
                result[:, active[done]], norm[active[done]] = q[:, done], size[done]
                if len(done) == len(active):
                    break
            residual[3:] *= self.lever
            jacobian = self.weighted_jacobian(columns, origins, flange[3])
            normal = np.einsum("ajn,bjn->abn", jacobian, jacobian)
            damping = _DAMPING * np.einsum("an,an->n", residual, residual) + 1e-13
            normal[range(6), range(6)] += damping
            solved = solve_positive(normal, residual)
            q += self.strides[:, None] * np.einsum("ajn,an->jn", jacobian, solved)
            # Sorting out before the step would copy all that it needs.
            if ended.any():
                left = np.flatnonzero(~ended)
                q, goal = q.take(left, axis=1), goal.take(left, axis=2)
                active = active[left]
        return result.T, norm

    def flange_of(self, columns: Floats, origins: Floats) -> Floats:
        """Columns of the flange's rotation, and its origin, from a sweep, (4, 3, n)."""
        n = columns.shape[-1]
        flange = self.last_from_flange[:3].T @ columns[-1].reshape(3, 3 * n)
        flange = flange.reshape(4, 3, n)
        flange[3] += origins[-1]
        return np.asarray(flange)

    def weighted_jacobian(
        self, columns: Floats, origins: Floats, flange: Floats
    ) -> Floats:
        """Flange velocity in the base by joints, turn rates times lever, (6, q, n)."""
        along = columns[:, 2]
        arm = flange - origins
        result = np.empty((6, *origins.shape[::2]))
        for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            result[a] = along[:, b] * arm[:, c] - along[:, c] * arm[:, b]
        result[3:] = self.lever * along.transpose(1, 0, 2)
        for i in np.flatnonzero(self.slides):
            result[:3, i], result[3:, i] = self.strides[i] * along[i], 0.0
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
        solved, norm = self.descend(
            flat.reshape(-1, len(self)), target.reshape(-1, 4, 4), 40
        )
        if len(norm) and norm.max() > REACHED:
            worst = int(np.argmax(norm))
            raise ConvergenceError(
                f"joints for displaced pose {worst} were not found: "
                f"{norm[worst]:.2g} m or rad are left; the arm is at a singularity "
                "or the displacement leaves its reach"
            )
        return solved.reshape(shape)
