"""From the minimum of an adjustment to its record: covariance, verdict, details."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.bundle_model import (
    BundleModel,
    Linearisation,
    State,
)
from handeye_tri.calibrate_cameras.degeneracy import scaled_condition
from handeye_tri.calibrate_cameras.least_squares import Minimum
from handeye_tri.camera import INTRINSIC_NAMES, Intrinsics, Lens, PinholeCamera
from handeye_tri.errors import ConvergenceError, DegenerateMotionError
from handeye_tri.records import CameraCalibration, Covariance, motion_labels
from handeye_tri.se3 import SE3
from handeye_tri.triangle import Axis

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

# A focal length whose sigma is a larger part of it than this is not determined.
_MAX_RELATIVE_SIGMA = 0.5
# Scaled information worse conditioned than this is singular in double precision.
_MAX_CONDITION = 1e14


def _camera_labels(
    cameras: Sequence[PinholeCamera], model: BundleModel
) -> tuple[list[str], list[int]]:
    """Labels of the cameras' unknowns, intrinsics before places, and their columns."""
    inner: list[tuple[str, int]] = []
    places: list[tuple[str, int]] = []
    for i, camera in enumerate(cameras):
        labels = [INTRINSIC_NAMES[index] for index in model.intrinsics[i]]
        labels += [camera.lens.names[index] for index in model.lenses[i]]
        start = model.columns[i].start
        inner += [
            (f"{camera.name}.{label}", start + j) for j, label in enumerate(labels)
        ]
        if i:
            start += len(labels)
            places += [
                (label, start + j)
                for j, label in enumerate(
                    motion_labels(f"reference_from_{camera.name}")
                )
            ]
    both = inner + places
    return [label for label, _ in both], [column for _, column in both]


def bundle_result(
    model: BundleModel,
    end: Minimum[State, Linearisation],
    cameras: Sequence[PinholeCamera],
    blocks: Indices,
    members: Indices,
    half_turns: int,
    kinds: tuple[tuple[Axis, int], ...],
    n: int,
) -> CameraCalibration:
    """Judge a minimum and put it into a record.

    Args:
        model: What was minimised.
        end: Its minimum.
        cameras: The cameras at the start, for names, image sizes and lens models.
        blocks: Station indices of each block, (b, w), -1 for none.
        members: Which half-turn each of the first blocks is.
        half_turns: How many half-turns there are.
        kinds: Name and mount of each axis.
        n: How many stations there are.

    Raises:
        DegenerateMotionError: the stations do not determine the cameras.
        ConvergenceError: the iteration did not settle.
    """
    state, normal = end.state, end.blocks.normal
    information = normal.reduced()
    condition = scaled_condition(information)
    labels, columns = _camera_labels(cameras, model)
    if condition > _MAX_CONDITION:
        raise DegenerateMotionError(
            f"the cameras are not determined (condition {condition:.2g} of "
            f"{len(labels)} unknowns): the triangle's planes may be parallel at all "
            "stations; tilt it at least 20 degrees between stations, or estimate fewer "
            "lens coefficients"
        )
    scale = 1.0 / np.sqrt(np.diagonal(information))
    shared = np.linalg.inv(information * np.outer(scale, scale))
    shared = 0.5 * (shared + shared.T) * np.outer(scale, scale)
    covariance = Covariance(tuple(labels), shared[np.ix_(columns, columns)])
    for camera, vector in zip(cameras, state.intrinsics, strict=True):
        for label, focal in zip(("fx", "fy"), vector[:2], strict=True):
            sigma = covariance.std(f"{camera.name}.{label}")
            if sigma > _MAX_RELATIVE_SIGMA * focal:
                raise DegenerateMotionError(
                    f"{camera.name}.{label} = {focal:.1f} px has a predicted sigma of "
                    f"{sigma:.1f} px: the stations do not determine it; add stations "
                    "with the triangle tilted at least 20 degrees and larger in the "
                    "image"
                )
    if not end.converged:
        raise ConvergenceError(
            f"the adjustment did not settle in {end.iterations} iterations (chi2 "
            f"{end.cost_start:.4g} to {end.cost:.4g}); start nearer, or estimate fewer "
            "lens coefficients"
        )
    calibrated = tuple(
        PinholeCamera(
            camera.name,
            Intrinsics.from_vector(state.intrinsics[i]),
            camera.image_size,
            Lens(camera.lens.model, state.lenses[i]),
        )
        for i, camera in enumerate(cameras)
    )
    present = blocks >= 0
    residuals = np.full((len(cameras), n, 3, 2), np.nan)
    residuals[:, blocks[present]] = np.where(
        model.seen[..., None], -end.blocks.residuals, np.nan
    )[:, present]
    details = {
        "reference_from_triangle": _whole(
            model.poses(state)[present], blocks[present], n
        ),
        "station_covariance": _whole(
            _station_covariance(model, end, shared)[present], blocks[present], n
        ),
        "used": np.sort(blocks[present]),
        "iterations": end.iterations,
        "deviance": _deviance(model, end, information),
    }
    if model.tied:
        details["turn_sigmas"] = _whole(state.turn[: len(members)], members, half_turns)
        details["axes"] = tuple(axis for axis, _ in kinds)
        details["axis_mounts"] = tuple(mount for _, mount in kinds)
        details["triangle_from_axis"] = state.lines
    return CameraCalibration(
        cameras=calibrated,
        reference_from_camera=tuple(SE3(m) for m in state.reference_from_camera),
        covariance=covariance,
        chi2=end.cost,
        dof=end.blocks.observations - end.blocks.unknowns,
        residuals=residuals,
        condition=condition,
        cost_start=end.cost_start,
        method="bundle adjustment"
        + (" with half-turns" if model.tied else "")
        + (f", huber {model.huber:g}" if np.isfinite(model.huber) else ""),
        details=details,
    )


def _deviance(
    model: BundleModel, end: Minimum[State, Linearisation], information: Floats
) -> float:
    """-2 log of the restricted likelihood, but for what the observations fix."""
    _, own = np.linalg.slogdet(end.blocks.normal.own)
    _, shared = np.linalg.slogdet(information)
    spread = 0.0
    if model.turns is not None:
        both = model.seen[:, :, 0] & model.seen[:, :, 1]
        # Two coordinates of each marker that is seen before and after.
        spread = 2.0 * float((both * np.log1p(-(model.turns.correlation**2))).sum())
    return end.cost + spread + float(own.sum() + shared)


def _whole(values: Floats, rows: Indices, n: int) -> Floats:
    """Values in the order of all n stations or half-turns, NaN where unused; locked."""
    result = np.full((n, *values.shape[1:]), np.nan)
    result[rows] = values
    result.setflags(write=False)
    return result


def _station_covariance(
    model: BundleModel, end: Minimum[State, Linearisation], shared: Floats
) -> Floats:
    """Marginal covariance of each station's tangent, shape (b, w, 6, 6)."""
    normal = end.blocks.normal
    gain = np.linalg.solve(normal.own, normal.cross)
    spread = gain @ shared
    own = np.linalg.inv(normal.own) + spread @ np.swapaxes(gain, -1, -2)
    lines = shared[model.cameras_stop :, model.cameras_stop :]
    below = np.broadcast_to(lines, (len(own), *lines.shape))
    cross = np.concatenate([-spread[..., model.cameras_stop :], below], axis=1)
    return model.station_covariance(end.state, own, cross)
