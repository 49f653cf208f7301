"""Where the adjustment of cameras before a flat target starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.homography import ImageScale
from handeye_tri.calibrate_cameras.least_squares import minimise
from handeye_tri.calibrate_cameras.target_model import TargetModel, TargetState
from handeye_tri.calibrate_cameras.trial_starts import (
    intrinsics_from_homographies,
    linear_homographies,
    poses_from_homographies,
    usable_intrinsics,
)
from handeye_tri.camera import distort
from handeye_tri.errors import DegenerateMotionError
from handeye_tri.se3 import nearest_rotation

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

# Cameras and places are adjusted over so many views of each before all views are.
_FEW_VIEWS = 24
# That start needs no more digits than its sigma.
_ROUGH = 1.0
# Focal lengths that are tried over the image's longer side, where no closed form is.
_FOCAL_LENGTHS = (0.7, 1.2, 2.5)
# Little damping: depth and focal length are nearly one unknown.
DAMPING = 1e-7


def start_of(
    model: TargetModel, image_sizes: list[tuple[int, int]], names: list[str]
) -> TargetState:
    """Cameras and places from some of the views, then the poses of all.

    Args:
        model: The cameras' views of the target; each camera has usable ones.
        image_sizes: (width, height) of each camera, pixels.
        names: Of the cameras.

    Raises:
        DegenerateMotionError: no camera fits one camera's views.
    """
    m, _, n, _ = model.pixels.shape
    usable = np.asarray(model.seen.any(axis=2))
    few = np.unique(np.concatenate([_spread(np.flatnonzero(one)) for one in usable]))
    if len(few) == n:
        return closed_forms(model, image_sizes, names)
    part = model.take(list(range(m)), few)
    state = closed_forms(part, image_sizes, names)
    end = minimise(
        part.evaluate,
        part.retract,
        state,
        0.0,
        tolerance=_ROUGH,
        damping=DAMPING,
        take_last=False,
    )
    if end is not None:
        state = end.state
    rotation, translation = np.empty((n, 3, 3)), np.empty((n, 3))
    rotation[few], translation[few] = state.rotation, state.translation
    left = np.ones(n, dtype=bool)
    left[few] = False
    for i in range(m):
        rest = np.flatnonzero(left & usable[i])
        if not len(rest):
            continue
        turn, shift = state.rotations[i], state.translations[i]
        found = _poses(
            model.take([i], rest), image_sizes[i], state.intrinsics[i], state.lenses[i]
        )
        rotation[rest] = turn.T @ found[0]
        translation[rest] = (found[1] - shift) @ turn
        left[rest] = False
    return replace(state, rotation=rotation, translation=translation)


def _spread(views: Indices) -> Indices:
    """A few of the views, evenly spaced."""
    if len(views) <= _FEW_VIEWS:
        return views
    return views[np.linspace(0, len(views) - 1, _FEW_VIEWS).astype(np.intp)]


def closed_forms(
    model: TargetModel, image_sizes: list[tuple[int, int]], names: list[str]
) -> TargetState:
    """Each camera from its own views, then the places from the views they share.

    Args:
        model: The cameras' views of the target; each camera has usable ones.
        image_sizes: (width, height) of each camera, pixels.
        names: Of the cameras.

    Returns:
        Cameras without lens, their places, and the pose of each view.

    Raises:
        DegenerateMotionError: no camera fits one camera's views.
    """
    m = len(model.pixels)
    images = [ImageScale.of(size) for size in image_sizes]
    usable = np.asarray(model.seen.any(axis=2))
    homographies = _homographies(model, images, model.pixels)
    lens = np.zeros(8 if max(model.lens, default=0) > 4 else 5)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        if not usable.all():
            unseen = np.diag([1.0, 1.0, 1.0])[:, :, None, None]
            homographies = np.where(usable.T, homographies, unseen)
        unit = intrinsics_from_homographies(
            homographies, usable.T.astype(float), 2 in model.intrinsics
        )
        good = usable_intrinsics(unit)
        unit = np.where(good, unit, 1.0)
        rotation, translation = _metric(model, unit, homographies)
    intrinsics = unit.T * np.array([image.scale for image in images])[:, None]
    intrinsics[:, 3:] += np.array([image.centre for image in images])
    for i in np.flatnonzero(~good).tolist():
        views = np.flatnonzero(usable[i])
        found = _best_guess(model.take([i], views), images[i], lens)
        if found is None:
            raise DegenerateMotionError(
                f"no camera fits the views of {names[i]!r}: in each start a point is "
                "behind it; check that points and pixels are in the same order"
            )
        intrinsics[i] = found.intrinsics[0]
        rotation[i, views], translation[i, views] = found.rotation, found.translation
    return _placed(intrinsics, (lens,) * m, rotation, translation, usable)


def _best_guess(
    model: TargetModel, image: ImageScale, lens: Floats
) -> TargetState | None:
    """One camera where no closed form is: the best of some focal lengths, adjusted."""
    homographies = _homographies(model, [image], model.pixels)
    best, least = None, np.inf
    for focal in _FOCAL_LENGTHS:
        unit = np.array([focal, focal, 0.0, 0.0, 0.0])
        rotation, translation = _metric(model, unit[:, None], homographies)
        vector = unit * image.scale
        vector[3:] += image.centre
        place = np.eye(3)[None], np.zeros((1, 3))
        state = TargetState(vector[None], (lens,), *place, rotation[0], translation[0])
        end = minimise(
            model.evaluate, model.retract, state, 0.0, tolerance=_ROUGH, damping=DAMPING
        )
        if end is not None and end.cost < least:
            best, least = end.state, end.cost
    return best


def _homographies(
    model: TargetModel, images: list[ImageScale], pixels: Floats
) -> Floats:
    """Of each camera's views, (3, 3, n, m), from pixels (m, 2, n, p), without lens."""
    centre, size = _target_scale(model)
    plane = (model.plane - centre[:, None]) / size
    seen = None
    if not all(model.complete):
        seen = model.seen.transpose(2, 1, 0).astype(float)
    middle = np.array([image.centre for image in images])
    scale = np.array([image.scale for image in images])
    scaled = (pixels - middle[..., None, None]) / scale[:, None, None, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        return linear_homographies(
            plane[:, :, None, None],
            np.ascontiguousarray(scaled.transpose(1, 3, 2, 0)),
            seen,
        )


def _target_scale(model: TargetModel) -> tuple[Floats, float]:
    centre = model.plane.mean(axis=1)
    return centre, float(np.sqrt(((model.plane.T - centre) ** 2).sum(axis=1).mean()))


def _metric(
    model: TargetModel, unit: Floats, homographies: Floats
) -> tuple[Floats, Floats]:
    """camera_from_target of each camera's views: (m, n, 3, 3), (m, n, 3), metres."""
    centre, size = _target_scale(model)
    rotation, translation = poses_from_homographies(unit, homographies)
    turned = np.ascontiguousarray(rotation.transpose(3, 2, 0, 1))
    return turned, size * translation.transpose(2, 1, 0) - turned[..., :2] @ centre


def _poses(
    model: TargetModel, image_size: tuple[int, int], intrinsics: Floats, lens: Floats
) -> tuple[Floats, Floats]:
    """Poses of views before a camera that is known."""
    image = ImageScale.of(image_size)
    pixels = model.pixels[0]
    if lens.any():
        fx, fy, skew, cx, cy = intrinsics
        y = (pixels[1] - cy) / fy
        distorted = np.stack([(pixels[0] - cx - skew * y) / fx, y], axis=-1)
        # A start needs no better inverse of the lens.
        ideal = 2.0 * distorted - distort(lens, distorted)
        pixels = np.stack(
            [fx * ideal[..., 0] + skew * ideal[..., 1] + cx, fy * ideal[..., 1] + cy]
        )
    unit = intrinsics.copy()
    unit[3:] -= image.centre
    rotation, translation = _metric(
        model,
        unit[:, None] / image.scale,
        _homographies(model, [image], pixels[None]),
    )
    return rotation[0], translation[0]


def _placed(
    intrinsics: Floats,
    lenses: tuple[Floats, ...],
    rotation: Floats,
    translation: Floats,
    usable: NDArray[np.bool_],
) -> TargetState:
    """Places of the cameras from the views that they share, the most shared first."""
    m = len(usable)
    rotations, translations = np.tile(np.eye(3), (m, 1, 1)), np.zeros((m, 3))
    poses, shifts, known = rotation[0].copy(), translation[0].copy(), usable[0].copy()
    left = set(range(1, m))
    while left:
        i = max(left, key=lambda k: int((usable[k] & known).sum()))
        left.remove(i)
        both = usable[i] & known
        relative = rotation[i, both] @ np.swapaxes(poses[both], 1, 2)
        turn = nearest_rotation(relative.sum(axis=0)[None])[0]
        rotations[i] = turn
        translations[i] = np.median(
            translation[i, both] - shifts[both] @ turn.T, axis=0
        )
        new = usable[i] & ~known
        poses[new] = turn.T @ rotation[i, new]
        shifts[new] = (translation[i, new] - translations[i]) @ turn
        known |= new
    return TargetState(intrinsics, lenses, rotations, translations, poses, shifts)
