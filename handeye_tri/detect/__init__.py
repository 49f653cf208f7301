"""The three markers in an image, with a covariance for each centre."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.detect import search
from handeye_tri.detect.corners import detect_corners, likeness
from handeye_tri.detect.ellipse import Indices
from handeye_tri.detect.identity import assign
from handeye_tri.detect.markers import Detection, MarkerSpec, Reason, chroma
from handeye_tri.detect.outline import Outlines, common_scatter, measure
from handeye_tri.detect.sheet import detection_sheet
from handeye_tri.errors import InputError
from handeye_tri.records import Floats

__all__ = [
    "Detection",
    "MarkerSpec",
    "detect_corners",
    "detect_markers",
    "detection_sheet",
    "likeness",
]

Image = NDArray[np.uint8]

_MIN_SIDE = 32
# Not in the scatter, px times px of radius: an outline that curves within a pixel does
# not cover it quite as a straight edge would (0.03, 0.03, 0.02, 0.01 found on exact
# areas without blur, radii 4.5, 7, 10, 14 px).
_CURVATURE_ERROR = 0.03


def detect_markers(image: Image, markers: MarkerSpec) -> Detection:
    """Find the balls A, B, C in one image.

    The pixel of a marker is the centre of its outline's ellipse, which is not the
    image of the ball's centre. Nothing is known but the image: no earlier view, no
    pose.

    Args:
        image: RGB, shape (h, w, 3), or grey, shape (h, w), 8 bits.
        markers: What they look like. Identity by colour needs an RGB image;
            identity by radius takes either.

    Raises:
        InputError: the image is not of this kind.
    """
    _check(image, markers)
    if markers.identity == "colour":
        hues = chroma(markers.colours)
        # The part of the marker's colour, blind to every grey: 255 is all of it.
        weights = hues / (hues**2).sum(axis=1, keepdims=True)
        return _measured(image, search.coloured_spots(image, markers), markers, weights)
    if image.ndim == 3:
        image = search.grey(image)
    for stride in search.STRIDES:
        spots = search.flat_spots(image, stride)
        detection = _measured(image, spots, markers, None)
        if detection.complete:
            break
    return detection


def _measured(
    image: Image,
    spots: list[search.Candidate],
    markers: MarkerSpec,
    weights: Floats | None,
) -> Detection:
    """Measure spots and name them.

    Args:
        image: Grey, or RGB with weights.
        spots: What to measure.
        markers: What to name them as.
        weights: What to add up of red, green and blue for each marker, (3, 3).
    """
    if not spots:
        return _detection([None] * 3, ["no_candidate"] * 3, None)
    if weights is not None:
        weights = weights[[spot.markers[0] for spot in spots]]

    def sampler(own: Indices, points: Floats) -> Floats:
        values = search.sample(image, points)
        if weights is None:
            return values
        return np.asarray((values @ weights[own, None, :, None])[..., 0])

    def reader(spot: Indices, row: Indices, column: Indices) -> Floats:
        values = image[row, column]
        if weights is None:
            return values.astype(float)
        return np.asarray((values * weights[spot]).sum(axis=1))

    outlines = measure(
        sampler,
        reader,
        (image.shape[1], image.shape[0]),
        np.array([spot.centre for spot in spots]),
        np.array([spot.radius for spot in spots]),
    )
    good = [k for k, reason in enumerate(outlines.reasons) if reason is None]
    excess = np.zeros((len(good), 3))
    if weights is None:
        # Of a grey image only.
        excess = outlines.levels[good, None] - 255.0 * markers.colours.mean(axis=1)
    named, unclear = assign(
        [spots[k].markers for k in good],
        outlines.centres[good],
        outlines.longest[good],
        markers,
        excess,
    )
    why: list[Reason] = []
    for marker in range(3):
        rejected = [
            reason
            for spot, reason in zip(spots, outlines.reasons, strict=True)
            if reason is not None and spot.markers == (marker,)
        ]
        why.append(unclear or (*rejected, "no_candidate")[0])
    return _detection([None if k is None else good[k] for k in named], why, outlines)


def _check(image: Image, markers: MarkerSpec) -> None:
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        kind = getattr(image, "dtype", type(image).__name__)
        raise InputError(f"image must be an array of uint8, got {kind}")
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise InputError(
            f"image must have shape (h, w, 3) or (h, w), got {image.shape}"
        )
    if min(image.shape[:2]) < _MIN_SIDE:
        raise InputError(
            f"image must have at least {_MIN_SIDE} rows and columns, got {image.shape}"
        )
    if image.ndim == 2 and markers.identity == "colour":
        raise InputError(
            "the image is grey but the markers are told apart by colour; take RGB "
            'images, or use balls of three sizes and identity "radius"'
        )


def _detection(
    named: list[int | None], why: list[Reason], outlines: Outlines | None
) -> Detection:
    """Put the named outlines in the markers' order, and say why others lack."""
    pixels = np.full((3, 2), np.nan)
    covariance = np.full((3, 2, 2), np.nan)
    radii = np.full(3, np.nan)
    edges = np.full((3, 3), np.nan)
    reasons: list[Reason | None] = list(why)
    found = [marker for marker, spot in enumerate(named) if spot is not None]
    if found and outlines is not None:
        spots = [spot for spot in named if spot is not None]
        scatter = common_scatter(outlines.scatter[spots])
        pixels[found] = outlines.centres[spots]
        radii[found] = outlines.radii[spots]
        edges[found] = outlines.edges[spots]
        unseen = (_CURVATURE_ERROR / radii[found]) ** 2
        covariance[found] = scatter[:, None, None] * outlines.gain[spots]
        covariance[found] += unseen[:, None, None] * np.eye(2)
        for marker in found:
            reasons[marker] = None
    return Detection(pixels, covariance, radii, tuple(reasons), edges)
