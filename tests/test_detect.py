"""Detection on analytic discs: accuracy, honest covariance, reasons; and on renders."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from handeye_tri.detect import Detection, MarkerSpec, detect_markers
from handeye_tri.errors import InputError

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

PURE = np.eye(3)
EQUAL = np.array([0.008, 0.008, 0.008])
THREE_SIZES = np.array([0.0065, 0.008, 0.010])
BY_COLOUR = MarkerSpec("colour", PURE, EQUAL)
BY_RADIUS = MarkerSpec("radius", np.ones((3, 3)), THREE_SIZES)
Inside = Callable[[Floats, Floats], NDArray[np.bool_]]


class Canvas:
    """A picture in which shapes cover parts of pixels by area."""

    def __init__(self, width: int, height: int, level: float, channels: int = 3):
        self.levels = np.full((height, width, channels), float(level))

    def paint(
        self, colour: object, box: tuple[float, ...], inside: Inside, fine: int
    ) -> None:
        """Cover what ``inside(x, y)`` says within box (left, top, right, bottom)."""
        height, width = self.levels.shape[:2]
        left, top = (max(0, int(np.floor(v)) - 1) for v in box[:2])
        right = min(width, int(np.ceil(box[2])) + 2)
        bottom = min(height, int(np.ceil(box[3])) + 2)
        if right <= left or bottom <= top:
            return
        part = (np.arange(fine) + 0.5) / fine - 0.5
        x = (np.arange(left, right)[:, None] + part).ravel()
        y = (np.arange(top, bottom)[:, None] + part).ravel()
        mask = inside(x[None, :], y[:, None])
        cover = mask.reshape(bottom - top, fine, right - left, fine).mean(axis=(1, 3))
        area = self.levels[top:bottom, left:right]
        area += cover[..., None] * (np.asarray(colour, dtype=float) - area)

    def disc(
        self, colour: object, centre: Floats, radius: float, stretch: float = 1.0
    ) -> None:
        """An ellipse, stretched by a factor along the diagonal."""
        u, v = centre

        def inside(x: Floats, y: Floats) -> NDArray[np.bool_]:
            along, across = (x - u + y - v) / np.sqrt(2), (x - u - y + v) / np.sqrt(2)
            return (along / stretch) ** 2 + across**2 < radius**2

        r = radius * max(stretch, 1.0) + 1
        self.paint(colour, (u - r, v - r, u + r, v + r), inside, 16)

    def rod(self, colour: object, start: Floats, end: Floats, width: float) -> None:
        """A straight bar with round ends."""
        d = np.subtract(end, start)
        length = float(np.linalg.norm(d))
        d = d / length

        def inside(x: Floats, y: Floats) -> NDArray[np.bool_]:
            along = np.clip((x - start[0]) * d[0] + (y - start[1]) * d[1], 0, length)
            away = np.hypot(x - start[0] - along * d[0], y - start[1] - along * d[1])
            return away < width / 2

        low, high = np.minimum(start, end) - width, np.maximum(start, end) + width
        self.paint(colour, (*low, *high), inside, 4)

    def image(
        self, rng: np.random.Generator, noise: float = 0.0, blur: float = 0.0
    ) -> Image:
        """8 bits, blur in px, noise in percent of 255."""
        levels = self.levels
        if blur:
            levels = gaussian_filter(levels, blur, axes=(0, 1))
        levels = levels + rng.normal(0.0, 2.55 * noise, levels.shape)
        image = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
        return image[..., 0] if image.shape[2] == 1 else image


def place(rng: np.random.Generator) -> Floats:
    """Three centres in a 320 x 240 image, apart from each other and the border."""
    while True:
        centres = rng.uniform((40, 40), (279, 199), (3, 2))
        gaps = [
            np.linalg.norm(centres[i] - centres[j]) for i, j in ((0, 1), (1, 2), (0, 2))
        ]
        if min(gaps) > 60:
            return centres


def errors_of(
    detections: list[Detection], centres: list[Floats]
) -> tuple[Floats, Floats]:
    """Errors, shape (n, 2), and normalised squared errors per axis, shape (n,)."""
    for detection in detections:
        assert detection.complete, detection.reasons
    error = np.array([d.pixels - c for d, c in zip(detections, centres, strict=True)])
    cov = np.array([d.covariance for d in detections])
    squares = np.einsum("nmi,nmij,nmj->nm", error, np.linalg.inv(cov), error) / 2
    return error.reshape(-1, 2), squares.ravel()


def coloured(
    rng: np.random.Generator,
    centres: Floats,
    *,
    colours: Floats = PURE,
    radius: float = 14.3,
    rods: int = 0,
    noise: float = 0.0,
    blur: float = 0.0,
) -> Image:
    """Three discs on neutral patches, rods behind them."""
    canvas = Canvas(320, 240, 120)
    for _ in range(4):
        start = rng.uniform((0, 0), (300, 220))
        level = rng.uniform(30, 220)
        canvas.rod(level, start, start + rng.uniform(-90, 90, 2), rng.uniform(20, 60))
    for centre in np.repeat(centres, rods, axis=0):
        end = centre + 60 * np.array(np.sin(rng.uniform(0, 6.3) + np.array([0, 1.57])))
        canvas.rod(rng.uniform(20, 90), centre, end, 5.0)
    for centre, colour in zip(centres, colours, strict=True):
        canvas.disc(255 * colour, centre, radius, rng.uniform(1.0, 1.06))
    return canvas.image(rng, noise, blur)


def test_exact_areas_give_the_centre_to_a_few_thousandths() -> None:
    rng = np.random.default_rng(1)
    centres = [place(rng) for _ in range(8)]
    found = [detect_markers(coloured(rng, c), BY_COLOUR) for c in centres]
    error, _ = errors_of(found, centres)
    # 8 bits and 16 x 16 parts per pixel leave about 0.002 px.
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.005
    radii = np.array([d.radii_px for d in found])
    assert np.abs(radii - 14.3 * np.sqrt(1.03)).max() < 0.3


@pytest.mark.parametrize(("noise", "blur"), [(2.0, 0.8), (3.0, 0.0)])
def test_noise_blur_and_rods(noise: float, blur: float) -> None:
    rng = np.random.default_rng(2)
    centres = [place(rng) for _ in range(40)]
    found = [
        detect_markers(coloured(rng, c, rods=2, noise=noise, blur=blur), BY_COLOUR)
        for c in centres
    ]
    error, squares = errors_of(found, centres)
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.02
    # Predicted against sampled: 120 centres, 16 degrees of freedom behind each
    # variance, so that the mean is 1.14 with a standard deviation of 0.12.
    assert 0.7 < squares.mean() < 1.6
