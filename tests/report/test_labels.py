"""Names in drawings cover neither each other nor letters nor lines."""

import itertools

import numpy as np
import pytest
from finished_session import finished, finished_on_two_mounts
from matplotlib.figure import Figure
from matplotlib.text import Annotation

from handeye_tri.report import geometry
from handeye_tri.report.labels import place_names
from handeye_tri.report.style import WIDTH


def boxes_of(figure):
    figure.draw_without_rendering()
    (ax,) = figure.axes
    texts = [text for text in ax.texts if text.get_text()]
    return ax, {
        f"{i} {text.get_text()}": text.get_window_extent()
        for i, text in enumerate(texts)
    }


@pytest.mark.parametrize("done", [finished, finished_on_two_mounts])
def test_names_of_frames_stand_free(done, monkeypatch):
    drawn = []

    def keep(name, draw, height):
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        draw(figure)
        drawn.append(figure)
        return ""

    monkeypatch.setattr(geometry, "svg", keep)
    geometry.frames(done().session, done().calibration)
    ax, boxes = boxes_of(drawn[0])
    names = {key: box for key, box in boxes.items() if len(key.split()[-1]) > 1}
    assert len(names) >= 3
    for name, box in names.items():
        for other, its in boxes.items():
            assert other == name or not box.overlaps(its), (name, other)
    for line in ax.lines:
        ends = ax.transData.transform(line.get_xydata())
        for start, end in itertools.pairwise(ends):
            if line.get_alpha() != 0:
                points = np.linspace(start, end, 300)
                for name, box in names.items():
                    assert not box.count_contains(points), name


def test_where_there_is_no_room_the_least_is_covered():
    figure = Figure(figsize=(1.0, 1.0))
    ax = figure.subplots()
    ax.set_xlim(0, 1)
    ax.set_ylim(0, 1)
    # Lines so near to each other that a name covers some wherever it is, but for the
    # right half, where they are fewer.
    heights = np.linspace(0.0, 1.0, 40)
    lines = np.array([[(-1.0, y), (0.5, y)] for y in heights])
    lines = np.concatenate([lines, [[(-1.0, y), (2.0, y)] for y in heights[::5]]])
    (text,) = place_names(ax, ["name"], np.array([[0.5, 0.5]]), [], lines)
    assert isinstance(text, Annotation)
    assert text.get_position()[0] > 0
