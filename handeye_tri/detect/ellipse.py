"""Ellipses fitted to the pixels along their edges, by Gauss-Newton.

Across an edge, the part of a pixel that is covered follows the normal distribution
of the distance to the outline; a pixel's own area counts as a blur of variance
1/12 px^2 in every direction.

An ellipse (1 + e) x^2 + 2 f x y + (1 - e) y^2 = R^2 about its centre is a row of six
numbers: centre (2), R, e, f, and the blur of its edge, sigma, in px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from handeye_tri.records import Floats

Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

# Directions into which the outline is divided.
RAYS = 64
ANGLES = 2.0 * np.pi * np.arange(RAYS) / RAYS
_DOUBLE = np.stack([np.cos(2 * ANGLES), np.sin(2 * ANGLES)])
_BESIDE = (np.arange(RAYS)[:, None] + np.arange(-1, 2)) % RAYS
# 1.4826 times the median of absolute deviations is a standard deviation.
MAD = 1.4826
BLUR_RANGE = (0.28, 2.5)
# The edge ends at so many sigmas of its blur.
EDGE_SIGMAS = 3.0
# Linear steps, with what does not fit left out, before the model is taken anew.
_STEPS = (1, 2)
_NEARLY_NOTHING = 1e-6 * np.eye(6)
_TRIM_SIGMAS = 3.5
# Edges nearer to the fit than this are never trimmed, px.
_TRIM_FLOOR = 0.15
# Behind the edge, in its last part, covers must vanish on the mean to within this.
_BEHIND_SIGMAS = 1.5
_MAX_SURPLUS = 0.1
# Harmonics of the edge's residual that tell its noise: the fit absorbs 0, 1 and 2.
_NOISE_HARMONICS = np.arange(3, 11)
# White noise of the sensor is in the background too, a median over five directions: an
# error there moves neighbouring edges together. At the k-th harmonic it adds to the
# edge's own noise, of power 1, ...
_TOGETHER = 5
_MOVED_TOGETHER = (
    np.sin(_TOGETHER * np.pi * np.arange(1, 11) / RAYS)
    / (_TOGETHER * np.sin(np.pi * np.arange(1, 11) / RAYS))
) ** 2
# ... this times the edge's blur in px times R over the radius of the ring in which the
# background is read: sqrt(pi) / 2 by the integrals of a normal edge, 1.43 for the
# variance of a median of five over that of their mean, and 2.35 px for how wide a ring
# its three samples see.
_BY_BACKGROUND = 0.5 * np.sqrt(np.pi) * 1.43 / 2.35
# The ring begins so many sigmas of the blur behind the edge, and its middle is so much
# farther, px; sampling between pixels widens the edge by the variance, px^2.
RING_START = 1.75
RING_MIDDLE = 0.9
SAMPLING_VARIANCE = 1.0 / 6.0
# Each has a sine and a cosine: so many numbers does a scatter come from.
SCATTER_NUMBERS = 2 * len(_NOISE_HARMONICS)


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """The n pixels along the edges of m ellipses, sorted by ellipse.

    Attributes:
        starts: First pixel of each ellipse, and n, shape (m + 1,).
        spot: Ellipse of each pixel, shape (n,).
        columns: Shape (n,).
        rows: Shape (n,).
        ray: Ellipse and direction of each pixel, ellipse * RAYS + direction, (n,).
        background: Level behind the edge, shape (m * RAYS,).
        weight: How much each direction counts, 0-1, shape (m * RAYS,).
    """

    starts: Indices
    spot: Indices
    columns: Indices
    rows: Indices
    ray: Indices
    background: Floats
    weight: Floats

    def covers(self, values: Floats, levels: Floats) -> Floats:
        """Part of each pixel that is covered, shape (n,).

        Args:
            values: Levels of the pixels, shape (n,).
            levels: Level inside each ellipse, shape (m,).
        """
        contrast = np.repeat(levels, RAYS) - self.background
        contrast[self.weight == 0] = np.inf
        return np.asarray((values - self.background[self.ray]) / contrast[self.ray])

    def sums(self, values: Floats) -> Floats:
        """Sums of values (n,) by direction, shape (m, RAYS)."""
        total = np.bincount(self.ray, values, len(self.weight))
        return np.asarray(total.reshape(-1, RAYS))


@dataclass(frozen=True, slots=True, eq=False)
class EllipseFit:
    """Ellipses that fit m edges.

    Attributes:
        ellipses: Shape (m, 6).
        gain: Covariance of the centres for an edge of unit scatter, (m, 2, 2), px^2.
        scatter: Variance of the covers along the edge, at the wavelengths that move
            the centre, shape (m,).
        misfit: Root mean square distance of the edge from the ellipse beyond what the
            noise behind the edge explains, shape (m,), px.
        usable: Part of the directions that the fit uses, shape (m,).
        hidden: Part of the directions where the edge lies inside the ellipse by more
            than its scatter: something is before the ball, shape (m,).
        astray: Part of the directions where it lies off to either side, shape (m,).
        edges: Width of the edge across direction t: the variance mean + cos(2t) c +
            sin(2t) s, as (mean, c, s), shape (m, 3), px^2. An image drawn out over a
            length L along t has L^2 / 12 more variance there.
    """

    ellipses: Floats
    gain: Floats
    scatter: Floats
    misfit: Floats
    usable: Floats
    hidden: Floats
    astray: Floats
    edges: Floats


def medians(values: Floats, counted: Flags) -> Floats:
    """Lower medians of the counted values, shape (m,), of (m, k); 0 where none is."""
    ordered = np.sort(np.where(counted, values, np.inf), axis=1)
    count = counted.sum(axis=1)
    middle = ordered[np.arange(len(values)), np.maximum(count - 1, 0) // 2]
    return np.where(count > 0, middle, 0.0)


def radii_by_direction(ellipses: Floats) -> Floats:
    """Distance from centre to outline, shape (m, RAYS), px, of ellipses (m, 6)."""
    return np.asarray(ellipses[:, 2:3] / np.sqrt(1 + ellipses[:, 3:5] @ _DOUBLE))


def pixels_around(
    ellipses: Floats, background: Floats, weight: Floats, image_size: tuple[int, int]
) -> Edge:
    """Collect the pixels along the edges.

    Args:
        ellipses: Shape (m, 6).
        background: Level behind the edge by direction, shape (m, RAYS).
        weight: How much it counts there, 0-1, shape (m, RAYS).
        image_size: (width, height), pixels.
    """
    x0, y0, size, e, f, blur = ellipses.T[..., None, None]
    width = EDGE_SIGMAS * blur
    reach = size / np.sqrt(1 - np.hypot(e, f)) + width
    half = int(reach.max()) + 2
    span = np.arange(-half, half + 1)
    left, top = np.rint(x0).astype(np.intp), np.rint(y0).astype(np.intp)
    x = (left - x0) + span
    y = (top - y0) + span[:, None]
    q = np.sqrt((1 + e) * x * x + y * ((1 - e) * y + 2 * f * x))
    spot, row, column = np.nonzero(np.abs(q - size) < width)
    columns = column + (left.ravel() - half)[spot]
    rows = row + (top.ravel() - half)[spot]
    inside = (columns >= 0) & (columns < image_size[0])
    inside &= (rows >= 0) & (rows < image_size[1])
    if not inside.all():
        spot, columns, rows = spot[inside], columns[inside], rows[inside]
    angle = np.arctan2(rows - ellipses[spot, 1], columns - ellipses[spot, 0])
    direction = np.rint(angle * (RAYS / (2 * np.pi))).astype(np.intp) % RAYS
    return Edge(
        np.searchsorted(spot, np.arange(len(ellipses) + 1)),
        spot,
        columns,
        rows,
        spot * RAYS + direction,
        background.ravel(),
        weight.ravel(),
    )


def fit_ellipses(
    edge: Edge, covers: Floats, ellipses: Floats, trusted: Flags
) -> EllipseFit:
    """Least squares on the covers; directions that do not fit are left out.

    The scatter is that of the edge about the fit, as it is along this outline, at
    wavelengths near those that move the centre: it holds for noise of the sensor and
    for the staircase of a rendered edge. A blur of variance s^2 leaves of the latter's
    power exp(-(k s / R)^2) at the k-th harmonic of an outline of radius R, and leaves
    the sensor's noise as it is.

    Args:
        edge: The pixels.
        covers: What was measured there, shape (n,).
        ellipses: Start, shape (m, 6), to a fraction of a pixel.
        trusted: Directions to begin with, shape (m, RAYS).
    """
    ellipses = ellipses.copy()
    m = len(ellipses)
    own = [slice(edge.starts[k], edge.starts[k + 1]) for k in range(m)]
    offered = (edge.weight > 0).reshape(m, RAYS)
    shown = offered & trusted
    normal, right = np.empty((m, 6, 6)), np.empty((m, 6, 1))
    left = np.empty(len(covers))
    for steps in _STEPS:
        model, jacobian, slope, behind = _covers(edge, ellipses)
        residual = covers - model
        information = edge.sums(slope * slope)
        # A direction of a small ball may have no pixel on the edge itself.
        least = 0.25 * information.mean(axis=1, keepdims=True) + 1e-9
        many = edge.sums(behind)
        noise = np.array([_scatter(residual[k][behind[k] > 0]) for k in own])
        surplus = np.maximum(
            _MAX_SURPLUS * many, _TRIM_SIGMAS * noise[:, None] * np.sqrt(many)
        )
        # The linear model is good enough to find what does not fit, and without it
        # to step again.
        for _ in range(steps):
            counted = (edge.weight * shown.ravel())[edge.ray]
            weighted = counted * jacobian
            for k, part in enumerate(own):
                normal[k] = weighted[:, part] @ jacobian[:, part].T
                right[k, :, 0] = weighted[:, part] @ residual[part]
            # Keeps an outline without usable pixels from being singular.
            normal += _NEARLY_NOTHING
            step = np.linalg.solve(normal, right)[..., 0]
            for k, part in enumerate(own):
                left[part] = residual[part] - step[k] @ jacobian[:, part]
            # How far out of the fit the edge lies in each direction, px.
            out = edge.sums(slope * left) / np.maximum(information, least)
            limit = _TRIM_SIGMAS * MAD * medians(np.abs(out), shown)
            limit = np.maximum(limit, _TRIM_FLOOR)[:, None]
            # Something else may begin right behind the edge.
            bad = np.abs(out) > limit
            bad |= np.abs(edge.sums(behind * left)) > surplus
            shown = offered & ~bad[:, _BESIDE].any(axis=2)
        ellipses += np.clip(step, -1.5, 1.5)
        ellipses[:, 2] = np.maximum(ellipses[:, 2], 1.0)
        ellipses[:, 3:5] = np.clip(ellipses[:, 3:5], -0.6, 0.6)
        ellipses[:, 5] = np.clip(ellipses[:, 5], *BLUR_RANGE)
    count = np.maximum(shown.sum(axis=1), 1)
    kept = np.where(shown, out, 0.0)
    # Leaving out the largest would leave too small a scatter: a direction that is off
    # alone is taken for noise here, as far off as noise may be.
    alone = bad & (bad[:, _BESIDE].sum(axis=2) == 1) & (np.abs(out) > limit)
    noisy = offered & ~(bad & ~alone)[:, _BESIDE].any(axis=2)
    scattered = np.where(noisy, np.clip(out, -limit, limit), 0.0)
    power = np.abs(np.fft.rfft(scattered, axis=1)[:, _NOISE_HARMONICS]) ** 2
    # White noise of variance v in each of k directions has the power k v.
    many = np.maximum(noisy.sum(axis=1), 1)
    power *= ((information * noisy).sum(axis=1) / many**2)[:, None]
    white = 1.0 + _background_share(ellipses) * _MOVED_TOGETHER
    tail = white[:, _NOISE_HARMONICS - 1]
    sensor = np.minimum(noise**2, (power / tail).mean(axis=1))
    smooth = (ellipses[:, 5:] / ellipses[:, 2:3]) ** 2
    passed = np.exp(-smooth * _NOISE_HARMONICS**2)
    beyond = power - sensor[:, None] * tail
    stairs = (passed * beyond).sum(axis=1) / (passed**2).sum(axis=1)
    expected = (noise**2)[:, None] * shown / np.maximum(information, least)
    expected = expected.sum(axis=1) / count
    gain = np.empty((m, 2, 2))
    inverse = np.linalg.inv(normal)
    for k, part in enumerate(own):
        pull = inverse[k, :2] @ weighted[:, part]
        gain[k] = pull @ pull.T
    return EllipseFit(
        ellipses,
        gain,
        sensor * white[:, 0] + np.maximum(stairs, 0.0) * np.exp(-smooth[:, 0]),
        np.sqrt(np.maximum((kept**2).sum(axis=1) / count - expected, 0.0)),
        shown.mean(axis=1),
        (offered & (out < -limit)).mean(axis=1),
        (offered & (np.abs(out) > limit)).mean(axis=1),
        _edge_variances(edge, ellipses, left, jacobian[5], own),
    )


def _background_share(ellipses: Floats) -> Floats:
    """What noise of the background adds to that of an edge far along it, (m, 1)."""
    blur, size = ellipses[:, 5:], ellipses[:, 2:3]
    ring = RING_START * np.sqrt(blur**2 + SAMPLING_VARIANCE) + RING_MIDDLE
    return np.asarray(_BY_BACKGROUND * blur * size / (size + ring))


def _edge_variances(
    edge: Edge, ellipses: Floats, left: Floats, by_blur: Floats, own: list[slice]
) -> Floats:
    """Mean variance of the edges and both parts of its elongation, (m, 3), px^2.

    All directions with a background count, those that the fit left out as well: where
    the edge is wide it looks astray.
    """
    weight = edge.weight[edge.ray]
    rows = by_blur * np.concatenate([np.ones((1, RAYS)), _DOUBLE])[:, edge.ray % RAYS]
    result = np.empty((len(own), 3))
    for k, part in enumerate(own):
        weighted = weight[part] * rows[:, part]
        normal = weighted @ rows[:, part].T + _NEARLY_NOTHING[:3, :3]
        wider = np.linalg.solve(normal, weighted @ left[part])
        # First order in the widening.
        blur = ellipses[k, 5]
        result[k] = 2.0 * blur * wider
        result[k, 0] += blur**2
    return result


def _scatter(values: Floats) -> float:
    """Robust standard deviation about zero of values, shape (n,); 0 of none."""
    ordered = np.sort(np.abs(values))
    return MAD * float(ordered[len(ordered) // 2]) if len(ordered) else 0.0


def _covers(edge: Edge, ellipses: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Model of the covers.

    Returns:
        Covers (n,); derivatives by the ellipses' numbers (6, n); derivative by an
        outward shift of the edge (n,), 1/px; 1 behind the edge, else 0, (n,).
    """
    x0, y0, size, e, f, blur = ellipses.T[:, edge.spot]
    x, y = edge.columns - x0, edge.rows - y0
    ax = (1 + e) * x + f * y
    ay = f * x + (1 - e) * y
    q = np.sqrt(x * ax + y * ay)
    # First-order distance to the outline: (q - R) / |grad q|; exact for a circle.
    gradient = np.sqrt(ax * ax + ay * ay) / q
    z = (q - size) / (gradient * blur)
    slope = np.exp(-0.5 * z * z) / (np.sqrt(2 * np.pi) * blur)
    by_q = slope / gradient
    over = by_q / q
    jacobian = np.empty((6, len(x)))
    jacobian[0] = over * ax
    jacobian[1] = over * ay
    jacobian[2] = by_q
    jacobian[3] = -0.5 * over * (x * x - y * y)
    jacobian[4] = -over * x * y
    jacobian[5] = slope * z
    return ndtr(-z), jacobian, slope, (z > _BEHIND_SIGMAS).astype(float)
