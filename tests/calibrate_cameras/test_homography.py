"""Homographies of half-turns: exact, and with the covariance that they claim."""

from __future__ import annotations

import numpy as np
import pytest
from half_turn_scene import FOOT, IMAGE_SIZE, TRIANGLE, make_scene

from handeye_tri.calibrate_cameras.half_turns import read_half_turns
from handeye_tri.calibrate_cameras.homography import (
    conic_constraints,
    constraint_covariance,
    fit_homographies,
    vanishing_lines,
)


def fit(before, after, axes, o_mode="shared", o=None, sigma=None):
    data, _ = read_half_turns(before, after, TRIANGLE, IMAGE_SIZE, axes, sigma, None)
    return fit_homographies(data, o_mode, o)


def true_homographies(scene, result):
    """K [r1 r2 t] in the coordinates of the result."""
    image = np.linalg.inv(result.image.matrix) @ scene.camera.intrinsics.matrix
    plane = np.array(
        [
            [result.size, 0.0, result.origin[0]],
            [0.0, result.size, result.origin[1]],
            [0.0, 0.0, 1.0],
        ]
    )
    matrix = image @ scene.poses[:, :3][:, :, [0, 1, 3]] @ plane
    return matrix / matrix[:, 2:, 2:]


@pytest.mark.parametrize("axes", ["normal", "AB", "BC", "CA"])
@pytest.mark.parametrize("o_mode", ["shared", "free", "known"])
@pytest.mark.parametrize(
    "foot", [FOOT, (0.0, 0.0), tuple(TRIANGLE.points[1:, :2].mean(0))]
)
def test_exact_half_turns_give_the_exact_homography_and_foot(
    axes, o_mode, foot
) -> None:
    scene = make_scene(np.random.default_rng(1), 5, axes, foot=foot)
    known = np.array(foot) if o_mode == "known" else None
    result = fit(scene.before, scene.after, axes, o_mode, known)
    np.testing.assert_allclose(
        result.matrix, true_homographies(scene, result), atol=1e-9
    )
    if axes == "normal":
        np.testing.assert_allclose(result.o, np.tile(foot, (5, 1)), atol=1e-11)
    assert result.residual_px.max() < 1e-8


@pytest.mark.parametrize(
    ("axes", "o_mode"), [("normal", "shared"), ("normal", "free"), ("CA", "shared")]
)
def test_covariances_of_homography_constraint_and_line_match_their_spread(
    axes, o_mode
) -> None:
    scene = make_scene(np.random.default_rng(2), 5, axes)
    rng = np.random.default_rng(3)
    sigma = 0.05
    k = scene.camera.intrinsics.matrix
    trials = [
        fit(*scene.noisy(rng, sigma), axes, o_mode, sigma=sigma) for _ in range(250)
    ]
    exact = fit(scene.before, scene.after, axes, o_mode, sigma=sigma)
    unit_k = np.linalg.inv(exact.image.matrix) @ k
    w = np.linalg.inv(unit_k @ unit_k.T)
    b = w[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    eight = np.array([t.matrix.reshape(5, 9)[:, :8] for t in trials])
    error = eight - exact.matrix.reshape(5, 9)[:, :8]
    rows = np.array([conic_constraints(t.matrix) @ b for t in trials])
    lines = np.array([vanishing_lines(t)[0] for t in trials])
    line, line_covariance = vanishing_lines(exact)
    for samples, covariance in (
        (error, exact.covariance),
        (rows, constraint_covariance(exact, b)),
        (lines - line, line_covariance),
    ):
        # Mean squared Mahalanobis distance: 1250 samples of at least 2 dimensions.
        solved = np.linalg.solve(covariance, samples[..., None])[..., 0]
        nees = (samples * solved).sum(axis=-1).mean() / samples.shape[-1]
        assert nees == pytest.approx(1.0, abs=5 * np.sqrt(2 / (1250 * 2)))
    chi2 = np.mean([t.chi2 for t in trials]) / trials[0].dof
    assert chi2 == pytest.approx(1.0, abs=5 * np.sqrt(2 / (250 * trials[0].dof)))
