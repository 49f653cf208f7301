"""How the report's figures look, and their way into the page."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

# As in the recording, darker for white paper: estimate, held out, truth.
ESTIMATE, HELD_OUT, TRUTH = "#1868c7", "#c86400", "#8a8a8a"
INK, RULE = "#222222", "#d9d9d9"
_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 8.0,
    "axes.edgecolor": "#999999",
    "axes.labelcolor": INK,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 8.5,
    "xtick.color": INK,
    "ytick.color": INK,
    "text.color": INK,
    "svg.fonttype": "none",
    # A dollar in a camera's name is a dollar.
    "text.parse_math": False,
    "axes.unicode_minus": False,
}
# Inches: a phone shows a figure this wide at nearly its own size.
WIDTH = 4.6


def svg(name: str, draw: Callable[[Figure], None], height: float) -> str:
    """A figure as SVG, the same bytes for the same numbers.

    Args:
        name: Keeps the identities inside apart from other figures'.
        draw: Puts the drawing on a figure.
        height: Inches.
    """
    with mpl.rc_context({**_STYLE, "svg.hashsalt": name}):
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        draw(figure)
        stream = io.StringIO()
        figure.savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    text = stream.getvalue()
    return text[text.index("<svg") :]
