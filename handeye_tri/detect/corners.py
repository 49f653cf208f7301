"""Corners of a printed thing, and how alike two of them look."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.detect import search
from handeye_tri.errors import InputError
from handeye_tri.records import Floats

Image = NDArray[np.uint8]

# Half widths of the windows in which a corner is refined, and compared, pixels.
_WINDOW = 5
_LOOKS = 8
# Corners nearer to each other are one; one that the refinement moves farther is none.
_APART = 6.0
_MOVED = 3.0


def detect_corners(image: Image, mask: NDArray[np.bool_]) -> Floats:
    """Sub-pixel corners where edges of a surface's print meet.

    Args:
        image: RGB, shape (h, w, 3), or grey, shape (h, w), 8 bits.
        mask: Where to look, shape (h, w).

    Returns:
        Shape (n, 2), pixels, strongest first; away from the image's border.

    Raises:
        InputError: image and mask do not fit.
    """
    if mask.shape != image.shape[:2]:
        raise InputError(
            f"mask must have the image's shape {image.shape[:2]}, got {mask.shape}"
        )
    grey = _grey(image)
    found, refined = search.harris_corners(grey, mask, _APART, _WINDOW)
    near = np.linalg.norm(refined - found, axis=1) <= _MOVED
    size = np.array(grey.shape[::-1])
    inside = ((refined >= _LOOKS) & (refined <= size - 1 - _LOOKS)).all(axis=1)
    kept: list[Floats] = []
    for corner in refined[near & inside]:
        # Two that were found beside one corner are refined to the same.
        if all(np.linalg.norm(corner - other) >= _APART / 2 for other in kept):
            kept.append(corner)
    return np.array(kept).reshape(-1, 2)


def likeness(first: Image, at: Floats, second: Image, there: Floats) -> Floats:
    """How alike the surroundings of corners of two images are.

    Normalised cross-correlation of square windows, the rows of both images parallel.

    Args:
        first: RGB, shape (h, w, 3), or grey, shape (h, w), 8 bits.
        at: Corners in it, shape (n, 2), pixels.
        second: The other image.
        there: Corners in that, shape (m, 2), pixels.

    Returns:
        Shape (n, m), from -1 to 1 (the same up to brightness and contrast).
    """
    return _looks(_grey(first), at) @ _looks(_grey(second), there).T


def _grey(image: Image) -> Image:
    return image if image.ndim == 2 else search.grey(image)


def _looks(image: Image, corners: Floats) -> Floats:
    """Windows about corners, (n, pixels), of mean zero and length one."""
    steps = np.arange(-_LOOKS, _LOOKS + 1.0)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    points = corners[:, None] + grid
    values = np.array([search.sample(image, each) for each in points])
    values = values.reshape(len(corners), len(grid))
    values -= values.mean(axis=1, keepdims=True)
    length = np.linalg.norm(values, axis=1, keepdims=True)
    return np.asarray(values / np.maximum(length, 1e-9))
