"""The joint adjustment of a session: what goes in, the iteration, what is chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from handeye_tri.adjustment.linearisation import (
    Linearisation,
    evaluate,
    normal_equations,
)
from handeye_tri.adjustment.model import AdjustmentModel
from handeye_tri.adjustment.problem import Sides, State
from handeye_tri.adjustment.result import (
    adjustment_result,
    check_determined,
    check_seen,
)
from handeye_tri.adjustment.robot import RobotParameters, determined
from handeye_tri.adjustment.robust import Loss
from handeye_tri.adjustment.session_input import (
    check_input,
    error_root,
    side_lengths,
    start_state,
    stations_in_blocks,
)
from handeye_tri.calibrate_cameras.bundle_input import unknowns
from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
from handeye_tri.calibrate_cameras.least_squares import Minimum, minimise
from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.errors import ConvergenceError, DegenerateMotionError, InputError
from handeye_tri.records import HandEyeCalibration, Session
from handeye_tri.threads import one_thread

Floats = NDArray[np.float64]

# Correlations of detection errors that are tried where markers lie on the axis.
_CORRELATIONS = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 0.96, 0.985)


def adjust(
    session: Session,
    start: HandEyeCalibration,
    *,
    side_sigma: float = np.inf,
    loss: Loss | None = None,
    robot_parameters: RobotParameters | None = None,
    on_axis_correlation: float | None = None,
) -> HandEyeCalibration:
    """Adjust cameras, their places, markers and robot poses together.

    Maximum likelihood of all detected pixels, each with its covariance, and of the
    poses that the robot reports, with its repeatability: at each calibration station
    the flange truly stands at ``reported @ exp(xi)``, xi normal with the stated
    covariance (nothing is estimated where the robot is exact). Unknown are each
    camera's intrinsics and the lens coefficients that the session names, each
    camera's place in the base, and the three markers in the flange frame, on each
    mount of the triangle anew: its stations share the cameras and the base with all
    others, and only tell of other markers. Nothing is
    left to choose: base and flange are the robot's own frames, its reported
    motions fix the scale, and where a correction common to all stations could trade
    against cameras or markers, the corrections' zero mean decides.

    Every seen marker counts, whatever else is seen at its station. Levenberg-Marquardt
    with the stations eliminated: time and memory grow in proportion to them.

    Spheres are seen by the centre of their outline: the part due to perspective is
    in the model; the part due to the lens bending the outline (0.03 px at most)
    is computed from the state where an iteration starts, and again after it.

    Args:
        session: Calibration stations are used, evaluation stations are not.
        start: The same cell from the separate steps. Quantities that the session does
            not ask for keep its values.
        side_sigma: How well the triangle's sides are known (each one standard
            deviation), metres: 0 for exact sides, infinite for markers that calibrate
            themselves, which costs hardly any accuracy and needs no measured rig.
            On each mount the sides are off by themselves.
        loss: A robust loss, for wrong detections; None for the likelihood. chi2 is
            then the sum of that loss, and the covariance that of the points kept.
        robot_parameters: Systematic errors of the robot as further unknowns, at all
            stations of the session. Those that the data determine no better than
            their sigma are left at zero, see ``details``.
        on_axis_correlation: Correlation of the detection errors of a marker that lies
            on a half-turn's edge axis, before and after: it is seen twice at the same
            place. None estimates it by restricted maximum likelihood (Patterson and
            Thompson 1971, doi:10.1093/biomet/58.3.545).

    Returns:
        The cell. ``covariance`` has the cameras, "reference_from_<camera>",
        "base_from_<camera>", "flange_from_triangle", the markers ("marker_A.x" ...
        in the flange frame, metres), the same of other mounts
        ("flange_from_triangle_2", "marker_A_2.x" ...) and the robot's parameters; it
        is singular, since some follow from others. ``residuals`` are of the stations at
        which the pixels alone fix the flange, see "stations". ``robot`` has the values
        of the parameters that were freed. ``details`` has:

        - "pixel_residuals": detected less predicted, (m, n, 3, 2), NaN where unused;
        - "corrections": xi at every station, (n, 6), m and rad, NaN where unused;
        - "stations": indices of the stations that ``residuals`` are of;
        - "chi2_pixels", "chi2_robot", "chi2_sides", "chi2_parameters": chi2 by source
          (without a loss they add up);
        - "undetermined": labels of the robot's parameters that were left at zero;
        - "on_axis_correlation", "iterations", "condition".

    Raises:
        InputError: session, start or an option do not fit, or a mount shows markers at
            fewer than two stations.
        DegenerateMotionError: the data do not determine the unknowns; names them.
        ConvergenceError: the iteration did not settle.
    """
    check_input(session, start, side_sigma, loss, robot_parameters, on_axis_correlation)
    # Products of a few hundred numbers a side: threads cost more than they bring.
    with one_thread():
        return _adjusted(
            session, start, side_sigma, loss, robot_parameters, on_axis_correlation
        )


def _adjusted(
    session: Session,
    start: HandEyeCalibration,
    side_sigma: float,
    loss: Loss | None,
    robot_parameters: RobotParameters | None,
    on_axis_correlation: float | None,
) -> HandEyeCalibration:
    edge = any(turn.axis != "normal" for turn in session.half_turns)
    estimate = on_axis_correlation is None and edge
    correlation = 0.0 if on_axis_correlation is None else on_axis_correlation
    stations = stations_in_blocks(
        session, correlation if edge else 0.0, paired=estimate
    )
    inner, outer = unknowns(
        start.cameras,
        [info.skew for info in session.cameras],
        [info.lens for info in session.cameras],
    )
    model = AdjustmentModel(
        stations,
        inner,
        outer,
        session.marker_radii,
        Sides(side_lengths(session), side_sigma),
        error_root(session.repeatability),
        None,
        loss,
    )
    state = start_state(session, start, model)
    undetermined: tuple[str, ...] = ()
    if robot_parameters is not None:
        model, state, undetermined = _free_robot(
            model, state, robot_parameters, start.cameras
        )
    end = _solve(model, state, start.cameras)
    if estimate:
        correlation, end = _correlated(end, start.cameras)
    return adjustment_result(session, start, end, undetermined, correlation)


def _free_robot(
    model: AdjustmentModel,
    state: State,
    parameters: RobotParameters,
    cameras: Sequence[PinholeCamera],
) -> tuple[AdjustmentModel, State, tuple[str, ...]]:
    """Add the robot's parameters that the data determine; the labels of the others.

    Information is that at the optimum without them, where pixels and poses fit best.
    """
    end = _solve(model, state, cameras)
    whole = replace(end.blocks.model, robot=parameters)
    count = len(parameters.labels)
    at = replace(end.state, robot=np.zeros(count))
    information = normal_equations(whole, at).reduced()
    extra = whole.extra
    information[extra, extra] -= np.diag(parameters.sigma**-2)
    others = information[: extra.start, : extra.start]
    both = information[: extra.start, extra]
    scale = 1.0 / np.sqrt(np.diagonal(others))
    solved = scale[:, None] * np.linalg.solve(
        others * np.outer(scale, scale), scale[:, None] * both
    )
    kept = determined(information[extra, extra] - both.T @ solved, parameters.sigma)
    labels = [parameters.labels[k] for k in kept]
    left = tuple(label for label in parameters.labels if label not in labels)
    if not labels:
        return end.blocks.model, end.state, left
    chosen = parameters.select(labels)
    state = replace(end.state, robot=np.zeros(len(labels)))
    return replace(end.blocks.model, robot=chosen), state, left


def _solve(
    model: AdjustmentModel, state: State, cameras: Sequence[PinholeCamera]
) -> Minimum[State, Linearisation]:
    """Minimise, with what lenses do to the outlines of spheres kept up to date."""
    bent = any(outer for outer in model.lenses) or any(
        coefficients.any() for coefficients in state.lenses
    )
    if not (bent and model.radii.any()):
        return _minimum(model, state, cameras)
    end = _minimum(_with_bending(model, state, cameras), state, cameras)
    return _minimum(_with_bending(model, end.state, cameras), end.state, cameras)


def _with_bending(
    model: AdjustmentModel, state: State, cameras: Sequence[PinholeCamera]
) -> AdjustmentModel:
    bending = np.zeros(model.stations.pixels.shape)
    for chunk, i, seen, local in model.views(state):
        camera = PinholeCamera(
            cameras[i].name,
            Intrinsics.from_vector(state.intrinsics[i]),
            cameras[i].image_size,
            Lens(cameras[i].lens.model, state.lenses[i]),
        )
        local = np.moveaxis(local, 0, -1)
        axial = local.copy()
        axial[..., 2] -= model.radii**2 / local[..., 2]
        whole = camera.project(local) + sphere_shift(camera, local, model.radii)
        bending[i, chunk] = np.where(
            seen[..., None], whole - camera.project(axial), 0.0
        )
    return replace(model, stations=replace(model.stations, bending=bending))


def _minimum(
    model: AdjustmentModel, state: State, cameras: Sequence[PinholeCamera]
) -> Minimum[State, Linearisation]:
    first = evaluate(model, state)
    if first is None:
        raise InputError(
            "start puts a seen marker behind its camera; start from a better cell"
        )
    if first.observations <= first.unknowns:
        raise DegenerateMotionError(
            f"{first.observations} observations (the robot's poses among them) are too "
            f"few for {first.unknowns} unknowns; add stations, or estimate fewer lens "
            "coefficients"
        )
    check_seen(first, cameras)
    largest = float(np.abs(model.stations.pixels).max())
    whitest = float(np.abs(model.stations.whitener).max())
    rounding = float(np.finfo(float).eps * largest * whitest)
    end = minimise(partial(evaluate, model), model.retract, state, rounding)
    assert end is not None
    if not end.converged:
        check_determined(end, cameras)
        raise ConvergenceError(
            f"the joint adjustment did not settle in {end.iterations} iterations (chi2 "
            f"{end.cost_start:.4g} to {end.cost:.4g}); start nearer, or estimate fewer "
            "lens coefficients"
        )
    return end


def _correlated(
    end: Minimum[State, Linearisation], cameras: Sequence[PinholeCamera]
) -> tuple[float, Minimum[State, Linearisation]]:
    """The correlation of errors on the axis with the highest restricted likelihood."""
    best, found, deviance = end, 0.0, _deviance(end)
    for tried in _CORRELATIONS:
        model = best.blocks.model
        stations = replace(model.stations, correlation=tried)
        other = _solve(replace(model, stations=stations), best.state, cameras)
        if _deviance(other) > deviance:
            break
        best, found, deviance = other, tried, _deviance(other)
    return found, best


def _deviance(end: Minimum[State, Linearisation]) -> float:
    """-2 log of the restricted likelihood, but for what the observations fix."""
    equations, model = end.blocks.equations(), end.blocks.model
    _, shared = np.linalg.slogdet(equations.reduced())
    assert model.stations.on_axis is not None
    twice = model.seen[:, :, 0] & model.seen[:, :, 1] & model.stations.on_axis
    # Two coordinates of each marker that is seen before and after.
    spread = 2.0 * int(twice.sum()) * np.log1p(-(model.stations.correlation**2))
    return float(end.cost + spread + equations.log_determinant() + shared)
