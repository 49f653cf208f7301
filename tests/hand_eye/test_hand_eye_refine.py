"""The weighted refinement: derivatives, efficiency, covariance."""

import numpy as np
import pytest

from handeye_tri.errors import ConvergenceError
from handeye_tri.hand_eye import solve_axzb
from handeye_tri.hand_eye.refine import refine_axzb, residuals_axzb
from handeye_tri.se3 import (
    SE3,
    rotation_from_quaternion_wxyz,
    se3_exp,
    se3_inverse,
    se3_left_jacobian_inverse,
    se3_log,
)


def random_poses(rng, n, spread=0.5):
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = rotation_from_quaternion_wxyz(rng.standard_normal((n, 4)))
    poses[:, :3, 3] = spread * rng.standard_normal((n, 3))
    return poses


def central(function, h):
    return np.stack(
        [(function(h * e) - function(-h * e)) / (2 * h) for e in np.eye(6)], axis=-1
    )


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.05, 0.3999, 0.4001, 1.5, 3.0])
def test_left_jacobian_inverse_of_se3(angle):
    rng = np.random.default_rng(0)
    x = rng.standard_normal(6)
    x[3:] *= angle / np.linalg.norm(x[3:])
    numeric = central(lambda d: se3_log(se3_exp(d) @ se3_exp(x)), 1e-5)
    # Truncation h^2 times third derivatives of order 10, rounding 1e-15 / h.
    np.testing.assert_allclose(se3_left_jacobian_inverse(x), numeric, atol=5e-9)


def test_residual_derivatives_against_differences():
    rng = np.random.default_rng(1)
    a, b = random_poses(rng, 4), random_poses(rng, 4)
    x, z = random_poses(rng, 2)
    # Large residuals on purpose: the derivative is exact there, too.
    e, gradient, by_b = residuals_axzb(a, b, x, z)
    assert np.linalg.norm(e[:, 3:], axis=1).max() > 1.0
    numeric_x = central(lambda d: residuals_axzb(a, b, x @ se3_exp(d), z)[0], 1e-5)
    numeric_z = central(lambda d: residuals_axzb(a, b, x, z @ se3_exp(d))[0], 1e-5)
    numeric_b = central(lambda d: residuals_axzb(a, b @ se3_exp(d), x, z)[0], 1e-5)
    np.testing.assert_allclose(gradient[..., :6], numeric_x, atol=1e-7)
    np.testing.assert_allclose(gradient[..., 6:], numeric_z, atol=1e-7)
    np.testing.assert_allclose(by_b, numeric_b, atol=1e-7)


def draw(seed, sigma_a, sigma_b, n=22):
    rng = np.random.default_rng([2, seed])
    x, z = random_poses(np.random.default_rng(5), 2, 0.2)
    truth = random_poses(np.random.default_rng(6), n, 0.3)
    a = truth @ se3_exp(sigma_a * rng.standard_normal((n, 6)))
    b = se3_inverse(z) @ truth @ x @ se3_exp(sigma_b * rng.standard_normal((n, 6)))
    x0, z0 = solve_axzb(a, b)
    return (
        refine_axzb(a, b, (x0,), z0, np.diag(sigma_a**2), np.diag(sigma_b**2)),
        a,
        b,
        SE3(x),
        SE3(z),
    )


SIGMA_A = np.array([3e-4, 1e-4, 2e-4, 2e-3, 1e-3, 5e-4])
SIGMA_B = np.array([1e-4, 1e-4, 1e-3, 2e-3, 2e-3, 3e-4])


def test_predicted_covariance_is_the_spread():
    errors, nees, chi2 = [], [], []
    for seed in range(150):
        found, _, _, x, z = draw(seed, SIGMA_A, SIGMA_B)
        error = np.append((found.x.inverse() @ x).log(), (found.z.inverse() @ z).log())
        errors.append(error / np.sqrt(np.diagonal(found.covariance)))
        nees.append(error @ np.linalg.solve(found.covariance, error) / 12)
        chi2.append(found.chi2 / 120)
    # The mean of 150 normalised chi-squares of 12 and of 120 degrees of freedom has
    # standard deviations of 0.033 and 0.011; the spread of 150 numbers 6 %.
    assert abs(np.mean(nees) - 1) < 0.13
    assert abs(np.mean(chi2) - 1) < 0.045
    spread = np.std(errors, axis=0)
    assert spread.min() > 0.76
    assert spread.max() < 1.24


def test_derivative_by_b_against_the_estimator_itself():
    found, a, b, _, _ = draw(0, SIGMA_A, SIGMA_B)
    rng = np.random.default_rng(3)
    # Poses in b move by up to a micrometre and a microradian.
    tangent = 1e-6 * rng.standard_normal((len(b), 6))
    moved = refine_axzb(
        a,
        b @ se3_exp(tangent),
        found.xs,
        found.z,
        np.diag(SIGMA_A**2),
        np.diag(SIGMA_B**2),
    )
    measured = np.append(
        (found.x.inverse() @ moved.x).log(), (found.z.inverse() @ moved.z).log()
    )
    predicted = np.einsum("tni,ni->t", found.by_b, tangent)
    # Gauss-Newton leaves out terms in the residuals, of relative size 1e-3 here.
    np.testing.assert_allclose(measured, predicted, atol=5e-3 * np.abs(predicted).max())


def test_two_mounts_share_z():
    """Two X and one Z: the covariance is the spread, and Z gains by both."""
    rng = np.random.default_rng(7)
    x = random_poses(rng, 2, 0.2)
    z = random_poses(rng, 1)[0]
    mounts = np.repeat([0, 1], [12, 8])
    nees, chi2 = [], []
    for seed in range(100):
        rng = np.random.default_rng([8, seed])
        truth = random_poses(np.random.default_rng(6), 20, 0.3)
        a = truth @ se3_exp(SIGMA_A * rng.standard_normal((20, 6)))
        b = se3_inverse(z) @ truth @ x[mounts]
        b = b @ se3_exp(SIGMA_B * rng.standard_normal((20, 6)))
        start = [SE3(one) @ SE3.exp([0.01] * 6) for one in (*x, z)]
        noise = np.diag(SIGMA_A**2), np.diag(SIGMA_B**2)
        found = refine_axzb(a, b, start[:2], start[2], *noise, mounts)
        motions = zip((*found.xs, found.z), (*x, z), strict=True)
        error = np.concatenate([(one.inverse() @ SE3(t)).log() for one, t in motions])
        nees.append(error @ np.linalg.solve(found.covariance, error) / 18)
        chi2.append(found.chi2 / (6 * 20 - 18))
    # Standard deviations of such means of 100: 0.033 and 0.014.
    assert abs(np.mean(nees) - 1) < 0.13
    assert abs(np.mean(chi2) - 1) < 0.056
    alone = refine_axzb(a[:12], b[:12], start[:1], start[2], *noise)
    assert (
        np.diagonal(found.covariance)[-6:] < 0.9 * np.diagonal(alone.covariance)[-6:]
    ).all()
    with pytest.raises(ValueError, match="too many values"):
        _ = found.x


def test_pairs_that_do_not_belong_together_do_not_converge():
    rng = np.random.default_rng(4)
    a, b = random_poses(rng, 8), random_poses(rng, 8)
    with pytest.raises(ConvergenceError, match="belong together"):
        refine_axzb(
            a, b, (SE3.identity(),), SE3.identity(), np.zeros((6, 6)), np.eye(6) * 1e-6
        )
