"""The refinement's derivatives, its model of a turn, and its second start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from half_turn_scene import IMAGE_SIZE, TRIANGLE, make_scene, project

from handeye_tri.calibrate_cameras.half_turns import read_half_turns
from handeye_tri.calibrate_cameras.intrinsic_choice import IntrinsicChoice
from handeye_tri.calibrate_cameras.refine import (
    HalfTurnModel,
    State,
    refine_from_starts,
)
from handeye_tri.se3 import se3_exp

MIXED = ("normal", "AB", "BC", "CA")
TURN_COVARIANCE = np.diag([3e-5**2] * 3 + [1e-4**2] * 3)


def setup(
    o_mode="shared",
    lens=(),
    turn=True,
    skew=True,
    coefficients=5,
    fixed=None,
    aspect=None,
):
    rng = np.random.default_rng(0)
    scene = make_scene(rng, 4, MIXED)
    covariance = np.empty((4, 2, 3, 2, 2))
    covariance[:] = [[0.02, 0.007], [0.007, 0.01]]
    data, _ = read_half_turns(
        scene.before, scene.after, TRIANGLE, IMAGE_SIZE, MIXED, None, covariance
    )
    model = HalfTurnModel(
        data,
        choice=IntrinsicChoice.of(skew, fixed, aspect),
        lens=lens,
        o_mode=o_mode,
        turn_covariance=np.tile(TURN_COVARIANCE, (4, 1, 1)) if turn else None,
    )
    state = State(
        scene.camera.intrinsics.vector,
        0.02 * rng.standard_normal(coefficients) if lens else np.zeros(coefficients),
        scene.poses,
        np.tile(scene.foot, (4, 1)) + 1e-3 * rng.standard_normal((4, 2)),
        5.0 * rng.standard_normal((4, 6 if turn else 0)),
    )
    return scene, data, model, state


@pytest.mark.parametrize(
    "choice",
    [
        {"turn": False},
        {"o_mode": "known", "skew": False},
        {"o_mode": "free", "lens": (0, 1, 2, 3)},
        {"aspect": 0.997, "fixed": {"cx": 519.3}, "lens": (1,)},
        {"o_mode": "shared", "lens": tuple(range(8)), "coefficients": 8},
        {"o_mode": "shared", "lens": (0, 4), "turn": False, "skew": False},
    ],
)
def test_derivatives_meet_central_differences(choice) -> None:
    _, _, model, state = setup(**choice)
    blocks = model.evaluate(state)
    n, own, shared = 4, blocks.own.shape[-1], blocks.shared.shape[-1]
    assert (own, shared) == (model.own_unknowns, model.shared_unknowns)
    # A step h leaves errors of h^2 f''' and eps f / h; each column's h is chosen so
    # that the pixels move by about 0.01 whitened units, where both are below 1e-7 of
    # the column.
    for kind, count in (("own", own), ("shared", shared)):
        for i in range(count):
            column = getattr(blocks, kind)[..., i]
            norm = np.linalg.norm(column)
            if norm == 0.0:
                continue
            h = 0.01 / np.abs(column).max()
            values = []
            for sign in (1.0, -1.0):
                d_own, d_shared = np.zeros((n, own)), np.zeros(shared)
                (d_own if kind == "own" else d_shared)[..., i] = sign * h
                moved = model.retract(state, d_own, d_shared)
                values.append(model.evaluate(moved).residuals)
            numeric = (values[0] - values[1]) / (2 * h)
            assert np.linalg.norm(numeric - column) < 1e-6 * norm, (kind, i)


def test_residuals_are_predicted_less_detected_and_whitened() -> None:
    _, data, model, state = setup()
    residuals = model.evaluate(state).residuals[:, :12].reshape(4, 2, 3, 2)
    raw = model.predict(state) - data.pixels
    covariance = np.array([[0.02, 0.007], [0.007, 0.01]])
    expected = np.einsum(
        "nvki,nvki->", raw, np.linalg.solve(covariance, raw[..., None])[..., 0]
    )
    assert np.sum(residuals**2) == pytest.approx(expected, rel=1e-10)


def test_turn_is_applied_after_the_half_turn_in_the_triangles_frame() -> None:
    scene, _, model, state = setup()
    state = replace(state, o=np.tile(scene.foot, (4, 1)))
    root = model.turn_root
    np.testing.assert_allclose(root[0] @ root[0].T, TURN_COVARIANCE, rtol=1e-12)
    xi = (root @ state.turn[..., None])[..., 0]
    for i, axis in enumerate(MIXED):
        motion = TRIANGLE.half_turn(axis, scene.foot if axis == "normal" else None)
        after = scene.poses[i] @ motion.matrix @ se3_exp(xi[i])
        # Rotation and translation apart differ from exp by at most |xi_t| |xi_r| / 2.
        bound = np.linalg.norm(xi[i, :3]) * np.linalg.norm(xi[i, 3:]) / 2
        assert bound < 1e-6
        difference = np.abs(model.after_poses(state)[i] - after)
        assert difference.max() <= bound
        np.testing.assert_allclose(
            model.predict(state)[i, 1],
            project(scene.camera, TRIANGLE, model.after_poses(state)[i]),
            atol=1e-9,
        )


def test_second_start_is_kept_where_the_first_is_worse() -> None:
    scene, _, model, state = setup(turn=False)
    good = replace(state, o=np.tile(scene.foot, (4, 1)))
    behind = replace(good, poses=good.poses * np.array([1, 1, -1, 1])[:, None])
    end, chosen = refine_from_starts(model, [behind, good])
    assert chosen == 1
    assert end.converged
    np.testing.assert_allclose(
        end.state.intrinsics, scene.camera.intrinsics.vector, atol=1e-7
    )
    assert refine_from_starts(model, [behind]) is None
