"""A shorter programme for a hundredth of what it tells."""

from __future__ import annotations

from itertools import product

import numpy as np
import planning_scene as scene
import pytest

from handeye_tri.plan import plan_motions, shortening
from handeye_tri.plan.shortening import inserted


def distances(start, end):
    return np.linalg.norm(np.asarray(end) - start, axis=-1)


@pytest.mark.parametrize("returns", [False, True])
@pytest.mark.parametrize("count", [1, 2, 6])
def test_two_stations_are_inserted_where_they_add_least(count, returns):
    rng = np.random.default_rng(count)
    rest, pairs = rng.random((count, 2)), rng.random((40, 2, 2))
    end = rng.random(2) if returns else None

    def length(order):
        if returns:
            order = np.concatenate([order, end[None]])
        return distances(order[:-1], order[1:]).sum()

    for pair, found in zip(pairs, inserted(distances, rest, pairs, end), strict=True):
        every = []
        for a, b in product(range(1, count + 1), range(1, count + 2)):
            one = np.insert(rest, a, pair[0], axis=0)
            every += [length(np.insert(one, b, pair[1], axis=0))]
        assert found == pytest.approx(min(every) - length(rest))


def test_a_programme_is_shorter_and_tells_nearly_as_much(monkeypatch):
    cell, arm = scene.cell_of("hp3_single"), scene.arm_of("hp3_single")
    short = scene.plan_of("hp3_single").certificate
    monkeypatch.setattr(shortening, "_WORSE", 1.0)
    best = plan_motions(cell, arm, 1).certificate
    told = "track_calibration_rms_mm"
    assert best[told] < short[told] < 1.0101 * best[told]
    assert short["cycle_time_s"] < 0.97 * best["cycle_time_s"]
    assert short["relaxed_bound_mm"] == best["relaxed_bound_mm"]
