"""From a calibrated session to its verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.degeneracy import plane_spread_deg
from handeye_tri.calibrate_cameras.half_turns import read_half_turns
from handeye_tri.calibrate_cameras.single_camera import self_check
from handeye_tri.diagnose.gates import (
    Finding,
    Verdict,
    half_turn_gate,
    judge,
    loop_gate,
    motion_gate,
    prediction_gate,
    scale_gate,
    touch_gate,
    track_gate,
)
from handeye_tri.hand_eye.observed_poses import triangle_poses
from handeye_tri.records import (
    CameraCalibration,
    HandEyeCalibration,
    Session,
    TrackEvaluation,
)
from handeye_tri.se3 import se3_inverse, so3_log

Floats = NDArray[np.float64]


def assess(
    session: Session,
    cameras: CameraCalibration,
    calibration: HandEyeCalibration,
    track: TrackEvaluation,
    *,
    track_limit: float,
    min_plane_spread: float,
) -> Verdict:
    """Run every gate on a calibrated session and draw the verdict.

    Args:
        session: What was observed, without the half-turns that the cameras dropped.
        cameras: Its calibrated cameras.
        calibration: Its calibrated cell.
        track: Its held-out track.
        track_limit: Largest accepted distance at a held-out station, metres.
        min_plane_spread: Least accepted angle between half-turn planes, radians.
    """
    found, expected = _half_turn_misfit(session)
    rotations = session.base_from_flange[session.indices("calibration"), :3, :3]
    before = [turn.before for turn in session.half_turns]
    planes = session.base_from_flange[before, :3, :3]
    turn = _rigs(calibration)[session.mounts[before], :3, :3]
    gates = (
        half_turn_gate(found, expected),
        motion_gate(
            plane_spread_deg((planes @ turn)[:, :, 2]),
            _axes_rank(rotations),
            float(np.degrees(min_plane_spread)),
        ),
        loop_gate(float(np.sqrt(calibration.chi2 / calibration.dof))),
        scale_gate(*free_scale(session, cameras, calibration)),
        track_gate(1e3 * track.max, 1e3 * track_limit),
        prediction_gate(track.rms / track.predicted_rms),
        touch_gate(),
    )
    radius = 1e3 * float(np.mean(radius_95(track.predicted_covariance)))
    places = "Where the robot says a marker is and where the cameras see it"
    verdict = judge(gates, f"{places} agree within {radius:.2f} mm (95 %, predicted).")
    if verdict.outcome != "PASS":
        sentence = (
            f"{places} are up to {1e3 * track.max:.2f} mm apart; {radius:.2f} mm "
            "(95 %) was predicted."
        )
        verdict = replace(verdict, sentence=sentence)
    dropped = cameras.details.get("dropped", ())
    if not dropped:
        return verdict
    finding = Finding(
        "DROPPED",
        "half-turns that disagree with the others were left out",
        "; ".join(str(one) for one in dropped),
        "warning",
        "look at those images, and repeat those half-turns where they are needed",
        tuple(sorted({j for one in dropped for j in (one.before, one.after)})),
        dropped[0].camera if len({one.camera for one in dropped}) == 1 else "",
    )
    return replace(verdict, findings=(*verdict.findings, finding))


def radius_95(covariance: Floats) -> Floats:
    """Radii that hold 95 % of zero-mean normal errors, shape (r,).

    The squared length is taken as a scaled chi-square of the same mean and variance
    (Patnaik 1949, doi:10.1093/biomet/36.1-2.202).

    Args:
        covariance: Shape (r, 3, 3).
    """
    # scipy.stats has the same quantile but takes a second to import.
    from scipy.special import gammaincinv

    mean = np.trace(covariance, axis1=1, axis2=2)
    variance = 2 * np.trace(covariance @ covariance, axis1=1, axis2=2)
    dof = 2 * mean**2 / variance
    return np.asarray(np.sqrt(mean / dof * 2 * gammaincinv(0.5 * dof, 0.95)))


def _half_turn_misfit(session: Session) -> tuple[float, float]:
    """Worst half-turn in the images and what noise explains, px."""
    before = [turn.before for turn in session.half_turns]
    after = [turn.after for turn in session.half_turns]
    true_side = session.triangle.side_ab
    worst = 0.0
    scale = []
    for i, camera in enumerate(session.cameras):
        data, _ = read_half_turns(
            session.pixels[i, before],
            session.pixels[i, after],
            session.triangle,
            camera.image_size,
            [turn.axis for turn in session.half_turns],
            1.0,
            None,
        )
        worst = max(worst, float(self_check(data).max()))
        side = np.linalg.norm(data.pixels[:, 0, 1] - data.pixels[:, 0, 0], axis=-1)
        scale.append(side.max() / true_side)
    noise = np.nanmean(session.pixel_covariance[..., [0, 1], [0, 1]])
    robot = session.repeatability
    # Two executed poses; a marker sits about one side away from the flange.
    moved = 2 * (robot.translation**2 + (robot.rotation * true_side) ** 2)
    return worst, float(np.sqrt(2 * noise + max(scale) ** 2 * moved))


def _axes_rank(rotations: Floats) -> int:
    """Dimension that the axes of the motions from the first pose span."""
    vectors = so3_log(np.swapaxes(rotations[:1], 1, 2) @ rotations[1:])
    angles = np.linalg.norm(vectors, axis=1)
    turning = vectors[angles > np.radians(5)]
    if len(turning) == 0:
        return 0
    values = np.linalg.svd(turning, compute_uv=False)
    return int((values > 0.05 * values[0]).sum())


def free_scale(
    session: Session, cameras: CameraCalibration, calibration: HandEyeCalibration
) -> tuple[float, float]:
    """Robot's lengths over the cameras' lengths, and its standard deviation.

    With the rotations of the hand-eye solution held, the translations of
    ``base_from_flange @ flange_from_triangle = base_from_camera @
    camera_from_triangle`` are linear in the unknown translations (of the cameras, and
    of each mount) and in a factor on the cameras' lengths. The standard deviation holds
    what the residuals show and what the cameras' own covariance adds: it moves all
    stations together.
    """
    stations = session.indices("calibration")
    observed = triangle_poses(
        session.triangle,
        cameras,
        session.pixels[:, stations],
        session.pixel_covariance[:, stations],
        session.marker_radii,
        start=se3_inverse(calibration.base_from_camera[0].matrix)
        @ session.base_from_flange[stations]
        @ _rigs(calibration)[session.mounts[stations]],
    )
    used = stations[observed.views]
    flange, mounts = session.base_from_flange[used], session.mounts[used]
    at = 3 * len(calibration.mounts)
    poses = observed.reference_from_triangle
    base_from_reference = calibration.base_from_camera[0].rotation
    rows = np.zeros((len(poses), 3, at + 4))
    for mount in range(len(calibration.mounts)):
        held = mounts == mount
        rows[held, :, 3 * mount : 3 * mount + 3] = -flange[held, :3, :3]
    rows[:, :, at : at + 3] = np.eye(3)
    rows[:, :, -1] = poses[:, :3, 3] @ base_from_reference.T
    matrix, target = rows.reshape(-1, at + 4), flange[:, :3, 3].ravel()
    inverse = np.linalg.pinv(matrix)
    solution = inverse @ target
    residual = target - matrix @ solution
    dof = len(target) - len(solution)
    by_residuals = residual @ residual / dof * inverse[-1] @ inverse[-1]
    moved = base_from_reference @ poses[:, :3, :3] @ observed.by_cameras[:, :3]
    gradient = -solution[-1] * inverse[-1] @ moved.reshape(len(target), -1)
    by_cameras = gradient @ cameras.covariance.matrix @ gradient
    return float(solution[-1]), float(np.sqrt(by_residuals + by_cameras))


def _rigs(calibration: HandEyeCalibration) -> Floats:
    """How each mount holds the triangle on the flange, shape (k, 4, 4), metres."""
    return np.array([mount.flange_from_triangle.matrix for mount in calibration.mounts])
