from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handeye_tri.plan.design import Design, Kinds

ALL = 9


def problem(seed, n=ALL, size=3, rows=2):
    """Random information of two rows each, in units many orders apart."""
    rng = np.random.default_rng(seed)
    units = np.array([1e3, 1.0, 1e-3, 10.0])[:size]
    a = rng.normal(size=(n, rows, size)) / units
    cost = rng.normal(size=(size, size)) / units
    return a.swapaxes(1, 2) @ a, 1e-3 * np.diag(units**-2.0), cost.T @ cost


def price(information, prior, cost, weights):
    total = prior + np.tensordot(weights, information, 1)
    return np.trace(cost @ np.linalg.inv(total))


def ones(chosen, n=ALL):
    return np.bincount(list(chosen), minlength=n).astype(float)


def test_cost_is_that_of_the_covariance_in_any_units():
    parts = problem(0)
    design = Design(*parts)
    weights = np.random.default_rng(1).random(ALL)
    assert design.cost(weights) == pytest.approx(price(*parts, weights), rel=1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_exchange_ends_near_the_best_of_all_choices(seed):
    parts = problem(seed)
    design, usable = Design(*parts), np.ones(ALL, dtype=bool)
    everything = [price(*parts, ones(c)) for c in combinations(range(ALL), 3)]
    relaxation = design.relax(3, usable)
    start = [int(k) for k in np.argsort(-relaxation.weights)[:3]]
    chosen = design.exchange(start, usable)
    assert len(set(chosen)) == 3
    now = price(*parts, ones(chosen))
    assert now <= price(*parts, ones(start)) * (1 + 1e-9)
    assert now <= 1.1 * min(everything)
    # No exchange of one is left that helps.
    for out in chosen:
        for other in set(range(ALL)) - set(chosen):
            swapped = ones([*(set(chosen) - {out}), other])
            assert price(*parts, swapped) >= now * (1 - 1e-5)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), wanted=st.integers(1, 5), n=st.integers(6, 40))
def test_the_bound_is_below_every_choice_and_close_to_the_fractional_one(
    seed, wanted, n
):
    parts = problem(seed, n, 4)
    design = Design(*parts)
    relaxation = design.relax(wanted, np.ones(n, dtype=bool))
    weights = relaxation.weights
    assert weights.sum() == pytest.approx(wanted)
    assert (weights >= 0).all()
    assert (weights <= 1).all()
    value = price(*parts, weights)
    assert relaxation.bound <= value * (1 + 1e-9)
    assert relaxation.bound >= value * (1 - 4e-3)
    rng = np.random.default_rng(seed)
    for _ in range(50):
        chosen = rng.choice(n, wanted, replace=False)
        assert price(*parts, ones(chosen, n)) >= relaxation.bound * (1 - 1e-9)


def test_what_may_not_be_used_is_not_used_and_does_not_lower_the_bound():
    parts = problem(4, 30, 4)
    design, usable = Design(*parts), np.ones(30, dtype=bool)
    free = design.relax(4, usable)
    usable[free.weights > 0.1] = False
    held = design.relax(4, usable)
    assert (held.weights[~usable] == 0).all()
    assert held.bound > free.bound
    start = [int(k) for k in np.argsort(-held.weights)[:4]]
    assert usable[design.exchange(start, usable)].all()
    ranked = design.ranked(held.weights, usable)
    assert sorted(ranked) == list(np.flatnonzero(usable))


def test_as_many_candidates_as_wanted_leave_no_choice():
    parts = problem(5, 4)
    relaxation = Design(*parts).relax(4, np.ones(4, dtype=bool))
    np.testing.assert_array_equal(relaxation.weights, np.ones(4))
    assert relaxation.bound == pytest.approx(price(*parts, np.ones(4)))


@pytest.mark.parametrize("seed", range(4))
def test_swaps_are_all_that_cost_less_than_a_limit(seed):
    parts = problem(seed)
    design, usable = Design(*parts), np.arange(ALL) != 7
    chosen = [0, 2, 5, 8]
    costs = {
        k: price(*parts, ones([0, 2, k, 8]))
        for k in range(ALL)
        if k not in chosen + [7]
    }
    limit = float(np.median(list(costs.values())))
    found = design.swaps([0, 2, 5, 8], 2, usable, limit)
    assert found.tolist() == [k for k, cost in costs.items() if cost < limit]
    assert len(found) > 0


@pytest.mark.parametrize("seed", range(4))
def test_an_exchange_leaves_enough_of_each_kind(seed):
    """The best of all choices with two of each kind at least, or nearly."""
    parts = problem(seed)
    kinds = Kinds(np.arange(ALL) // 6, (2, 2))
    design = Design(*parts, kinds)
    usable = np.ones(ALL, dtype=bool)
    start = kinds.filled([], np.arange(ALL), 4)
    assert sorted(start) == [0, 1, 6, 7]
    chosen = design.exchange(start, usable)
    able = [c for c in combinations(range(ALL), 4) if not kinds.lacking(list(c))]
    best = min(price(*parts, ones(c)) for c in able)
    assert not kinds.lacking(chosen)
    assert price(*parts, ones(chosen)) <= 1.05 * best
    # Two of a kind: only one of the same may come for one of them.
    for place, current in enumerate(chosen):
        other = design.swaps(chosen, place, usable, np.inf)
        assert set(kinds.of[other]) == {kinds.of[current]}


def test_a_choice_is_filled_by_kind_first_and_then_by_rank():
    kinds = Kinds(np.array([0, 0, 0, 1, 1, 1]), (1, 1))
    ranked = np.array([2, 1, 0, 5, 4, 3])
    assert kinds.filled([], ranked, 3) == [2, 5, 1]
    assert kinds.filled([5], ranked, 3) == [5, 2, 1]
    assert kinds.lacking([0, 1]) == [1]
    assert kinds.lacking([]) == [0, 1]
    # With one more of its kind than needed, any may come instead.
    assert kinds.instead([0, 1, 3], 0).all()
    assert kinds.instead([0, 1, 3], 3).tolist() == [False] * 3 + [True] * 3
