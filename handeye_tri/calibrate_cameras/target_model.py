"""Residuals and derivatives of m cameras that see one flat target in many poses.

Every number of a point is in an array of its own, (view, point), so that numpy works
on all views at once; what a camera's views say of its own unknowns and of the target's
pose is multiplied out per view, and carried to the unknowns of all cameras by 6 x 6
matrices. Time and memory grow in proportion to the views.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.least_squares import NormalEquations
from handeye_tri.calibrate_cameras.trial_equations import Scratch
from handeye_tri.camera import distort, distort_components
from handeye_tri.se3 import hat, so3_exp

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Which of (fx, fy, skew, cx, cy) move the column of a pixel, and which its row.
_MOVES = ((0, 2, 3), (1, 4))
# Points that are worked on at a time: their derivatives stay in the cache.
_POINTS_AT_ONCE = 4096


@dataclass(frozen=True, slots=True, eq=False)
class TargetState:
    """One value of all unknowns.

    Attributes:
        intrinsics: fx, fy, skew, cx, cy of each camera, shape (m, 5), pixels.
        lenses: Lens coefficients of each camera, (5,) or (8,).
        rotations: camera_from_reference, shape (m, 3, 3); the first stays put.
        translations: The same, shape (m, 3), metres.
        rotation: reference_from_target of each view, shape (n, 3, 3).
        translation: The same, shape (n, 3), metres.
    """

    intrinsics: Floats
    lenses: tuple[Floats, ...]
    rotations: Floats
    translations: Floats
    rotation: Floats
    translation: Floats


@dataclass(frozen=True, slots=True, eq=False)
class TargetRows:
    """Normal equations at one state, with what the minimiser asks for."""

    cost: float
    observations: int
    unknowns: int
    normal: NormalEquations

    def equations(self) -> NormalEquations:
        """The normal equations at this state."""
        return self.normal


@dataclass(frozen=True, slots=True, eq=False)
class TargetModel:
    """Measurements and the choice of unknowns.

    A view's own unknowns: its pose (translation, rotation; in the directions of the
    reference camera). Shared unknowns, in order: for each camera its intrinsics that
    move u, lens coefficients, intrinsics that move v, and, after the first camera, its
    place (6).

    Attributes:
        plane: The target's points, shape (2, p), metres.
        pixels: Shape (m, 2, n, p); 0 where unseen.
        seen: Shape (m, n, p).
        intrinsics: Indices of the estimated intrinsics, alike in all cameras.
        lens: Indices of the estimated lens coefficients, likewise.
        scratch: For intermediate results.
        complete: Whether each camera saw every point of every view.
        places: Where the intrinsics, in order, and the lens coefficients of each
            camera are among the shared unknowns.
    """

    plane: Floats
    pixels: Floats
    seen: Bools
    intrinsics: tuple[int, ...]
    lens: tuple[int, ...]
    scratch: Scratch = field(default_factory=Scratch)
    complete: tuple[bool, ...] = field(init=False)
    places: tuple[NDArray[np.intp], ...] = field(init=False)

    def __post_init__(self) -> None:
        """Note which cameras see everything, and where their unknowns are."""
        complete = tuple(bool(one.all()) for one in self.seen)
        object.__setattr__(self, "complete", complete)
        u, v = self.moves
        second = len(u) + len(self.lens)
        inner = [u.index(k) if k in u else second + v.index(k) for k in self.intrinsics]
        offsets = np.array([*inner, *range(len(u), second)], dtype=np.intp)
        places = tuple(offsets + self.columns(i).start for i in range(len(self.pixels)))
        object.__setattr__(self, "places", places)

    @property
    def moves(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Estimated intrinsics that move the column of a pixel, and its row."""
        u, v = (tuple(k for k in one if k in self.intrinsics) for one in _MOVES)
        return u, v

    @property
    def inner(self) -> int:
        """Number of intrinsics and lens coefficients estimated of each camera."""
        return len(self.intrinsics) + len(self.lens)

    @property
    def shared_unknowns(self) -> int:
        """Number of unknowns that all views share."""
        m = len(self.pixels)
        return m * self.inner + 6 * (m - 1)

    def columns(self, i: int) -> slice:
        """Where camera i is among the shared unknowns, without its place."""
        start = i * self.inner + 6 * max(i - 1, 0)
        return slice(start, start + self.inner)

    def take(self, cameras: list[int], views: NDArray[np.intp]) -> TargetModel:
        """Some of the cameras and views, shape (v,)."""
        return replace(
            self,
            pixels=np.ascontiguousarray(self.pixels[cameras][:, :, views]),
            seen=self.seen[cameras][:, views],
            scratch=Scratch(),
        )

    def in_cameras(self, state: TargetState) -> tuple[Floats, Floats]:
        """camera_from_target: rotations (m, n, 3, 3), translations (m, n, 3)."""
        turn = state.rotations[:, None]
        shifted = state.translation @ np.swapaxes(state.rotations, 1, 2)
        return turn @ state.rotation, shifted + state.translations[:, None]

    def _blocks(self) -> Iterator[tuple[slice, slice]]:
        """Cameras and views that are worked on at a time."""
        m, _, n, p = self.pixels.shape
        views = max(1, min(n, _POINTS_AT_ONCE // p))
        cameras = max(1, _POINTS_AT_ONCE // (n * p))
        for i in range(0, m, cameras):
            for j in range(0, n, views):
                yield slice(i, i + cameras), slice(j, j + views)

    def evaluate(self, state: TargetState) -> TargetRows | None:
        """Normal equations; None where a seen point is behind a camera."""
        m, _, n, p = self.pixels.shape
        g, k = self.shared_unknowns, self.inner
        if state.intrinsics[:, :2].min() <= 0:
            return None
        found = self._products(state)
        if found is None:
            return None
        by_pose, inner = found
        shared = np.zeros((g, g + 1))
        for i in range(m):
            at = self.columns(i)
            shared[at, at] = inner[i, :-1, :-1]
            shared[at, -1] = inner[i, :-1, -1]
        own = by_pose[0]
        if m > 1:
            own = np.zeros((n, 6, 7 + g))
            turn = np.zeros((m, 1, 6, 6))
            turn[:, 0, :3, :3] = turn[:, 0, 3:, 3:] = state.rotations
            turned = np.swapaxes(turn, 2, 3) @ by_pose
            own[:, :, :6] = (turned[..., :6] @ turn).sum(axis=0)
            own[:, :, -1] = turned[..., -1].sum(axis=0)
            for i in range(m):
                at = self.columns(i)
                own[:, :, 6 + at.start : 6 + at.stop] = turned[i, :, :, 6:-1]
                if i == 0:
                    continue
                # The place's rotation is about the reference camera's centre.
                carry = np.zeros((n, 6, 6))
                carry[:, range(6), range(6)] = 1.0
                carry[:, :3, 3:] = -hat(state.translation @ state.rotations[i].T)
                place = slice(at.stop, at.stop + 6)
                own[:, :, 6 + place.start : 6 + place.stop] = (
                    turned[i, :, :, :6] @ carry
                )
                back = carry.reshape(6 * n, 6).T
                carried = back @ by_pose[i, :, :, 6:].reshape(6 * n, k + 1)
                shared[place, at] = carried[:, :-1]
                shared[at, place] = carried[:, :-1].T
                shared[place, -1] = carried[:, -1]
                moved = by_pose[i, :, :, :6] @ carry
                shared[place, place] = back @ moved.reshape(6 * n, 6)
        return TargetRows(
            float(inner[:, -1, -1].sum()),
            2 * int(self.seen.sum()),
            6 * n + g,
            NormalEquations(
                own[:, :, :6],
                own[:, :, 6:-1],
                shared[:, :-1],
                own[:, :, -1],
                shared[:, -1],
            ),
        )

    def _products(self, state: TargetState) -> tuple[Floats, Floats] | None:
        """What the pixels say, multiplied out; None with a point behind a camera.

        Returns:
            By rows of the target's pose before each camera: that, the camera's own
            unknowns, residual, (m, n, 6, 7 + k); the same of the camera's own unknowns,
            (m, k + 1, k + 1).
        """
        m, _, n, p = self.pixels.shape
        (of_u, of_v), lens, k = self.moves, len(self.lens), self.inner
        first, second = 6 + len(of_u), 6 + k - len(of_v)
        # One camera's products are the equations themselves, and must last.
        shape = (m, n, 6, 7 + k)
        by_pose = np.empty(shape) if m == 1 else self.scratch.array("products", shape)
        by_pose[..., second:-1] = 0.0
        inner = np.zeros((m, k + 1, k + 1))
        common = len(of_u) + lens
        poses = self.in_cameras(state)
        for block in self._blocks():
            found = self._rows(state, poses, block)
            if found is None:
                return None
            u, v = found
            product = u[:6].transpose(1, 2, 0, 3) @ u.transpose(1, 2, 3, 0)
            by_pose[block][..., :second] = product[..., :-1]
            by_pose[block][..., -1] = product[..., -1]
            product = v[:6].transpose(1, 2, 0, 3) @ v.transpose(1, 2, 3, 0)
            by_pose[block][..., :6] += product[..., :6]
            by_pose[block][..., first:] += product[..., 6:]
            mine = inner[block[0]]
            flat = u[6:].reshape(len(u) - 6, u.shape[1], -1).transpose(1, 0, 2)
            product = flat @ np.swapaxes(flat, 1, 2)
            mine[:, :common, :common] += product[:, :-1, :-1]
            mine[:, :common, -1] += product[:, :-1, -1]
            mine[:, -1, :common] += product[:, -1, :-1]
            mine[:, -1, -1] += product[:, -1, -1]
            flat = v[6:].reshape(len(v) - 6, v.shape[1], -1).transpose(1, 0, 2)
            mine[:, len(of_u) :, len(of_u) :] += flat @ np.swapaxes(flat, 1, 2)
        return by_pose, inner

    def _rows(
        self,
        state: TargetState,
        poses: tuple[Floats, Floats],
        block: tuple[slice, slice],
    ) -> tuple[Floats, Floats] | None:
        """Derivatives of u and of v, then their residuals, (columns, m, n, p).

        None where a seen point is behind a camera.
        """
        cameras, views = block
        rotation, translation = poses[0][block], poses[1][block]
        pixels = self.pixels[cameras, :, views]
        m, n, p = pixels.shape[0], *pixels.shape[2:]
        q = (rotation[..., :2] @ self.plane).transpose(2, 0, 1, 3)
        depth = q[2] + translation[..., 2:]
        complete = all(self.complete[cameras])
        if not complete:
            depth = np.where(self.seen[block], depth, 1.0)
        if depth.min() <= 0:
            return None
        w = 1.0 / depth
        fx, fy, skew, cx, cy = state.intrinsics[cameras].T[..., None, None]
        bent_axes = bool(skew.any())
        of_u, of_v = self.moves
        u = self.scratch.array("u", (7 + len(of_u) + len(self.lens), m, n, p))
        v = self.scratch.array("v", (7 + len(self.lens) + len(of_v), m, n, p))
        # Derivatives of (x, y) by the pose: (w, 0, -xw, -x qy, qz + x qx, -qy) and
        # (0, w, -yw, -qz - y qy, y qx, qx) with q over the depth.
        by_pose = self.scratch.array("by pose", (2, 6, m, n, p))
        near = self.scratch.array("near", (3, m, n, p))
        moved = self.scratch.array("moved", (4, m, n, p))
        np.negative(w, out=near[0])
        np.multiply(q[1], near[0], out=near[1])
        np.multiply(q[0], w, out=near[2])
        qz = q[2] * w
        x = near[2] + translation[..., :1] * w
        y = translation[..., 1:2] * w - near[1]
        np.multiply(x, near, out=by_pose[0, 2:5])
        np.multiply(y, near, out=by_pose[1, 2:5])
        by_pose[0, 4] += qz
        by_pose[1, 3] -= qz
        by_pose[0, 5], by_pose[1, 5] = near[1], near[2]
        start = 6 + len(of_u)
        if self.lenses_bend(state):
            lens = np.array(state.lenses[cameras]).T[..., None, None]
            bent = distort_components(lens, x, y)
            x, y = bent.x, bent.y
            along_x, along_y = fx * bent.x_by_x, fx * bent.x_by_y
            if bent_axes:
                along_x += skew * bent.x_by_y
                along_y += skew * bent.y_by_y
            down_x, down_y = fy * bent.x_by_y, fy * bent.y_by_y
            # A shift of x leaves y, and one of y leaves x.
            for rows, by_x, by_y in ((u, along_x, along_y), (v, down_x, down_y)):
                np.multiply(by_x, w, out=rows[0])
                np.multiply(by_y, w, out=rows[1])
                np.multiply(by_x, by_pose[0, 2:], out=rows[2:6])
                rows[2:6] += np.multiply(by_y, by_pose[1, 2:], out=moved)
            whole = self.lens == tuple(range(len(lens)))
            by_lens = bent.by_lens if whole else bent.by_lens[:, list(self.lens)]
            np.multiply(fx, by_lens[0], out=u[start:-1])
            if bent_axes:
                u[start:-1] += skew * by_lens[1]
            np.multiply(fy, by_lens[1], out=v[6 : 6 + len(self.lens)])
        else:
            by_pose[0, 0] = by_pose[1, 1] = w
            by_pose[0, 1] = by_pose[1, 0] = 0.0
            np.multiply(fx, by_pose[0], out=u[:6])
            if bent_axes:
                u[:6] += skew * by_pose[1]
            np.multiply(fy, by_pose[1], out=v[:6])
        for k, index in enumerate(of_u):
            u[6 + k] = {0: x, 2: y}.get(index, 1.0)
        for k, index in enumerate(of_v):
            v[6 + len(self.lens) + k] = {1: y}.get(index, 1.0)
        np.multiply(fx, x, out=u[-1])
        if bent_axes:
            u[-1] += skew * y
        u[-1] += cx
        u[-1] -= pixels[:, 0]
        np.multiply(fy, y, out=v[-1])
        v[-1] += cy
        v[-1] -= pixels[:, 1]
        if not complete:
            u *= self.seen[block]
            v *= self.seen[block]
        return u, v

    def lenses_bend(self, state: TargetState) -> bool:
        """Whether a lens is estimated or not the identity."""
        return bool(self.lens) or any(lens.any() for lens in state.lenses)

    def residuals(self, state: TargetState) -> Floats:
        """Detected less predicted, shape (m, n, p, 2), px, NaN where unseen."""
        rotation, translation = self.in_cameras(state)
        local = rotation[..., :2] @ self.plane + translation[..., None]
        result = np.empty((*self.seen.shape, 2))
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = (local[..., :2, :] / local[..., 2:, :]).swapaxes(-1, -2)
        for i, (fx, fy, skew, cx, cy) in enumerate(state.intrinsics):
            x, y = np.moveaxis(distort(state.lenses[i], xy[i]), -1, 0)
            result[i, ..., 0] = self.pixels[i, 0] - (fx * x + skew * y + cx)
            result[i, ..., 1] = self.pixels[i, 1] - (fy * y + cy)
        if not all(self.complete):
            result[~self.seen] = np.nan
        return result

    def retract(self, state: TargetState, own: Floats, shared: Floats) -> TargetState:
        """Move a state by steps of poses (n, 6) and shared (g,) unknowns."""
        intrinsics = state.intrinsics.copy()
        rotations, translations = state.rotations, state.translations
        lenses = []
        count = len(self.intrinsics)
        for i, old in enumerate(state.lenses):
            place = self.places[i]
            intrinsics[i, list(self.intrinsics)] += shared[place[:count]]
            lens = old.copy()
            lens[list(self.lens)] += shared[place[count:]]
            lenses.append(lens)
        if len(lenses) > 1:
            steps = np.zeros((len(lenses), 6))
            for i in range(1, len(lenses)):
                steps[i] = shared[self.columns(i).stop :][:6]
            translations = translations + steps[:, :3]
            rotations = so3_exp(steps[:, 3:]) @ rotations
        return TargetState(
            intrinsics,
            tuple(lenses),
            rotations,
            translations,
            so3_exp(own[:, 3:]) @ state.rotation,
            state.translation + own[:, :3],
        )
