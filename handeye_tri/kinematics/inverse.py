"""Joints that reach given poses of the flange, for any serial arm."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.kinematics.chain import REACHED, SerialChain
from handeye_tri.kinematics.systems import columns_of, turn_between
from handeye_tri.threads import one_thread

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

# Most solutions take 4-8 steps; a start that needs more is worth less than
# another start.
_STEPS = 10
# Configurations to start from. Larger tables start closer but take longer to
# search: 600-1500 were the fastest of 500-6000, for 6 joints and for 7.
_TABLE_SIZE = 800
# Parts of the table whose nearest ones are ranked by their first step.
_FORESEEN = 8
# Damping of that step, per squared lever.
_FIRST_DAMPING = 1e-3
# What leaving the limits costs there, squared, against going as far.
_OUTSIDE = 100.0
# Starts that are spent on a target before those that are left get more.
_ROUNDS = (1, 3, 12)
# What only solutions beyond the limits have reached by then gets so many times more.
_MORE = 4
# Solutions closer than this in every joint are one.
_SAME = 1e-4


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


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """Configurations that cover the joint space; a start needs no double precision.

    Attributes:
        joints: Shape (q, t).
        features: Times -2 their poses' features, and their square, shape (10, t).
        flange: Columns of the flange's rotation, and its place, (4, 3, t).
        back: Damped inverse of the weighted Jacobian, (q, 6, t).
    """

    joints: Singles
    features: Singles
    flange: Singles
    back: Singles


class InverseKinematics:
    """Solves a chain by damped Gauss-Newton from the nearest of a table.

    Attributes:
        chain: The arm.
    """

    def __init__(self, chain: SerialChain) -> None:
        """Keep the chain; the table is made when it is first needed."""
        self.chain = chain

    def solve(
        self,
        base_from_flange: ArrayLike,
        rng: np.random.Generator,
        *,
        starts: int = 48,
        first: bool = False,
    ) -> InverseSolutions:
        """Joints that reach poses.

        Args:
            base_from_flange: Targets, shape (n, 4, 4), metres.
            rng: Draws every third start; the others are the nearest of a table.
            starts: How many starts a target gets.
            first: Stop at a target's first solution. Then the first starts are those
                of the table's nearest that promise the shortest way, and a target
                that was reached beyond the limits alone gets more than ``starts``.

        Returns:
            Solutions by target.
        """
        target = np.asarray(base_from_flange, dtype=float).reshape(-1, 4, 4)
        with one_thread():
            return self._solve(target, rng, starts, first)

    def _solve(
        self, target: Floats, rng: np.random.Generator, starts: int, first: bool
    ) -> InverseSolutions:
        """See :meth:`solve`."""
        found: list[Floats] = [np.empty((0, len(self.chain)))] * len(target)
        beyond = np.zeros(len(target), dtype=bool)
        left = np.arange(len(target))
        ahead = self._foreseen(target) if first else None
        ends = [starts]
        if first:
            ends = [*(end for end in _ROUNDS if end < starts), starts]
            ends.append(min(_MORE * starts, _TABLE_SIZE))
        begin = 0
        for end in ends:
            if end > starts:
                left = left[beyond[left]]
            if len(left) == 0:
                break
            if ahead is not None and end <= _FORESEEN:
                start = ahead[left, begin:end]
            else:
                start = self._starts(target[left], rng, begin, end)
            owner = np.repeat(left, end - begin)
            q, norm = self.chain.descend(
                start.reshape(len(owner), -1), target[owner], _STEPS
            )
            q, inside = self.chain.wrapped(q)
            reached = norm < REACHED
            beyond[owner[reached & ~inside]] = True
            rows = np.flatnonzero(reached & inside)
            if first:
                owners, places = np.unique(owner[rows], return_index=True)
                for j, one in zip(owners, q[rows[places], None], strict=True):
                    found[j] = one
            else:
                bounds = np.searchsorted(owner[rows], np.arange(len(target) + 1))
                for j in left.tolist():
                    found[j] = self._distinct(q[rows[bounds[j] : bounds[j + 1]]])
            left = np.array([j for j in left if not len(found[j])], dtype=np.intp)
            begin = end
        beyond[[len(rows) > 0 for rows in found]] = False
        return InverseSolutions(tuple(found), beyond)

    @cached_property
    def _table(self) -> _Table:
        chain = self.chain
        joints = chain.random(np.random.default_rng(0), _TABLE_SIZE)
        features = self._features(chain.forward(joints))
        square = (features**2).sum(axis=1, keepdims=True)
        columns, origins = chain.sweep(joints.T)
        flange = chain.flange_of(columns, origins)
        jacobian = chain.weighted_jacobian(columns, origins, flange[3])
        jacobian = jacobian.transpose(2, 0, 1)
        turned = jacobian.transpose(0, 2, 1)
        damping = _FIRST_DAMPING * chain.lever**2 * np.eye(6)
        back = turned @ np.linalg.inv(jacobian @ turned + damping)
        back *= chain.strides[:, None]
        return _Table(
            np.ascontiguousarray(joints.T, dtype=np.float32),
            np.concatenate([-2.0 * features, square], axis=1, dtype=np.float32).T,
            flange.astype(np.float32),
            np.ascontiguousarray(back.transpose(1, 2, 0), dtype=np.float32),
        )

    def _features(self, flange: Floats) -> Floats:
        """Position and two axes, shape (n, 9): near poses have near features."""
        axes = self.chain.lever * flange[:, :3, :2].reshape(-1, 6)
        return np.concatenate([flange[:, :3, 3], axes], axis=1)

    def _distances(self, target: Floats) -> Singles:
        """Squared, less a constant, of targets from the table's poses, (n, t)."""
        ones = np.ones((len(target), 1))
        features = [self._features(target), ones]
        joined = np.concatenate(features, axis=1, dtype=np.float32)
        return np.asarray(joined @ self._table.features)

    def _starts(
        self, target: Floats, rng: np.random.Generator, begin: int, end: int
    ) -> Floats:
        """Starts ``begin`` to ``end`` of every target, (n, end - begin, q)."""
        distance = self._distances(target)
        near = np.argpartition(distance, end - 1, axis=1)[:, :end]
        order = np.argsort(np.take_along_axis(distance, near, 1), axis=1)
        near = np.take_along_axis(near, order, 1)
        chosen = self._table.joints.T[near[:, begin:end]].astype(float)
        # Every third start is drawn at random: the table's nearest may share a
        # branch of solutions that the limits forbid.
        chosen[:, 2::3] = self.chain.random(rng, chosen[:, 2::3].shape[:2])
        return chosen

    def _foreseen(self, target: Floats) -> Floats:
        """Near configurations of the table after a first step, the shortest first.

        Args:
            target: Shape (n, 4, 4).

        Returns:
            Shape (n, k, q).
        """
        table, chain = self._table, self.chain
        # The nearest of each part of the table: finding the nearest of all takes as
        # long as solving.
        part = _TABLE_SIZE // _FORESEEN
        shape = len(target), _FORESEEN
        near = self._distances(target).reshape(*shape, part).argmin(axis=2)
        flat = (near + part * np.arange(_FORESEEN)).ravel()
        here = table.flange.take(flat, axis=2)
        goal = columns_of(target).astype(np.float32)
        goal = np.repeat(goal, _FORESEEN, axis=2)
        residual = np.empty((6, len(flat)), np.float32)
        residual[:3] = goal[3] - here[3]
        residual[3:] = chain.lever * turn_between(here[:3], goal[:3])
        step = np.einsum("jan,an->jn", table.back.take(flat, axis=2), residual)
        q = table.joints.take(flat, axis=1) + step
        limits = (one[:, None].astype(np.float32) for one in (chain.lower, chain.upper))
        outside = q - np.clip(q, *limits)
        length = np.einsum("jn,jn->n", step, step)
        length += _OUTSIDE * np.einsum("jn,jn->n", outside, outside)
        order = np.argsort(length.reshape(shape), axis=1)
        ordered = np.take_along_axis(q.T.reshape(*shape, -1), order[..., None], 1)
        return ordered.astype(float)

    def _distinct(self, rows: Floats) -> Floats:
        """Solutions (s, q) without repetitions, in order."""
        kept: list[Floats] = []
        for q in rows:
            if not kept or self._differ(q, np.array(kept)):
                kept.append(q)
        return np.array(kept).reshape(-1, len(self.chain))

    def _differ(self, q: Floats, known: Floats) -> bool:
        gap = np.abs(known - q)
        slides = self.chain.slides
        gap = np.where(slides, gap, np.minimum(gap, np.abs(2 * np.pi - gap)))
        return bool((gap.max(axis=1) > _SAME).all())
