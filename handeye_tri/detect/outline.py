"""The outline of a ball, first seen along rays, then fitted to the pixels around it.

The image of a ball of one brightness is I = B + (L - B) c: L its level, B the level
of what lies behind, c the part of the pixel that the ball covers, blurred by the
optics. Half-way between L and B lies the edge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from handeye_tri.detect.ellipse import (
    ANGLES,
    BLUR_RANGE,
    MAD,
    RAYS,
    RING_MIDDLE,
    RING_START,
    SAMPLING_VARIANCE,
    SCATTER_NUMBERS,
    Flags,
    Indices,
    fit_ellipses,
    medians,
    pixels_around,
    radii_by_direction,
)
from handeye_tri.detect.markers import Reason
from handeye_tri.records import Floats

# Levels between pixels: m spots (m,) and points (m, rays, s, 2) to levels
# (m, rays, s).
Sampler = Callable[[Indices, Floats], Floats]
# Levels of pixels: spot, row and column of each, all (n,), to levels (n,).
Reader = Callable[[Indices, Indices, Indices], Floats]

# The first look goes along every second ray, between these parts of the radius.
_LOOKS = ANGLES[::2]
_LOOK = np.stack([np.cos(_LOOKS), np.sin(_LOOKS)], axis=-1)
_REACH = np.linspace(0.4, 1.65, 32)
_INNER = int((_REACH < 0.65).sum())
_BEYOND = np.array([1.8, 2.6, 3.4])
# Radius of a displaced, slightly oval circle by direction.
_OVAL = np.stack(
    [np.ones_like(_LOOKS)] + [f(k * _LOOKS) for k in (1, 2) for f in (np.cos, np.sin)],
    axis=-1,
)
_OVAL_PASSES = 4
_OVAL_SCATTER = 0.1
# Between marker and background at least so many levels, and so many times the noise.
_MIN_CONTRAST = 12.0
_MIN_CONTRAST_SIGMAS = 5.0
# The background is read so far behind the end of the edge, px, and its median taken
# over neighbouring directions.
_RING = RING_MIDDLE + np.array([-0.6, 0.0, 0.6])
_DIRECTIONS = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1)
_NEAR = (np.arange(RAYS)[:, None] + np.arange(-2, 3)) % RAYS
# A change of the background by this part of the contrast makes an edge unusable.
_MAX_UNEVEN = 0.08
# Of the outline at least this part must be usable, and at most that part hidden.
_MIN_USABLE = 0.5
_MAX_HIDDEN = 0.12
_MAX_ASTRAY = 0.2
# Levels that differ by less of a marker's usual contrast are the marker's own; what
# stands behind it, a light arm before a dark one, is farther from it.
_ALIKE = 0.25
# Flat dots are seen by up to 60 degrees aslant.
_MAX_OVAL = 0.6
_MAX_MISFIT = 0.22
_BORDER = 1.0
_MAX_SCATTER_RATIO = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Outlines:
    """Fitted outlines of m spots.

    Attributes:
        centres: Shape (m, 2), pixels.
        gain: Covariance of the centres for an edge of unit scatter, (m, 2, 2), px^2.
        scatter: Variance of the covers along the edge, shape (m,).
        radii: Mean radii, shape (m,), px.
        longest: Semi-axes the long way, shape (m,), px: of a flat dot that is seen
            aslant, what it would measure face on.
        levels: Levels inside, shape (m,).
        edges: How wide the edges are, see :class:`EllipseFit`, (m, 3), px^2.
        reasons: Why an outline is not usable, None where it is.
    """

    centres: Floats
    gain: Floats
    scatter: Floats
    radii: Floats
    longest: Floats
    levels: Floats
    edges: Floats
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
    m = len(centres)
    ellipses, levels, noise, kept, astray = _first_look(sampler, centres, radii)
    seen = kept.mean(axis=1)
    reasons = [_objection(ellipses[k], image_size, seen[k]) for k in range(m)]
    gain, scatter = np.full((m, 2, 2), np.nan), np.full(m, np.nan)
    edges = np.full((m, 3), np.nan)
    good = np.array([k for k in range(m) if reasons[k] is None], dtype=np.intp)
    if len(good):
        background, weight = _background(
            sampler, good, ellipses[good], levels[good], noise[good]
        )
        edge = pixels_around(ellipses[good], background, weight, image_size)
        values = reader(good[edge.spot], edge.rows, edge.columns)
        covers = edge.covers(values, levels[good])
        # One look stands for two rays.
        trusted = ~astray[good].repeat(2, axis=1)
        fit = fit_ellipses(edge, covers, ellipses[good], trusted)
        ellipses[good] = fit.ellipses
        gain[good], scatter[good] = fit.gain, fit.scatter
        edges[good] = fit.edges
        beyond = _goes_on(sampler, good, fit.ellipses, levels[good])
        for k, spot in enumerate(good):
            if (
                fit.usable[k] < _MIN_USABLE
                or fit.hidden[k] > _MAX_HIDDEN
                or fit.astray[k] + beyond[k] > _MAX_ASTRAY
            ):
                reasons[spot] = "occluded"
            elif not fit.misfit[k] < max(_MAX_MISFIT, 0.01 * fit.ellipses[k, 2]):
                reasons[spot] = "not_round"
            else:
                reasons[spot] = _objection(fit.ellipses[k], image_size, 1.0)
    flat = np.minimum((ellipses[:, 3:5] ** 2).sum(axis=1), 0.9)
    return Outlines(
        ellipses[:, :2],
        gain,
        scatter,
        ellipses[:, 2] / (1 - flat) ** 0.25,
        ellipses[:, 2] / np.sqrt(1 - np.sqrt(flat)),
        levels,
        edges,
        tuple(reasons),
    )


def common_scatter(scatter: Floats) -> Floats:
    """Scatters of one image's outlines, each known better by the others, (k,).

    One outline's scatter comes from 16 numbers and is off by a third, which would make
    good weights of bad ones. The outlines of one image share sensor, optics and
    lighting: their mean is taken, except where one is three times that of the others
    (by chance in 1 of 300 images), which keeps its own and leaves the mean. A normal
    error over a scatter from n numbers follows Student's t distribution, whose
    variance is n / (n - 2) times as large.

    Args:
        scatter: Of each outline, shape (k,).
    """
    together = np.full(len(scatter), len(scatter))
    result = np.full(len(scatter), scatter.mean() if len(scatter) else 0.0)
    worst = int(scatter.argmax()) if len(scatter) > 1 else 0
    if len(scatter) > 1:
        rest = np.delete(scatter, worst).mean()
        if scatter[worst] > _MAX_SCATTER_RATIO * rest:
            together -= 1
            result[:] = rest
            together[worst], result[worst] = 1, scatter[worst]
    numbers = SCATTER_NUMBERS * together
    return np.asarray(result * numbers / (numbers - 2))


def _objection(
    ellipse: Floats, image_size: tuple[int, int], seen: float
) -> Reason | None:
    """What speaks against an ellipse, shape (6,), of which a part was seen."""
    x, y, size, e, f, _ = (float(value) for value in ellipse)
    oval = e * e + f * f
    if not np.isfinite(size):
        return "no_fit"
    if oval > _MAX_OVAL**2:
        return "not_round"
    scale = size / (1 - oval) ** 0.5
    reach_x = scale * (1 - e) ** 0.5 + _BORDER
    reach_y = scale * (1 + e) ** 0.5 + _BORDER
    if (
        min(x - reach_x, y - reach_y) < 0
        or x + reach_x > image_size[0] - 1
        or y + reach_y > image_size[1] - 1
    ):
        return "at_border"
    return "occluded" if seen < _MIN_USABLE else None


def _first_look(
    sampler: Sampler, centres: Floats, radii: Floats
) -> tuple[Floats, Floats, Floats, Flags, Flags]:
    """Half-level edges along rays, and an oval through them.

    Returns:
        Ellipses (m, 6), NaN where too few edges were seen; levels inside (m,); noise
        inside (m,); which looks see the oval's edge and which another, (m, looks).
    """
    spots = np.arange(len(centres))
    reach = radii[:, None] * _REACH
    rays = reach[:, None, :, None] * _LOOK[:, None]
    values = sampler(spots, centres[:, None, None] + rays)
    inner = np.sort(values[..., :_INNER].reshape(len(centres), -1), axis=1)
    count = inner.shape[1]
    levels = inner[:, count // 2]
    # Two of three normal errors lie within one standard deviation.
    noise = 0.5 * (inner[:, (5 * count) // 6] - inner[:, count // 6])
    # Where the level is left for the first time, something else begins.
    low = np.maximum(_MIN_CONTRAST, _MIN_CONTRAST_SIGMAS * noise)
    away = values - levels[:, None, None]
    leaves = np.argmax(np.abs(away) > low[:, None, None], axis=2)
    step = reach[:, 1] - reach[:, 0]
    beyond = leaves[..., None] + np.ceil(_BEYOND / step[:, None, None]).astype(int)
    last = len(_REACH) - 1
    seen = (leaves > 0) & (beyond[..., 2] <= last)
    each = (spots[:, None], np.arange(len(_LOOK)))
    contrast = away[each[0][..., None], each[1][:, None], np.minimum(beyond, last)]
    contrast = np.sort(contrast, axis=2)[..., 1]
    seen &= np.abs(contrast) > low[:, None]
    part = away / np.where(seen, contrast, np.inf)[..., None]
    after = np.maximum(np.argmax(part > 0.5, axis=2), 1)
    before = part[(*each, after - 1)]
    slope = np.maximum(part[(*each, after)] - before, 1e-3)
    crossing = after - 1 + np.clip((0.5 - before) / slope, 0.0, 1.0)
    edges = reach[:, :1] + step[:, None] * crossing
    ovals, kept = _ovals(edges, seen)
    # A normal edge rises by 1 / (sqrt(2 pi) sigma) per pixel where it is steepest.
    rise = np.maximum(medians(slope, seen), 1e-3) / step
    blur = np.clip(1.0 / (np.sqrt(2 * np.pi) * rise), *BLUR_RANGE)
    mean, a, b, c, d = ovals.T
    mean = np.where((mean > 1) & (kept.mean(axis=1) > 0.25), mean, np.nan)
    x, y = centres.T
    ellipses = np.stack([x + a, y + b, mean, -2 * c / mean, -2 * d / mean, blur], 1)
    return ellipses, levels, noise, kept, seen & ~kept


def _ovals(edges: Floats, seen: Flags) -> tuple[Floats, Flags]:
    """Displaced ovals through edges at radii (m, looks), outliers trimmed.

    Returns:
        Coefficients of _OVAL, (m, 5), and which edges were kept, (m, looks).
    """
    middle = medians(edges, seen)[:, None]
    weight = 1.0 * (seen & (np.abs(edges - middle) < 0.4 * middle))
    for _ in range(_OVAL_PASSES):
        weighted = (weight[..., None] * _OVAL).swapaxes(1, 2)
        normal = weighted @ _OVAL + 1e-9 * np.eye(5)
        coefficients = np.linalg.solve(normal, weighted @ edges[..., None])[..., 0]
        residual = np.abs(edges - coefficients @ _OVAL.T)
        # Sums of absolute values: what hides a part of the outline pulls little.
        weight = seen / np.maximum(residual, _OVAL_SCATTER)
    spread = MAD * medians(residual, seen)
    kept = seen & (residual < np.maximum(3 * spread, 3 * _OVAL_SCATTER)[:, None])
    return np.asarray(coefficients), kept


def _ring(
    sampler: Sampler, spots: Indices, ellipses: Floats
) -> tuple[Floats, Floats, Floats]:
    """Levels just behind the edge in each direction, (m, rays, 3).

    Returns:
        The levels; how far behind the edge, (m, 3), px; the edge's blur, (m, 1), px.
    """
    # Sampling between pixels blurs the edge a little more.
    blur = np.sqrt(ellipses[:, 5] ** 2 + SAMPLING_VARIANCE)[:, None]
    distance = RING_START * blur + _RING
    radii = radii_by_direction(ellipses)[..., None] + distance[:, None]
    points = ellipses[:, None, None, :2] + radii[..., None] * _DIRECTIONS[:, None]
    return sampler(spots, points), distance, blur


def _goes_on(
    sampler: Sampler, spots: Indices, ellipses: Floats, levels: Floats
) -> Floats:
    """Part of the directions in which the marker's level goes on behind the edge, (m,).

    There the outline is none: the fit leaves those directions out, and would not see
    that the ellipse lies within the marker.
    """
    behind = _ring(sampler, spots, ellipses)[0].mean(axis=2)
    usual = np.median(behind, axis=1, keepdims=True)
    inside = levels[:, None]
    alike = _ALIKE * np.abs(usual - inside)
    return np.asarray((np.abs(behind - inside) < alike).mean(axis=1))


def _background(
    sampler: Sampler, spots: Indices, ellipses: Floats, levels: Floats, noise: Floats
) -> tuple[Floats, Floats]:
    """What lies behind the edge in each direction, and how much the edge counts.

    Returns:
        Levels (m, rays); weights 0-1 (m, rays), 0 where the background is uneven or
        too like the marker.
    """
    values, distance, blur = _ring(sampler, spots, ellipses)
    # The edge's foot still covers a little of these places.
    foot = ndtr(-distance / blur)[:, None]
    values = (values - foot * levels[:, None, None]) / (1 - foot)
    mean = values.mean(axis=2)
    level = np.sort(mean[:, _NEAR], axis=2)[..., 2]
    contrast = np.abs(level - levels[:, None])
    floor = np.maximum(_MIN_CONTRAST, _MIN_CONTRAST_SIGMAS * noise)[:, None]
    range_ = values.max(axis=2) - values.min(axis=2)
    uneven = np.maximum(np.abs(mean - level), 0.5 * range_)
    usable = uneven < _MAX_UNEVEN * contrast + 2.0 * noise[:, None]
    usable &= contrast > floor
    typical = np.maximum(medians(contrast, usable), _MIN_CONTRAST)[:, None]
    return level, usable * np.minimum(contrast / typical, 1.0) ** 2
