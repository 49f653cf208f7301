"""Where markers may be: a coarse look at the whole image. All of OpenCV is here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from handeye_tri.detect.markers import MarkerSpec, chroma
from handeye_tri.records import Floats

Image = NDArray[np.uint8]

# A look at every fourth pixel of every fourth row first; at more where it finds
# nothing, so that small markers cost time and not the detection.
_STRIDES = (4, 2, 1)
# A pixel has a marker's colour from this part of the full chroma on.
_MIN_PART = 0.35
_MIN_SAMPLES = 6
# Grey markers are flat spots: a step of more levels than this is an edge.
_EDGE_LEVELS = 14.0
_SHRINK = 2


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A spot that may be a marker.

    Attributes:
        markers: Indices of the markers that it may be.
        centre: Column and row, pixels, to a few pixels.
        radius: Pixels, to a few pixels.
    """

    markers: tuple[int, ...]
    centre: tuple[float, float]
    radius: float


def coloured_spots(image: Image, spec: MarkerSpec) -> list[Candidate]:
    """Spots of each marker's hue, at most three a marker, largest first.

    Args:
        image: RGB, shape (h, w, 3).
        spec: The markers' colours.
    """
    hues = chroma(spec.colours)
    strength = np.linalg.norm(hues, axis=1)
    # Saturating arithmetic: what is below the threshold becomes 0.
    threshold = 255.0 * _MIN_PART * strength.min()
    transform = np.column_stack([hues / strength[:, None], np.full(3, -threshold)])
    wanted = [0, 1, 2]
    found: list[Candidate] = []
    for stride in _STRIDES:
        small = image
        if stride > 1:
            size = (-(-image.shape[1] // stride), -(-image.shape[0] // stride))
            small = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
        scores = cv2.split(cv2.transform(small, transform))
        for marker in tuple(wanted):
            spots = _spots_of(scores, marker, stride)
            if spots:
                wanted.remove(marker)
                found += spots
        if not wanted:
            break
    return found


def _spots_of(scores: Sequence[Image], marker: int, stride: int) -> list[Candidate]:
    left, top, width, height = cv2.boundingRect(scores[marker])
    if width == 0:
        return []
    part = np.s_[top : top + height, left : left + width]
    own = scores[marker][part]
    others = [scores[k][part] for k in range(3) if k != marker]
    mask = (own > np.maximum(*others)).astype(np.uint8)
    _, _, stats, centroids = cv2.connectedComponentsWithStats(mask, connectivity=8)
    # Row 0 is what is not in the mask.
    order = 1 + np.argsort(-stats[1:, cv2.CC_STAT_AREA])[:3]
    return [
        Candidate(
            (marker,),
            (
                stride * (left + float(centroids[k, 0])),
                stride * (top + float(centroids[k, 1])),
            ),
            stride * float(np.sqrt(stats[k, cv2.CC_STAT_AREA] / np.pi)),
        )
        for k in order
        if stats[k, cv2.CC_STAT_AREA] >= _MIN_SAMPLES
    ]


def flat_spots(image: Image) -> list[Candidate]:
    """Round spots of one level, of any brightness, enclosed by an edge.

    Args:
        image: Grey, shape (h, w).
    """
    size = (image.shape[1] // _SHRINK, image.shape[0] // _SHRINK)
    small = cv2.resize(
        image[: size[1] * _SHRINK, : size[0] * _SHRINK],
        size,
        interpolation=cv2.INTER_AREA,
    )
    steps = cv2.morphologyEx(small, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    threshold = max(_EDGE_LEVELS, 2.0 * float(np.median(steps[::4, ::4])))
    mask = (steps < threshold).view(np.uint8)
    _, _, stats, centroids = cv2.connectedComponentsWithStats(mask, connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA]
    width = stats[:, cv2.CC_STAT_WIDTH]
    height = stats[:, cv2.CC_STAT_HEIGHT]
    fill = area / (width * height)
    longest = np.maximum(width, height)
    good = (
        (area >= _MIN_SAMPLES)
        & (longest <= 1.6 * np.minimum(width, height) + 1)
        & (fill > 0.6)
        & (longest < 0.2 * min(size))
    )
    good[0] = False
    half = 0.5 * (_SHRINK - 1)
    return [
        Candidate(
            (0, 1, 2),
            tuple(_SHRINK * centroids[k] + half),
            # The edge's width is missing all around.
            _SHRINK * float(np.sqrt(area[k] / np.pi) + 1.2),
        )
        for k in np.flatnonzero(good)
    ]


def grey(image: Image) -> Image:
    """Grey levels, shape (h, w), of an RGB image, shape (h, w, 3)."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def sample(image: Image, points: Floats) -> Floats:
    """Bilinear samples, shape (..., channels) or (...), at points, (..., 2), pixels.

    Points outside take the value of the image's border.
    """
    flat = points.reshape(-1, points.shape[-2], 2).astype(np.float32)
    values = cv2.remap(
        image,
        flat[..., 0],
        flat[..., 1],
        interpolation=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(values.reshape(points.shape[:-1] + image.shape[2:]), dtype=float)
