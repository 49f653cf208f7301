"""The report's figures of numbers: track, map, budget, residuals, crops."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse
from numpy.typing import NDArray

from handeye_tri.records import (
    Session,
    TrackEvaluation,
)
from handeye_tri.report.style import ESTIMATE, HELD_OUT, INK, RULE, TRUTH, WIDTH, svg
from handeye_tri.summary import digits, round_magnification
from handeye_tri.triangle import VERTICES

if TYPE_CHECKING:
    from handeye_tri.evaluate.views import ViewCheck

Floats = NDArray[np.float64]
Photograph = Callable[[str, int], NDArray[np.uint8]]


# So many stations have room for the word above each.
_ROOMY = 8


def held_out_track(track: TrackEvaluation, radii_95_mm: Sequence[float]) -> str:
    """Robot-reported and observed positions, and their distance, row by row.

    Args:
        track: The held-out track.
        radii_95_mm: Radius that holds 95 % of the predicted errors, one per row.
    """
    rows = np.arange(len(track.stations))

    def draw(figure: Figure) -> None:
        axes = figure.subplots(4, 1, sharex=True, height_ratios=[1, 1, 1, 1.3])
        for k, ax in enumerate(axes[:3]):
            for points, colour, mark, size, label in (
                (track.reported, ESTIMATE, "o", 5.5, "robot reports"),
                (track.observed, HELD_OUT, "x", 4.0, "cameras observe"),
            ):
                ax.plot(
                    *(rows, 1e3 * points[:, k], mark),
                    color=colour,
                    markersize=size,
                    markerfacecolor="none",
                    label=label,
                )
            ax.set_ylabel(f"{'xyz'[k]}, mm")
            ax.grid(color=RULE, linewidth=0.4)
        figure.legend(
            *axes[0].get_legend_handles_labels(),
            ncols=2,
            loc="outside upper left",
            frameon=False,
        )
        ax = axes[3]
        ax.bar(rows, 1e3 * track.distances, color=HELD_OUT, width=0.62)
        ax.plot(
            *(rows, radii_95_mm, "_"),
            color=INK,
            markersize=9,
            label="95 % of errors, predicted",
        )
        ax.set_ylabel("distance, mm")
        ax.set_ylim(0, None)
        ax.grid(axis="y", color=RULE, linewidth=0.4)
        ax.legend(frameon=False, loc="upper left", fontsize=7.5)
        ax.set_ylim(0, 1.3 * ax.get_ylim()[1])
        edges = np.flatnonzero(np.diff(track.stations)) + 0.5
        for ax in axes:
            for edge in edges:
                ax.axvline(edge, color="#999999", linewidth=0.5)
        axes[3].set_xticks(rows, [VERTICES[k] for k in track.markers])
        ends = np.concatenate([[-0.5], edges, [len(rows) - 0.5]])
        # The word before each number only where there is room for it.
        roomy = len(edges) < _ROOMY
        if not roomy:
            axes[0].text(
                *(-0.01, 1.03, "station"),
                transform=axes[0].transAxes,
                ha="right",
                fontsize=7,
            )
        for start, end in zip(ends, ends[1:], strict=False):
            station = int(track.stations[round(start + 0.5)])
            axes[0].text(
                *(0.5 * (start + end), 1.03),
                f"station {station}" if roomy else str(station),
                transform=axes[0].get_xaxis_transform(),
                ha="center",
                fontsize=7,
            )

    return svg("track", draw, 5.4)


def workspace_map(points: Floats, covariance: Floats, radii_mm: Floats) -> str:
    """Predicted 95 % ellipses of the track error, seen from above.

    Args:
        points: Grid at one height in the base, shape (a, b, 3), metres.
        covariance: Of the error at each, shape (a, b, 3, 3), m^2; NaN = not seen
            by enough cameras.
        radii_mm: Radius that holds 95 % of the errors in space, shape (a, b), mm.
    """
    x, y = 1e3 * points[:, 0, 0], 1e3 * points[0, :, 1]
    step = min(float(np.diff(x).min()), float(np.diff(y).min()))
    values, axes = np.linalg.eigh(np.nan_to_num(covariance[..., :2, :2]))
    # Semi-axes of a plane ellipse: 95 % of chi-square with two degrees of freedom.
    semi = 1e3 * np.sqrt(5.991 * np.maximum(values, 0.0))
    factor = round_magnification(float(semi.max()), 0.48 * step)

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        for a, b in np.ndindex(radii_mm.shape):
            if not np.isfinite(radii_mm[a, b]):
                ax.plot(x[a], y[b], "x", color=TRUTH, markersize=4)
                continue
            long = axes[a, b, :, 1]
            ax.add_patch(
                Ellipse(
                    (float(x[a]), float(y[b])),
                    2 * factor * float(semi[a, b, 1]),
                    2 * factor * float(semi[a, b, 0]),
                    angle=float(np.degrees(np.arctan2(long[1], long[0]))),
                    facecolor=ESTIMATE,
                    alpha=0.25,
                    edgecolor=ESTIMATE,
                )
            )
            ax.annotate(
                f"{radii_mm[a, b]:.{digits(float(np.nanmin(radii_mm)))}f}",
                (x[a], y[b]),
                ha="center",
                va="center",
                fontsize=6.5,
            )
        ax.set_xlim(x[0] - 0.6 * step, x[-1] + 0.6 * step)
        ax.set_ylim(y[0] - 0.6 * step, y[-1] + 0.6 * step)
        ax.set_xlabel("x in the robot base, mm")
        ax.set_ylabel("y, mm")
        ax.set_aspect("equal")
        ax.set_title(
            f"height {1e3 * points[0, 0, 2]:.0f} mm; ellipses {factor} times too large"
        )

    ratio = float(np.ptp(y) + 1.2 * step) / float(np.ptp(x) + 1.2 * step)
    return svg("map", draw, float(np.clip(0.86 * WIDTH * ratio, 1.6, 4.0)) + 0.6)


def origin_of_error(parts_mm: Mapping[str, float]) -> str:
    """Shares of the predicted track error's square, largest first."""
    total = sum(value**2 for value in parts_mm.values())
    ordered = sorted(parts_mm.items(), key=lambda item: item[1])

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        names = [name.replace("_", " ") for name, _ in ordered]
        shares = [100 * value**2 / total for _, value in ordered]
        ax.barh(names, shares, color=ESTIMATE, height=0.55)
        for k, (_, value) in enumerate(ordered):
            ax.text(
                *(shares[k] + 1.5, k, f"{shares[k]:.0f} %   {value:.3f} mm rms"),
                va="center",
            )
        ax.set_xlim(0, 145)
        ax.spines[["bottom", "left"]].set_visible(False)
        ax.tick_params(length=0, labelbottom=False)

    return svg("origin", draw, 0.35 + 0.32 * len(ordered))


def residual_maps(session: Session, predicted: Floats) -> tuple[str, int]:
    """Seen less predicted over each camera's image, as arrows.

    Args:
        session: For the detected centres.
        predicted: Shape (m, n, 3, 2), pixels.

    Returns:
        The figure, and how many times too long the arrows are.
    """
    held_out = np.zeros(len(session.stations), dtype=bool)
    held_out[session.indices("evaluation")] = True
    residuals = session.pixels - predicted
    lengths = np.linalg.norm(residuals, axis=-1)
    width = max(camera.image_size[0] for camera in session.cameras)
    largest = float(np.nanmax(lengths, initial=0.0))
    factor = round_magnification(largest, 0.12 * width)
    columns = min(2, len(session.cameras))
    lines = -(-len(session.cameras) // columns)

    def draw(figure: Figure) -> None:
        axes: Any = figure.subplots(lines, columns, squeeze=False)
        for ax in axes.flat[len(session.cameras) :]:
            ax.set_axis_off()
        for i, (ax, camera) in enumerate(zip(axes.flat, session.cameras, strict=False)):
            for which, colour in ((~held_out, ESTIMATE), (held_out, HELD_OUT)):
                at = session.pixels[i, which].reshape(-1, 2)
                by = factor * residuals[i, which].reshape(-1, 2)
                ax.quiver(
                    *(*at.T, *by.T),
                    color=colour,
                    angles="xy",
                    scale_units="xy",
                    scale=1.0,
                    width=0.007,
                )
            ax.set_xlim(-0.5, camera.image_size[0] - 0.5)
            ax.set_ylim(camera.image_size[1] - 0.5, -0.5)
            ax.set_aspect("equal")
            ax.set_xticks([])
            ax.set_yticks([])
            ax.spines[["top", "right"]].set_visible(True)
            ax.set_title(camera.name)

    return svg("residuals", draw, 1.95 * lines), factor


def crops(
    checks: Sequence[ViewCheck],
    session: Session,
    predicted: Floats,
    photograph: Photograph,
) -> str:
    """The worst views' worst markers, cut out of their images.

    Args:
        checks: Which views, each with a marker that was seen.
        session: For the detected centres.
        predicted: Shape (m, n, 3, 2), pixels.
        photograph: Image of a camera (name) at a station (index), uint8.
    """
    names = [camera.name for camera in session.cameras]
    columns = 3
    lines = -(-len(checks) // columns)
    half = 26

    def draw(figure: Figure) -> None:
        axes: Any = figure.subplots(lines, columns, squeeze=False)
        for ax in axes.flat:
            ax.set_axis_off()
        for ax, check in zip(axes.flat, checks, strict=False):
            i, k = names.index(check.camera), VERTICES.index(check.worst)
            seen = session.pixels[i, check.station, k]
            hoped = predicted[i, check.station, k]
            image = photograph(check.camera, check.station)
            _show_crop(ax, image, seen, half)
            colour = HELD_OUT if check.held_out else ESTIMATE
            ring = Circle(
                (seen[0], seen[1]), 0.85 * half, fill=False, color=colour, linewidth=1.5
            )
            ax.add_patch(ring)
            ax.plot(*hoped, "+", color="white", markersize=9)
            ax.set_title(
                f"{check.camera} {check.station}, {check.worst}: "
                f"{check.worst_px:.2f} px",
                fontsize=7,
            )

    return svg("crops", draw, 1.72 * lines)


def _show_crop(ax: Axes, image: NDArray[np.uint8], centre: Floats, half: int) -> None:
    """Show the pixels about a point; the axes are in pixels of the whole image."""
    height, width = image.shape[:2]
    column, row = (round(float(value)) for value in centre)
    left, top = max(column - half, 0), max(row - half, 0)
    part = image[
        top : min(row + half + 1, height), left : min(column + half + 1, width)
    ]
    bottom, right = top + part.shape[0], left + part.shape[1]
    ax.imshow(
        part,
        cmap="gray",
        vmin=0,
        vmax=255,
        interpolation="nearest",
        extent=(left - 0.5, right - 0.5, bottom - 0.5, top - 0.5),
    )
    ax.set_xlim(column - half - 0.5, column + half + 0.5)
    ax.set_ylim(row + half + 0.5, row - half - 0.5)
