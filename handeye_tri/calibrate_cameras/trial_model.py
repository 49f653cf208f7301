"""Residuals and derivatives of half-turns of many independent trials at once.

The model of :mod:`refine` for exact half-turns, with every number of a trial in the
last axis of contiguous arrays, so that numpy works on hundreds of half-turns at a time
and nothing loops over them. A half-turn about a normal or an edge keeps the markers in
their plane: it is a flat target of six points before one pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.trial_equations import Equations, Scratch
from handeye_tri.camera import distort_components

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Which of (fx, fy, skew, cx, cy) move the column of a pixel, and which its row.
_MOVES = ((0, 2, 3), (1, 4))


@dataclass(frozen=True, slots=True, eq=False)
class TrialState:
    """One value of all unknowns of c trials.

    Attributes:
        intrinsics: fx, fy, skew, cx, cy, shape (5, c), pixels.
        lens: Lens coefficients, shape (5, c) or (8, c).
        rotation: camera_from_triangle before each half-turn, shape (3, 3, n, c).
        translation: The same, shape (3, n, c), metres.
        o: Foot of the normal axes, triangle's frame, (2, n, c) or (2, 1, c), metres.
    """

    intrinsics: Floats
    lens: Floats
    rotation: Floats
    translation: Floats
    o: Floats

    def take(self, rows: NDArray[np.intp] | Bools) -> TrialState:
        """Some of the trials, by index or mask, shape (c,)."""
        return TrialState(*(getattr(self, f.name)[..., rows] for f in fields(self)))

    def put(self, rows: NDArray[np.intp] | Bools, other: TrialState) -> None:
        """Overwrite some of the trials, by index or mask, shape (c,)."""
        for one in fields(self):
            getattr(self, one.name)[..., rows] = getattr(other, one.name)


@dataclass(frozen=True, slots=True, eq=False)
class TrialModel:
    """Measurements of c trials and the choice of unknowns.

    Own unknowns of a half-turn, in order: translation and rotation of its pose (6, in
    the camera's directions), O if free (2). Shared: see
    ``places``.

    Attributes:
        pixels: Shape (2, 6, n, c): column and row; A B C before, A B C after.
        weight: 1 for half-turns that count and 0 for others, shape (n, c).
        plane: Markers before and, with O at the origin, after; (2, 6, n, 1), metres.
        reach: Their derivative by O, shape (6, n, 1).
        intrinsics: Indices of the estimated intrinsics.
        lens: Indices of the estimated lens coefficients.
        o_mode: Whether O is estimated: "known", "shared" or "free".
        scratch: For intermediate results.
    """

    pixels: Floats
    weight: Floats
    plane: Floats
    reach: Floats
    intrinsics: tuple[int, ...]
    lens: tuple[int, ...]
    o_mode: str
    scratch: Scratch = field(default_factory=Scratch)

    @property
    def own_unknowns(self) -> int:
        """Number of unknowns of each half-turn."""
        return 8 if self.o_mode == "free" else 6

    @property
    def shared_unknowns(self) -> int:
        """Number of unknowns that a trial's half-turns share."""
        camera = len(self.intrinsics) + len(self.lens)
        return camera + 2 * (self.o_mode == "shared")

    @property
    def moves(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Estimated intrinsics that move the column of a pixel, and its row."""
        u, v = (tuple(k for k in one if k in self.intrinsics) for one in _MOVES)
        return u, v

    @property
    def places(self) -> list[int]:
        """Where intrinsics, lens and O are among the shared unknowns.

        These are ordered: intrinsics that move u; lens and O; intrinsics that move v.
        """
        u, v = self.moves
        second = self.shared_unknowns - len(v)
        inner = [u.index(k) if k in u else second + v.index(k) for k in self.intrinsics]
        return inner + list(range(len(u), second))

    def take(self, rows: NDArray[np.intp] | Bools) -> TrialModel:
        """Some of the trials, by index or mask, shape (c,)."""
        return replace(
            self, pixels=self.pixels[..., rows], weight=self.weight[..., rows]
        )

    def evaluate(self, state: TrialState, slot: int = 0) -> Equations:
        """Normal equations; cost NaN where a marker is behind the camera.

        Args:
            state: Where.
            slot: Of the scratch that takes the result, until it is next used.
        """
        n, c = self.weight.shape
        fx, fy, skew, cx, cy = state.intrinsics
        r, t = state.rotation, state.translation
        px, py = self.plane
        if self.o_mode != "known":
            px, py = px + self.reach * state.o[0], py + self.reach * state.o[1]
        q = [r[i, 0] * px + r[i, 1] * py for i in range(3)]
        depth = q[2] + t[2]
        behind = (np.where(self.weight > 0, depth, 1.0) <= 0).any(axis=(0, 1))
        behind |= ~((fx > 0) & (fy > 0))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            w = 1.0 / depth
            x, y = (q[0] + t[0]) * w, (q[1] + t[1]) * w
            equations = self._equations(state, q, w, x, y, slot)
        if behind.any():
            equations.shared[..., behind] = np.nan
        return equations

    def _equations(
        self,
        state: TrialState,
        q: list[Floats],
        w: Floats,
        x: Floats,
        y: Floats,
        slot: int,
    ) -> Equations:
        n, c = self.weight.shape
        size, g = self.own_unknowns, self.shared_unknowns
        first, second = size + len(self.moves[0]), size + g - len(self.moves[1])
        rows_u, rows_v = self._rows(state, q, w, x, y)
        if not self.weight.all():
            rows_u = np.where(self.weight > 0, rows_u, 0.0)
            rows_v = np.where(self.weight > 0, rows_v, 0.0)
        own = self.scratch.array(f"own {slot}", (size, size + g + 1, n, c))
        shared = np.zeros((g + 1, g + 1, c))
        for k in range(size):
            product = self.scratch.array("product", (len(rows_u) - k, n, c))
            np.einsum("pnc,jpnc->jnc", rows_u[k], rows_u[k:], out=product)
            own[k, k:second] = product[:-1]
            own[k, second:-1] = 0.0
            own[k, -1] = product[-1]
            product = self.scratch.array("product", (len(rows_v) - k, n, c))
            np.einsum("pnc,jpnc->jnc", rows_v[k], rows_v[k:], out=product)
            own[k, k:size] += product[: size - k]
            own[k, first:] += product[size - k :]
            # What no residual depends on stays put.
            own[k, k][own[k, k] == 0.0] = 1.0
        for k in range(size, second + 1):
            product = np.einsum("pnc,jpnc->jc", rows_u[k], rows_u[k:])
            at = k - size if k < second else g
            shared[at, at : second - size] = product[:-1]
            shared[at, g] = product[-1]
        for k in range(size, len(rows_v)):
            product = np.einsum("pnc,jpnc->jc", rows_v[k], rows_v[k:])
            at = k - size + first - size
            shared[at, at:] += product
        return Equations(own, shared, self.scratch)

    def _rows(
        self, state: TrialState, q: list[Floats], w: Floats, x: Floats, y: Floats
    ) -> tuple[Floats, Floats]:
        """Derivatives of u and of v, then their residuals, (columns, 6, n, c)."""
        n, c = self.weight.shape
        fx, fy, skew, cx, cy = state.intrinsics
        qx, qy, qz = (part * w for part in q)
        # Derivatives of (x, y), None for zero.
        along: list[tuple[Floats | None, Floats | None]] = [
            (w, None),
            (None, w),
            (-x * w, -y * w),
            (-x * qy, -qz - y * qy),
            (qz + x * qx, y * qx),
            (-qy, qx),
        ]
        by_o: list[tuple[Floats, Floats]] = []
        if self.o_mode != "known":
            r, moved = state.rotation, w * self.reach
            by_o = [
                (moved * (r[0, j] - x * r[2, j]), moved * (r[1, j] - y * r[2, j]))
                for j in range(2)
            ]
        if self.o_mode == "free":
            along += by_o
        # Derivatives of u and v by (x, y).
        to_u: tuple[Floats, Floats | None] = (fx, skew if skew.any() else None)
        to_v: tuple[Floats | None, Floats] = (None, fy)
        by_lens: list[tuple[Floats, Floats]] = []
        if self.lens or state.lens.any():
            bent = distort_components(state.lens, x, y)
            x, y = bent.x, bent.y
            to_u = (
                fx * bent.x_by_x + skew * bent.x_by_y,
                fx * bent.x_by_y + skew * bent.y_by_y,
            )
            to_v = (fy * bent.x_by_y, fy * bent.y_by_y)
            by_lens = [
                (fx * along_x + skew * along_y, fy * along_y)
                for along_x, along_y in (bent.by_lens[:, k] for k in self.lens)
            ]
        result = []
        for image, factors in enumerate((to_u, to_v)):
            mine = self.moves[image]
            extra = by_o if self.o_mode == "shared" else []
            common = len(by_lens) + len(extra)
            count = len(along) + len(mine) + common + 1
            rows = self.scratch.array(f"rows {image}", (count, 6, n, c))
            columns = iter(rows)
            for pair in along:
                _combine(factors, pair, next(columns))
            # Columns of u alone come first, of v alone last, so that what both have
            # is in one piece.
            before, after = (mine, ()) if image == 0 else ((), mine)
            for k in before:
                next(columns)[:] = {0: x, 2: y}.get(k, 1.0)
            for lens in by_lens:
                next(columns)[:] = lens[image]
            for pair in extra:
                _combine(factors, pair, next(columns))
            for k in after:
                next(columns)[:] = {1: y}.get(k, 1.0)
            result.append(rows)
        u, v = result
        np.multiply(fx, x, out=u[-1])
        u[-1] += skew * y
        u[-1] += cx - self.pixels[0]
        np.multiply(fy, y, out=v[-1])
        v[-1] += cy - self.pixels[1]
        return u, v

    def retract(self, state: TrialState, own: Floats, shared: Floats) -> TrialState:
        """Move a state by steps of own (l, n, c) and shared (g, c) unknowns."""
        intrinsics, lens, o = state.intrinsics.copy(), state.lens, state.o
        place = self.places
        count = len(self.intrinsics)
        intrinsics[list(self.intrinsics)] += shared[place[:count]]
        if self.lens:
            lens = lens.copy()
            lens[list(self.lens)] += shared[place[count : count + len(self.lens)]]
        if self.o_mode == "shared":
            o = o + shared[place[-2:], None]
        elif self.o_mode == "free":
            o = o + own[6:8]
        rotation = _turned(state.rotation, own[3:6])
        return TrialState(intrinsics, lens, rotation, state.translation + own[:3], o)


def _combine(
    factors: tuple[Floats | None, Floats | None],
    values: tuple[Floats | None, Floats | None],
    out: Floats,
) -> None:
    """Sum of products; None is zero."""
    started = False
    for factor, value in zip(factors, values, strict=True):
        if factor is None or value is None:
            continue
        if started:
            out += factor * value
        else:
            np.multiply(factor, value, out=out)
        started = True
    if not started:
        out[:] = 0.0


def _turned(rotation: Floats, vector: Floats) -> Floats:
    """Rotations turned from the left by small vectors (Cayley), (3, 3, ...)."""
    half = 0.5 * vector
    factor = 2.0 / (1.0 + (half * half).sum(axis=0))
    x, y, z = half
    result = np.empty_like(rotation)
    for j in range(3):
        a, b, c = rotation[:, j]
        # R + factor (v x R + v x (v x R)).
        da, db, dc = y * c - z * b, z * a - x * c, x * b - y * a
        result[0, j] = a + factor * (da + y * dc - z * db)
        result[1, j] = b + factor * (db + z * da - x * dc)
        result[2, j] = c + factor * (dc + x * db - y * da)
    return result
