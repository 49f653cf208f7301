"""Derivatives against differences, elimination against dense algebra."""

from dataclasses import replace
from functools import partial

import adjust_scene
import numpy as np
import pytest

from handeye_tri.adjustment.equations import CHUNK, ChunkedEquations
from handeye_tri.adjustment.linearisation import (
    evaluate,
    normal_equations,
    whitened_rows,
)
from handeye_tri.adjustment.model import AdjustmentModel
from handeye_tri.adjustment.problem import Sides
from handeye_tri.adjustment.robot import RobotParameters
from handeye_tri.adjustment.robust import Loss
from handeye_tri.adjustment.session_input import (
    error_root,
    side_lengths,
    start_state,
    stations_in_blocks,
)
from handeye_tri.calibrate_cameras.least_squares import NormalEquations, minimise


def built(session, start, *, side_sigma=np.inf, correlation=0.0, **options):
    """Model and start of a session, all intrinsics and k1, p2 free."""
    stations = stations_in_blocks(session, correlation, paired=correlation > 0)
    m = len(session.cameras)
    model = AdjustmentModel(
        stations,
        ((0, 1, 2, 3, 4),) * m,
        ((0, 3),) * m,
        session.marker_radii,
        Sides(side_lengths(session), side_sigma),
        error_root(session.repeatability),
        **options,
    )
    state = start_state(session, start, model)
    if model.robot is not None:
        state = replace(state, robot=np.zeros(len(model.robot.labels)))
    return model, state


def stacked(model, state):
    """All whitened pixel residuals and their dense derivatives, own unknowns first."""
    size = model.own
    width = model.blocks * size
    parts = []
    for chunk, i, mount, rows in whitened_rows(model, state):
        place = np.r_[model.columns[i], model.rigs[mount], model.extra]
        rows = rows.reshape(len(rows), -1, rows.shape[-1])
        for offset, block in enumerate(range(chunk.start, chunk.stop)):
            dense = np.zeros((rows.shape[1], width + model.shared + 1))
            dense[:, size * block : size * (block + 1)] = rows[offset, :, :size]
            dense[:, width + place] = rows[offset, :, size:-1]
            dense[:, -1] = rows[offset, :, -1]
            parts.append(dense)
    whole = np.concatenate(parts)
    return whole[:, -1], whole[:, :-1]


def with_priors(model, state):
    """The same with the priors as rows."""
    residual, jacobian = stacked(model, state)
    own = model.blocks * model.own
    rows = [np.eye(own, jacobian.shape[1])]
    values = [state.missed.ravel()]
    if model.sides.count:
        for rig, markers in zip(model.rigs, state.markers, strict=True):
            value, slope = model.sides.residuals(markers)
            row = np.zeros((3, jacobian.shape[1]))
            row[:, own + rig.start : own + rig.stop] = slope
            rows.append(row)
            values.append(value)
    return np.concatenate([residual, *values]), np.concatenate([jacobian, *rows])


def turned(session, rng, p=3, nonlinear=False):
    """Parameters of a robot with large second derivatives."""
    n = len(session.stations)
    jacobian = rng.normal(size=(n, 6, p))
    linear = RobotParameters(
        tuple(f"joint_{k}.offset" for k in range(p)), jacobian, np.full(p, 0.01)
    )
    if not nonlinear:
        return linear
    return replace(
        linear, kinematics=lambda theta: linear.poses(session.base_from_flange, theta)
    )


CASES = {
    "free markers": {},
    "exact sides": {"side_sigma": 0.0},
    "sides with a sigma": {"side_sigma": 1e-4},
    "exact robot": {"repeatability": adjust_scene.EXACT},
    "spheres": {"marker_radii": (0.008, 0.0065, 0.01)},
    "lens": {"lens": adjust_scene.LENS, "marker_radii": (0.008,) * 3},
    "pairs": {"axis": "CA", "correlation": 0.4},
    "parameters": {"parameters": True},
    "kinematics": {"parameters": True, "nonlinear": True, "side_sigma": 0.0},
    "two mounts": {"axes": ("normal", "BC")},
    "two mounts, exact sides": {"axes": ("CA", "AB"), "side_sigma": 0.0},
    "two mounts, pairs": {"axes": ("BC", "normal"), "correlation": 0.4},
    "two mounts, parameters": {"axes": ("normal", "normal"), "parameters": True},
}


@pytest.mark.parametrize("name", CASES)
def test_derivatives_against_differences(name):
    case = dict(CASES[name])
    chosen = {k: case.pop(k) for k in ("side_sigma", "correlation") if k in case}
    parameters, nonlinear = case.pop("parameters", False), case.pop("nonlinear", False)
    options = {"sigma_px": 0.1, "repeatability": adjust_scene.ROBOT, **case}
    session, _, start = adjust_scene.cell(3, half_turns=3, **options)
    rng = np.random.default_rng(5)
    if parameters:
        chosen["robot"] = turned(session, rng, nonlinear=nonlinear)
    # Far larger misses than any robot's, so that second-order terms would show.
    root = np.diag(np.repeat([0.02, 0.05], 3))
    model, state = built(session, start, **chosen)
    if session.repeatability.translation:
        model = replace(model, root=root)
        state = replace(state, missed=rng.normal(size=(model.blocks, model.own)))
    if parameters:
        state = replace(state, robot=0.01 * rng.normal(size=3))
    residual, jacobian = stacked(model, state)
    own, g = model.blocks * model.own, model.shared
    units = np.ones(own + g)
    for columns in model.columns:
        stop = own + columns.stop
        # Pixels differ from lens coefficients, metres and radians.
        units[own + columns.start : stop - 8] = 1e2
        units[stop - 8 :] = 1e-1
    probe = rng.choice(own + g, size=min(25, own), replace=False)
    for column in {*probe.tolist(), *range(own, own + g)}:
        h = 1e-5 * units[column]
        sides = []
        for sign in (1.0, -1.0):
            step = np.zeros(own + g)
            step[column] = sign * h
            moved = model.retract(
                state, step[:own].reshape(model.blocks, -1), step[own:]
            )
            sides.append(stacked(model, moved)[0])
        numeric = (sides[0] - sides[1]) / (2 * h)
        scale = max(np.abs(numeric).max(), 1e-3)
        # Central differences: h^2 of the third derivative, about 1e-8 of the first
        # here, and 1e-16 of residuals of 1e4 over h.
        assert np.abs(jacobian[:, column] - numeric).max() < 2e-6 * scale, column
    assert len(residual) == 2 * model.seen.size


def test_cost_is_the_sum_of_squares_of_the_rows():
    session, _, start = adjust_scene.cell(
        1, axis="CA", sigma_px=0.1, repeatability=adjust_scene.ROBOT, half_turns=4
    )
    model, state = built(session, start, side_sigma=1e-4, correlation=0.5)
    state = replace(state, missed=np.random.default_rng(0).normal(size=(4, 12)))
    linear = evaluate(model, state)
    residual, _ = with_priors(model, state)
    assert linear.cost == pytest.approx(residual @ residual, rel=1e-12)
    # 8 stations x 3 markers x 2 cameras x 2, six a station, three sides.
    assert linear.observations == 96 + 48 + 3
    assert linear.unknowns == 48 + 2 * 13 + 9


def test_each_mount_has_its_own_sides_and_markers():
    session, _, start = adjust_scene.cell(
        1,
        axes=("CA", "normal"),
        sigma_px=0.1,
        repeatability=adjust_scene.ROBOT,
        half_turns=4,
    )
    model, state = built(session, start, side_sigma=1e-4, correlation=0.5)
    # Blocks of half-turns about CA, then stations of the other mount by themselves.
    assert model.stations.mounts.tolist() == 4 * [0] + 8 * [1]
    assert (model.stations.index[:, 1] >= 0).tolist() == 4 * [True] + 8 * [False]
    assert model.stations.on_axis.sum(axis=1).tolist() == 4 * [2] + 8 * [0]
    missed = np.random.default_rng(0).normal(size=(12, 12))
    missed[4:, 6:] = 0.0
    state = replace(state, missed=missed)
    linear = evaluate(model, state)
    residual, _ = with_priors(model, state)
    assert linear.cost == pytest.approx(residual @ residual, rel=1e-12)
    assert linear.observations == 2 * 96 + 6 * 16 + 2 * 3
    assert linear.unknowns == 6 * 16 + 2 * 13 + 2 * 9


@pytest.mark.parametrize("mounts", [{}, {"axes": ("normal", "BC")}])
def test_normal_equations_are_those_of_the_rows(mounts):
    session, _, start = adjust_scene.cell(
        2, sigma_px=0.1, repeatability=adjust_scene.ROBOT, half_turns=4, **mounts
    )
    model, state = built(session, start, side_sigma=1e-4)
    residual, jacobian = with_priors(model, state)
    found = normal_equations(model, state)
    own = model.blocks * model.own
    normal, gradient = jacobian.T @ jacobian, jacobian.T @ residual
    scale = np.sqrt(np.diagonal(normal))
    blocks = np.zeros((own, own))
    for b in range(model.blocks):
        s = slice(6 * b, 6 * b + 6)
        blocks[s, s] = found.own[b]
    joined = np.block([[blocks, found.cross.reshape(own, -1)],
                       [found.cross.reshape(own, -1).T, found.shared]])  # fmt: skip
    assert np.abs((joined - normal) / np.outer(scale, scale)).max() < 1e-12
    both = np.r_[found.own_gradient.ravel(), found.shared_gradient]
    # Cancellation in a gradient is against the norm of its rows.
    bound = scale * np.linalg.norm(residual)
    assert (np.abs(both - gradient) / bound).max() < 1e-12


def test_chunked_elimination_agrees_with_its_base():
    rng = np.random.default_rng(0)
    n, size, g = CHUNK + 37, 4, 5
    rows = rng.normal(size=(n, 7, size + g + 1))
    product = np.swapaxes(rows, 1, 2) @ rows
    total = product[:, size:, size:].sum(axis=0)
    parts = (
        product[:, :size, :size] + 0.1 * np.eye(size),
        product[:, :size, size:-1],
        total[:-1, :-1],
        product[:, :size, -1],
        total[:-1, -1],
    )
    plain, chunked = NormalEquations(*parts), ChunkedEquations(*parts)
    for damping in (0.0, 1e-3, 10.0):
        for ours, theirs in zip(
            chunked.step(damping), plain.step(damping), strict=True
        ):
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(chunked.reduced(), plain.reduced(), rtol=1e-9)
    determinant = np.linalg.slogdet(plain.own)[1].sum()
    assert chunked.log_determinant() == pytest.approx(determinant, rel=1e-12)


def test_the_same_minimum_as_a_dense_solver_at_100_stations():
    rng = np.random.default_rng(8)
    session, truth = adjust_scene.ring(2, 100, rng)
    start = adjust_scene.rough(truth, rng)
    stations = stations_in_blocks(session, 0.0, paired=False)
    model = AdjustmentModel(
        stations,
        ((0, 1, 3, 4),) * 2,
        ((),) * 2,
        session.marker_radii,
        Sides(side_lengths(session), np.inf),
        error_root(session.repeatability),
    )
    state = start_state(session, start, model)
    end = minimise(partial(evaluate, model), model.retract, state, 0.0)
    dense = state
    own = model.blocks * 6
    for _ in range(7):
        residual, jacobian = with_priors(model, dense)
        scale = 1.0 / np.linalg.norm(jacobian, axis=0)
        orthogonal, upper = np.linalg.qr(jacobian * scale)
        step = -scale * np.linalg.solve(upper, orthogonal.T @ residual)
        dense = model.retract(dense, step[:own].reshape(-1, 6), step[own:])
    covariance = np.linalg.inv(
        (jacobian * scale).T @ (jacobian * scale)
    ) * np.outer(scale, scale)  # fmt: skip
    sigma = np.sqrt(np.diagonal(covariance))
    assert end.cost == pytest.approx(residual @ residual, rel=1e-9)
    np.testing.assert_allclose(
        end.state.intrinsics, dense.intrinsics, rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(
        end.state.base_from_camera, dense.base_from_camera, rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(end.state.markers, dense.markers, rtol=0, atol=1e-9)
    reduced = np.linalg.inv(end.blocks.equations().reduced())
    ours = np.sqrt(np.diagonal(reduced))
    np.testing.assert_allclose(ours, sigma[own:], rtol=1e-7)


@pytest.mark.parametrize("loss", [Loss("huber", 2.0), Loss("cauchy", 2.0)])
def test_a_loss_has_the_gradient_of_its_cost(loss):
    session, _, start = adjust_scene.cell(
        4, sigma_px=0.1, repeatability=adjust_scene.ROBOT, half_turns=3
    )
    model, state = built(session, start, loss=loss)
    gradient = normal_equations(model, state).shared_gradient
    for column, h in ((0, 1e-3), (9, 1e-6), (model.rigs[0].start, 1e-6)):
        step = np.zeros(model.shared)
        step[column] = h
        zero = np.zeros((model.blocks, model.own))
        plus = evaluate(model, model.retract(state, zero, step)).cost
        minus = evaluate(model, model.retract(state, zero, -step)).cost
        # The cost is the square: twice J'r.
        assert (plus - minus) / (4 * h) == pytest.approx(gradient[column], rel=1e-4)
