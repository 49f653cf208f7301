"""Names in a drawing, where they cover neither each other nor lines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.text import Text
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# From a place to the nearest side of its name, points.
_GAPS = (5.0, 9.0, 14.0, 20.0)
_DIRECTIONS = np.radians(np.arange(0.0, 360.0, 15.0))
# Lines are looked at as points this far apart, and names keep as far from them, pixels.
_GRAIN = 2.0


def place_names(
    ax: Axes,
    names: Sequence[str],
    places: Floats,
    others: Sequence[Text],
    lines: Floats,
) -> list[Text]:
    """Write names beside their places, each where it covers least.

    One after the other: the first free room, near before far. What covers nothing is
    free; where no room is, the one that covers the fewest points.

    Args:
        ax: Where all that is not a name is drawn, its limits settled.
        names: n names.
        places: Shape (n, 2), in the coordinates of the axes.
        others: Texts that must stay free.
        lines: Ends of the lines that must, shape (m, 2, 2), in those coordinates.
    """
    figure = ax.get_figure(root=True)
    assert figure is not None
    written = [
        ax.annotate(
            name,
            (place[0], place[1]),
            xytext=(0, 0),
            textcoords="offset points",
            ha="center",
            va="center",
        )
        for name, place in zip(names, places, strict=True)
    ]
    figure.draw_without_rendering()
    per_point = figure.dpi / 72.0
    ends = ax.transData.transform(lines.reshape(-1, 2)).reshape(-1, 2, 2)
    covered = [
        start
        + np.linspace(0.0, 1.0, 2 + int(np.linalg.norm(end - start) / _GRAIN))[:, None]
        * (end - start)
        for start, end in ends
    ]
    boxes = [np.array(text.get_window_extent().extents) for text in others]
    for text, place in zip(written, places, strict=True):
        size = np.array(text.get_window_extent().size)
        origin = ax.transData.transform(place)
        best, fewest = np.zeros(2), np.inf
        for gap in _GAPS:
            for angle in _DIRECTIONS:
                way = np.array([np.cos(angle), np.sin(angle)])
                away = way * (gap * per_point + 0.5 * np.abs(way) @ size)
                low = origin + away - 0.5 * size - _GRAIN
                high = origin + away + 0.5 * size + _GRAIN
                count = sum(
                    float(((points > low) & (points < high)).all(axis=1).sum())
                    for points in covered
                )
                for box in boxes:
                    shared = np.minimum(high, box[2:]) - np.maximum(low, box[:2])
                    count += float(np.prod(shared.clip(0.0))) / _GRAIN**2
                if count < fewest:
                    best, fewest = away, count
        text.set_position((best[0] / per_point, best[1] / per_point))
        centre = origin + best
        boxes.append(np.concatenate([centre - 0.5 * size, centre + 0.5 * size]))
    return [*written]
