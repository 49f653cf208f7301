"""Where the refinement of many trials starts: closed forms, all half-turns at once.

The route of the single calibration (foot of the axis, homographies, K, poses) with
linear homographies and two constraints a half-turn that weigh alike: enough for a
start. The last two axes of every array are half-turns and trials.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.closed_form import NOMINAL_FOCAL
from handeye_tri.calibrate_cameras.homography import ImageScale
from handeye_tri.calibrate_cameras.starts import GENERIC_FOCAL
from handeye_tri.calibrate_cameras.trial_equations import eliminate
from handeye_tri.calibrate_cameras.trial_model import TrialModel, TrialState

Floats = NDArray[np.float64]

# A closed form outside this is noise: focal length over the image's longer side, its
# axes' ratio, and the principal point's distance from the middle.
_FOCAL_RANGE = (0.2, 20.0)
_MAX_ASPECT = 2.0
_MAX_OFF_CENTRE = 1.0


def start_feet(pixels: Floats, points: Floats) -> Floats:
    """Foot of each normal axis without K, triangle's frame, shape (2, n, c), metres.

    In the image a half-turn about a normal is the harmonic homology
    x' ~ (o.l) x - 2 (l.x) o. With the image o of O as origin, l = (l1, l2, 1) follows
    from two equations a marker, and depths are as 1 / (l.x).

    Args:
        pixels: Before and after, shape (2, 6, n, c), any affine coordinates.
        points: A, B, C, shape (2, 3, 1, 1), metres.
    """
    before, after = pixels[:, :3], pixels[:, 3:]
    along = after - before
    length = np.sqrt((along * along).sum(axis=0))
    normal = np.stack([-along[1], along[0]])
    # Each line counts by the length of its diagonal: n n' / |n|.
    weight = 1.0 / np.maximum(length, np.finfo(float).tiny)
    middle = 0.5 * (before + after)
    centre = middle.mean(axis=1)
    height = ((middle - centre[:, None]) * normal).sum(axis=0) * weight
    xx = (normal[0] * normal[0] * weight).sum(axis=0)
    xy = (normal[0] * normal[1] * weight).sum(axis=0)
    yy = (normal[1] * normal[1] * weight).sum(axis=0)
    meet = centre + _solve_2x2(
        xx, xy, yy, (normal[0] * height).sum(axis=0), (normal[1] * height).sum(axis=0)
    )
    (a, b), (a2, b2) = before - meet[:, None], after - meet[:, None]
    # l1 a b' + l2 b b' = -(b + b') / 2 and l1 a a' + l2 b a' = -(a + a') / 2.
    size = a2 * a2 + b2 * b2
    right = -0.5 * ((a + a2) * a2 + (b + b2) * b2)
    line = _solve_2x2(
        (a * a * size).sum(axis=0),
        (a * b * size).sum(axis=0),
        (b * b * size).sum(axis=0),
        (a * right).sum(axis=0),
        (b * right).sum(axis=0),
    )
    # O as a sum of A, B, C: in the image by areas, in the plane by depths too.
    area = np.stack([a[(k + 1) % 3] * b[(k + 2) % 3] for k in range(3)])
    area -= np.stack([a[(k + 2) % 3] * b[(k + 1) % 3] for k in range(3)])
    part = area * (line[0] * a + line[1] * b + 1.0)
    return np.asarray((part * points).sum(axis=1) / part.sum(axis=0))


def _solve_2x2(xx: Floats, xy: Floats, yy: Floats, u: Floats, v: Floats) -> Floats:
    determinant = xx * yy - xy * xy
    return np.stack([(yy * u - xy * v) / determinant, (xx * v - xy * u) / determinant])


def linear_homographies(
    plane: Floats, image: Floats, seen: Floats | None = None
) -> Floats:
    """Direct linear homographies of flat targets, (3, 3, n, c), last element 1.

    The first two rows are eliminated from the normal equations, which leaves three by
    three for the last row.

    Args:
        plane: Coordinates of about unit size around 0, shape (2, p, n, c) or (.., 1).
        image: The same of the images, shape (2, p, n, c).
        seen: 1 for points that count and 0 for others, (p, n, c); None for all.
    """
    x, y = plane
    u, v = image
    terms = (x * x, x * y, x, y * y, y, np.ones_like(x))
    if seen is not None:
        terms = tuple(term * seen for term in terms)

    def moments(weight: Floats | None) -> Floats:
        sums = [(t if weight is None else t * weight).sum(axis=0) for t in terms]
        xx, xy, x1, yy, y1, one = sums
        return np.stack([[xx, xy, x1], [xy, yy, y1], [x1, y1, one]])

    inverse = _inverse_3x3(moments(None))
    by_u, by_v = moments(u), moments(v)
    last = moments(u * u + v * v)
    back_u = _product(inverse, by_u)
    back_v = _product(inverse, by_v)
    last = last - _product(by_u, back_u) - _product(by_v, back_v)
    third = np.ones((3, *last.shape[2:]))
    third[:2] = _solve_2x2(last[0, 0], last[0, 1], last[1, 1], -last[0, 2], -last[1, 2])
    result = np.empty((3, 3, *last.shape[2:]))
    result[0] = (back_u * third).sum(axis=1)
    result[1] = (back_v * third).sum(axis=1)
    result[2] = third
    return result


def _product(a: Floats, b: Floats) -> Floats:
    return np.stack([(a[i, :, None] * b).sum(axis=0) for i in range(3)])


def _inverse_3x3(m: Floats) -> Floats:
    """Inverses of symmetric matrices, shape (3, 3, ...)."""
    a = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    b = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    c = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    d = m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2]
    e = m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]
    f = m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]
    determinant = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c
    rows = [np.stack([a, b, c]), np.stack([b, d, e]), np.stack([c, e, f])]
    return np.asarray(np.stack(rows) / determinant)


def intrinsics_from_homographies(
    homographies: Floats, weight: Floats, skew: bool
) -> Floats:
    """K in closed form (paper, Sec. III-C), (fx, fy, skew, cx, cy), NaN where none.

    Least squares with w33 = 1, each half-turn's rows over the size of its h1 and h2
    as a nominal camera sees them.

    Args:
        homographies: Shape (3, 3, n, c), image coordinates of about unit size around 0.
        weight: Shape (n, c).
        skew: Whether w12 is free.

    Returns:
        Shape (5, c), in units of the image coordinates.
    """
    h, g = homographies[:, 0], homographies[:, 1]
    nominal = np.array([NOMINAL_FOCAL**-2, NOMINAL_FOCAL**-2, 1.0])[:, None, None]
    scale = weight / np.sqrt((nominal * h * h).sum(axis=0) * (nominal * g * g).sum(0))

    def row(p: Floats, q: Floats) -> list[Floats]:
        """The paper's v(p, q), w12 left out without skew."""
        values = [p[0] * q[0], p[1] * q[1], p[0] * q[2] + p[2] * q[0]]
        values += [p[1] * q[2] + p[2] * q[1]]
        if skew:
            values.append(p[0] * q[1] + p[1] * q[0])
        return [*values, p[2] * q[2]]

    first = np.stack(row(h, g)) * scale
    second = (np.stack(row(h, h)) - np.stack(row(g, g))) * scale
    rows = np.stack([first, second], axis=1)
    count = len(rows) - 1
    normal = np.stack([(rows[k] * rows).sum(axis=(1, 2)) for k in range(count)])
    eliminate(normal, count)
    b = np.zeros((5, normal.shape[-1]))
    for k in reversed(range(count)):
        rest = normal[k, -1] + (normal[k, k + 1 : count] * b[k + 1 : count]).sum(axis=0)
        b[k] = -rest / normal[k, k]
    w11, w22, w13, w23, w12 = b
    # Cholesky's factorisation of w = K^-T K^-1, written out.
    minor = w11 * w22 - w12 * w12
    cy = (w12 * w13 - w11 * w23) / minor
    size = 1.0 - (w13 * w13 + cy * (w12 * w13 - w11 * w23)) / w11
    fx = np.sqrt(size / w11)
    fy = np.sqrt(size * w11 / minor)
    s = -w12 * fx * fx * fy / size
    return np.stack([fx, fy, s, s * cy / fy - w13 * fx * fx / size, cy])


def usable_intrinsics(unit: Floats) -> NDArray[np.bool_]:
    """Which closed forms are a camera rather than noise, shape (c,).

    Args:
        unit: Shape (5, c), in units of the image's longer side, from its middle.
    """
    focal, off = unit[:2], np.abs(unit[3:]).max(axis=0)
    good = (focal > _FOCAL_RANGE[0]).all(axis=0)
    good &= (focal < _FOCAL_RANGE[1]).all(axis=0) & (off < _MAX_OFF_CENTRE)
    ratio = focal[0] / np.where(good, focal[1], 1.0)
    return np.asarray(good & (ratio > 1.0 / _MAX_ASPECT) & (ratio < _MAX_ASPECT))


def poses_from_homographies(
    intrinsics: Floats, homographies: Floats
) -> tuple[Floats, Floats]:
    """Rotation (3, 3, n, c) and translation (3, n, c) of planes of unit size.

    K^-1 H = [r1 r2 t] up to scale; r1 and r2 become orthonormal by their polar
    decomposition.

    Args:
        intrinsics: Shape (5, c), in units of the image coordinates.
        homographies: Shape (3, 3, n, c), last element positive.
    """
    fx, fy, skew, cx, cy = intrinsics
    third = homographies[2]
    second = (homographies[1] - cy * third) / fy
    first = (homographies[0] - cx * third - skew * second) / fx
    h = np.stack([first, second, third])
    a, b = (h[:, 0] ** 2).sum(axis=0), (h[:, 1] ** 2).sum(axis=0)
    c = (h[:, 0] * h[:, 1]).sum(axis=0)
    root = np.sqrt(np.maximum(a * b - c * c, np.finfo(float).tiny))
    trace = np.sqrt(a + b + 2.0 * root)
    rotation = np.empty_like(h)
    rotation[:, 0] = (h[:, 0] * (b + root) - h[:, 1] * c) / (root * trace)
    rotation[:, 1] = (h[:, 1] * (a + root) - h[:, 0] * c) / (root * trace)
    x, y = rotation[:, 0], rotation[:, 1]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rotation[i, 2] = x[j] * y[k] - x[k] * y[j]
    return rotation, h[:, 2] * (2.0 / trace)


def closed_form_start(
    model: TrialModel, known_o: Floats | None, image_size: tuple[int, int], skew: bool
) -> tuple[TrialState, NDArray[np.bool_]]:
    """A start for every trial, and where it is generic, for want of a closed form.

    Args:
        model: The trials.
        known_o: Shape (2,), or None where it is estimated.
        image_size: (width, height), pixels.
        skew: Whether skew is estimated.
    """
    image = ImageScale.of(image_size)
    n, c = model.weight.shape
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        observed = (model.pixels - image.centre[:, None, None, None]) / image.scale
        o = _feet(model, observed, known_o)
        homographies, origin, size = _homographies(model, observed, o)
        found = intrinsics_from_homographies(homographies, model.weight, skew)
    good = usable_intrinsics(found)
    generic = np.array([GENERIC_FOCAL, GENERIC_FOCAL, 0.0, 0.0, 0.0])[:, None]
    unit = np.where(good, found, generic)
    return _state(model, unit, homographies, origin, size, image, o), ~good


def generic_start(
    model: TrialModel, known_o: Floats | None, image_size: tuple[int, int]
) -> TrialState:
    """A start with a generic camera, its focal length high rather than low.

    Args:
        model: The trials.
        known_o: Shape (2,), or None where it is estimated.
        image_size: (width, height), pixels.
    """
    image = ImageScale.of(image_size)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        observed = (model.pixels - image.centre[:, None, None, None]) / image.scale
        o = _feet(model, observed, known_o)
        homographies, origin, size = _homographies(model, observed, o)
    unit = np.zeros((5, model.weight.shape[1]))
    unit[:2] = GENERIC_FOCAL
    return _state(model, unit, homographies, origin, size, image, o)


def _feet(model: TrialModel, observed: Floats, known: Floats | None) -> Floats:
    n, c = model.weight.shape
    about = model.reach[5, :, 0] > 0
    if model.o_mode == "known" or not about.any():
        o = np.zeros(2) if known is None else known
        return np.tile(o[:, None, None], (1, n, c))
    feet = np.zeros((2, n, c))
    feet[:, about] = start_feet(observed[:, :, about], model.plane[:, :3, :1])
    # Away from the triangle by several of its sizes, it is noise.
    reach = 5.0 * np.abs(model.plane[:, :3]).max()
    usable = (np.abs(feet) < reach).all(axis=0) & (model.weight > 0)
    feet = np.where(usable, feet, np.nan)[:, about]
    middle = _median(feet)
    if model.o_mode == "shared":
        return middle[:, None]
    result = np.zeros((2, n, c))
    result[:, about] = np.where(np.isnan(feet), middle[:, None], feet)
    return result


def _median(values: Floats) -> Floats:
    """Median along axis 1 of what is not NaN; 0 where nothing is."""
    ordered = np.sort(values, axis=1)
    count = np.isfinite(ordered).sum(axis=1, keepdims=True)
    last = np.maximum(count - 1, 0)
    low = np.take_along_axis(ordered, last // 2, axis=1)[:, 0]
    high = np.take_along_axis(ordered, (last + 1) // 2, axis=1)[:, 0]
    return np.nan_to_num(0.5 * (low + high), nan=0.0)


def _homographies(
    model: TrialModel, observed: Floats, o: Floats
) -> tuple[Floats, Floats, float]:
    vertices = model.plane[:, :3, 0, 0]
    origin = vertices.mean(axis=1)
    size = float(np.sqrt(((vertices - origin[:, None]) ** 2).sum(axis=0).mean()))
    plane = model.plane + model.reach * o[:, None]
    plane = (plane - origin[:, None, None, None]) / size
    return linear_homographies(plane, observed), origin, size


def _state(
    model: TrialModel,
    unit: Floats,
    homographies: Floats,
    origin: Floats,
    size: float,
    image: ImageScale,
    o: Floats,
) -> TrialState:
    n, c = model.weight.shape
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        rotation, translation = poses_from_homographies(unit, homographies)
    translation = size * translation
    translation = translation - rotation[:, 0] * origin[0] - rotation[:, 1] * origin[1]
    still = model.weight == 0
    if still.any():
        rotation[:, :, still] = np.eye(3)[:, :, None]
        translation[:, still] = np.array([0.0, 0.0, 1.0])[:, None]
    intrinsics = unit * image.scale
    intrinsics[3:] += image.centre[:, None]
    width = 8 if max(model.lens, default=0) > 4 else 5
    return TrialState(intrinsics, np.zeros((width, c)), rotation, translation, o)
