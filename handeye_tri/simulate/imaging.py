"""From a rendered picture to a camera's image: lens, skew, blur, noise, 8 bits.

The renderer draws pinholes without skew, finer than the image by a whole factor s.
Pixel u of the image lies at (u + 0.5) s - 0.5 of the fine picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.sparse import csr_array, vstack

if TYPE_CHECKING:
    from handeye_tri.camera import PinholeCamera
    from handeye_tri.config import ImagingConfig

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

# The inverse lens is exact at nodes this far apart and splined between them, which
# is off by 4e-9 px at k1 -0.2 in 1024 x 768 pixels.
_NODE_SPACING_PX = 16.0
# Rows of the image whose resampling weights are computed at once.
_BAND = 16


@dataclass(frozen=True, slots=True)
class Pinhole:
    """The picture that is rendered, before it is made finer.

    Attributes:
        size: (width, height), pixels of the camera's size.
        focal: (fx, fy), pixels.
        principal_point: (cx, cy), pixels; (0, 0) is the first pixel's centre.
    """

    size: tuple[int, int]
    focal: tuple[float, float]
    principal_point: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Optics:
    """How to get from the rendered picture to a camera's image.

    Attributes:
        size: (width, height) of the image.
        pinhole: What to render.
        supersample: How much finer than the pinhole's size to render it.
        resample: Sparse matrix from the fine picture's pixels to the image's; None
            where the camera is itself a pinhole without skew.
    """

    size: tuple[int, int]
    pinhole: Pinhole
    supersample: int
    resample: csr_array | None

    @classmethod
    def of(cls, camera: PinholeCamera, supersample: int) -> Optics:
        """Optics of a camera.

        Raises:
            InputError: the lens has no inverse somewhere in the image.
        """
        k = camera.intrinsics
        focal = (k.fx, k.fy)
        if camera.lens.is_identity and k.skew == 0:
            pinhole = Pinhole(camera.image_size, focal, (k.cx, k.cy))
            return cls(camera.image_size, pinhole, supersample, None)
        u, v = _ideal_pixels(camera, supersample)
        # One pixel more on every side, for the neighbours that bilinear weights use.
        left, top = (int(np.floor(x.min())) - 1 for x in (u, v))
        right, bottom = (int(np.ceil(x.max())) + 1 for x in (u, v))
        pinhole = Pinhole(
            (right - left + 1, bottom - top + 1), focal, (k.cx - left, k.cy - top)
        )
        fine_u = (u - left + 0.5) * supersample - 0.5
        fine_v = (v - top + 0.5) * supersample - 0.5
        width = pinhole.size[0] * supersample
        height = pinhole.size[1] * supersample
        # Band by band: what a band needs fits the processor's cache.
        bands = [
            _bilinear_means(
                fine_u[row : row + _BAND * supersample],
                fine_v[row : row + _BAND * supersample],
                supersample,
                (height, width),
            )
            for row in range(0, len(fine_u), _BAND * supersample)
        ]
        matrix = vstack(bands, format="csr")
        return cls(camera.image_size, pinhole, supersample, matrix)

    def reduce(self, fine: Image) -> NDArray[np.float32]:
        """Average the fine picture, (h s, w s, c), into the image, (H, W, c), 0-255."""
        width, height = self.size
        channels = fine.shape[2]
        if self.resample is not None:
            flat = fine.reshape(-1, channels).astype(np.float32)
            image = self.resample @ flat
            return np.asarray(image.reshape(height, width, channels))
        s = self.supersample
        # Whole rows first: that is half of the strided work.
        rows = fine[0::s].astype(np.uint16)
        for k in range(1, s):
            rows += fine[k::s]
        total = rows[:, 0::s].astype(np.float32)
        for k in range(1, s):
            total += rows[:, k::s]
        total *= np.float32(1.0 / (s * s))
        return total


def _ideal_pixels(camera: PinholeCamera, supersample: int) -> tuple[Floats, Floats]:
    """Where the samples of an image lie in the pinhole picture of the same K.

    Returns:
        u and v, each of shape (H s, W s), pixels of the image's size.
    """
    k = camera.intrinsics
    axes = []
    for size in camera.image_size:
        nodes = max(32, int(np.ceil(size / _NODE_SPACING_PX)) + 1)
        axes.append(np.linspace(-0.5, size - 0.5, nodes))
    grid = np.stack(np.meshgrid(*axes), axis=-1)
    ideal = camera.normalised(grid)
    samples = [
        (np.arange(size * supersample) + 0.5) / supersample - 0.5
        for size in camera.image_size
    ]
    u, v = (
        RectBivariateSpline(axes[1], axes[0], ideal[..., a], kx=5, ky=5)(
            samples[1], samples[0]
        )
        for a in range(2)
    )
    return k.fx * u + k.cx, k.fy * v + k.cy


def _bilinear_means(
    u: Floats, v: Floats, supersample: int, shape: tuple[int, int]
) -> csr_array:
    """Means over s x s bilinear samples, as one sparse matrix.

    Resampling the fine picture and then averaging does not alias; resampling it
    straight to the image's size does. Joining both steps costs neighbours that the
    samples of a pixel share only once.

    Args:
        u: Column of each sample in the fine picture, shape (H s, W s).
        v: Its row, likewise.
        supersample: The factor s.
        shape: Rows and columns of the fine picture.

    Returns:
        Shape (H W, fine pixels), float32; rows sum to one.
    """
    s = supersample
    height, width = shape
    rows, columns = u.shape[0] // s, u.shape[1] // s
    blocks = [
        x.reshape(rows, s, columns, s).transpose(0, 2, 1, 3).reshape(-1, s * s)
        for x in (u, v)
    ]
    first = [np.floor(x.min(axis=1)).astype(np.int32) for x in blocks]
    spans = [
        int((np.floor(x.max(axis=1)) - start).max()) + 2
        for x, start in zip(blocks, first, strict=True)
    ]
    across = np.arange(spans[0], dtype=np.float32)
    down = np.arange(spans[1], dtype=np.float32)
    weights = np.zeros((rows * columns, spans[1], spans[0]), dtype=np.float32)
    for sample in range(s * s):
        hats = [
            np.maximum(
                0.0,
                1.0 - np.abs((x[:, sample] - start).astype(np.float32)[:, None] - k),
            )
            for x, start, k in zip(blocks, first, (across, down), strict=True)
        ]
        weights += hats[1][:, :, None] * hats[0][:, None, :]
    weights /= s * s
    steps = (
        np.arange(spans[1], dtype=np.int32)[:, None] * width
        + np.arange(spans[0], dtype=np.int32)
    ).ravel()
    indices = (first[1] * width + first[0])[:, None] + steps
    pointers = np.arange(rows * columns + 1, dtype=np.int32) * len(steps)
    matrix = csr_array(
        (weights.reshape(-1), indices.ravel(), pointers),
        shape=(rows * columns, width * height),
    )
    matrix.eliminate_zeros()
    return matrix


def blurred(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Gaussian blur; beyond the border the image repeats its last pixel.

    The sampled Gaussian is cut at four sigmas. Whole slices are added because that
    takes a third of the time of a general convolution.

    Args:
        image: Shape (h, w, c).
        sigma: Standard deviation, pixels, above 0.
    """
    reach = int(4.0 * sigma + 0.5)
    kernel = np.exp(-0.5 * (np.arange(reach + 1) / sigma) ** 2)
    kernel = (kernel / (kernel[0] + 2.0 * kernel[1:].sum())).astype(np.float32)
    for axis in (0, 1):
        margins = [(reach, reach) if a == axis else (0, 0) for a in range(3)]
        size = image.shape[axis]
        padded = np.moveaxis(np.pad(image, margins, mode="edge"), axis, 0)
        total = padded[reach : reach + size] * kernel[0]
        pair = np.empty_like(total)
        for k in range(1, reach + 1):
            before, after = padded[reach - k :], padded[reach + k :]
            np.add(before[:size], after[:size], out=pair)
            pair *= kernel[k]
            total += pair
        image = np.moveaxis(total, 0, axis)
    return image


def develop(
    optics: Optics,
    imaging: ImagingConfig,
    fine: Image,
    rng: np.random.Generator,
) -> Image:
    """Turn a rendered picture into the image that the camera delivers.

    Args:
        optics: Of this camera.
        imaging: Blur, noise, grey.
        fine: RGB, shape (h s, w s, 3).
        rng: Source of the noise.

    Returns:
        RGB, shape (H, W, 3), or the channels' mean, shape (H, W), where the cell
        is grey.
    """
    image = optics.reduce(fine)
    if imaging.grey:
        image = image.mean(axis=2, keepdims=True)
    if imaging.blur_px > 0:
        image = blurred(image, imaging.blur_px)
    if imaging.noise_percent > 0:
        noise = rng.standard_normal(image.shape, dtype=np.float32)
        image += np.float32(2.55 * imaging.noise_percent) * noise
    np.rint(image, out=image)
    np.clip(image, 0, 255, out=image)
    result = image.astype(np.uint8)
    return result[..., 0] if imaging.grey else result
