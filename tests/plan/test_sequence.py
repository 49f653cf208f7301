from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pytest

from handeye_tri.plan.sequence import Stops, shortest_order, travel_time


def stops(seed, count, options, forbidden=0.0):
    rng = np.random.default_rng(seed)
    k = count * options
    times = rng.random((k, k))
    times[rng.random((k, k)) < forbidden] = np.inf
    return Stops(np.repeat(np.arange(count), options), rng.random(k), times)


def duration(problem, order):
    return problem.first[order[0]] + problem.times[order[:-1], order[1:]].sum()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("count", "options"), [(1, 3), (2, 2), (5, 3), (6, 2)])
def test_the_order_is_the_best_of_all(seed, count, options):
    problem = stops(seed, count, options, forbidden=0.3)
    every = (
        [p * options + c for p, c in zip(order, chosen, strict=True)]
        for order in permutations(range(count))
        for chosen in product(range(options), repeat=count)
    )
    best = min(duration(problem, order) for order in every)
    found = shortest_order(problem)
    if np.isinf(best):
        assert found is None
    else:
        assert duration(problem, found) == pytest.approx(best)
        assert sorted(problem.stop[found]) == list(range(count))


def test_a_long_programme_is_ordered_as_well_as_on_a_line():
    """Stops on a line, in any order given: the best order goes along it once."""
    rng = np.random.default_rng(2)
    place = rng.permutation(40).astype(float)
    times = np.abs(place[:, None] - place[None])
    problem = Stops(np.arange(40), place + 1, times)
    order = shortest_order(problem)
    np.testing.assert_array_equal(place[order], np.arange(40))


def test_a_long_programme_visits_everything_once_and_beats_the_nearest_next():
    problem = stops(3, 25, 4)
    order = shortest_order(problem)
    assert sorted(problem.stop[order]) == list(range(25))
    nearest = [int(np.argmin(problem.first))]
    while len(nearest) < 25:
        left = ~np.isin(problem.stop, problem.stop[nearest])
        nearest.append(int(np.argmin(np.where(left, problem.times[nearest[-1]], 9))))
    assert duration(problem, order) < duration(problem, nearest)


@pytest.mark.parametrize("count", [4, 14])
def test_no_order_where_a_stop_cannot_be_reached(count):
    problem = stops(0, count, 1)
    problem.times[:, 2] = problem.first[2] = np.inf
    assert shortest_order(problem) is None


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
