"""Fig. 9: the corners of a model plane, reconstructed by the calibrated pair."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import StereoRig
from handeye_tri.experiments.chessboard import Board, BoardViews, zhang_pair
from handeye_tri.experiments.outcome import Options, Outcome, finish, new_figure
from handeye_tri.experiments.real_views import calibrate_views

Floats = NDArray[np.float64]

# Allowed difference of the mean distance of adjacent corners from the truth.
_MEAN_MM = 0.05
# Any equal noise of all corners gives the same points; this is about what it is.
_SIGMA_PX = 0.2


@dataclass(frozen=True, slots=True)
class Row:
    """One view of the board, reconstructed.

    Attributes:
        method: "three points" or "Zhang".
        view: Number of the pair.
        corners: Reconstructed.
        mean_mm: Mean distance of adjacent corners.
        std_mm: Its standard deviation over the corners.
        off_plane_mm: RMS distance of the corners from their best plane.
    """

    method: str
    view: str
    corners: int
    mean_mm: float
    std_mm: float
    off_plane_mm: float


def run(options: Options) -> Outcome:
    """Reconstruct every view; compare with the pair calibrated by Zhang's method."""
    real = calibrate_views(options)
    views = real.views
    ours = reconstruct(real.rig, views)
    other = reconstruct(zhang_pair(views), views)
    rows = [*_rows("three points", ours, views), *_rows("Zhang", other, views)]
    distances, theirs = (
        1e3 * np.concatenate([adjacent(points, views.board) for points in all_points])
        for all_points in (ours, other)
    )
    true = 1e3 * views.board.square
    flat, flat_other = (
        float(np.sqrt(np.mean([row.off_plane_mm**2 for row in half])))
        for half in (rows[: len(ours)], rows[len(ours) :])
    )
    return finish(
        options,
        "fig09",
        "Fig. 9: reconstruction results in the first real experiment",
        passed=abs(distances.mean() - true) <= _MEAN_MM,
        sentence=(
            f"{len(distances)} adjacent corners {distances.mean():.3f} mm apart in the "
            f"mean (truth {true:g}, allowed +-{_MEAN_MM:g}; the paper 30.21; Zhang "
            f"here {theirs.mean():.3f}), STD {distances.std():.3f} mm (Zhang "
            f"{theirs.std():.3f}); off their planes {flat:.2f} mm rms (Zhang "
            f"{flat_other:.2f})"
        ),
        rows=[asdict(row) for row in rows],
        figure=_drawn(ours, views.board, distances, true),
    )


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


def _rows(method: str, all_points: Floats, views: BoardViews) -> list[Row]:
    rows = []
    for name, points in zip(views.names, all_points, strict=True):
        distance = 1e3 * adjacent(points, views.board)
        rows.append(
            Row(
                method,
                name,
                len(points),
                float(distance.mean()),
                float(distance.std()),
                1e3 * off_plane(points),
            )
        )
    return rows


def _drawn(all_points: Floats, board: Board, distances: Floats, true: float) -> Any:
    from matplotlib import colormaps

    figure, axes = new_figure(14.0, 4.6, 1, 3)
    front, above, spread = axes[0]
    colours = colormaps["viridis"](np.linspace(0, 0.9, len(all_points)))
    for points, colour in zip(all_points, colours, strict=True):
        grid = 1e3 * points.reshape(board.rows, board.columns, 3)
        for panel, vertical in ((front, 1), (above, 2)):
            for lines in (grid, grid.swapaxes(0, 1)):
                for line in lines:
                    panel.plot(
                        line[:, 0], line[:, vertical], color=colour, linewidth=0.7
                    )
    front.invert_yaxis()
    front.set_title("as the left camera sees them")
    above.set_title("from above: boards tilt, corners stay on planes")
    for panel, name in ((front, "y (down)"), (above, "z (forward)")):
        panel.set_aspect("equal")
        panel.set_xlabel("x, mm")
        panel.set_ylabel(f"{name}, mm")
    spread.hist(distances, 40, color="#1f5fa8")
    spread.axvline(true, color="black", linestyle="--", label=f"truth {true:g} mm")
    spread.axvline(
        distances.mean(), color="#d95f02", label=f"mean {distances.mean():.3f} mm"
    )
    spread.set_xlabel("distance of adjacent corners, mm")
    spread.set_ylabel("pairs of corners")
    spread.legend(fontsize=9)
    figure.suptitle("Fig. 9: the model plane in every pair of views")
    return figure
