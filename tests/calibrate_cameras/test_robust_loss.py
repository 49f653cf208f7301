"""Losses as changed residuals: their value, their derivative, their limits."""

from __future__ import annotations

import numpy as np
import pytest

from handeye_tri.calibrate_cameras.robust_loss import LOSSES, soften


def expected(loss, d):
    if loss == "huber":
        return np.where(d > 1.8, 2 * 1.8 * d - 1.8**2, d**2)
    return 9.0 * np.log1p(d**2 / 9.0)


@pytest.mark.parametrize("loss", LOSSES)
def test_square_of_the_changed_residual_is_the_loss(loss) -> None:
    rng = np.random.default_rng(0)
    e = rng.standard_normal((50, 2)) * np.geomspace(1e-9, 1e3, 50)[:, None]
    rows = np.concatenate([np.zeros((50, 2, 3)), e[..., None]], axis=-1)
    soften(rows, loss)
    found = (rows[..., -1] ** 2).sum(axis=-1)
    np.testing.assert_allclose(found, expected(loss, np.linalg.norm(e, axis=1)), 1e-9)


@pytest.mark.parametrize("loss", LOSSES)
def test_derivatives_meet_central_differences(loss) -> None:
    rng = np.random.default_rng(1)
    slope = rng.standard_normal((40, 2, 4))
    offset = rng.standard_normal((40, 2)) * rng.uniform(0.1, 20, (40, 1))

    def residual(x):
        rows = np.concatenate([slope, (offset + slope @ x)[..., None]], axis=-1)
        soften(rows, loss)
        return rows

    analytic = residual(np.zeros(4))[..., :-1]
    step = 1e-6
    for k, unit in enumerate(np.eye(4)):
        change = residual(step * unit)[..., -1] - residual(-step * unit)[..., -1]
        # Rounding of 20 over a step of 1e-6, and its square times the curvature.
        np.testing.assert_allclose(change / (2 * step), analytic[..., k], atol=1e-7)
