"""Fig. 9: the corners of a model plane, reconstructed by the calibrated pair.

The pair of the rendered clock looks at a rendered plane; that of real views at the
real boards, where there are some.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import StereoRig
from handeye_tri.experiments.chessboard import Board, BoardViews, zhang_pair
from handeye_tri.experiments.outcome import Options, Outcome, finish, new_figure
from handeye_tri.experiments.real_views import calibrate_views
from handeye_tri.experiments.rendered import calibrate_rendered, rendered_board_views
from handeye_tri.experiments.table1 import CLOCK

Floats = NDArray[np.float64]

# Allowed difference of the mean distance of adjacent corners from the truth.
_MEAN_MM = 0.05
# Any equal noise of all corners gives the same points; this is about what it is.
_SIGMA_PX = 0.2
_PAPER_MM = 30.21


@dataclass(frozen=True, slots=True)
class Row:
    """One view of the model plane, reconstructed.

    Attributes:
        views: "clock" (rendered) or "boards" (real).
        method: "three points" or "Zhang".
        view: Number of the pair.
        corners: Reconstructed.
        mean_mm: Mean distance of adjacent corners.
        std_mm: Its standard deviation over the corners.
        off_plane_mm: RMS distance of the corners from their best plane.
    """

    views: str
    method: str
    view: str
    corners: int
    mean_mm: float
    std_mm: float
    off_plane_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """All views of the model plane, reconstructed by one pair of cameras.

    Attributes:
        views: As in the rows.
        method: As in the rows.
        seen: The corners.
        points: In the left camera's frame, shape (views, corners, 3), metres.
    """

    views: str
    method: str
    seen: BoardViews
    points: Floats

    @property
    def distances_mm(self) -> Floats:
        """Of all adjacent corners, shape (n,)."""
        each = [adjacent(points, self.seen.board) for points in self.points]
        return np.asarray(1e3 * np.concatenate(each))

    @property
    def off_plane_mm(self) -> float:
        """RMS over all corners."""
        each = [off_plane(points) for points in self.points]
        return 1e3 * float(np.sqrt(np.mean(np.square(each))))

    @property
    def rows(self) -> list[Row]:
        """One per view."""
        rows = []
        for name, points in zip(self.seen.names, self.points, strict=True):
            apart = 1e3 * adjacent(points, self.seen.board)
            rows.append(
                Row(
                    *(self.views, self.method, name, len(points)),
                    *(float(apart.mean()), float(apart.std()), 1e3 * off_plane(points)),
                )
            )
        return rows


def run(options: Options) -> Outcome:
    """Reconstruct every view; compare with the pair calibrated by Zhang's method."""
    rendered = calibrate_rendered(options, CLOCK)
    seen = rendered_board_views(options, CLOCK)
    found = [
        _reconstructed("clock", "three points", rendered.rig, seen),
        _reconstructed("clock", "Zhang", zhang_pair(seen, lens=False), seen),
    ]
    if options.images is not None:
        real = calibrate_views(options.images)
        found += [
            _reconstructed("boards", "three points", real.rig, real.views),
            _reconstructed("boards", "Zhang", zhang_pair(real.views), real.views),
        ]
    true = 1e3 * seen.board.square
    ours = [one for one in found if one.method == "three points"]
    parts = [
        f"{_NAMES[one.views]}: {one.distances_mm.size} adjacent corners "
        f"{one.distances_mm.mean():.3f} mm apart in the mean (Zhang "
        f"{other.distances_mm.mean():.3f}), STD {one.distances_mm.std():.3f} (Zhang "
        f"{other.distances_mm.std():.3f}), off their planes {one.off_plane_mm:.2f} mm "
        f"rms (Zhang {other.off_plane_mm:.2f})"
        for one, other in zip(ours, found[1::2], strict=True)
    ]
    if options.images is None:
        parts.append("no real views (--images)")
    return finish(
        options,
        "fig09",
        "Fig. 9: reconstruction results in the first real experiment",
        passed=all(abs(one.distances_mm.mean() - true) <= _MEAN_MM for one in ours),
        sentence=(
            f"{'; '.join(parts)} (truth {true:g} mm, allowed +-{_MEAN_MM:g}; the paper "
            f"{_PAPER_MM})"
        ),
        rows=[asdict(row) for one in found for row in one.rows],
        figure=_drawn(ours, true),
    )


_NAMES = {"clock": "rendered clock", "boards": "real boards"}


def _reconstructed(
    views: str, method: str, rig: StereoRig, seen: BoardViews
) -> Reconstruction:
    return Reconstruction(views, method, seen, reconstruct(rig, seen))


def reconstruct(rig: StereoRig, views: BoardViews) -> Floats:
    """Corners in the left camera's frame, shape (views, corners, 3), metres."""
    pixels = views.corners.reshape(2, -1, 2)
    covariance = np.broadcast_to(_SIGMA_PX**2 * np.eye(2), (*pixels.shape, 2))
    points, _ = rig.triangulate(pixels, covariance)
    return points.reshape(len(views.names), -1, 3)


def adjacent(points: Floats, board: Board) -> Floats:
    """Distances of adjacent corners of one view, corners of shape (k, 3), metres."""
    grid = points.reshape(board.rows, board.columns, 3)
    across = np.linalg.norm(np.diff(grid, axis=1), axis=-1)
    down = np.linalg.norm(np.diff(grid, axis=0), axis=-1)
    return np.concatenate([across.ravel(), down.ravel()])


def off_plane(points: Floats) -> float:
    """RMS distance of points, shape (k, 3), from the plane that fits them best."""
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(singular[2] / np.sqrt(len(points)))


def _drawn(found: Sequence[Reconstruction], true: float) -> Any:
    figure, axes = new_figure(14.0, 4.6 * len(found), len(found), 3)
    for line, one in zip(axes, found, strict=True):
        front, flat, spread = line
        _draw_planes(front, flat, one)
        front.set_title(f"{_NAMES[one.views]}: as the left camera sees it")
        flat.set_title(f"coplanar within {one.off_plane_mm:.2f} mm rms")
        spread.set_title("distances against the truth")
        distances = one.distances_mm
        spread.hist(distances, 40, color="#1f5fa8")
        spread.axvline(true, color="black", linestyle="--", label=f"truth {true:g} mm")
        mean = distances.mean()
        spread.axvline(mean, color="#d95f02", label=f"mean {mean:.3f} mm")
        spread.set_xlabel("distance of adjacent corners, mm")
        spread.set_ylabel("pairs of corners")
        spread.legend(fontsize=9)
    figure.suptitle("Fig. 9: the model plane in every pair of views")
    return figure


def _draw_planes(front: Any, flat: Any, found: Reconstruction) -> None:
    """Every view by itself, side by side; and how far corners are off its plane."""
    from matplotlib import colormaps

    board = found.seen.board
    count = len(found.points)
    colours = colormaps["viridis"](np.linspace(0, 0.9, count))
    across = int(np.ceil(np.sqrt(count)))
    for k, (points, colour) in enumerate(zip(found.points, colours, strict=True)):
        own = 1e3 * (points - points.mean(axis=0))
        place = np.array([k % across, k // across, 0]) * (330.0, 300.0, 0.0)
        grid = (own + place).reshape(board.rows, board.columns, 3)
        for lines in (grid, grid.swapaxes(0, 1)):
            for line in lines:
                front.plot(line[:, 0], line[:, 1], color=colour, linewidth=0.7)
        label = found.seen.names[k]
        front.text(*place[:2], label, fontsize=8, ha="center", va="center", zorder=5)
        axes = np.linalg.svd(own, full_matrices=False)[2]
        flat.plot(own @ axes[0], own @ axes[2], ".", color=colour, markersize=3)
    front.invert_yaxis()
    front.set_aspect("equal")
    front.set_xlabel("x, mm (views side by side)")
    front.set_ylabel("y (down), mm")
    flat.axhline(0, color="black", linewidth=0.8)
    flat.set_xlabel("along the plane, mm")
    flat.set_ylabel("distance of corners from their plane, mm")
