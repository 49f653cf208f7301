"""Half-turns before a camera that is known: each by itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.extrinsics import poses_from_homographies
from handeye_tri.calibrate_cameras.half_turns import HalfTurnData
from handeye_tri.calibrate_cameras.homography import Homographies, fit_homographies
from handeye_tri.calibrate_cameras.least_squares import minimise
from handeye_tri.calibrate_cameras.refine import HalfTurnModel, State
from handeye_tri.errors import DegenerateMotionError

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

Build = Callable[[HalfTurnData, Indices], HalfTurnModel]


def build_of(build: Build, row: Indices) -> Build:
    """What makes models of copies of one row of the half-turns.

    Args:
        build: Makes the model of some rows of them.
        row: That row, shape (1,).
    """

    def build_copies(copies: HalfTurnData, rows: Indices) -> HalfTurnModel:
        return build(copies, row[rows])

    return build_copies


def own_homography(data: HalfTurnData, o: Floats | None) -> Homographies | None:
    """The homography of one half-turn alone, None where there is none.

    Args:
        data: That half-turn.
        o: The foot of a normal axis, shape (2,), metres; None where it is not known.
    """
    try:
        return fit_homographies(data, "free" if o is None else "known", o)
    except (DegenerateMotionError, np.linalg.LinAlgError):
        return None


def joined(each: list[Homographies]) -> Homographies:
    """Homographies of single half-turns as those of many."""
    return replace(
        each[0],
        matrix=np.concatenate([one.matrix for one in each]),
        covariance=np.concatenate([one.covariance for one in each]),
        o=np.concatenate([one.o for one in each]),
    )


def fit_poses(
    model: HalfTurnModel, homographies: Homographies, state: State
) -> State | None:
    """Poses of half-turns before a known camera; None where one is behind it.

    Args:
        model: Of these half-turns.
        homographies: One each, to start from.
        state: Camera, lens and O; its poses are not read.
    """
    fx, fy, skew, cx, cy = state.intrinsics
    k = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    n = len(model.data)
    start = replace(
        state,
        poses=poses_from_homographies(k, homographies, model.data.triangle),
        o=homographies.o if model.free_o else np.tile(state.o[0], (n, 1)),
        turn=np.zeros((n, model.turn_unknowns)),
    )
    fixed = model.with_camera_known()
    end = minimise(fixed.evaluate, fixed.retract, start, 1e-9, max_iterations=60)
    return None if end is None else end.state
