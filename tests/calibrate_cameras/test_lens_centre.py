"""A lens about an uncertain centre: the stated covariance is that of the errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from half_turn_scene import FOOT, IMAGE_SIZE, camera, make_scene

from handeye_tri.calibrate_cameras import calibrate_camera
from handeye_tri.calibrate_cameras.lens_centre import (
    centre_quadrature,
    mean_and_covariance,
)
from handeye_tri.calibrate_cameras.trials import calibrate_trials
from handeye_tri.camera import Lens
from handeye_tri.triangle import TriangleRig

COEFFICIENTS = np.array([-0.21, 0.13, 1e-3, -6e-4, 0.0])
NAMES = ("k1", "k2", "p1", "p2")


def scene_of(axis: Any, coefficients: Any = COEFFICIENTS) -> Any:
    """Eleven half-turns with the triangle anywhere in the image."""
    view = camera(lens=Lens("radtan", coefficients))
    return make_scene(np.random.default_rng(2), 11, axis, view=view, sideways=0.25)


@pytest.mark.parametrize("axis", ["normal", "AB"])
@pytest.mark.parametrize("names", [("k1",), NAMES])
def test_nees_is_one_where_the_centre_is_not_determined(axis: Any, names: Any) -> None:
    kept = np.isin(("k1", "k2", "p1", "p2", "k3"), names)
    scene = scene_of(axis, COEFFICIENTS * kept)
    rng = np.random.default_rng(3)
    shape = (300, *scene.before.shape)
    found = calibrate_trials(
        scene.before + rng.standard_normal(shape),
        scene.after + rng.standard_normal(shape),
        scene.triangle,
        image_size=IMAGE_SIZE,
        axis=axis,
        distortion=names,
        sigma_px=1.0,
    )
    good = found.converged
    assert good.sum() >= 0.98 * len(found)
    truth = np.array([scene.camera.parameter(name) for name in found.labels])
    values = np.concatenate([found.intrinsics, found.lens], axis=1)[good]
    error = values[:, : len(truth)] - truth
    sigma = found.sigma[good]
    # The principal point is off by a tenth of the image's height and more.
    assert np.median(sigma[:, 3:5]) > 50
    nees = np.einsum(
        "ti,ti->t",
        error,
        np.linalg.solve(found.covariance[good], error[..., None])[..., 0],
    ) / len(truth)
    # Of 300 chi-square variables with 6 or 9 degrees of freedom: 1 +- 0.033; the
    # covariance of the linear problem has 1.5 to 3.8.
    assert 0.8 < nees.mean() < 1.2
    covered = (np.abs(error) < 1.959964 * sigma).mean(axis=0)
    assert covered.min() > 0.86


def test_the_mean_fits_nearly_as_well_as_the_best_lens_about_its_centre() -> None:
    scene = scene_of("AB")
    rise = []
    for trial in range(25):
        seen = scene.noisy(np.random.default_rng([4, trial]), 1.0)
        options: dict[str, Any] = {
            "image_size": IMAGE_SIZE,
            "axis": "AB",
            "sigma_px": 1.0,
        }
        result = calibrate_camera(*seen, scene.triangle, distortion=NAMES, **options)
        cx, cy = result.camera.intrinsics.vector[3:]
        known = calibrate_camera(
            *seen,
            scene.triangle,
            distortion=NAMES,
            fixed={"cx": cx, "cy": cy},
            **options,
        )
        rise.append(result.chi2 - known.chi2)
        assert np.square(result.residuals).sum() == pytest.approx(result.chi2)
    assert min(rise) > -1e-6
    # The true camera's chi2 is 9 above the least, on average.
    assert np.median(rise) < 2


def test_a_well_known_centre_leaves_maximum_and_linear_covariance() -> None:
    scene = scene_of("normal")
    rng = np.random.default_rng(5)
    sigma = 1e-3
    seen = scene.noisy(rng, sigma)
    options: dict[str, Any] = {"image_size": IMAGE_SIZE, "distortion": NAMES, "o": FOOT}
    stated = calibrate_camera(*seen, scene.triangle, sigma_px=sigma, **options)
    # A hundredth of the noise leaves what is not linear a ten-thousandth.
    finer = calibrate_camera(*seen, scene.triangle, sigma_px=sigma / 100, **options)
    labels = ("fx", "fy", "skew", "cx", "cy", *NAMES)
    off = [
        stated.camera.parameter(name) - finer.camera.parameter(name) for name in labels
    ]
    std = np.array([stated.covariance.std(f"camera.{name}") for name in labels])
    assert np.abs(np.array(off) / std).max() < 0.02
    difference = stated.covariance.matrix - 1e4 * finer.covariance.matrix
    assert np.abs(difference / np.outer(std, std)).max() < 1e-3


@pytest.mark.parametrize("names", [("k1", "k2"), NAMES])
def test_nees_is_one_where_k2_is_not_determined(names: Any) -> None:
    kept = np.isin(("k1", "k2", "p1", "p2", "k3"), names)
    scene = make_scene(
        np.random.default_rng(2),
        11,
        "AB",
        triangle=TriangleRig(0.13, 0.12, np.radians(60.0)),
        view=camera(lens=Lens("radtan", COEFFICIENTS * kept)),
        sideways=0.25,
    )
    wanted = ("fx", "fy", "skew", *names)
    truth = np.array([scene.camera.parameter(name) for name in wanted])
    nees = []
    for trial in range(120):
        found = calibrate_camera(
            *scene.noisy(np.random.default_rng([7, trial]), 1.0),
            scene.triangle,
            image_size=IMAGE_SIZE,
            axis="AB",
            distortion=names,
            fixed={"cx": 519.3, "cy": 377.8},
            sigma_px=1.0,
        )
        assert found.covariance.labels == tuple(f"camera.{name}" for name in wanted)
        error = np.array([found.camera.parameter(name) for name in wanted]) - truth
        covariance = found.covariance.matrix
        nees.append(error @ np.linalg.solve(covariance, error) / len(error))
    # Of 120 chi-square variables with 5 or 7 degrees of freedom: 1 +- 0.06; the
    # covariance of the linear problem has 1.2.
    assert 0.82 < np.mean(nees) < 1.18


def test_a_known_principal_point_is_not_averaged_over() -> None:
    scene = scene_of("normal")
    seen = scene.noisy(np.random.default_rng(6), 0.5)
    known = {"cx": 519.3, "cy": 377.8}
    result = calibrate_camera(
        *seen,
        scene.triangle,
        image_size=IMAGE_SIZE,
        distortion=NAMES,
        fixed=known,
        sigma_px=0.5,
    )
    assert {name: result.camera.parameter(name) for name in known} == known
    both = calibrate_camera(
        *seen,
        scene.triangle,
        image_size=IMAGE_SIZE,
        distortion=NAMES,
        fixed={"cx": 519.3},
        sigma_px=0.5,
    )
    assert both.camera.parameter("cx") == known["cx"]
    assert "camera.cy" in both.covariance.labels


def test_moments_of_a_normal_and_of_a_bent_one_are_exact() -> None:
    units, gauss = centre_quadrature(2)
    np.testing.assert_allclose(gauss.sum(), 1.0)
    # x standard normal in the plane; y = 0.7 (x0^2 - 1) with variance 0.09 about that.
    steps = np.column_stack([units, 0.7 * (units[:, 0] ** 2 - 1.0)])
    about = np.zeros((len(units), 3, 3))
    about[:, 2, 2] = 0.09
    logarithms = np.zeros(len(units))
    logarithms[0] = -np.inf
    mean, covariance = mean_and_covariance(steps, about, gauss, logarithms)
    # Without the one node in a corner, of weight 1e-4, all to about that.
    np.testing.assert_allclose(mean, 0.0, atol=5e-3)
    expected = np.diag([1.0, 1.0, 0.09 + 2 * 0.49])
    np.testing.assert_allclose(covariance, expected, atol=0.02)
