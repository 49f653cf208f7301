"""The calibration's steps once more, to show how it got where it ended."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import HandEyeError
from handeye_tri.records import HandEyeCalibration, Mount, Session
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
    from handeye_tri.hand_eye.mounts import solve_mounts

    before = [turn.before for turn in session.half_turns]
    after = [turn.after for turn in session.half_turns]
    reported = session.base_from_flange[before + after]
    mounts = session.mounts[before + after]
    no_shift = np.zeros((len(session.stations), 3, 2))
    cameras, seen = [], []
    found: list[list[SE3]] = [[] for _ in result.mounts]
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
        seen.append((reported[known], mounts[known], poses[known]))
        xs, _ = solve_mounts(reported[known], poses[known], mounts[known])
        for mount, x in xs.items():
            found[mount].append(x)
    # A mount with which no camera saw a half-turn whole stays where it ends.
    rigs = [
        SE3.mean(those) if those else end.flange_from_triangle
        for those, end in zip(found, result.mounts, strict=True)
    ]
    matrices = np.array([rig.matrix for rig in rigs])
    places = tuple(
        SE3.mean([SE3(m) for m in base_from_flange @ matrices[of] @ se3_inverse(views)])
        for base_from_flange, of, views in seen
    )
    first, *others = (Mount(rig, rig.apply(session.triangle.points)) for rig in rigs)
    return replace(
        result,
        cameras=tuple(cameras),
        base_from_camera=places,
        flange_from_triangle=first.flange_from_triangle,
        markers=first.markers,
        other_mounts=tuple(others),
    )
