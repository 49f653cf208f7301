"""What the joint adjustment takes from a session and a start."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri import arguments
from handeye_tri.adjustment.model import AdjustmentModel
from handeye_tri.adjustment.problem import State, Stations
from handeye_tri.adjustment.robot import RobotParameters
from handeye_tri.adjustment.robust import Loss
from handeye_tri.calibrate_cameras.bundle_input import observations, pairs
from handeye_tri.counting import counted
from handeye_tri.errors import InputError
from handeye_tri.records import HandEyeCalibration, Repeatability, Session
from handeye_tri.triangle import EDGES

Floats = NDArray[np.float64]


def check_input(
    session: Session,
    start: HandEyeCalibration,
    side_sigma: float,
    loss: Loss | None,
    robot_parameters: RobotParameters | None,
    on_axis_correlation: float | None,
) -> None:
    """Refuse what :func:`handeye_tri.adjust` cannot use.

    Raises:
        InputError: an argument is of the wrong kind, or they do not fit together.
    """
    arguments.record("session", session, Session)
    arguments.record("start", start, HandEyeCalibration)
    names = tuple(camera.name for camera in start.cameras)
    expected = tuple(info.name for info in session.cameras)
    if names != expected:
        raise InputError(
            f"start has the cameras ({', '.join(names)}), the session "
            f"({', '.join(expected)}); give them in the session's order"
        )
    if len(start.mounts) != _mounts(session):
        raise InputError(
            f"start knows {counted(len(start.mounts), 'mount')} of the triangle, the "
            f"session's stations have {_mounts(session)}; start from a cell that knows "
            "each"
        )
    if loss is not None:
        arguments.record("loss", loss, Loss)
    if not arguments.number("side_sigma", side_sigma) >= 0:
        raise InputError(
            f"side_sigma must be 0 or more (metres, or infinite), got {side_sigma}"
        )
    if on_axis_correlation is not None and not (
        0 <= arguments.number("on_axis_correlation", on_axis_correlation) < 1
    ):
        raise InputError(
            "on_axis_correlation must be at least 0 and below 1, "
            f"got {on_axis_correlation}"
        )
    if robot_parameters is None:
        return
    arguments.record("robot_parameters", robot_parameters, RobotParameters)
    n = len(session.stations)
    if len(robot_parameters.jacobian) != n:
        raise InputError(
            f"robot_parameters must be of all {n} stations of the session, "
            f"got {len(robot_parameters.jacobian)}"
        )
    owners = {label.rsplit(".", 1)[0] for label in robot_parameters.labels}
    if owners & set(names):
        raise InputError(
            f"robot_parameters and cameras share the names "
            f"{', '.join(sorted(owners & set(names)))}; rename the parameters"
        )


def _mounts(session: Session) -> int:
    """How many mounts hold the triangle, one after the other."""
    return 1 + int(session.mounts.max())


def error_root(repeatability: Repeatability) -> Floats:
    """Square root of the covariance of the robot's error without empty columns."""
    sigma = np.repeat([repeatability.translation, repeatability.rotation], 3)
    return np.diag(sigma)[:, sigma > 0]


def side_lengths(session: Session) -> Floats:
    """Lengths of AB, BC, CA, shape (3,), metres."""
    points = session.triangle.points
    return np.array(
        [np.linalg.norm(points[end] - points[start]) for start, end in EDGES.values()]
    )


def stations_in_blocks(
    session: Session, correlation: float, *, paired: bool
) -> Stations:
    """Calibration stations that show a marker, in blocks of one or of half-turns.

    Args:
        session: Its cameras, stations, half-turns and pixels.
        correlation: Of the errors of a marker on a half-turn's edge axis.
        paired: Blocks of half-turns even where that is 0, since it will be estimated.

    Raises:
        InputError: a camera sees no marker, or a mount shows some at fewer than two
            stations; names it.
    """
    m, n = len(session.cameras), len(session.stations)
    observed, whitener = observations(m, session.pixels, session.pixel_covariance)
    seen = np.asarray(np.isfinite(observed).all(axis=-1))
    held = session.indices("evaluation")
    seen[:, held] = False
    used = np.flatnonzero(seen.any(axis=(0, 2)))
    for i, info in enumerate(session.cameras):
        if not seen[i].any():
            raise InputError(
                f"camera {info.name!r} sees no marker at any calibration station; "
                "leave it out, or add stations in its view"
            )
    shown = np.bincount(session.mounts[used], minlength=_mounts(session))
    if len(shown) > 1 and shown.min() < 2:
        raise InputError(
            f"mount {1 + int(shown.argmin())} of the triangle shows a marker at "
            f"{counted(int(shown.min()), 'calibration station')}, and each mount needs "
            "2 or more; add stations with it, or leave its stations out"
        )
    if paired or correlation > 0:
        turns = [turn for turn in session.half_turns if turn.axis != "normal"]
        index, members = pairs(turns, used, n)
        on_axis = np.zeros((len(index), 3), dtype=bool)
        for block, member in enumerate(members):
            on_axis[block, list(EDGES[turns[member].axis])] = True
    else:
        index, on_axis = used[:, None], None
    mounts = session.mounts[index[:, 0]]
    # A chunk of blocks then has one mount.
    order = np.argsort(mounts, kind="stable")
    index, mounts = index[order], mounts[order]
    on_axis = None if on_axis is None else on_axis[order]
    present = index >= 0
    reported = np.tile(np.eye(4), (*index.shape, 1, 1))
    reported[present] = session.base_from_flange[index[present]]
    usable = seen[:, index] & present[..., None]
    return Stations(
        np.where(usable[..., None], observed[:, index], 0.0),
        np.where(usable[..., None, None], whitener[:, index], 0.0),
        reported,
        index,
        mounts,
        on_axis,
        correlation,
    )


def start_state(
    session: Session, start: HandEyeCalibration, model: AdjustmentModel
) -> State:
    """The start as a state; exact sides take the session's triangle."""
    markers = [mount.markers for mount in start.mounts]
    if model.sides.exact:
        points = session.triangle.points
        markers = [mount.flange_from_triangle.apply(points) for mount in start.mounts]
    return State(
        np.array([camera.intrinsics.vector for camera in start.cameras]),
        tuple(camera.lens.coefficients for camera in start.cameras),
        np.array([motion.matrix for motion in start.base_from_camera]),
        np.array(markers),
        np.zeros(0),
        np.zeros((model.blocks, model.own)),
    )
