from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pytest

from handeye_tri.plan.sequence import Visits, shortest_order, travel_time

ROUNDS = 400


def visits(seed, places, ways, forbidden=0.0):
    """Random points in a square; each place a half-turn or a single station."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 3, places)
    numbers = iter(range(1000))
    groups = [
        np.array([[next(numbers) for _ in range(size)] for _ in range(ways)])
        for size in sizes
    ]
    k = next(numbers)
    points = rng.random((k + 1, 2))
    times = np.linalg.norm(points[:, None] - points, axis=-1)
    first = times[k, :k].copy()
    blocked = np.triu(rng.random((k, k)) < forbidden)
    times = np.where(blocked | blocked.T, np.inf, times[:k, :k])
    # Half of the programmes end where they began.
    last = first if seed % 2 else np.zeros(k)
    return Visits(groups, first, last, times)


def duration(problem, order):
    between = problem.times[order[:-1], order[1:]].sum()
    return problem.first[order[0]] + between + problem.last[order[-1]]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("places", "ways"), [(1, 3), (2, 2), (4, 2)])
@pytest.mark.parametrize("forbidden", [0.0, 0.3])
def test_the_order_is_the_best_of_all(seed, places, ways, forbidden):
    problem = visits(seed, places, ways, forbidden)
    best = min(
        duration(problem, list(order))
        for chosen in product(*problem.ways)
        for order in permutations(np.concatenate(chosen))
    )
    found = shortest_order(problem, 0, ROUNDS)
    assert found.seconds == pytest.approx(best)
    if np.isfinite(best):
        assert duration(problem, found.options) == pytest.approx(best)


@pytest.mark.parametrize(("places", "ways"), [(1, 1), (9, 3), (30, 4)])
def test_every_place_is_visited_once_by_one_of_its_ways(places, ways):
    problem = visits(1, places, ways)
    order = shortest_order(problem, 3, ROUNDS).options
    chosen = [w for each in problem.ways for w in each if np.isin(w, order).all()]
    assert len(chosen) == places
    assert sorted(order) == sorted(np.concatenate(chosen))


def test_places_on_a_line_are_visited_along_it():
    """Both stations of a half-turn are passed once, whatever lies between them."""
    rng = np.random.default_rng(2)
    place = rng.permutation(40).astype(float)
    times = np.abs(place[:, None] - place[None])
    ways = [np.array([[2 * k, 2 * k + 1]]) for k in range(10)]
    ways += [np.array([[k]]) for k in range(20, 40)]
    order = shortest_order(Visits(ways, place + 1, 0 * place, times), 0, ROUNDS)
    np.testing.assert_array_equal(place[order.options], np.arange(40))
    assert order.seconds == pytest.approx(40)


def test_the_search_goes_on_from_an_order_and_is_never_worse():
    problem = visits(5, 20, 4)
    short = shortest_order(problem, 0, 5)
    longer = shortest_order(problem, 1, 100, short)
    assert longer.seconds < short.seconds
    assert shortest_order(problem, 1, 100, short) == longer


@pytest.mark.parametrize("places", [1, 6])
def test_an_order_that_must_use_a_forbidden_move_takes_for_ever(places):
    problem = visits(0, places, 2)
    problem.first[problem.ways[-1]] = np.inf
    problem.times[problem.ways[-1]] = np.inf
    problem.times[:, problem.ways[-1]] = np.inf
    found = shortest_order(problem, 0, ROUNDS)
    assert found.seconds == np.inf
    assert len(found.options) == sum(ways.shape[1] for ways in problem.ways)


def test_a_move_takes_what_its_slowest_joint_takes():
    speed = np.array([2.0, 1.0])
    # 1 s at full speed and 0.5 s for both ramps together; the other is quicker.
    assert travel_time(np.zeros(2), np.array([2.0, 0.1]), speed, 0.5) == 1.5
    # Too short for full speed: half the way speeding up at 2 m/s in 0.5 s.
    assert travel_time(np.zeros(2), np.array([0.25, 0.0]), speed, 0.5) == (
        pytest.approx(2 * np.sqrt(0.125 / 2))
    )
    many = travel_time(np.zeros((3, 1, 2)), np.ones((1, 4, 2)), speed, 0.5)
    assert many.shape == (3, 4)
    assert travel_time(np.ones(2), np.ones(2), speed, 0.5) == 0


def test_time_grows_with_distance_and_is_smooth_where_full_speed_is_reached():
    distance = np.linspace(0, 2, 400)[:, None]
    times = travel_time(np.zeros(1), distance, np.array([1.0]), 0.5)
    steps = np.diff(times)
    assert (steps > 0).all()
    knee = np.searchsorted(distance[:, 0], 0.5)
    assert np.abs(np.diff(steps[knee - 3 : knee + 3])).max() < 1e-4
