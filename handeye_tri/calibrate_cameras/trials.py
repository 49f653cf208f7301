"""Many independent calibrations of one camera at once, as Monte-Carlo studies need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from handeye_tri import arguments
from handeye_tri.calibrate_cameras.degeneracy import (
    MAX_CONDITION,
    MAX_RELATIVE_SIGMA,
    check_axis_ends,
    check_count,
    least_noise,
)
from handeye_tri.calibrate_cameras.half_turns import check_triangle, read_axes
from handeye_tri.calibrate_cameras.options import lens_choice, o_choice
from handeye_tri.calibrate_cameras.trial_centre import average_trials_over_centre
from handeye_tri.calibrate_cameras.trial_equations import inverses
from handeye_tri.calibrate_cameras.trial_minimise import (
    RELATIVE_TOLERANCE,
    TrialMinima,
    minimise_trials,
)
from handeye_tri.calibrate_cameras.trial_model import TrialModel, TrialState
from handeye_tri.calibrate_cameras.trial_starts import (
    closed_form_start,
    generic_start,
)
from handeye_tri.camera import INTRINSIC_NAMES, LENS_COEFFICIENTS, LensModel
from handeye_tri.errors import InputError
from handeye_tri.records import numeric
from handeye_tri.triangle import Axis, TriangleRig

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Half-turns that are worked on at a time: their derivatives stay in the cache.
_AT_A_TIME = 2000
# Chance that a good fit is taken for a local minimum and started a second time.
_CHANCE = 1e-3
# A minimum that is only the start of another needs no more digits than its sigma.
_ROUGH = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class TrialCalibrations:
    """One camera, calibrated from each of t sets of measurements.

    Attributes:
        labels: Names of the k estimated intrinsics and lens coefficients, in the order
            of ``covariance``.
        intrinsics: fx, fy, skew, cx, cy of each trial, shape (t, 5), pixels.
        lens: Lens coefficients, shape (t, 5) or (t, 8).
        covariance: Of the estimated quantities, shape (t, k, k).
        chi2: Sum of squared residuals over sigma_px squared, shape (t,).
        dof: Observations less unknowns, shape (t,).
        cost_start: chi2 at the start, shape (t,).
        poses: camera_from_triangle before each half-turn, (t, n, 4, 4), metres; NaN
            where it was left out.
        o: Foot of the axis, triangle's frame, (t, n, 2), metres; NaN for edges.
        iterations: Of the refinement, shape (t,).
        converged: Which trials have a result, shape (t,). The others' numbers are NaN.
        failures: Why a trial has none, t sentences, empty where it has.
    """

    labels: tuple[str, ...]
    intrinsics: Floats
    lens: Floats
    covariance: Floats
    chi2: Floats
    dof: NDArray[np.intp]
    cost_start: Floats
    poses: Floats
    o: Floats
    iterations: NDArray[np.intp]
    converged: Bools
    failures: tuple[str, ...]

    def __len__(self) -> int:
        """Number of trials."""
        return len(self.chi2)

    @property
    def sigma(self) -> Floats:
        """Standard deviations of the estimated quantities, shape (t, k)."""
        return np.asarray(np.sqrt(np.einsum("tkk->tk", self.covariance)))


def calibrate_trials(
    before: ArrayLike,
    after: ArrayLike,
    triangle: TriangleRig,
    *,
    image_size: tuple[int, int],
    axis: Axis | Sequence[Axis] = "normal",
    skew: bool = True,
    distortion: LensModel | Sequence[str] | None = None,
    o: Literal["shared", "free"] | ArrayLike = "shared",
    sigma_px: float | None = None,
) -> TrialCalibrations:
    """Calibrate one camera from each of t independent sets of n half-turns.

    The estimate of :func:`calibrate_camera`, all trials in the same arrays: closed
    form, then maximum likelihood with one pose per half-turn (Zhao, Liu and Zhang
    2008, doi:10.1109/TIP.2008.2005562, Sec. III), each half-turn's pose eliminated.
    A trial that does not look like a good fit is started a second time from a generic
    camera and the lower cost is kept; without ``sigma_px`` every trial is. A trial
    that fails is flagged and leaves the others alone. With a lens the likelihood is
    averaged over its centre (:mod:`lens_centre`).

    Args:
        before: Pixels of A, B, C before each half-turn, shape (t, n, 3, 2). Half-turns
            with a NaN, before or after, are left out of their trial.
        after: After it, shape (t, n, 3, 2).
        triangle: The rig.
        image_size: (width, height), pixels.
        axis: "normal" or an edge; one for all half-turns or one each, alike in all
            trials.
        skew: Whether the skew factor is estimated; otherwise it is zero.
        distortion: Lens coefficients to estimate: all of a model, or their names.
        o: Where a normal axis meets the triangle's plane: unknown and the same in all
            half-turns of a trial, free in each, or known, shape (2,), metres.
        sigma_px: Standard deviation of each pixel coordinate. None scales each trial's
            covariance by its chi2 / dof.

    Raises:
        InputError: an argument cannot be used.
        DegenerateMotionError: n half-turns of this triangle are too few for the
            unknowns, or turn about an edge with a right angle at one of its ends.
    """
    check_triangle(triangle)
    pixels, complete = _read(before, after)
    t, n = pixels.shape[:2]
    axes = read_axes(axis, n)
    size = arguments.image_size("image_size", image_size)
    arguments.flag("skew", skew)
    if sigma_px is not None:
        arguments.positive("sigma_px", sigma_px)
    lens_model, lens = lens_choice(distortion)
    o_mode, known_o = o_choice(o)
    about = np.array([name == "normal" for name in axes])
    model = TrialModel(
        np.zeros((2, 6, n, 0)),
        np.zeros((n, 0)),
        *_plane(triangle, axes, known_o),
        (0, 1, 2, 3, 4) if skew else (0, 1, 3, 4),
        lens,
        o_mode if about.any() else "known",
    )
    shared = model.shared_unknowns
    per_half_turn = 4 if model.o_mode == "free" else 6
    inner = len(model.intrinsics)
    check_count(n, inner, shared, per_half_turn)
    check_axis_ends(triangle, axes)
    failures = np.full(t, "", dtype=object)
    inside = (pixels > -0.5) & (pixels < np.array(size) - 0.5)
    inside |= ~complete[..., None, None]
    failures[~inside.all(axis=(1, 2, 3))] = "a marker lies outside the image"
    needed = max((inner + 1) // 2, shared // per_half_turn + 1)
    failures[complete.sum(axis=1) < needed] = (
        f"fewer than {needed} half-turns are complete"
    )
    dof = 6 * complete.sum(axis=1) - shared
    if model.o_mode == "free":
        dof -= 2 * (complete & about).sum(axis=1)
    k = len(model.intrinsics) + len(lens)
    labels = [INTRINSIC_NAMES[i] for i in model.intrinsics]
    labels += [LENS_COEFFICIENTS[lens_model][i] for i in lens]
    result = TrialCalibrations(
        tuple(labels),
        np.full((t, 5), np.nan),
        np.full((t, len(LENS_COEFFICIENTS[lens_model])), np.nan),
        np.full((t, k, k), np.nan),
        np.full(t, np.nan),
        dof,
        np.full(t, np.nan),
        np.full((t, n, 4, 4), np.nan),
        np.full((t, n, 2), np.nan),
        np.zeros(t, dtype=np.intp),
        np.zeros(t, dtype=bool),
        (),
    )
    whole = np.flatnonzero(failures == "")
    step = max(1, _AT_A_TIME // max(n, 1))
    for first in range(0, len(whole), step):
        rows = whole[first : first + step]
        part = replace(
            model,
            pixels=np.ascontiguousarray(pixels[rows].transpose(3, 2, 1, 0)),
            weight=np.ascontiguousarray(complete[rows].T.astype(float)),
        )
        found = _solve(part, dof[rows], known_o, size, sigma_px)
        _fill(result, rows, part, found, about, failures, sigma_px)
    for name in TrialCalibrations.__slots__:
        value = getattr(result, name)
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
    return replace(result, failures=tuple(failures.tolist()))


def _read(before: ArrayLike, after: ArrayLike) -> tuple[Floats, Bools]:
    """Pixels (t, n, 6, 2), 0 in half-turns that are not complete; which are (t, n)."""
    both = []
    for name, value in (("before", before), ("after", after)):
        array = numeric(name, value)
        if array.ndim != 4 or array.shape[2:] != (3, 2):
            raise InputError(
                f"{name} must have shape (t, n, 3, 2): trial, half-turn, marker A B C, "
                f"(column, row) in pixels; got {array.shape}"
            )
        both.append(array)
    if both[0].shape != both[1].shape:
        raise InputError(
            "before and after must pair up, got shapes "
            f"{both[0].shape} and {both[1].shape}"
        )
    pixels = np.concatenate(both, axis=2)
    complete = np.asarray(np.isfinite(pixels).all(axis=(2, 3)))
    if not complete.all():
        pixels[~complete] = 0.0
    return pixels, complete


def _plane(
    triangle: TriangleRig, axes: tuple[Axis, ...], known_o: Floats | None
) -> tuple[Floats, Floats]:
    """Markers in their plane before and after, (2, 6, n, 1), and their d/dO."""
    o = np.zeros(2) if known_o is None else known_o
    after = np.array(
        [triangle.half_turn(name, o).apply(triangle.points) for name in axes]
    )
    plane = np.empty((2, 6, len(axes), 1))
    plane[:, :3, :, 0] = triangle.points[:, :2].T[:, :, None]
    plane[:, 3:, :, 0] = after[..., :2].transpose(2, 1, 0)
    reach = np.zeros((6, len(axes), 1))
    if known_o is None:
        reach[3:] = 2.0 * (np.array(axes) == "normal")[:, None]
    return plane, reach


def _solve(
    model: TrialModel,
    dof: NDArray[np.intp],
    known_o: Floats | None,
    image_size: tuple[int, int],
    sigma_px: float | None,
) -> TrialMinima:
    skew = 2 in model.intrinsics
    freedom = np.maximum(dof, 1).astype(float)
    # Pixels are stored with so much rounding.
    rounding = np.finfo(float).eps * float(np.abs(model.pixels).max(initial=0.0))
    floor = 12.0 * model.weight.sum(axis=0) * rounding**2
    pinhole = replace(model, lens=())
    tolerance = _ROUGH if model.lens else RELATIVE_TOLERANCE
    start, generic = closed_form_start(model, known_o, image_size, skew)
    found = minimise_trials(pinhole, start, freedom, floor, tolerance)
    with np.errstate(invalid="ignore"):
        if sigma_px is None:
            doubtful = np.ones(len(dof), dtype=bool)
        else:
            limit = sigma_px**2 * chdtri(freedom, _CHANCE)
            doubtful = ~found.converged | ~(found.cost <= limit)
    again = np.flatnonzero(doubtful & ~generic)
    if len(again):
        part = pinhole.take(again)
        second = minimise_trials(
            part,
            generic_start(part, known_o, image_size),
            freedom[again],
            floor[again],
            tolerance,
        )
        mine, other = found.cost[again], second.cost
        better = second.converged & (~found.converged[again] | ~(mine <= other))
        found.put(again[better], second, better)
    if model.lens:
        start = _with_lens(found.state, model)
        refined = minimise_trials(model, start, freedom, floor)
        found = replace(refined, cost_start=found.cost_start)
    return found


def _with_lens(state: TrialState, model: TrialModel) -> TrialState:
    width = 8 if max(model.lens) > 4 else 5
    return replace(state, lens=np.zeros((width, state.lens.shape[1])))


def _fill(
    result: TrialCalibrations,
    rows: NDArray[np.intp],
    model: TrialModel,
    found: TrialMinima,
    about: Bools,
    failures: NDArray[np.object_],
    sigma_px: float | None,
) -> None:
    """Judge the minima of some trials and write those that are good."""
    scale = 1.0 if sigma_px is None else sigma_px
    chi2 = found.cost / scale**2
    k = result.covariance.shape[1]
    covariance, condition = inverses(found.equations.information() / scale**2)
    place = model.places[:k]
    covariance = covariance[:, place][:, :, place]
    noise = np.ones(len(rows))
    if sigma_px is None:
        noise = chi2 / np.maximum(result.dof[rows], 1)
    judged = np.maximum(noise, least_noise(0.0, noise_known=sigma_px is not None))
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(judged[:, None] * np.einsum("tkk->tk", covariance)[:, :2])
        weak = ~(sigma <= MAX_RELATIVE_SIGMA * found.state.intrinsics[:2].T).all(axis=1)
        weak |= ~(condition <= MAX_CONDITION)
    nothing = ~np.isfinite(chi2)
    for flags, why in (
        (~found.converged, "the refinement did not settle"),
        (weak, "the half-turns do not determine the focal length"),
        (nothing, "no start has every marker in front of the camera"),
    ):
        failures[rows[flags]] = why
    good = found.converged & ~weak & ~nothing
    put = rows[good]
    state, chi2 = found.state.take(good), chi2[good]
    covariance = noise[good, None, None] * covariance[good]
    if model.lens:
        state, chi2, covariance = average_trials_over_centre(
            model.take(good), state, chi2 * scale**2, covariance, noise[good] * scale**2
        )
        chi2 = chi2 / scale**2
    result.converged[put] = True
    result.intrinsics[put] = state.intrinsics.T
    result.lens[put] = state.lens.T
    result.covariance[put] = covariance
    result.chi2[put] = chi2
    result.cost_start[put] = found.cost_start[good] / scale**2
    result.iterations[put] = found.iterations[good]
    poses = np.zeros((len(put), model.weight.shape[0], 4, 4))
    poses[..., :3, :3] = state.rotation.transpose(3, 2, 0, 1)
    poses[..., :3, 3] = state.translation.transpose(2, 1, 0)
    poses[..., 3, 3] = 1.0
    poses[model.weight[:, good].T == 0] = np.nan
    result.poses[put] = poses
    o = np.broadcast_to(state.o, (2, *model.weight[:, good].shape))
    seen = (model.weight[:, good] > 0) & about[:, None]
    result.o[put] = np.where(seen, o, np.nan).transpose(2, 1, 0)
