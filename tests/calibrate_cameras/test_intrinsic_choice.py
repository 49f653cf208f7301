"""Cameras of which something is known: fewer half-turns, smaller sigmas, same truth."""

from __future__ import annotations

import numpy as np
import pytest
from half_turn_scene import IMAGE_SIZE, camera, make_scene

from handeye_tri.calibrate_cameras import calibrate_camera
from handeye_tri.calibrate_cameras.homography import ImageScale
from handeye_tri.calibrate_cameras.intrinsic_choice import IntrinsicChoice
from handeye_tri.calibrate_cameras.special_motion import conic_matrix
from handeye_tri.camera import Intrinsics, Lens
from handeye_tri.errors import DegenerateMotionError, InputError

K = Intrinsics(1720.0, 1715.0, 1.5, 519.3, 377.8)
CENTRE = {"cx": 519.3, "cy": 377.8}
ASPECT = 1715.0 / 1720.0


def calibrate(scene, seen=None, **options):
    before, after = (scene.before, scene.after) if seen is None else seen
    return calibrate_camera(
        before,
        after,
        scene.triangle,
        image_size=IMAGE_SIZE,
        axis=scene.axes,
        **options,
    )


@pytest.mark.parametrize("axis", ["normal", "CA"])
@pytest.mark.parametrize(
    ("skew", "n", "options", "labels"),
    [
        (1.5, 5, {"fixed": CENTRE}, "fx fy skew"),
        (1.5, 5, {"fixed": {"cx": 519.3}}, "fx fy skew cy"),
        (1.5, 4, {"fixed": {"skew": 1.5}}, "fx fy cx cy"),
        (1.5, 4, {"fixed": {"fx": 1720.0}}, "fy skew cx cy"),
        (1.5, 4, {"aspect": ASPECT}, "fx skew cx cy"),
        (0.0, 3, {"skew": False, "aspect": ASPECT}, "fx cx cy"),
        (0.0, 2, {"skew": False}, "fx fy cx cy"),
        (0.0, 2, {"skew": False, "fixed": CENTRE}, "fx fy"),
        (0.0, 1, {"skew": False, "fixed": CENTRE, "aspect": ASPECT}, "fx"),
    ],
)
def test_exact_data_give_the_rest_exactly(axis, skew, n, options, labels) -> None:
    scene = make_scene(np.random.default_rng([1, n]), n, axis, view=camera(skew=skew))
    known_o = {"o": scene.foot} if n == 1 else {}
    result = calibrate(scene, **options, **known_o)
    error = result.camera.intrinsics.vector - scene.camera.intrinsics.vector
    assert np.abs(error).max() < 1e-7
    assert result.covariance.labels == tuple(f"camera.{x}" for x in labels.split())


def test_what_is_known_makes_the_rest_surer_and_the_sigma_stays_true() -> None:
    scene = make_scene(np.random.default_rng(2), 6, view=camera(skew=0.0))
    options = {"skew": False, "fixed": CENTRE, "aspect": ASPECT, "sigma_px": 0.2}
    trials = 60
    scores = []
    for trial in range(trials):
        rng = np.random.default_rng([3, trial])
        seen = scene.noisy(rng, 0.2)
        result = calibrate(scene, seen, **options)
        sigma = result.covariance.std("camera.fx")
        scores.append(((result.camera.intrinsics.fx - 1720.0) / sigma) ** 2)
        assert result.camera.intrinsics.fy == pytest.approx(
            ASPECT * result.camera.intrinsics.fx, rel=1e-12
        )
    assert np.mean(scores) == pytest.approx(1.0, abs=4 * np.sqrt(2 / trials))
    free = calibrate(scene, seen, sigma_px=0.2).covariance.std("camera.fx")
    assert sigma < 0.7 * free


def test_known_lens_is_not_estimated() -> None:
    lens = Lens("radtan", np.array([-0.2, 0.1, 0.0, 0.0, 0.0]))
    scene = make_scene(np.random.default_rng(4), 8, view=camera(lens=lens))
    result = calibrate(scene, fixed={"k1": -0.2, "k2": 0.1})
    error = result.camera.intrinsics.vector - scene.camera.intrinsics.vector
    assert np.abs(error).max() < 1e-6
    assert len(result.covariance.labels) == 5
    half = calibrate(scene, fixed={"k2": 0.1}, distortion=("k1",))
    assert half.camera.lens.coefficients[0] == pytest.approx(-0.2, abs=1e-7)
    assert half.covariance.labels[5:] == ("camera.k1",)


@pytest.mark.parametrize(
    ("skew", "fixed", "aspect"),
    [
        (True, None, None),
        (False, None, None),
        (False, {"cx": 519.3}, ASPECT),
        (False, CENTRE, None),
        (True, CENTRE, None),
    ],
)
def test_conic_basis_holds_the_true_conic(skew, fixed, aspect) -> None:
    k = Intrinsics(1720.0, 1715.0, 1.5 if skew else 0.0, 519.3, 377.8).matrix
    image = ImageScale.of(IMAGE_SIZE)
    inverse = np.linalg.inv(np.linalg.inv(image.matrix) @ k)
    w = inverse.T @ inverse
    b = w[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    np.testing.assert_allclose(conic_matrix(b), w)
    basis = IntrinsicChoice.of(skew, fixed, aspect).conic_basis(image)
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-12)
    np.testing.assert_allclose(basis @ (basis.T @ b), b, atol=1e-12)
    known = (not skew) + len(fixed or {}) + (aspect is not None)
    assert basis.shape[1] == 6 - known


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"fixed": {"f": 1.0}}, InputError, r"fixed\['f'\] is none of fx, fy"),
        ({"fixed": {"cx": np.nan}}, InputError, r"fixed\['cx'\] must be a number"),
        ({"fixed": {"fx": -1.0}}, InputError, "focal lengths must be positive"),
        ({"aspect": 0.0}, InputError, r"aspect \(fy / fx\) must be a positive"),
        ({"aspect": 1.0, "fixed": {"fx": 1.0, "fy": 1.0}}, InputError, "too many"),
        ({"fixed": {"k1": 0.1}, "distortion": ("k1",)}, InputError, "k1 is both"),
        ({"aspect": 1.0, "refine": False}, InputError, "need refine=True"),
        (
            {"skew": False, "fixed": {**CENTRE, "fx": 1.0, "fy": 1.0}},
            InputError,
            "nothing left to estimate",
        ),
        ({"fixed": {"cx": 519.3}}, DegenerateMotionError, "1 half-turn is too few"),
    ],
)
def test_bad_choices_are_named(options, error, message) -> None:
    scene = make_scene(np.random.default_rng(5), 1)
    with pytest.raises(error, match=message):
        calibrate(scene, **options)
