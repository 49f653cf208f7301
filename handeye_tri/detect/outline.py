"""The outline of a ball, measured: an ellipse fitted to the pixels of its edge.

The image of a ball of one brightness is I = B + (L - B) c: L its level, B the level
of what lies behind, c the part of the pixel that the ball covers, blurred by the
optics. Across the edge, c follows the normal distribution of the distance to the
outline; a pixel's own area counts as a blur of variance 1/12 px^2 in every direction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from handeye_tri.detect.markers import Reason
from handeye_tri.records import Floats

Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]
# Levels between pixels: points (m, rays, s, 2) of m spots to levels (m, rays, s).
Sampler = Callable[[Floats], Floats]
# Levels of pixels: spot, row and column of each, all (n,), to levels (n,).
Reader = Callable[[Indices, Indices, Indices], Floats]

# Directions in which an outline is looked at.
_RAYS = 64
_ANGLES = 2.0 * np.pi * np.arange(_RAYS) / _RAYS
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
# Radius of a displaced, slightly oval circle by direction.
_OVAL = np.stack(
    [np.ones(_RAYS), *(f(k * _ANGLES) for k in (1, 2) for f in (np.cos, np.sin))],
    axis=-1,
)
# The first look goes along each ray from and to these parts of the radius.
_REACH = np.linspace(0.3, 1.7, 44)
_INNER = _REACH < 0.6
_BEYOND = np.array([1.8, 2.6, 3.4])
# Between marker and background at least so many levels, and so many times the noise.
_MIN_CONTRAST = 12.0
_MIN_CONTRAST_SIGMAS = 5.0
_BLUR_RANGE = (0.28, 2.5)
# The edge ends at so many sigmas of its blur; the background is read beyond.
_EDGE_SIGMAS = 3.0
_RING = np.array([0.5, 1.1, 1.7, 2.3])
# A change of the background by this part of the contrast makes an edge unusable.
_MAX_UNEVEN = 0.15
# 1.4826 times the median of absolute deviations is a standard deviation.
_MAD = 1.4826
_TRIM_SIGMAS = 3.5
# Edges nearer to the fit than this are never trimmed, px.
_TRIM_FLOOR = 0.15
_MAX_SURPLUS = 0.15
_ITERATIONS = 4
# Harmonics of the edge's residual that tell its noise: the fit absorbs 0, 1 and 2.
_NOISE_HARMONICS = slice(3, 11)
_MIN_VISIBLE = 0.5
_MAX_HIDDEN = 0.12
_MAX_OVAL = 0.35
_MAX_MISFIT = 0.3
_BORDER = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Outlines:
    """Fitted outlines of m spots.

    Attributes:
        centres: Shape (m, 2), pixels.
        covariance: Shape (m, 2, 2), px^2.
        radii: Mean radii, shape (m,), px.
        levels: Levels inside, shape (m,).
        reasons: Why an outline is not usable, None where it is.
    """

    centres: Floats
    covariance: Floats
    radii: Floats
    levels: Floats
    reasons: tuple[Reason | None, ...]


def measure(
    sampler: Sampler,
    reader: Reader,
    image_size: tuple[int, int],
    centres: Floats,
    radii: Floats,
) -> Outlines:
    """Fit the outlines of spots.

    Args:
        sampler: Gives the levels between pixels.
        reader: Gives the levels of pixels.
        image_size: (width, height), pixels.
        centres: Where the spots are to a few pixels, shape (m, 2), pixels.
        radii: Their radii to about 20 %, shape (m,), px.
    """
    # An ellipse (1 + e) x^2 + 2 f x y + (1 - e) y^2 = R^2 about its centre: rows of
    # centre (2), R, e, f, and the blur of its edge, sigma in px.
    ellipses, levels, noise, visible = _first_look(sampler, centres, radii)
    reasons = _misfits(ellipses, image_size, visible)
    good = np.array([reason is None for reason in reasons])
    # Unusable ones keep to a harmless place so that all have one shape.
    ellipses[~good] = (0.5 * image_size[0], 0.5 * image_size[1], 5, 0, 0, 1)
    background, weight = _background(sampler, ellipses, levels, noise)
    edge = _edge(reader, ellipses, levels, background, weight, image_size)
    ellipses, covariance, misfit, visible, hidden = _fit(edge, ellipses)
    for k in np.flatnonzero(good):
        if not np.isfinite(ellipses[k]).all():
            reasons[k] = "no_fit"
        elif visible[k] < _MIN_VISIBLE or hidden[k] > _MAX_HIDDEN:
            reasons[k] = "occluded"
        elif misfit[k] > max(_MAX_MISFIT, 0.02 * ellipses[k, 2]):
            reasons[k] = "not_round"
    flattening = np.minimum((ellipses[:, 3:5] ** 2).sum(axis=1), 0.9)
    mean_radii = ellipses[:, 2] / (1 - flattening) ** 0.25
    return Outlines(ellipses[:, :2], covariance, mean_radii, levels, tuple(reasons))


def _misfits(
    ellipses: Floats, image_size: tuple[int, int], visible: Floats
) -> list[Reason | None]:
    """What is wrong with the ellipses at first sight."""
    x, y, size, e, f, _ = ellipses.T
    reasons: list[Reason | None] = []
    for k in range(len(ellipses)):
        if not np.isfinite(ellipses[k]).all():
            reasons.append("no_fit")
            continue
        if np.hypot(e[k], f[k]) > _MAX_OVAL:
            reasons.append("not_round")
            continue
        scale = size[k] / np.sqrt(1 - e[k] ** 2 - f[k] ** 2)
        reach_x = scale * np.sqrt(1 - e[k]) + _BORDER
        reach_y = scale * np.sqrt(1 + e[k]) + _BORDER
        if (
            min(x[k] - reach_x, y[k] - reach_y) < 0
            or x[k] + reach_x > image_size[0] - 1
            or y[k] + reach_y > image_size[1] - 1
        ):
            reasons.append("at_border")
        elif visible[k] < _MIN_VISIBLE:
            reasons.append("occluded")
        else:
            reasons.append(None)
    return reasons


def _first_look(
    sampler: Sampler, centres: Floats, radii: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Half-level edges along rays, and an oval through them.

    Returns:
        Ellipses (m, 6), NaN where too few edges were seen; levels inside (m,); noise
        inside (m,); part of the rays that see the oval's edge (m,).
    """
    reach = radii[:, None] * _REACH
    rays = reach[:, None, :, None] * _DIRECTIONS[:, None]
    values = sampler(centres[:, None, None] + rays)
    m = len(values)
    inner = values[..., _INNER].reshape(m, -1)
    levels = np.median(inner, axis=1)
    noise = _MAD * np.median(np.abs(inner - levels[:, None]), axis=1)
    # Where the level is left for the first time, something else begins.
    low = np.maximum(_MIN_CONTRAST, _MIN_CONTRAST_SIGMAS * noise)
    away = values - levels[:, None, None]
    leaves = np.argmax(np.abs(away) > low[:, None, None], axis=2)
    step = reach[:, 1] - reach[:, 0]
    beyond = leaves[..., None] + np.ceil(_BEYOND / step[:, None, None]).astype(int)
    seen = (leaves > 0) & (beyond[..., -1] < values.shape[2])
    beyond = np.minimum(beyond, values.shape[2] - 1)
    contrast = np.median(np.take_along_axis(away, beyond, axis=2), axis=2)
    seen &= np.abs(contrast) > low[:, None]
    contrast[~seen] = np.inf
    # Half-way between both levels lies the edge.
    part = away / contrast[..., None]
    after = np.maximum(np.argmax(part > 0.5, axis=2), 1)[..., None]
    here = np.take_along_axis(part, after, axis=2)[..., 0]
    before = np.take_along_axis(part, after - 1, axis=2)[..., 0]
    slope = np.where(seen, here - before, 1.0)
    slope = np.maximum(slope, 1e-3)
    first = np.take_along_axis(reach, after[..., 0] - 1, axis=1)
    edges = first + np.clip((0.5 - before) / slope, 0, 1) * step[:, None]
    ovals, kept = _ovals(np.where(seen, edges, 0.0), seen)
    steepest = np.median(np.where(seen, slope, 1.0), axis=1) / step
    blur = np.clip(1.0 / (np.sqrt(2 * np.pi) * steepest), *_BLUR_RANGE)
    mean, a, b, c, d = ovals.T
    ellipses = np.stack(
        [centres[:, 0] + a, centres[:, 1] + b, mean, -2 * c, -2 * d, blur], axis=1
    )
    ellipses[(mean <= 1) | (kept.sum(axis=1) < 0.25 * _RAYS)] = np.nan
    ellipses[:, 3:5] /= ellipses[:, 2:3]
    return ellipses, levels, noise, kept.mean(axis=1)


def _medians(values: Floats, counted: Flags) -> Floats:
    """Lower medians of the counted values, shape (m,), of (m, k); 0 where none is."""
    ordered = np.sort(np.where(counted, values, np.inf), axis=1)
    count = counted.sum(axis=1)
    middle = ordered[np.arange(len(values)), np.maximum(count - 1, 0) // 2]
    return np.where(count > 0, middle, 0.0)


def _ovals(edges: Floats, seen: Flags) -> tuple[Floats, Flags]:
    """Displaced ovals through edges at radii (m, rays), outliers trimmed.

    Returns:
        Coefficients of _OVAL, (m, 5), and which edges were kept, (m, rays).
    """
    m = len(edges)
    middle = _medians(edges, seen)[:, None]
    residual = edges - middle
    kept = seen & (np.abs(residual) < 0.4 * middle)
    coefficients = np.zeros((m, 5))
    for _ in range(4):
        weighted = kept[..., None] * _OVAL
        normal = np.swapaxes(weighted, 1, 2) @ _OVAL + 1e-9 * np.eye(5)
        right = np.swapaxes(weighted, 1, 2) @ edges[..., None]
        coefficients = np.linalg.solve(normal, right)[..., 0]
        residual = np.abs(edges - coefficients @ _OVAL.T)
        spread = _MAD * _medians(residual, kept)
        kept = seen & (residual < np.maximum(3 * spread, 0.3)[:, None])
    return coefficients, kept


def _radii(ellipses: Floats) -> Floats:
    """Distance from centre to outline by direction, shape (m, rays), px."""
    square = 1 + ellipses[:, 3:5] @ _OVAL[:, 3:].T
    return np.asarray(ellipses[:, 2:3] / np.sqrt(square))


def _background(
    sampler: Sampler, ellipses: Floats, levels: Floats, noise: Floats
) -> tuple[Floats, Floats]:
    """What lies behind the edge in each direction, and how much the edge counts.

    Returns:
        Levels (m, rays); weights 0-1 (m, rays), 0 where the background is uneven or
        too like the marker.
    """
    start = _radii(ellipses) + _EDGE_SIGMAS * ellipses[:, 5:]
    radii = start[..., None] + _RING
    points = ellipses[:, None, None, :2] + radii[..., None] * _DIRECTIONS[:, None]
    values = sampler(points)
    mean = values.mean(axis=2)
    near = np.stack([np.roll(mean, k, axis=1) for k in (-2, -1, 0, 1, 2)], axis=2)
    level = np.sort(near, axis=2)[..., 2]
    contrast = np.abs(level - levels[:, None])
    floor = np.maximum(_MIN_CONTRAST, _MIN_CONTRAST_SIGMAS * noise)[:, None]
    uneven = np.maximum(np.abs(mean - level), np.ptp(values, axis=2) / 2)
    even = uneven < _MAX_UNEVEN * contrast + 2.0 * noise[:, None]
    usable = even & (contrast > floor)
    typical = np.maximum(_medians(contrast, usable), _MIN_CONTRAST)[:, None]
    weight = np.where(usable, np.minimum(contrast / typical, 1.0) ** 2, 0.0)
    return level, weight


@dataclass(frozen=True, slots=True, eq=False)
class _Edge:
    """The n pixels along the edges of m outlines, sorted by outline.

    Attributes:
        starts: First pixel of each outline, and n, shape (m + 1,).
        spot: Outline of each pixel, shape (n,).
        points: Columns and rows, shape (n, 2).
        cover: Part of the pixel that the ball covers, as measured, shape (n,).
        weight: 0-1, shape (n,).
        ray: Index of outline and direction, outline * rays + direction, shape (n,).
    """

    starts: Indices
    spot: Indices
    points: Floats
    cover: Floats
    weight: Floats
    ray: Indices


def _edge(
    reader: Reader,
    ellipses: Floats,
    levels: Floats,
    background: Floats,
    weight: Floats,
    image_size: tuple[int, int],
) -> _Edge:
    """Collect the pixels along the edges."""
    width = _EDGE_SIGMAS * ellipses[:, 5]
    half = int(np.ceil((_radii(ellipses).max(axis=1) + width).max())) + 1
    span = np.arange(-half, half + 1)
    corner = np.rint(ellipses[:, :2]).astype(np.intp)
    x = (corner[:, :1] + span)[:, None, :] - ellipses[:, 0, None, None]
    y = (corner[:, 1:] + span)[:, :, None] - ellipses[:, 1, None, None]
    e, f = ellipses[:, 3, None, None], ellipses[:, 4, None, None]
    q = np.sqrt((1 + e) * x * x + (1 - e) * y * y + 2 * f * x * y)
    distance = np.abs(q - ellipses[:, 2, None, None])
    spot, row, column = np.nonzero(distance < width[:, None, None])
    xs = column - half + corner[spot, 0]
    ys = row - half + corner[spot, 1]
    inside = (xs >= 0) & (ys >= 0) & (xs < image_size[0]) & (ys < image_size[1])
    spot, xs, ys = spot[inside], xs[inside], ys[inside]
    points = np.stack([xs, ys], axis=1).astype(float)
    relative = points - ellipses[spot, :2]
    angle = np.arctan2(relative[:, 1], relative[:, 0])
    direction = np.rint(angle * (_RAYS / (2 * np.pi))).astype(np.intp) % _RAYS
    ray = spot * _RAYS + direction
    behind = background.ravel()[ray]
    contrast = levels[spot] - behind
    usable = weight.ravel()[ray] > 0
    cover = (reader(spot, ys, xs) - behind) / np.where(usable, contrast, 1.0)
    starts = np.searchsorted(spot, np.arange(len(ellipses) + 1))
    return _Edge(starts, spot, points, cover, weight.ravel()[ray], ray)


def _fit(edge: _Edge, ellipses: Floats) -> tuple[Floats, ...]:
    """Gauss-Newton on the covers, trimming directions that do not fit.

    Returns:
        Ellipses (m, 6); covariances of the centres (m, 2, 2), px^2; root mean square
        distances of the edge from the fit (m,), px; visible parts of the outlines (m,).
    """
    m = len(ellipses)
    ellipses = ellipses.copy()
    shown = np.ones((m, _RAYS), dtype=bool)
    offered = np.bincount(edge.ray, edge.weight > 0, m * _RAYS).reshape(m, _RAYS) > 0
    for _ in range(_ITERATIONS):
        model, jacobian, slope, outside = _cover(edge, ellipses)
        residual = edge.cover - model
        weight = edge.weight * shown.ravel()[edge.ray]
        weighted = jacobian * weight[:, None]
        normal = np.array(
            [
                weighted[a:b].T @ jacobian[a:b]
                for a, b in zip(edge.starts[:-1], edge.starts[1:], strict=True)
            ]
        ) + 1e-6 * np.eye(6)
        right = np.add.reduceat(weighted * residual[:, None], edge.starts[:-1], axis=0)
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        ellipses += np.clip(step, -1.5, 1.5)
        ellipses[:, 5] = np.clip(ellipses[:, 5], *_BLUR_RANGE)
        # How far out of the fit the edge lies in each direction.
        left = residual - np.einsum("nk,nk->n", jacobian, step[edge.spot])
        information = np.bincount(edge.ray, slope**2, m * _RAYS)
        information = information.reshape(m, _RAYS)
        moment = np.bincount(edge.ray, slope * left, m * _RAYS)
        out = moment.reshape(m, _RAYS) / np.maximum(information, 1e-9)
        limit = _TRIM_SIGMAS * _MAD * _medians(np.abs(out), offered & shown)
        limit = np.maximum(limit, _TRIM_FLOOR)[:, None]
        bad = np.abs(out) > limit
        # Where something else begins right behind the edge, too.
        beyond = np.bincount(edge.ray, outside * edge.weight, m * _RAYS)
        surplus = np.bincount(edge.ray, outside * edge.weight * left, m * _RAYS)
        bad |= (np.abs(surplus) > _MAX_SURPLUS * np.maximum(beyond, 1e-9)).reshape(
            m, _RAYS
        )
        shown = offered & ~(bad | np.roll(bad, 1, axis=1) | np.roll(bad, -1, axis=1))
    count = np.maximum(shown.sum(axis=1), 1)
    raw = out
    out = np.where(shown, out, 0.0)
    power = np.abs(np.fft.rfft(out, axis=1)[:, _NOISE_HARMONICS]) ** 2
    # White noise of variance v in each of k directions has the power k v.
    variance = power.mean(axis=1) / count
    strength = (information * shown).sum(axis=1) / count
    inverse = np.linalg.inv(normal)
    spread_normal = np.array(
        [
            (weighted[a:b] * weight[a:b, None]).T @ jacobian[a:b]
            for a, b in zip(edge.starts[:-1], edge.starts[1:], strict=True)
        ]
    )
    sandwich = inverse @ spread_normal @ inverse
    covariance = sandwich[:, :2, :2] * (variance * strength)[:, None, None]
    hidden = (offered & (raw < -limit)).mean(axis=1)
    misfit = np.sqrt((out**2).sum(axis=1) / count)
    return ellipses, covariance, misfit, shown.mean(axis=1), hidden


def _cover(edge: _Edge, ellipses: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Model of the covers.

    Returns:
        Covers (n,); derivatives by the ellipses' numbers (n, 6); derivative by an
        outward shift of the edge (n,), 1/px.
    """
    own = ellipses[edge.spot]
    x, y = (edge.points - own[:, :2]).T
    size, e, f, blur = own[:, 2:].T
    ax = (1 + e) * x + f * y
    ay = f * x + (1 - e) * y
    q = np.sqrt(np.maximum(x * ax + y * ay, 1e-6))
    # First-order distance to the outline: (q - R) / |grad q|; exact for a circle.
    gradient = np.sqrt(ax * ax + ay * ay) / q
    z = (q - size) / (gradient * blur)
    slope = np.exp(-0.5 * z * z) / (np.sqrt(2 * np.pi) * blur)
    by_q = slope / gradient
    jacobian = np.stack(
        [
            by_q * ax / q,
            by_q * ay / q,
            by_q,
            -by_q * (x * x - y * y) / (2 * q),
            -by_q * x * y / q,
            slope * z,
        ],
        axis=1,
    )
    return ndtr(-z), jacobian, slope, (z > 1.5).astype(float)
