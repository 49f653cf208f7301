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
STRIDES = (4, 2, 1)
# A pixel has a marker's colour from this part of the full chroma on.
_MIN_PART = 0.35
_MIN_SAMPLES = 6
# So many round spots of a hue are measured.
_MOST_SPOTS = 12
# Grey markers are flat spots: a step of more levels than this is an edge.
_EDGE_LEVELS = 14.0
# A corner's response is at least this part of the strongest one's.
_HARRIS_QUALITY = 0.0005
# A larger part of the image's side is no marker.
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
_MAX_PART = 0.25


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
    """Spots of each marker's hue, the largest round ones, or else the largest.

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
    for stride in STRIDES:
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
    order = 1 + np.argsort(-stats[1:, cv2.CC_STAT_AREA])
    order = order[stats[order, cv2.CC_STAT_AREA] >= _MIN_SAMPLES]
    round_ = order[_is_round(stats[order])][:_MOST_SPOTS]
    # What is not round shows why there is no marker.
    order = round_ if len(round_) else order[:3]
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
    ]


def _is_round(stats: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Which of connected parts, rows of OpenCV's statistics, may be an ellipse.

    It fills pi / 4 of its box, less where it lies aslant or is small.
    """
    _, _, width, height, area = stats.T
    longest, shortest = np.maximum(width, height), np.minimum(width, height)
    return np.asarray((longest <= 2 * shortest + 1) & (area > 0.5 * width * height))


def flat_spots(image: Image, shrink: int) -> list[Candidate]:
    """Round spots of one level, of any brightness, enclosed by an edge.

    Args:
        image: Grey, shape (h, w).
        shrink: Looks at the image smaller by this power of two: spots of radius 2.5
            times this are seen.
    """
    small = image
    for _ in range(shrink.bit_length() - 1):
        height, width = (side // 2 for side in small.shape)
        small = cv2.resize(
            small[: 2 * height, : 2 * width],
            (width, height),
            interpolation=cv2.INTER_AREA,
        )
    steps = cv2.morphologyEx(small, cv2.MORPH_GRADIENT, _CROSS)
    threshold = max(_EDGE_LEVELS, 2.0 * float(np.median(steps[::4, ::4])))
    flat = (steps < threshold).view(np.uint8)
    _, _, stats, centroids = cv2.connectedComponentsWithStats(flat, connectivity=4)
    _, _, width, height, area = stats[1:].T
    longest = np.maximum(width, height)
    round_ = _is_round(stats[1:]) & (longest >= 2)
    round_ &= longest < _MAX_PART * min(flat.shape)
    middle = 0.5 * (shrink - 1)
    return [
        Candidate(
            (0, 1, 2),
            (
                shrink * float(centroids[k, 0]) + middle,
                shrink * float(centroids[k, 1]) + middle,
            ),
            # The edge's width is missing all around.
            shrink * (float(np.sqrt(area[k - 1] / np.pi)) + 1.3),
        )
        for k in 1 + np.flatnonzero(round_)
    ]


def harris_corners(
    image: Image, mask: NDArray[np.bool_], apart: float, window: int
) -> tuple[Floats, Floats]:
    """Corners by Harris and Stephens (1988), at whole pixels and refined.

    Args:
        image: Grey, shape (h, w).
        mask: Where to look, shape (h, w).
        apart: Least distance of two corners, pixels.
        window: Half width of what a corner is refined in, pixels.

    Returns:
        Where they were found and where refined, both of shape (n, 2), pixels.
    """
    found = cv2.goodFeaturesToTrack(
        image,
        0,
        _HARRIS_QUALITY,
        apart,
        mask=mask.astype(np.uint8),
        blockSize=5,
        useHarrisDetector=True,
        k=0.04,
    )
    if found is None:
        return np.empty((0, 2)), np.empty((0, 2))
    until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    refined = cv2.cornerSubPix(image, found.copy(), (window, window), (-1, -1), until)
    return (
        np.asarray(found, dtype=float).reshape(-1, 2),
        np.asarray(refined, dtype=float).reshape(-1, 2),
    )


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
