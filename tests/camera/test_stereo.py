"""Triangulation: exact data, covariance, missing and impossible data."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from handeye_tri.camera import (
    Intrinsics,
    Lens,
    PinholeCamera,
    StereoRig,
    triangulate,
)
from handeye_tri.errors import InputError
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]
LENS = Lens("radtan", np.array([-0.11, 0.05, 0.0008, -0.0011, 0.0]))
LEFT = PinholeCamera(
    "left", Intrinsics(1720.0, 1655.0, 1.5, 519.3, 377.8), (1024, 768), LENS
)
RIGHT = PinholeCamera(
    "right", Intrinsics(1702.0, 1668.0, 0.0, 503.6, 390.2), (1024, 768)
)
LEFT_FROM_RIGHT = SE3.exp([0.25, 0.01, -0.02, 0.01, -0.27, 0.02])
RIG = StereoRig(LEFT, RIGHT, LEFT_FROM_RIGHT)
SIGMA = 0.02


def covariances(m: int, n: int) -> Floats:
    """Different for every pixel, correlated, about SIGMA."""
    rng = np.random.default_rng(5)
    root = SIGMA * (np.eye(2) + 0.3 * rng.normal(size=(m, n, 2, 2)))
    return np.asarray(root @ np.swapaxes(root, -1, -2))


def scene(n: int = 40) -> tuple[Floats, Floats]:
    """Points in the left frame and their exact pixels, shape (2, n, 2)."""
    rng = np.random.default_rng(2)
    p = rng.uniform((-0.1, -0.1, 0.7), (0.25, 0.1, 1.1), (n, 3))
    return p, np.array(
        [LEFT.project(p), RIGHT.project(LEFT_FROM_RIGHT.inverse().apply(p))]
    )


def test_exact_data_give_the_exact_point() -> None:
    p, pixels = scene()
    found, _ = RIG.triangulate(pixels, covariances(2, len(p)))
    assert np.abs(found - p).max() < 1e-12


def test_any_world_frame_and_a_third_camera() -> None:
    p, pixels = scene()
    world_from_left = SE3.exp([0.3, -0.5, 1.1, 0.4, 2.0, -1.0])
    third = SE3.exp([-0.2, 0.1, 0.05, 0.0, 0.3, 0.1])
    pixels = np.array([*pixels, LEFT.project(third.inverse().apply(p))])
    pixels[2, 3] = np.nan
    pixels[0, 4] = np.nan
    found, covariance = triangulate(
        (LEFT, RIGHT, LEFT),
        (world_from_left, world_from_left @ LEFT_FROM_RIGHT, world_from_left @ third),
        pixels,
        covariances(3, len(p)),
    )
    assert np.abs(found - world_from_left.apply(p)).max() < 1e-12
    assert np.isfinite(covariance).all()


def test_covariance_is_the_spread_of_repetitions() -> None:
    """4000 repetitions: the ratio of variances has a deviation of sqrt(2/4000) = 2 %.

    The whitened scatter, shape (3, 3), must be the identity to 5 of those.
    """
    rng = np.random.default_rng(3)
    p, pixels = scene(1)
    cov = covariances(2, 1)
    n = 4000
    noise = rng.normal(size=(2, n, 2, 1))
    noisy = pixels + (np.linalg.cholesky(cov) @ noise)[..., 0]
    found, _ = RIG.triangulate(noisy, np.repeat(cov, n, axis=1))
    _, predicted = RIG.triangulate(pixels, cov)
    white = np.linalg.solve(np.linalg.cholesky(predicted[0]), (found - p).T)
    scatter = white @ white.T / n
    assert np.abs(scatter - np.eye(3)).max() < 5 * np.sqrt(2 / n)
    assert np.abs(white.mean(axis=1)).max() < 5 / np.sqrt(n)


def test_it_is_the_maximum_of_the_likelihood() -> None:
    """Moving the point by a tenth of its deviation in any direction costs more."""
    rng = np.random.default_rng(4)
    p, pixels = scene(5)
    cov = covariances(2, 5)
    noisy = pixels + (np.linalg.cholesky(cov) @ rng.normal(size=(2, 5, 2, 1)))[..., 0]
    found, predicted = RIG.triangulate(noisy, cov)

    def cost(x: Floats) -> Floats:
        views = [LEFT.project(x), RIGHT.project(LEFT_FROM_RIGHT.inverse().apply(x))]
        residual = (noisy - np.array(views))[..., None]
        return np.asarray((residual * np.linalg.solve(cov, residual)).sum((0, 2, 3)))

    for direction in np.vstack([np.eye(3), -np.eye(3)]):
        step = 0.1 * np.linalg.cholesky(predicted) @ direction
        # 0.1 deviations cost 0.01 where the gradient is zero.
        assert cost(found + step) - cost(found) == pytest.approx(0.01, rel=0.05)


def test_a_point_seen_once_is_nan_and_harms_no_other() -> None:
    p, pixels = scene(6)
    cov = covariances(2, 6)
    pixels[1, 2] = np.nan
    cov[1, 2] = np.nan
    pixels[:, 4] = np.nan
    found, covariance = RIG.triangulate(pixels, cov)
    lost = np.isnan(found).all(axis=1)
    assert lost.tolist() == [False, False, True, False, True, False]
    assert np.isnan(covariance[lost]).all()
    assert np.abs(found[~lost] - p[~lost]).max() < 1e-12
    none, _ = RIG.triangulate(np.full((2, 3, 2), np.nan), cov[:, :3])
    assert np.isnan(none).all()
    assert RIG.triangulate(np.empty((2, 0, 2)), np.empty((2, 0, 2, 2)))[0].shape == (
        0,
        3,
    )


def test_parallel_rays_and_rays_that_part_are_nan() -> None:
    pinhole = PinholeCamera("p", LEFT.intrinsics, (1024, 768))
    rig = StereoRig(pinhole, pinhole, SE3.exp([0.2, 0, 0, 0, 0, 0]))
    same, apart, good = [600.0, 400.0], [800.0, 400.0], [500.0, 400.0]
    found, covariance = rig.triangulate(
        np.array([[same, same, same], [same, apart, good]]), covariances(2, 3)
    )
    assert np.isnan(found[:2]).all()
    assert np.isnan(covariance[:2]).all()
    assert found[2, 2] == pytest.approx(0.2 * 1720 / 100, rel=1e-3)


def test_two_cameras_at_one_place_see_no_depth() -> None:
    p, _ = scene(3)
    pixels = np.array([LEFT.project(p), LEFT.project(p)])
    found, _ = StereoRig(LEFT, LEFT, SE3.identity()).triangulate(
        pixels, covariances(2, 3)
    )
    assert np.isnan(found).all()


def test_bad_shapes_and_covariances_are_refused() -> None:
    _, pixels = scene(4)
    cov = covariances(2, 4)
    with pytest.raises(
        InputError, match=r"shape \(2, n, 2\) for 2 cameras, got \(4, 2\)"
    ):
        RIG.triangulate(pixels[0], cov)
    with pytest.raises(InputError, match=r"shape \(2, n, 2\) for 2 cameras, got \(1,"):
        RIG.triangulate(pixels[:1], cov[:1])
    with pytest.raises(InputError, match=r"covariance must have shape \(2, 4, 2, 2\)"):
        RIG.triangulate(pixels, cov[:, :3])
    with pytest.raises(InputError, match="2 motions"):
        triangulate((LEFT, RIGHT), (SE3.identity(),), pixels, cov)
    for bad in (np.nan, 0.0):
        cov[1, 2] = bad
        with pytest.raises(InputError, match=r"point 2 in camera 1 is not positive"):
            RIG.triangulate(pixels, cov)


def test_baseline() -> None:
    assert RIG.baseline == pytest.approx(np.linalg.norm(LEFT_FROM_RIGHT.translation))
