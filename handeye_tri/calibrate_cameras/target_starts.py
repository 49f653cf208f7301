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
        return _closed_forms(model, image_sizes, names)
    part = model.take(list(range(m)), few)
    state = _closed_forms(part, image_sizes, names)
    end = minimise(
        part.evaluate, part.retract, state, 0.0, tolerance=_ROUGH, damping=DAMPING
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


def _closed_forms(
    model: TargetModel, image_sizes: list[tuple[int, int]], names: list[str]
) -> TargetState:
    """Each camera from its own views, then the places from the views they share."""
    m, _, n, _ = model.pixels.shape
    rotation = np.full((m, n, 3, 3), np.nan)
    translation = np.full((m, n, 3), np.nan)
    intrinsics, usable = np.empty((m, 5)), np.asarray(model.seen.any(axis=2))
    lens = np.zeros(8 if max(model.lens, default=0) > 4 else 5)
    for i in range(m):
        views = np.flatnonzero(usable[i])
        mine = model if m == 1 and len(views) == n else model.take([i], views)
        found = _one_camera(mine, image_sizes[i], lens)
        if found is None:
            raise DegenerateMotionError(
                f"no camera fits the views of {names[i]!r}: in each start a point is "
                "behind it; check that points and pixels are in the same order"
            )
        intrinsics[i] = found.intrinsics[0]
        rotation[i, views], translation[i, views] = found.rotation, found.translation
    return _placed(intrinsics, (lens,) * m, rotation, translation, usable)


def _one_camera(
    model: TargetModel, image_size: tuple[int, int], lens: Floats
) -> TargetState | None:
    """A camera and its views' poses in closed form, or the best of some guesses."""
    image = ImageScale.of(image_size)
    homographies = _homographies(model, image, model.pixels[0])
    weight = np.ones(homographies.shape[2:])
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = intrinsics_from_homographies(
            homographies, weight, 2 in model.intrinsics
        )[:, 0]
    closed = bool(usable_intrinsics(unit[:, None])[0])
    choices = [unit]
    if not closed:
        choices = [np.array([f, f, 0.0, 0.0, 0.0]) for f in _FOCAL_LENGTHS]
    best, least = None, np.inf
    for choice in choices:
        poses = _metric(model, choice, homographies)
        vector = choice * image.scale
        vector[3:] += image.centre
        state = TargetState(
            vector[None], (lens,), np.eye(3)[None], np.zeros((1, 3)), *poses
        )
        if closed:
            return state
        end = minimise(
            model.evaluate, model.retract, state, 0.0, tolerance=_ROUGH, damping=DAMPING
        )
        if end is not None and end.cost < least:
            best, least = end.state, end.cost
    return best


def _homographies(model: TargetModel, image: ImageScale, pixels: Floats) -> Floats:
    """Of each view, (3, 3, n, 1), from pixels (2, n, p), without lens."""
    centre, size = _target_scale(model)
    plane = (model.plane - centre[:, None]) / size
    seen = None
    if not model.complete[0]:
        seen = model.seen[0].T[..., None].astype(float)
    scaled = (pixels - image.centre[:, None, None]) / image.scale
    with np.errstate(invalid="ignore", divide="ignore"):
        return linear_homographies(
            plane[:, :, None, None], scaled.transpose(0, 2, 1)[..., None], seen
        )


def _target_scale(model: TargetModel) -> tuple[Floats, float]:
    centre = model.plane.mean(axis=1)
    return centre, float(np.sqrt(((model.plane.T - centre) ** 2).sum(axis=1).mean()))


def _metric(
    model: TargetModel, unit: Floats, homographies: Floats
) -> tuple[Floats, Floats]:
    """camera_from_target of each view: (n, 3, 3), (n, 3), metres."""
    centre, size = _target_scale(model)
    rotation, translation = poses_from_homographies(unit[:, None], homographies)
    turned = np.moveaxis(rotation[..., 0], -1, 0)
    return turned, size * translation[..., 0].T - turned[:, :, :2] @ centre


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
        ideal = distorted
        # A start needs no better inverse of the lens.
        for _ in range(2):
            ideal = distorted - (distort(lens, ideal) - ideal)
        pixels = np.stack(
            [fx * ideal[..., 0] + skew * ideal[..., 1] + cx, fy * ideal[..., 1] + cy]
        )
    unit = intrinsics.copy()
    unit[3:] -= image.centre
    return _metric(model, unit / image.scale, _homographies(model, image, pixels))


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
