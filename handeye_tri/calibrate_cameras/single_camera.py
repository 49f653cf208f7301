"""One camera from half-turns of the triangle: the public function and its parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri import arguments
from handeye_tri.calibrate_cameras.closed_form import (
    ClosedForm,
    ClosedFormMethod,
    closed_form,
)
from handeye_tri.calibrate_cameras.degeneracy import (
    check_axis_ends,
    check_count,
    check_planes,
    check_turns,
    plane_spread_deg,
)
from handeye_tri.calibrate_cameras.half_turns import HalfTurnData, read_half_turns
from handeye_tri.calibrate_cameras.homography import (
    fit_homographies,
)
from handeye_tri.calibrate_cameras.intrinsic_choice import (
    IntrinsicChoice,
    split_fixed,
)
from handeye_tri.calibrate_cameras.lens_selection import lens_advice
from handeye_tri.calibrate_cameras.lens_verdict import judge_lens
from handeye_tri.calibrate_cameras.options import (
    lens_choice,
    o_choice,
    turn_covariances,
)
from handeye_tri.calibrate_cameras.outlier_reasons import drop_outliers
from handeye_tri.calibrate_cameras.refine import (
    HalfTurnModel,
)
from handeye_tri.calibrate_cameras.robust_loss import LOSSES, Loss
from handeye_tri.calibrate_cameras.single_camera_outcome import (
    Outcome,
    at_closed_form,
    refined,
)
from handeye_tri.calibrate_cameras.special_motion import diagonals_meet
from handeye_tri.calibrate_cameras.starts import (
    blank_state,
    refinement_starts,
)
from handeye_tri.camera import (
    LENS_COEFFICIENTS,
    Intrinsics,
    Lens,
    LensModel,
    PinholeCamera,
)
from handeye_tri.errors import (
    ConvergenceError,
    DegenerateMotionError,
    InputError,
)
from handeye_tri.records import CameraCalibration, Covariance
from handeye_tri.se3 import SE3
from handeye_tri.triangle import EDGES, Axis, TriangleRig

Floats = NDArray[np.float64]


def calibrate_camera(
    before: ArrayLike,
    after: ArrayLike,
    triangle: TriangleRig,
    *,
    image_size: tuple[int, int],
    axis: Axis | Sequence[Axis] = "normal",
    skew: bool = True,
    fixed: Mapping[str, float] | None = None,
    aspect: float | None = None,
    distortion: LensModel | Sequence[str] | None = None,
    refine: bool = True,
    method: ClosedFormMethod = "whitened",
    sigma_px: float | None = None,
    covariance: ArrayLike | None = None,
    o: Literal["shared", "free"] | ArrayLike = "shared",
    turn_covariance: ArrayLike | None = None,
    loss: Loss | None = None,
    reject: bool = False,
    name: str = "camera",
) -> CameraCalibration:
    """Calibrate one camera from n half-turns of three markers.

    Closed form (Zhao, Liu and Zhang 2008, doi:10.1109/TIP.2008.2005562, Sec. III-A
    to III-D), then maximum likelihood with one pose per half-turn (Sec. III-E).

    Args:
        before: Pixels of A, B, C before each half-turn, shape (n, 3, 2). Half-turns
            with a NaN, before or after, are left out.
        after: After it, shape (n, 3, 2).
        triangle: The rig. Only the ratios of its sides matter for K and lens; their
            size is that of the poses and of ``o``.
        image_size: (width, height), pixels.
        axis: "normal" (Sec. III-A) or an edge "AB", "BC", "CA" (Sec. III-B); one for
            all half-turns or one each.
        skew: Whether the skew factor is estimated; otherwise it is zero.
        fixed: What is known of the camera, by name, and not estimated: intrinsics in
            pixels, as {"cx": 511.5, "cy": 383.5}, or lens coefficients.
        aspect: fy / fx, where that is known. fy then follows from fx and has no row
            of its own in ``covariance``. With zero skew, a known principal point and
            aspect ratio, one half-turn is enough.
        distortion: Lens coefficients to estimate: all of a model, or their names. With
            the principal point estimated too, camera and covariance are mean and
            second moments of the likelihood (:mod:`lens_centre`), not its maximum;
            with it given, the maximum and the second moments about that.
        refine: False stops at the closed form.
        method: Closed form by the paper's rows, or by whitened homographies, which
            are about twice as accurate and near the Cramer-Rao bound. With ``refine``
            it is only the start.
        sigma_px: Standard deviation of each pixel coordinate.
        covariance: Instead: covariance of each observed point, (n, 2, 3, 2, 2), px^2.
            With neither, points count alike and the covariance of the result is
            scaled by chi2 / dof.
        o: Where a normal axis meets the triangle's plane: unknown and the same in all
            half-turns, free in each, or known, shape (2,), metres.
        turn_covariance: Of the tangent xi (translation m, rotation rad) by which a
            half-turn misses, ``after = before @ half_turn @ exp(xi)`` in the
            triangle's frame, shape (6, 6) or (n, 6, 6). None: half-turns are exact.
        loss: Of each point in the refinement: its square, or Huber's or Cauchy's loss,
            for errors with heavy tails. ``chi2`` is then the sum of the losses.
        reject: Leave out half-turns that disagree with the others: a wrong point,
            exchanged labels, a repeated image, a turn by another angle. A quarter of
            them may be bad. Where the noise is normal and as stated, 1 in 500 of those
            dropped is good on average; of good ones alone, any is dropped in 1 of 500
            data sets.
        name: The camera's name in the covariance labels.

    Returns:
        The camera. ``residuals`` has shape (1, 2n, 3, 2): half-turns 0 ... n-1 before,
        then 0 ... n-1 after. ``covariance`` has the estimated quantities only.
        ``cost_start`` is chi2 at the closed form, or, where that failed, at the
        generic start. Without ``refine`` chi2 is that of the poses of Sec. III-D,
        which are no fit to the pixels: a little above the least for "whitened", far
        above it for "paper". Only a refined chi2 / dof judges the data.
        ``details`` has:

        - "camera_from_triangle": before each half-turn, (n, 4, 4), metres;
          "camera_from_triangle_after": after it (NaN where left out);
        - "o": foot of the axis in the triangle's frame, (n, 2), metres, NaN for edges;
        - "self_check_px": (n,), computed without K. For a normal axis the RMS distance
          of AA', BB', CC' from their common point, for an edge the RMS of how far the
          two markers on it moved;
        - "turn_sigmas": (n, 6), the deviation of each half-turn over its prior's root,
          where there is a turn_covariance;
        - "lens_verdict": a :class:`LensVerdict` for each lens coefficient estimated:
          its effect in pixels, that of its sigma, and whether it is determined;
        - "weaknesses": sentences on what makes fx or fy uncertain by more than a
          fiftieth (a small target, low tilt, few half-turns), and the remedy;
        - "dropped": with ``reject``, why each half-turn was dropped, by index;
        - "used": indices of the half-turns used; "plane_spread_deg"; "start";
          "iterations".

    Raises:
        InputError: an argument cannot be used.
        DegenerateMotionError: the half-turns do not determine the camera.
        ConvergenceError: the refinement did not settle.
    """
    for what, value in (("skew", skew), ("refine", refine), ("reject", reject)):
        arguments.flag(what, value)
    arguments.title("name", name)
    arguments.check_one_of("method", method, get_args(ClosedFormMethod))
    lens_model, lens = lens_choice(distortion)
    inner, coefficients = split_fixed(fixed, lens_model, lens)
    choice = IntrinsicChoice.of(skew, inner, aspect)
    partly = fixed is not None or aspect is not None
    if not refine and (lens or turn_covariance is not None or partly):
        raise InputError(
            "distortion, turn_covariance, fixed and aspect need refine=True: the "
            "closed form knows neither a lens nor inexact half-turns, and of known "
            "intrinsics only zero skew"
        )
    o_mode, known_o = o_choice(o)
    dropped: dict[int, str] = {}
    data, used = read_half_turns(
        before,
        after,
        triangle,
        image_size,
        axis,
        sigma_px,
        covariance,
        dropped if reject else None,
    )
    n = len(np.asarray(before))
    noise_known = sigma_px is not None or covariance is not None
    if loss is not None:
        arguments.check_one_of("loss", loss, LOSSES)
        if not noise_known or not refine:
            raise InputError(
                f'loss="{loss}" needs refine=True, and sigma_px or covariance, which '
                "say what is far"
            )
    turn = turn_covariances(turn_covariance, n, used, noise_known)

    def build(part: HalfTurnData, rows: NDArray[np.intp]) -> HalfTurnModel:
        return HalfTurnModel(
            part,
            choice=choice,
            lens=lens,
            o_mode=o_mode,
            turn_covariance=None if turn is None else turn[rows],
            loss=loss,
        )

    everything = np.arange(len(data))
    model = build(data, everything)
    per_half_turn = 4 if model.free_o else 6
    check_count(len(data), len(choice.names), model.shared_unknowns, per_half_turn)
    check_axis_ends(triangle, data.axes)
    if reject:
        kept, why = drop_outliers(
            data, build, coefficients, o_mode, known_o, noise_known
        )
        dropped.update(why)
        data, used = data.take(kept), used[kept]
        model = build(data, kept)
        check_count(len(data), len(choice.names), model.shared_unknowns, per_half_turn)
    homographies = fit_homographies(data, o_mode, known_o)
    check_turns(data, homographies.residual_px, lens_ahead=bool(lens))
    if len(choice.names) > 2:
        # One plane gives two constraints, and that is enough for two intrinsics.
        check_planes(data, homographies, noise_known)

    first: ClosedForm | None = None
    try:
        first = closed_form(
            data, homographies, choice.conic_basis(homographies.image), method
        )
    except DegenerateMotionError:
        if not refine or method == "paper":
            raise
    zero = blank_state(model, coefficients, homographies)
    if first is not None and not refine:
        outcome = at_closed_form(model, zero, first, homographies, noise_known)
    else:
        starts = refinement_starts(model, zero, first, homographies)
        try:
            outcome = refined(model, starts, noise_known)
        except (DegenerateMotionError, ConvergenceError) as error:
            advice = None
            if len(lens) > 1:
                every = list(starts.values())
                advice = lens_advice(model, every, lens_model, noise_known)
            if advice is None:
                raise
            raise type(error)(f"{error}. {advice}") from error
    camera = PinholeCamera(
        name,
        Intrinsics.from_vector(outcome.state.intrinsics),
        data.image_size,
        Lens(lens_model, outcome.state.lens),
    )
    names = [*choice.names]
    names += [LENS_COEFFICIENTS[lens_model][i] for i in lens]
    details = _details(model, outcome, n, used)
    if reject:
        details["dropped"] = dropped
    if lens:
        both = np.stack([outcome.state.poses, model.after_poses(outcome.state)], 1)
        seen = triangle.points @ np.swapaxes(both[..., :3, :3], -1, -2)
        inner_count = len(choice.names)
        details["lens_verdict"] = judge_lens(
            camera,
            outcome.covariance[inner_count:, inner_count:],
            names[inner_count:],
            seen + both[..., None, :3, 3],
        )
    residuals = np.full((1, 2 * n, 3, 2), np.nan)
    missed = data.pixels - model.predict(outcome.state)
    residuals[0, used], residuals[0, n + used] = missed[:, 0], missed[:, 1]
    residuals.setflags(write=False)
    return CameraCalibration(
        cameras=(camera,),
        reference_from_camera=(SE3.identity(),),
        covariance=Covariance(
            tuple(f"{name}.{quantity}" for quantity in names), outcome.covariance
        ),
        chi2=outcome.chi2,
        dof=model.dof,
        residuals=residuals,
        condition=outcome.condition,
        cost_start=outcome.cost_start,
        method=f"{method}, {'refined' if refine else 'closed form'}",
        details=details,
    )


def _details(
    model: HalfTurnModel, outcome: Outcome, n: int, used: NDArray[np.intp]
) -> dict[str, Any]:
    def whole(values: Floats) -> Floats:
        """Rows of all n half-turns, NaN for those left out; locked."""
        result = np.full((n, *values.shape[1:]), np.nan)
        result[used] = values
        result.setflags(write=False)
        return result

    data, state = model.data, outcome.state
    o = np.where(data.about_normal[:, None] > 0, state.o, np.nan)
    result: dict[str, Any] = {
        "camera_from_triangle": whole(state.poses),
        "camera_from_triangle_after": whole(model.after_poses(state)),
        "o": whole(o),
        "self_check_px": whole(self_check(data)),
        "used": used,
        "plane_spread_deg": plane_spread_deg(state.poses[:, :3, 2]),
        "start": outcome.start,
        "iterations": outcome.iterations,
        "weaknesses": outcome.weaknesses,
    }
    if model.turn_root is not None:
        result["turn_sigmas"] = whole(state.turn)
    return result


def self_check(data: HalfTurnData) -> Floats:
    """How far each half-turn is from one, judged without K, shape (n,), pixels.

    For a normal axis the RMS distance of the lines AA', BB', CC' from their common
    point; for an edge the RMS distance that its two markers moved.
    """
    moved = np.linalg.norm(data.pixels[:, 1] - data.pixels[:, 0], axis=-1)
    _, result = diagonals_meet(data.pixels[:, 0], data.pixels[:, 1])
    for i, axis in enumerate(data.axes):
        if axis != "normal":
            result[i] = np.sqrt(np.mean(moved[i, list(EDGES[axis])] ** 2))
    return result
