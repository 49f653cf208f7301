"""The calibration's steps once more, to show how it got where it ended."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import HandEyeError
from handeye_tri.records import HandEyeCalibration, Session
from handeye_tri.se3 import SE3, se3_inverse

if TYPE_CHECKING:
    from handeye_tri.records import CameraCalibration
    from handeye_tri.replay import SolverStep

Floats = NDArray[np.float64]


def solver_steps(
    session: Session, cameras: CameraCalibration, result: HandEyeCalibration
) -> list[SolverStep]:
    """How the result was reached: closed form, each camera alone, all cameras.

    Each step is calibrated anew by the function that the calibration used. A step
    that does not get through by itself is left out.

    Args:
        session: What was observed.
        cameras: Its cameras, all together.
        result: Where the steps end.
    """
    from handeye_tri.hand_eye import calibrate_hand_eye
    from handeye_tri.replay import SolverStep

    steps = []
    for words, refine in (
        ("closed form, each camera alone", False),
        ("refined, each camera alone", True),
    ):
        with contextlib.suppress(HandEyeError):
            apart = _each_alone(session, result, refine=refine)
            steps.append(SolverStep(words, apart))
    with contextlib.suppress(HandEyeError):
        together = calibrate_hand_eye(session, cameras)
        steps.append(SolverStep("all cameras together, then hand-eye", together))
    return steps


def _each_alone(
    session: Session, result: HandEyeCalibration, *, refine: bool
) -> HandEyeCalibration:
    """Each camera from its half-turns (Sec. III), placed by AX = ZB in closed form.

    Spheres' centres are taken to be where they seem, since only calibrated cameras
    tell how far off that is.
    """
    from handeye_tri.calibrate_cameras.session_camera import alone
    from handeye_tri.hand_eye import solve_axzb

    before = [turn.before for turn in session.half_turns]
    after = [turn.after for turn in session.half_turns]
    reported = session.base_from_flange[before + after]
    no_shift = np.zeros((len(session.stations), 3, 2))
    cameras, seen, rigs = [], [], []
    for i in range(len(session.cameras)):
        one = alone(session, i, no_shift, refine=refine)
        poses = np.concatenate(
            [
                one.details["camera_from_triangle"],
                one.details["camera_from_triangle_after"],
            ]
        )
        known = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
        cameras.append(one.camera)
        seen.append((reported[known], poses[known]))
        rigs.append(solve_axzb(reported[known], poses[known])[0])
    rig = SE3.mean(rigs)
    places = tuple(
        SE3.mean(
            [SE3(m) for m in base_from_flange @ rig.matrix @ se3_inverse(camera_poses)]
        )
        for base_from_flange, camera_poses in seen
    )
    return replace(
        result,
        cameras=tuple(cameras),
        base_from_camera=places,
        flange_from_triangle=rig,
        markers=rig.apply(session.triangle.points),
    )
