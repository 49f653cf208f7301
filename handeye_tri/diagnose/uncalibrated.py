"""Why a session does not calibrate at all: other readings of it are tried."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.adjustment import RobotParameters
from handeye_tri.calibrate_cameras import (
    calibrate_cameras_general,
    calibrate_session_cameras,
)
from handeye_tri.diagnose.best_half_turns import without_bad_half_turns
from handeye_tri.diagnose.gates import Finding, Verdict
from handeye_tri.diagnose.images import blurred_views, image_findings
from handeye_tri.diagnose.mounts import (
    mount_findings,
    other_changes,
    seen_turns,
    shown_mounts,
    with_mounts,
)
from handeye_tri.diagnose.pose_pairs import assess_pose_pairs
from handeye_tri.diagnose.session_causes import Evidence, session_causes, turn_findings
from handeye_tri.diagnose.sides import unit_words
from handeye_tri.errors import DegenerateMotionError, HandEyeError
from handeye_tri.hand_eye import (
    calibrate_hand_eye,
    solve_pose_pairs,
    solve_readings,
)
from handeye_tri.hand_eye.observed_poses import triangle_poses
from handeye_tri.records import (
    CameraCalibration,
    HandEyeCalibration,
    PosePairs,
    Session,
)
from handeye_tri.se3 import so3_log
from handeye_tri.triangle import VERTICES

Floats = NDArray[np.float64]

# A reading that calibrates is believed up to this chi2 per degree of freedom.
_BELIEVED = 4.0
_SHIFTS = {1: "after", -1: "before"}


def uncalibrated_verdict(error: HandEyeError, findings: Sequence[Finding]) -> Verdict:
    """What is left to say where calibration gave up: no gate can run.

    It is CANNOT TELL where motions are too poor to determine what was asked for, as
    nothing contradicts anything then, and FAIL otherwise.

    Args:
        error: What calibration gave up with.
        findings: What :func:`why_uncalibrated` names.
    """
    poor = isinstance(error, DegenerateMotionError)
    if findings:
        poor = findings[0].code == "MOTION"
    return Verdict(
        "CANNOT TELL" if poor else "FAIL",
        f"Not calibrated: {error}",
        (),
        "",
        tuple(findings),
    )


def why_uncalibrated(
    session: Session,
    *,
    min_plane_spread: float,
    joints: RobotParameters | None = None,
    edges: Floats | None = None,
) -> tuple[Finding, ...]:
    """Name what is wrong with a session on which calibration gave up.

    Half-turns that turn about the axis of another mount than is recorded are seen at
    once. Where the cameras calibrate, robot and cameras contradict each other: the tool
    change is tried before other stations, and the readings of bare pose pairs are
    solved: inverted, shifted, in another unit. Where they do not, images that belong to
    the next or the last station, or markers that bear each other's names everywhere,
    would make half-turns that are none. Last, the cameras are calibrated from those
    half-turns that agree, or else as if the motions were general ones, and the causes
    of :func:`session_causes` compete on that.

    Args:
        session: What was detected.
        min_plane_spread: Least accepted angle between half-turn planes, radians.
        joints: See :class:`Evidence`.
        edges: See :class:`Evidence`, (m, n, 3, 3), px^2; None where not measured.
    """
    if not session.half_turns:
        return ()
    few = _too_little_turning(session, min_plane_spread)
    if few is not None:
        return (few,)
    findings = image_findings(session, blurred_views(session, edges), edges)
    if findings:
        return tuple(findings)
    seen = seen_turns(session)
    if seen.half_turns != session.half_turns and _cameras(seen) is not None:
        return _on_seen_mounts(session, seen, joints, edges)
    cameras = _cameras(session)
    if cameras is not None:
        return _with_another_change(session, cameras, joints, edges) or _readings(
            session.without(cameras.details["dropped"]), cameras
        )
    # Shifted by two, half-turns are half-turns again: only robot and cameras together
    # tell which way.
    misfits = {word: _misfit(_shifted(session, k)) for k, word in _SHIFTS.items()}
    word = min(misfits, key=lambda word: misfits[word])
    if misfits[word] < _BELIEVED:
        return (
            Finding(
                "READING",
                f"each image belongs to the robot pose {word} it",
                f"so paired, chi2/dof of the loop is {misfits[word]:.2f}; as stated, "
                "the half-turns are none",
                "error",
                "find out which pose each image was taken at, and pair them anew",
            ),
        )
    for order in list(permutations(range(3)))[1:]:
        named = replace(
            session,
            pixels=session.pixels[:, :, list(order)],
            pixel_covariance=session.pixel_covariance[:, :, list(order)],
        )
        if _cameras(named) is not None:
            names = ", ".join(VERTICES[k] for k in order)
            return (
                Finding(
                    "LABELS",
                    f"the markers are named wrongly everywhere: A, B, C are {names}",
                    "so named, the cameras calibrate; as stated they do not",
                    "error",
                    "correct rig.marker_colours or marker_radii_mm, or the sides",
                ),
            )
    return (
        _on_the_best_half_turns(session, joints, edges)
        or _on_general_motions(session, joints)
        or tuple(turn_findings(session, frozenset()))
    )


def _on_the_best_half_turns(
    session: Session, joints: RobotParameters | None, edges: Floats | None
) -> tuple[Finding, ...]:
    """What is wrong, where more half-turns are bad than calibration leaves out."""
    lost = without_bad_half_turns(session)
    if lost is None:
        return ()
    used = session.without(lost)
    try:
        calibration = calibrate_hand_eye(used, calibrate_session_cameras(used))
        return session_causes(Evidence(session, calibration, lost, joints, edges))
    except HandEyeError:
        return ()


def _on_general_motions(
    session: Session, joints: RobotParameters | None
) -> tuple[Finding, ...]:
    """What is wrong, where the half-turns need not be half-turns."""
    infos = session.cameras
    held = session.indices("evaluation")
    pixels = session.pixels.copy()
    pixels[:, held] = np.nan
    try:
        cameras = calibrate_cameras_general(
            pixels,
            session.triangle,
            image_sizes=[info.image_size for info in infos],
            skew=all(info.skew for info in infos),
            distortion=infos[0].lens or None,
            covariance=session.pixel_covariance,
            names=[info.name for info in infos],
        )
        calibration = calibrate_hand_eye(session, cameras)
        return session_causes(Evidence(session, calibration, joints=joints))
    except HandEyeError:
        return ()


def _on_seen_mounts(
    session: Session,
    seen: Session,
    joints: RobotParameters | None,
    edges: Floats | None,
) -> tuple[Finding, ...]:
    """What is wrong, where half-turns turn about the axis of another mount."""
    mounts = shown_mounts(session, seen)
    try:
        shown = with_mounts(seen, mounts)
        cameras = calibrate_session_cameras(shown)
        lost = cameras.details["dropped"]
        calibration = calibrate_hand_eye(shown.without(lost), cameras)
    except HandEyeError:
        return tuple(mount_findings(session, mounts, seen.half_turns, ()))
    return session_causes(Evidence(shown, calibration, lost, joints, edges, session))


def _with_another_change(
    session: Session,
    cameras: CameraCalibration,
    joints: RobotParameters | None,
    edges: Floats | None,
) -> tuple[Finding, ...]:
    """What is wrong, where the tool change fits before another station."""
    lost = cameras.details["dropped"]
    best: tuple[float, Session, HandEyeCalibration] | None = None
    for other in other_changes(session):
        with contextlib.suppress(HandEyeError):
            found = calibrate_hand_eye(other.without(lost), cameras)
            misfit = found.chi2 / found.dof
            if misfit < (_BELIEVED if best is None else best[0]):
                best = misfit, other, found
    if best is None:
        return ()
    _, shown, calibration = best
    return session_causes(Evidence(shown, calibration, lost, joints, edges, session))


def _cameras(session: Session) -> CameraCalibration | None:
    """The calibrated cameras, None where they are not believable."""
    try:
        found = calibrate_session_cameras(session)
    except HandEyeError:
        return None
    return found if found.chi2 < _BELIEVED * found.dof else None


def _misfit(session: Session) -> float:
    """chi2 per degree of freedom of the loop; infinite where nothing calibrates."""
    cameras = _cameras(session)
    if cameras is None:
        return np.inf
    try:
        found = calibrate_hand_eye(session.without(cameras.details["dropped"]), cameras)
    except HandEyeError:
        return np.inf
    return found.chi2 / found.dof


def _shifted(session: Session, shift: int) -> Session:
    """Every image beside the pose of the station after it (1) or before it (-1)."""
    pixels = np.roll(session.pixels, shift, axis=1)
    covariance = np.roll(session.pixel_covariance, shift, axis=1)
    # What went round the end belongs nowhere.
    edge = 0 if shift > 0 else -1
    pixels[:, edge], covariance[:, edge] = np.nan, np.nan
    return replace(session, pixels=pixels, pixel_covariance=covariance)


def _too_little_turning(session: Session, least: float) -> Finding | None:
    """Whether the rig hardly turned but for the half-turns."""
    poses = session.base_from_flange[[turn.before for turn in session.half_turns]]
    rotations = poses[:, :3, :3]
    between = so3_log(np.swapaxes(rotations[:, None], -1, -2) @ rotations[None])
    spread = float(np.linalg.norm(between, axis=-1).max())
    if spread >= least:
        return None
    return Finding(
        "MOTION",
        "the planes of the half-turns are nearly parallel",
        f"the rig turned by {np.degrees(spread):.1f} degrees at most between "
        f"half-turns (needs {np.degrees(least):.0f})",
        "error",
        "add half-turns tilted by 30 degrees about another axis",
    )


def _readings(session: Session, cameras: CameraCalibration) -> tuple[Finding, ...]:
    """What the poses of robot and triangle say as bare pairs.

    Of stations with one mount: a pair knows but one place on the flange.
    """
    stations = session.indices("calibration")
    mounts = session.mounts[stations]
    stations = stations[mounts == np.bincount(mounts).argmax()]
    try:
        observed = triangle_poses(
            session.triangle,
            cameras,
            session.pixels[:, stations],
            session.pixel_covariance[:, stations],
            session.marker_radii,
        )
        pairs = PosePairs(
            session.base_from_flange[stations[observed.views]],
            observed.reference_from_triangle,
            "eye_to_hand",
            "flange_in_base",
            "target_in_camera",
        )
        solution = solve_pose_pairs(pairs)
        readings = solve_readings(solution, pairs)
        verdict = assess_pose_pairs(pairs, solution, readings, None)
    except HandEyeError:
        return ()
    factor = next(one.scale for one in readings if one.key == "scaled")
    named = [
        replace(one, code="UNIT", cause=one.cause + unit_words(factor))
        if one.code == "SCALE"
        else one
        for one in verdict.findings
    ]
    # Bare pairs that contradict each other do so for one reason.
    return (*named[:1], *(replace(one, follows=named[0].code) for one in named[1:]))
