"""Things of known shape to photograph: a chessboard, and a cup with a print."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.experiments.chessboard import Board
from handeye_tri.mechanism import Geometry
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]

_BLACK, _WHITE, _CHINA = 0.06, 0.62, 0.50
# Levels of the cup's print: two dark and two light ones in a chequer, so that every
# corner is sharp and no two places look alike.
_INKS = (0.04, 0.16, 0.44, 0.62)
_INK_SEED = 10


def _quads(name: str, grey: float, quads: Sequence[Floats]) -> Geometry:
    """Quadrilaterals of one grey, each (4, 3), counter-clockwise from outside."""
    vertices = np.concatenate(quads)
    first = 4 * np.arange(len(quads))[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])
    return Geometry(
        name,
        0,
        "mesh",
        np.empty(0),
        SE3.identity(),
        vertices,
        faces,
        np.array([grey, grey, grey, 1.0]),
        False,
    )


def board_solids(board: Board) -> tuple[Geometry, ...]:
    """A chessboard whose inner corners are ``board.points``, seen from -z.

    One square of white surrounds the pattern.
    """
    square = board.square
    cells: dict[bool, list[Floats]] = {True: [], False: []}
    for row in range(-2, board.rows + 1):
        for column in range(-2, board.columns + 1):
            inside = -1 <= row < board.rows and -1 <= column < board.columns
            black = inside and (row + column) % 2 == 0
            corners = np.array([(0, 0), (0, 1), (1, 1), (1, 0)]) + (column, row)
            cells[black].append(square * np.column_stack([corners, np.zeros(4)]))
    return (
        _quads("black", _BLACK, cells[True]),
        _quads("white", _WHITE, cells[False]),
    )


@dataclass(frozen=True, slots=True)
class Cup:
    """A cup whose wall is a prism with a print of grey patches.

    Its frame stands in the middle of its bottom, z up.

    Attributes:
        sides: Patches around.
        rows: Patches high.
        radius: Of the circle through the wall's vertical edges, metres.
        height: Metres.
    """

    sides: int = 20
    rows: int = 8
    radius: float = 0.045
    height: float = 0.11

    @property
    def corners(self) -> Floats:
        """Corners of the print, shape (rows + 1, sides, 3), metres."""
        angle = 2 * np.pi * np.arange(self.sides) / self.sides
        around = self.radius * np.column_stack([np.cos(angle), np.sin(angle)])
        heights = np.linspace(0.0, self.height, self.rows + 1)
        result = np.empty((self.rows + 1, self.sides, 3))
        result[..., :2] = around
        result[..., 2] = heights[:, None]
        return result

    @property
    def inks(self) -> NDArray[np.intp]:
        """Which of the greys each patch has, shape (rows, sides)."""
        rng = np.random.default_rng(_INK_SEED)
        row, side = np.indices((self.rows, self.sides))
        return 2 * ((row + side) % 2) + rng.integers(2, size=row.shape)

    @property
    def solids(self) -> tuple[Geometry, ...]:
        """Wall, inside and handle."""
        grid, inks = self.corners, self.inks
        printed: dict[int, list[Floats]] = {ink: [] for ink in range(len(_INKS))}
        inner = grid * (0.93, 0.93, 1.0)
        china = []
        for side in range(self.sides):
            after = (side + 1) % self.sides
            for row in range(self.rows):
                patch = grid[[row, row, row + 1, row + 1], [side, after, after, side]]
                printed[int(inks[row, side])].append(patch)
            low, high, rim = inner[0], inner[-1], grid[-1]
            china.append(np.array([low[after], low[side], high[side], high[after]]))
            china.append(np.array([rim[side], rim[after], high[after], high[side]]))
            middle = np.array([0.0, 0.0, 0.002])
            china.append(np.array([low[side], low[after], middle, middle]))
        greys = [
            _quads(f"print {ink}", _INKS[ink], quads) for ink, quads in printed.items()
        ]
        return (*greys, _quads("inside", _CHINA, china), self._handle())

    def _handle(self) -> Geometry:
        """Half a ring, round in section, on the side of -x."""
        bend = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)[:, None]
        around = np.linspace(0.0, 2 * np.pi, 9)
        reach, lift, thick = 0.030, 0.3 * self.height, 0.006
        out, up = np.cos(bend), np.sin(bend)
        swell = 1.0 + thick / reach * np.cos(around)
        x = -0.96 * self.radius - reach * out * swell
        y = np.broadcast_to(thick * np.sin(around), x.shape)
        z = 0.5 * self.height + lift * up * swell
        ring = np.stack([x, y, z], axis=-1)
        quads = [
            ring[[i, i + 1, i + 1, i], [j, j, j + 1, j + 1]]
            for i in range(len(bend) - 1)
            for j in range(len(around) - 1)
        ]
        return _quads("handle", _CHINA, quads)


def block_solids(size: Sequence[float]) -> tuple[Geometry, ...]:
    """A block to stand things on, the origin in the middle of its top; size in m."""
    x, y, z = 0.5 * size[0], 0.5 * size[1], size[2]
    top = np.array([(-x, -y, 0.0), (x, -y, 0.0), (x, y, 0.0), (-x, y, 0.0)])
    low = top - (0.0, 0.0, z)
    walls = [
        np.array([low[k], low[(k + 1) % 4], top[(k + 1) % 4], top[k]]) for k in range(4)
    ]
    return (_quads("block", 0.35, [top, *walls]),)
