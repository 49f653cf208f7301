"""What the cameras saw of half-turns: lines through O; numpy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import PinholeCamera
from handeye_tri.records import Session
from handeye_tri.triangle import EDGES, VERTICES, Axis

Floats = NDArray[np.float64]

# Points per drawn half-turn line: enough to show what a lens bends.
_LINE_POINTS = 17
# Two places of one marker closer than this lie on the axis, pixels.
_STANDS_STILL = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class HalfTurnView:
    """What one camera saw of a half-turn.

    Attributes:
        lines: From each moving marker before to the same after, as curves that the
            lens bends; each of shape (p, 2), pixels.
        centre: O, where the lines meet the axis, shape (2,), pixels; NaN where the
            view does not show it.
        markers: Letters of the markers that the lines are of.
        edge: The edge that is the axis, of the same shape; None about the normal.
    """

    lines: tuple[Floats, ...]
    centre: Floats
    markers: str = ""
    edge: Floats | None = None


def half_turn_views(
    session: Session, i: int, camera: PinholeCamera
) -> tuple[HalfTurnView, ...]:
    """What camera i saw of each station's half-turn; without lines where of none."""
    views = [HalfTurnView((), np.full(2, np.nan)) for _ in session.stations]
    for turn in session.half_turns:
        seen = half_turn_view(
            camera,
            session.pixels[i, turn.before],
            session.pixels[i, turn.after],
            turn.axis,
        )
        views[turn.before] = views[turn.after] = seen
    return tuple(views)


def half_turn_view(
    camera: PinholeCamera, before: Floats, after: Floats, axis: Axis
) -> HalfTurnView:
    """Lines from each marker to its twin, and O where they meet the axis.

    About the normal all three lines pass through O (Zhao, Liu and Zhang 2008,
    Sec. III-A); about an edge the third vertex' line meets that edge in the foot of
    its perpendicular (Sec. III-B).
    """
    moved = np.linalg.norm(after - before, axis=1) > _STANDS_STILL
    # Lines are straight where there is no lens.
    start, end = camera.normalised(before[moved]), camera.normalised(after[moved])
    along = np.linspace(0.0, 1.0, _LINE_POINTS)[:, None, None]
    curves = camera.pixels(start + along * (end - start))
    pairs = list(zip(start, end, strict=True))
    edge = None
    if axis in EDGES:
        on_axis = camera.normalised(before[list(EDGES[axis])])
        if np.isfinite(on_axis).all():
            pairs.append((on_axis[0], on_axis[1]))
            edge = camera.pixels(on_axis[0] + along[:, 0] * (on_axis[1] - on_axis[0]))
    centre = np.full(2, np.nan)
    if len(pairs) >= 2:
        centre = camera.pixels(_meeting_point(np.array(pairs)))
    letters = "".join(VERTICES[k] for k in np.flatnonzero(moved))
    return HalfTurnView(tuple(np.moveaxis(curves, 1, 0)), centre, letters, edge)


def _meeting_point(pairs: Floats) -> Floats:
    """Point nearest to lines through pairs of points, (k, 2, 2) -> (2,)."""
    along = pairs[:, 1] - pairs[:, 0]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    offset = (normal * pairs[:, 0]).sum(axis=1)
    return np.asarray(np.linalg.lstsq(normal, offset)[0])
