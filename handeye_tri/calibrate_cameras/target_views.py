"""Cameras from views of a flat target of many points, as a chessboard.

The usual way (Zhang 2000, doi:10.1109/34.888718), for any number of cameras at once;
beside the half-turns of three points it is the method to compare with.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri import arguments
from handeye_tri.calibrate_cameras.bundle_input import check_links
from handeye_tri.calibrate_cameras.degeneracy import (
    MAX_CONDITION,
    MAX_RELATIVE_SIGMA,
    invert_information,
)
from handeye_tri.calibrate_cameras.least_squares import Minimum, minimise
from handeye_tri.calibrate_cameras.options import lens_choice
from handeye_tri.calibrate_cameras.target_model import (
    TargetModel,
    TargetRows,
    TargetState,
)
from handeye_tri.calibrate_cameras.target_starts import DAMPING, start_of
from handeye_tri.camera import (
    INTRINSIC_NAMES,
    LENS_COEFFICIENTS,
    Intrinsics,
    Lens,
    LensModel,
    PinholeCamera,
)
from handeye_tri.errors import ConvergenceError, DegenerateMotionError, InputError
from handeye_tri.records import CameraCalibration, Covariance, motion_labels, numeric
from handeye_tri.se3 import SE3, hat
from handeye_tri.threads import one_thread

Floats = NDArray[np.float64]

# A view of fewer points says less than its pose asks.
_LEAST_POINTS = 4
_LEAST_VIEWS = 3
# A further step of all unknowns together would be a hundredth of their sigma at most.
_TOLERANCE = 1e-4
# Points whose smaller spread is less than this part of the larger are on a line.
_MIN_WIDTH = 1e-3


def calibrate_target_views(
    points: ArrayLike,
    pixels: ArrayLike,
    *,
    image_sizes: tuple[int, int] | Sequence[tuple[int, int]],
    skew: bool = False,
    distortion: LensModel | Sequence[str] | None = "radtan",
    sigma_px: float | None = None,
    names: Sequence[str] | None = None,
) -> CameraCalibration:
    """Calibrate m cameras from n poses of a flat target.

    Maximum likelihood over all cameras, their places and the target's poses, with
    analytic derivatives and each pose eliminated: time and memory grow in proportion
    to the views. Each camera starts from Zhang's closed form.

    Args:
        points: Of the target, shape (p, 3), metres, all z = 0.
        pixels: What the cameras saw of it, shape (m, n, p, 2); NaN where unseen. A
            camera's view of fewer than four points is not used. Cameras stand, the
            target moves; all saw it at once.
        image_sizes: (width, height), pixels, for all cameras or one each.
        skew: Whether skew factors are estimated; otherwise they are zero.
        distortion: Lens coefficients to estimate: all of a model, or their names.
        sigma_px: Standard deviation of each pixel coordinate. None scales the
            covariance by chi2 / dof.
        names: Of the cameras; "camera0", "camera1" ... by default.

    Returns:
        The cameras, the first one the reference. ``residuals`` has shape (m, n, p, 2).
        ``details`` has "reference_from_target", (n, 4, 4), metres, NaN where no camera
        has a usable view; "rms_px", the root mean square distance of a point from its
        prediction; "iterations".

    Raises:
        InputError: an argument cannot be used.
        DegenerateMotionError: the views do not determine the cameras.
        ConvergenceError: the iteration did not settle.
    """
    target = _target(points)
    observed = _observed(pixels, target.shape[1])
    m, n, p, _ = observed.shape
    labels = [f"camera{i}" for i in range(m)]
    if names is not None:
        labels = arguments.titles("names", names, m)
    sizes = _sizes(image_sizes, observed, labels)
    arguments.flag("skew", skew)
    if sigma_px is not None:
        arguments.positive("sigma_px", sigma_px)
    lens_model, lens = lens_choice(distortion)
    seen = np.isfinite(observed).all(axis=-1)
    seen &= seen.sum(axis=2, keepdims=True) >= _LEAST_POINTS
    views = seen.any(axis=2)
    for name, count in zip(labels, views.sum(axis=1), strict=True):
        if count < _LEAST_VIEWS:
            raise DegenerateMotionError(
                f"camera {name!r} has {count} views of {_LEAST_POINTS} points or more; "
                f"at least {_LEAST_VIEWS} are needed, in planes that differ by 20 "
                "degrees or more"
            )
    if m > 1:
        check_links(labels, seen)
    used = np.flatnonzero(views.any(axis=0))
    if len(used) < n:
        seen = seen[:, used]
        observed = observed[:, used]
    whole = bool(seen.all())
    model = TargetModel(
        target,
        np.ascontiguousarray(
            np.moveaxis(
                observed if whole else np.where(seen[..., None], observed, 0.0), -1, 1
            )
        ),
        seen,
        (0, 1, 2, 3, 4) if skew else (0, 1, 3, 4),
        lens,
    )
    dof = 2 * int(seen.sum()) - 6 * len(used) - model.shared_unknowns
    if dof < 1:
        raise DegenerateMotionError(
            f"{2 * int(seen.sum())} pixel coordinates are too few for "
            f"{6 * len(used) + model.shared_unknowns} unknowns; add views or points"
        )
    with one_thread():
        start = start_of(model, sizes, labels)
        rounding = float(np.finfo(float).eps * np.abs(model.pixels).max())
        end = minimise(
            model.evaluate,
            model.retract,
            start,
            rounding,
            tolerance=_TOLERANCE,
            damping=DAMPING,
            foresee=True,
        )
        if end is None:
            raise DegenerateMotionError(
                "the cameras' places, from the poses that they share, put a point "
                "behind one of them; check that the views of all cameras are in the "
                "same order"
            )
        noise = end.cost / dof if sigma_px is None else sigma_px**2
        covariance, condition = _covariance(model, end, labels, lens_model, noise)
        if not end.converged:
            raise ConvergenceError(
                f"the adjustment did not settle in {end.iterations} iterations (cost "
                f"{end.cost_start:.4g} to {end.cost:.4g} px^2); estimate fewer lens "
                "coefficients or add views"
            )
        scale = 1.0 if sigma_px is None else sigma_px**2
        return _result(
            model,
            end,
            labels,
            sizes,
            lens_model,
            covariance,
            condition,
            scale,
            (n, used),
        )


def _target(points: ArrayLike) -> Floats:
    """The target in its plane, shape (2, p)."""
    target = numeric("points", points)
    if target.ndim != 2 or target.shape[1] != 3 or len(target) < _LEAST_POINTS:
        raise InputError(
            f"points must have shape (p, 3), p >= {_LEAST_POINTS}, got {target.shape}"
        )
    if not np.isfinite(target).all() or np.abs(target[:, 2]).max() > 0:
        raise InputError("points must be finite and all have z = 0 (a flat target)")
    spread = np.linalg.svd(target[:, :2] - target[:, :2].mean(axis=0))[1]
    if spread[1] <= _MIN_WIDTH * spread[0]:
        raise InputError("points lie on a line; a target needs two directions")
    return np.ascontiguousarray(target[:, :2].T)


def _observed(pixels: ArrayLike, p: int) -> Floats:
    observed = numeric("pixels", pixels)
    if observed.ndim != 4 or observed.shape[2:] != (p, 2) or not observed.size:
        raise InputError(
            f"pixels must have shape (m, n, {p}, 2): camera, view, point, (column, "
            f"row); got {observed.shape}"
        )
    return observed


def _sizes(
    image_sizes: tuple[int, int] | Sequence[tuple[int, int]],
    observed: Floats,
    labels: Sequence[str],
) -> list[tuple[int, int]]:
    size = arguments.image_sizes("image_sizes", image_sizes, len(labels))
    outside = (observed < -0.5) | (observed > np.array(size)[:, None, None] - 0.5)
    if outside.any():
        i, j, k, _ = np.argwhere(outside)[0]
        u, v = observed[i, j, k]
        raise InputError(
            f"pixels[{i}, {j}, {k}] (camera {labels[i]!r}) lies at ({u:.1f}, {v:.1f}), "
            f"outside the {size[i][0]} x {size[i][1]} image; check image_sizes and the "
            "order (column, row)"
        )
    return size


def _covariance(
    model: TargetModel,
    end: Minimum[TargetState, TargetRows],
    labels: Sequence[str],
    lens_model: LensModel,
    noise: float,
) -> tuple[Covariance, float]:
    """Covariance of the cameras and, on the right, of their places.

    Raises:
        DegenerateMotionError: the views do not determine them.
    """
    inverse, condition = invert_information(end.blocks.normal.reduced())
    if not condition <= MAX_CONDITION:
        raise DegenerateMotionError(
            f"the views do not determine the cameras (condition {condition:.2g}): tilt "
            "the target by 20 degrees or more between views, or estimate fewer lens "
            "coefficients"
        )
    names: list[str] = []
    rows: list[Floats] = []
    identity = np.eye(len(inverse))
    for i, label in enumerate(labels):
        inner = [INTRINSIC_NAMES[k] for k in model.intrinsics]
        inner += [LENS_COEFFICIENTS[lens_model][k] for k in model.lens]
        names += [f"{label}.{quantity}" for quantity in inner]
        rows.append(identity[model.places[i]])
    for i, label in enumerate(labels[1:], 1):
        names += motion_labels(f"reference_from_{label}")
        # camera_from_reference (exp(f) R, t + b): its inverse moves by exp(-b - t x f,
        # -f) on the right.
        carry = -np.eye(6)
        carry[:3, 3:] = -hat(end.state.translations[i])
        at = model.columns(i).stop
        rows.append(carry @ identity[at : at + 6])
    to_public = np.concatenate(rows)
    matrix = noise * (to_public @ inverse @ to_public.T)
    covariance = Covariance(tuple(names), 0.5 * (matrix + matrix.T))
    for i, label in enumerate(labels):
        for k in (0, 1):
            focal = float(end.state.intrinsics[i, k])
            sigma = covariance.std(f"{label}.{INTRINSIC_NAMES[k]}")
            if not sigma <= MAX_RELATIVE_SIGMA * focal:
                raise DegenerateMotionError(
                    f"{label}.{INTRINSIC_NAMES[k]} = {focal:.1f} px has a predicted "
                    f"sigma of {sigma:.3g} px: the views do not determine it; tilt the "
                    "target by 20 degrees or more between views"
                )
    return covariance, condition


def _result(
    model: TargetModel,
    end: Minimum[TargetState, TargetRows],
    labels: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    lens_model: LensModel,
    covariance: Covariance,
    condition: float,
    scale: float,
    views: tuple[int, NDArray[np.intp]],
) -> CameraCalibration:
    state = end.state
    n, used = views
    m, _, _, p = model.pixels.shape
    poses = np.full((n, 4, 4), np.nan)
    poses[used] = np.eye(4)
    poses[used, :3, :3], poses[used, :3, 3] = state.rotation, state.translation
    poses.setflags(write=False)
    residuals = model.residuals(state)
    if len(used) < n:
        some, residuals = residuals, np.full((m, n, p, 2), np.nan)
        residuals[:, used] = some
    places = [SE3.identity()]
    places += [
        SE3.from_parts(turn, shift).inverse()
        for turn, shift in zip(state.rotations[1:], state.translations[1:], strict=True)
    ]
    return CameraCalibration(
        cameras=tuple(
            PinholeCamera(
                label,
                Intrinsics.from_vector(state.intrinsics[i]),
                sizes[i],
                Lens(lens_model, state.lenses[i]),
            )
            for i, label in enumerate(labels)
        ),
        reference_from_camera=tuple(places),
        covariance=covariance,
        chi2=end.cost / scale,
        dof=end.blocks.observations - end.blocks.unknowns,
        residuals=residuals,
        condition=condition,
        cost_start=end.cost_start / scale,
        method="flat target, refined",
        details={
            "reference_from_target": poses,
            "rms_px": float(np.sqrt(2.0 * end.cost / end.blocks.observations)),
            "iterations": end.iterations,
        },
    )
