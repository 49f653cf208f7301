"""Corners of a print, exact to a fraction of a pixel, and pairs that look alike."""

import numpy as np
import pytest

from handeye_tri.detect import detect_corners, likeness
from handeye_tri.errors import InputError

SIZE = (120, 160)


def chequer(origin, angle, square=22.0, fine=8, contrast=1.0):
    """Squares of two greys, each pixel the mean of fine x fine samples."""
    height, width = SIZE
    steps = (np.arange(fine) + 0.5) / fine - 0.5
    u = (np.arange(width)[:, None] + steps).ravel() - origin[0]
    v = (np.arange(height)[:, None] + steps).ravel() - origin[1]
    u, v = np.meshgrid(u, v)
    c, s = np.cos(angle), np.sin(angle)
    index = np.floor((c * u + s * v) / square) + np.floor((c * v - s * u) / square)
    picture = 128 + contrast * np.where(index % 2 == 0, -70.0, 70.0)
    picture = picture.reshape(height, fine, width, fine).mean(axis=(1, 3))
    grid = square * np.stack(np.meshgrid(*2 * [np.arange(-9, 10)]), -1).reshape(-1, 2)
    corners = grid @ np.array([[c, s], [-s, c]]) + origin
    return picture.round().astype(np.uint8), corners


@pytest.mark.parametrize("origin", [(80.0, 60.0), (80.3, 59.6)])
@pytest.mark.parametrize("angle", [0.1, 0.6])
def test_corners_are_found_to_a_fraction_of_a_pixel(origin, angle):
    image, exact = chequer(origin, angle)
    found = detect_corners(image, np.ones(SIZE, dtype=bool))
    apart = np.linalg.norm(found[:, None] - exact, axis=-1)
    assert apart.min(axis=1).max() < 0.1
    limit = np.array(SIZE[::-1]) - 1 - 12
    inside = ((exact >= 12) & (exact <= limit)).all(axis=1)
    assert (apart.min(axis=0)[inside] < 0.1).all()
    # Each once.
    assert len(set(apart.argmin(axis=1).tolist())) == len(found)


def test_only_the_mask_is_looked_at():
    image, _ = chequer((80.0, 60.0), 0.1)
    mask = np.zeros(SIZE, dtype=bool)
    assert detect_corners(image, mask).shape == (0, 2)
    mask[:, :80] = True
    found = detect_corners(np.repeat(image[..., None], 3, axis=2), mask)
    assert len(found) > 0
    assert found[:, 0].max() < 83
    with pytest.raises(InputError, match=r"mask must have the image's shape"):
        detect_corners(image, mask[:-1])


def test_likeness_sees_through_contrast_and_tells_corners_apart():
    first, corners = chequer((80.0, 60.0), 0.1)
    second, _ = chequer((80.0, 60.0), 0.1, contrast=0.4)
    inside = ((corners > 30) & (corners < np.array(SIZE[::-1]) - 30)).all(axis=1)
    at = corners[inside]
    score = likeness(first, at, second, at)
    assert np.diagonal(score).min() > 0.999
    # The next corner has dark and light exchanged.
    next_ = np.linalg.norm(at[:, None] - at, axis=-1)
    next_ = np.isclose(next_, 22.0)
    assert next_.any()
    assert score[next_].max() < -0.9
