"""The block solver against dense algebra and on a problem with a known minimum."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from handeye_tri.calibrate_cameras.least_squares import (
    Blocks,
    NormalEquations,
    minimise,
)


def random_blocks(rng, n=4, r=7, own=3, shared=2):
    return Blocks(
        rng.standard_normal((n, r)),
        rng.standard_normal((n, r, own)),
        rng.standard_normal((n, r, shared)),
    )


def dense(blocks):
    n, r, own = blocks.own.shape
    jacobian = np.zeros((n * r, n * own + blocks.shared.shape[-1]))
    for i in range(n):
        jacobian[i * r : (i + 1) * r, i * own : (i + 1) * own] = blocks.own[i]
        jacobian[i * r : (i + 1) * r, n * own :] = blocks.shared[i]
    return jacobian, blocks.residuals.ravel()


@pytest.mark.parametrize("shared", [0, 2])
@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_step_gain_and_covariances_are_those_of_the_dense_problem(
    shared, damping
) -> None:
    blocks = random_blocks(np.random.default_rng(0), shared=shared)
    equations = NormalEquations.of(blocks)
    jacobian, residuals = dense(blocks)
    information = jacobian.T @ jacobian
    damped = information + damping * np.diag(np.diagonal(information))
    expected = -np.linalg.solve(damped, jacobian.T @ residuals)
    own, common, gain = equations.step(damping)
    np.testing.assert_allclose(np.append(own.ravel(), common), expected, atol=1e-12)
    # Drop of the linear model's cost, twice damped as the step minimises.
    model = np.sum((residuals + jacobian @ expected) ** 2)
    assert gain == pytest.approx(residuals @ residuals - model, rel=1e-10)
    covariance = np.linalg.inv(information)
    for i, block in enumerate(equations.own_covariance()):
        rows = slice(3 * i, 3 * i + 3)
        np.testing.assert_allclose(block, covariance[rows, rows], atol=1e-12)
    if shared:
        reduced = np.linalg.inv(equations.reduced())
        np.testing.assert_allclose(reduced, covariance[-2:, -2:], atol=1e-12)


def test_unknown_without_residuals_stays_put() -> None:
    blocks = random_blocks(np.random.default_rng(1))
    blocks.own[2, :, 1] = 0.0
    own, _, _ = NormalEquations.of(blocks).step(0.1)
    assert own[2, 1] == 0.0
    assert np.abs(own).max() > 0.01


def exponential(true_rate, times, gains):
    """Decays of own gain and shared rate: y = gain exp(-rate t)."""
    seen = gains[:, None] * np.exp(-true_rate * times)

    def evaluate(state):
        own, rate = state
        if rate < -1:
            return None
        decay = np.exp(-rate * times)
        return Blocks(
            own[:, None] * decay - seen,
            np.broadcast_to(decay, seen.shape)[..., None].copy(),
            (-own[:, None] * times * decay)[..., None],
        )

    def retract(state, d_own, d_shared):
        return state[0] + d_own[:, 0], state[1] + float(d_shared[0])

    return evaluate, retract


def test_reaches_the_exact_minimum_and_reports_it() -> None:
    gains, times = np.array([1.0, 2.0, -3.0]), np.linspace(0, 2, 9)
    evaluate, retract = exponential(1.3, times, gains)
    end = minimise(evaluate, retract, (np.ones(3), 0.0), 1e-16)
    assert end is not None
    assert end.converged
    assert end.cost < 1e-25 < end.cost_start
    assert end.state[1] == pytest.approx(1.3, abs=1e-11)
    np.testing.assert_allclose(end.state[0], gains, atol=1e-11)


def test_a_known_minimum_ends_the_second_run_early() -> None:
    rng = np.random.default_rng(2)
    gains, times = np.array([1.0, 2.0, -3.0]), np.linspace(0, 2, 9)
    exact, retract = exponential(1.3, times, gains)
    noise = 0.1 * rng.standard_normal((3, 9))

    def evaluate(state):
        blocks = exact(state)
        return Blocks(blocks.residuals + noise, blocks.own, blocks.shared)

    first = minimise(evaluate, retract, (np.ones(3), 0.0), 1e-16)
    again = minimise(evaluate, retract, (np.ones(3), 0.5), 1e-16)
    short = minimise(evaluate, retract, (np.ones(3), 0.5), 1e-16, known=first.cost)
    assert again.cost == pytest.approx(first.cost, rel=1e-9)
    assert short.iterations < again.iterations
    assert not short.converged


def test_the_last_step_may_be_left_out() -> None:
    rng = np.random.default_rng(3)
    gains, times = np.array([1.0, 2.0, -3.0]), np.linspace(0, 2, 9)
    exact, retract = exponential(1.3, times, gains)
    noise = 0.1 * rng.standard_normal((3, 9))

    def evaluate(state):
        blocks = exact(state)
        return Blocks(blocks.residuals + noise, blocks.own, blocks.shared)

    start = (np.ones(3), 0.5)
    exactly, taken, left = (
        minimise(evaluate, retract, start, 1e-16, tolerance=tolerance, take_last=last)
        for tolerance, last in ((1e-9, True), (0.1, True), (0.1, False))
    )
    assert taken.converged
    assert left.converged
    assert left.iterations == taken.iterations - 1
    # Its gain was less than a tenth of the cost per degree of freedom.
    assert left.cost - exactly.cost < 0.15 * exactly.cost / (27 - 4)


def test_freed_arrays_keep_their_pages() -> None:
    """In a process of its own: what other tests have freed decides, too."""
    script = """
import resource
import numpy as np
from handeye_tri.calibrate_cameras.least_squares import Blocks, minimise

still = Blocks(np.zeros((1, 2)), np.ones((1, 2, 1)), np.ones((1, 2, 0)))
minimise(lambda _: still, lambda *_: None, None, 1.0)
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(1_000_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults()
print(faults())
"""
    found = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    # Fresh ones would be 1950, of 4 kB each.
    assert int(found.stdout) < 100


def test_a_start_that_cannot_be_evaluated_gives_none() -> None:
    evaluate, retract = exponential(1.3, np.linspace(0, 2, 9), np.ones(3))
    assert minimise(evaluate, retract, (np.ones(3), -2.0), 1e-16) is None
