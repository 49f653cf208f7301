from __future__ import annotations

import numpy as np
import pytest

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.config import ImagingConfig
from handeye_tri.errors import InputError
from handeye_tri.simulate.imaging import Optics, blurred, develop

SIZE = (96, 72)
PINHOLE = PinholeCamera("a", Intrinsics(160.0, 158.0, 0.0, 49.3, 33.8), SIZE)
LENSES = {
    "skew": (1.5, Lens()),
    "radtan": (0.0, Lens("radtan", np.array([-0.2, 0.1, 6e-4, -4e-4, 0.0]))),
    "pincushion": (-1.0, Lens("radtan", np.array([0.15, 0.0, 0.0, 1e-3, 0.0]))),
    "rational": (
        1.0,
        Lens("rational", np.array([0.1, 0.05, 5e-4, 3e-4, 0.0, 0.3, 0.02, 0.0])),
    ),
}


def camera_of(name: str) -> PinholeCamera:
    skew, lens = LENSES[name]
    k = PINHOLE.intrinsics
    return PinholeCamera("a", Intrinsics(k.fx, k.fy, skew, k.cx, k.cy), SIZE, lens)


@pytest.mark.parametrize("supersample", [1, 2, 3])
@pytest.mark.parametrize("name", LENSES)
def test_resampling_lands_where_the_inverse_lens_says(
    name: str, supersample: int
) -> None:
    """Bilinear weights reproduce a ramp exactly, so a ramp reads out the map."""
    camera = camera_of(name)
    optics = Optics.of(camera, supersample)
    assert optics.resample is not None
    width, height = (supersample * n for n in optics.pinhole.size)
    # The fine picture holds its own ideal normalised coordinates, times f.
    u = (np.arange(width) + 0.5) / supersample - 0.5 - optics.pinhole.principal_point[0]
    v = (np.arange(height) + 0.5) / supersample - 0.5
    v -= optics.pinhole.principal_point[1]
    ramps = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    read = (optics.resample @ ramps).reshape(SIZE[1], SIZE[0], 2)
    fine = (np.arange(supersample) + 0.5) / supersample - 0.5
    pixels = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1)
    expected = np.mean(
        [camera.normalised(pixels + (du, dv)) for dv in fine for du in fine], axis=0
    ) * (camera.intrinsics.fx, camera.intrinsics.fy)
    # Weights are float32: 2^-24 of a coordinate of 60 px, several times.
    np.testing.assert_allclose(read, expected, atol=3e-5)
    sums = np.asarray(optics.resample.sum(axis=1))
    np.testing.assert_allclose(sums, 1.0, atol=1e-6)


def test_a_pinhole_is_averaged_in_blocks() -> None:
    fine = np.random.default_rng(0).integers(0, 256, (144, 192, 3), dtype=np.uint8)
    optics = Optics.of(PINHOLE, 2)
    assert optics.resample is None
    assert optics.pinhole.size == SIZE
    expected = fine.reshape(72, 2, 96, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(optics.reduce(fine), expected, atol=1e-4)


def test_a_vanishing_skew_changes_nothing() -> None:
    """The sparse route and the block route are one camera."""
    k = PINHOLE.intrinsics
    camera = PinholeCamera("a", Intrinsics(k.fx, k.fy, 1e-9, k.cx, k.cy), SIZE)
    optics = Optics.of(camera, 2)
    width, height = (2 * n for n in optics.pinhole.size)
    fine = np.random.default_rng(1).integers(0, 256, (height, width, 3), dtype=np.uint8)
    left = round(optics.pinhole.principal_point[0] - k.cx)
    top = round(optics.pinhole.principal_point[1] - k.cy)
    part = fine[2 * top : 2 * top + 144, 2 * left : 2 * left + 192]
    np.testing.assert_allclose(
        optics.reduce(fine), Optics.of(PINHOLE, 2).reduce(part), atol=1e-3
    )


def test_a_lens_that_folds_its_image_is_refused() -> None:
    camera = PinholeCamera(
        "a", PINHOLE.intrinsics, SIZE, Lens("radtan", np.array([-4.0, 0, 0, 0, 0]))
    )
    with pytest.raises(InputError):
        Optics.of(camera, 2)


@pytest.mark.parametrize("sigma", [0.8, 2.0])
def test_blur_spreads_a_point_by_its_sigma_and_keeps_its_light(sigma: float) -> None:
    image = np.zeros((41, 43, 1), dtype=np.float32)
    image[20, 21] = 1.0
    spread = blurred(image, sigma)[..., 0].astype(float)
    assert spread.sum() == pytest.approx(1.0, abs=1e-5)
    for axis, centre in ((0, 20), (1, 21)):
        profile = spread.sum(axis=1 - axis)
        offset = np.arange(len(profile)) - centre
        assert profile @ offset == pytest.approx(0.0, abs=1e-5)
        # The variance of the sampled Gaussian, cut at 4 sigmas: within 1.5 %.
        assert profile @ offset**2 == pytest.approx(sigma**2, rel=0.015)


def test_blur_keeps_a_flat_image_up_to_its_border() -> None:
    image = np.full((9, 11, 3), 77.0, dtype=np.float32)
    np.testing.assert_allclose(blurred(image, 0.8), 77.0, atol=1e-4)


def test_noise_is_as_stated_and_independent() -> None:
    fine = np.full((2 * 256, 2 * 256, 3), 120, dtype=np.uint8)
    camera = PinholeCamera("a", Intrinsics(300, 300, 0, 128, 128), (256, 256))
    image = develop(
        Optics.of(camera, 2),
        ImagingConfig(noise_percent=2.0),
        fine,
        np.random.default_rng(5),
    ).astype(float)
    n = 256 * 256
    # Rounding to whole grey values adds 1/12.
    expected = np.sqrt((0.02 * 255) ** 2 + 1 / 12)
    for channel in np.moveaxis(image, 2, 0):
        # Four standard errors of a mean and of a standard deviation.
        assert abs(channel.mean() - 120) < 4 * expected / np.sqrt(n)
        assert abs(channel.std() - expected) < 4 * expected / np.sqrt(2 * n)
    pairs = np.corrcoef(image.reshape(-1, 3).T)[np.triu_indices(3, 1)]
    neighbours = np.corrcoef(image[:, 1:, 0].ravel(), image[:, :-1, 0].ravel())[0, 1]
    assert np.abs([*pairs, neighbours]).max() < 4 / np.sqrt(n)


def test_grey_is_the_mean_of_the_channels() -> None:
    fine = np.zeros((144, 192, 3), dtype=np.uint8)
    fine[...] = (30, 60, 240)
    image = develop(
        Optics.of(PINHOLE, 2), ImagingConfig(grey=True), fine, np.random.default_rng(0)
    )
    assert image.shape == (72, 96)
    assert image.dtype == np.uint8
    assert (image == 110).all()


def test_rounding_goes_to_the_nearest_and_stays_in_range() -> None:
    fine = np.zeros((144, 192, 3), dtype=np.uint8)
    # Blocks of four: mean 0.75 becomes 1, mean 0.25 becomes 0.
    fine[0::2] = 1
    fine[1::2, 0::2] = 1
    imaging = ImagingConfig()
    image = develop(Optics.of(PINHOLE, 2), imaging, fine, np.random.default_rng(0))
    assert (image == 1).all()
    loud = ImagingConfig(noise_percent=60)
    bright = np.full_like(fine, 250)
    image = develop(Optics.of(PINHOLE, 2), loud, bright, np.random.default_rng(0))
    assert image.max() == 255
    assert image.min() == 0
    # Nothing wraps around: far fewer pixels below half than above.
    assert (image < 128).mean() < 0.25
