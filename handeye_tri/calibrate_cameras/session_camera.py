"""One camera of a session by itself, from the half-turns that it saw whole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from handeye_tri.calibrate_cameras.single_camera import calibrate_camera
from handeye_tri.errors import (
    ConvergenceError,
    DegenerateMotionError,
    HandEyeError,
    InputError,
)
from handeye_tri.records import (
    CameraCalibration,
    DroppedHalfTurn,
    Repeatability,
    Session,
)

Floats = NDArray[np.float64]

# How far from the flange the rig is taken to be, which nobody knows before the
# hand-eye step: by this lever an orientation error of the robot moves the rig; metres.
_LEVER = 0.1
# Chance that noise as stated gives a chi2 that has half-turns looked into.
_CHANCE = 1e-4


def turn_covariance(repeatability: Repeatability) -> Floats:
    """How far a half-turn of the rig misses, from how far the robot repeats.

    Two executed poses make a half-turn, each off by the repeatability, and the rig is
    0.1 m from the flange: 2 (s_t^2 + (0.1 m)^2 s_r^2) for each translation, 2 s_r^2 for
    each rotation, correlations left out.

    Returns:
        Covariance of the tangent (translation m, rotation rad), shape (6, 6).
    """
    rotation = 2.0 * repeatability.rotation**2
    translation = 2.0 * repeatability.translation**2 + _LEVER**2 * rotation
    return np.diag([translation] * 3 + [rotation] * 3)


def alone(
    session: Session,
    i: int,
    shift: Floats,
    *,
    refine: bool = True,
    reject: bool = False,
) -> CameraCalibration:
    """Calibrate camera i from its half-turns.

    Args:
        session: Half-turns and pixels.
        i: Index of the camera.
        shift: What is taken off its pixels, shape (n, 3, 2).
        refine: False stops at the closed form, which knows neither a lens nor that
            the robot's half-turns are inexact.
        reject: Leave out half-turns that disagree with the others.

    Raises:
        InputError: its data cannot be used; names the camera.
        DegenerateMotionError: its half-turns do not determine it; names the camera.
        ConvergenceError: the refinement did not settle; names the camera.
    """
    info = session.cameras[i]
    before = [turn.before for turn in session.half_turns]
    after = [turn.after for turn in session.half_turns]
    normal = [turn.before for turn in session.half_turns if turn.axis == "normal"]
    # A normal axis has its foot O where the mount has it: one for all is one mount's.
    one_foot = len(set(session.mounts[normal].tolist())) < 2
    pixels, covariance = session.pixels[i] - shift, session.pixel_covariance[i]
    whole = np.asarray(np.isfinite(pixels).all(axis=(1, 2)))
    count = int((whole[before] & whole[after]).sum())
    need = 3 if info.skew else 2
    if count < need:
        raise DegenerateMotionError(
            f"camera {info.name!r} saw all three markers before and after in only "
            f"{count} of {len(before)} half-turns, and needs at least {need}"
            f"{' with skew' if info.skew else ''}; add half-turns in its view"
        )
    try:
        return calibrate_camera(
            pixels[before],
            pixels[after],
            session.triangle,
            image_size=info.image_size,
            axis=[turn.axis for turn in session.half_turns],
            skew=info.skew,
            distortion=(info.lens or None) if refine else None,
            covariance=np.stack([covariance[before], covariance[after]], axis=1),
            o="shared" if one_foot else "free",
            turn_covariance=turn_covariance(session.repeatability) if refine else None,
            refine=refine,
            reject=reject,
            name=info.name,
        )
    except (InputError, DegenerateMotionError, ConvergenceError) as error:
        raise type(error)(f"camera {info.name!r}: {error}") from error


def alone_without_outliers(
    session: Session, i: int, shift: Floats, *, only_to_succeed: bool = False
) -> tuple[CameraCalibration, list[DroppedHalfTurn]]:
    """Calibrate camera i, without half-turns that disagree where there seem to be any.

    Nothing is dropped where chi2 is what noise explains, nor where fewer than three
    quarters of the half-turns agree with each other: what is wrong then is no matter
    of single half-turns.

    Args:
        session: Half-turns and pixels.
        i: Index of the camera.
        shift: What is taken off its pixels, shape (n, 3, 2).
        only_to_succeed: Drop none unless all of them together are an error.

    Raises:
        InputError: its data cannot be used; names the camera.
        DegenerateMotionError: its half-turns do not determine it; names the camera.
        ConvergenceError: the refinement did not settle; names the camera.
    """
    failure: HandEyeError | None = None
    try:
        plain = alone(session, i, shift)
        if only_to_succeed or plain.chi2 <= chdtri(plain.dof, _CHANCE):
            return plain, []
    except (InputError, DegenerateMotionError, ConvergenceError) as error:
        failure = error
    try:
        found = alone(session, i, shift, reject=True)
    except (InputError, DegenerateMotionError, ConvergenceError):
        if failure is not None:
            raise failure from None
        return plain, []
    lost = [
        DroppedHalfTurn(
            session.cameras[i].name,
            index,
            session.half_turns[index].before,
            session.half_turns[index].after,
            why,
        )
        for index, why in sorted(found.details["dropped"].items())
    ]
    return found, lost
