"""The hand-eye step of a session: cameras in the base, the rig on the flange."""

from __future__ import annotations

import contextlib

import numpy as np
from numpy.typing import NDArray

from handeye_tri import arguments
from handeye_tri.counting import counted
from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.hand_eye.absolute import solve_axzb
from handeye_tri.hand_eye.mounts import motions_by_mount, solve_mounts
from handeye_tri.hand_eye.observed_poses import ObservedPoses, triangle_poses
from handeye_tri.hand_eye.refine import Refinement, refine_axzb
from handeye_tri.hand_eye.relative import RELATIVE_METHODS, solve_axxb
from handeye_tri.records import (
    CameraCalibration,
    Covariance,
    HandEyeCalibration,
    Mount,
    Session,
    motion_labels,
    triangle_name,
)
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]


def calibrate_hand_eye(
    session: Session, cameras: CameraCalibration
) -> HandEyeCalibration:
    """Solve ``base_from_flange @ flange_from_triangle = base_from_camera @ ...``.

    At each calibration station the known triangle's pose is fitted to all cameras'
    pixels; then AX = ZB in closed form (Shah 2013) and by maximum likelihood,
    weighed by the robot's repeatability and by each pose's own covariance.

    Where the triangle changes its mount, each mount has its own X and all share one Z.
    Relative motions in the base, between stations with the same mount, do not depend on
    X: those of all mounts together give Z in closed form (AX = XB, Park and Martin
    1994) and decide whether it is determined. Every X follows from its stations, and
    maximum likelihood refines all at once.

    The covariance holds the cameras' parameters too, consistently: an error of the
    cameras moves every pose and through them both motions; this is propagated
    linearly (implicit function theorem at both optima) and added to what pixels and
    robot noise contribute. The two are taken as uncorrelated although the cameras
    were calibrated from the same pixels. That is exact to first order when the
    cameras come from a bundle with a free pose per station: the error of maximum-
    likelihood parameters is uncorrelated with that of nuisance poses re-estimated
    with the true parameters. Where the bundle also used that a pair of stations is
    a half-turn, a small correlation is left out.

    Args:
        session: Calibration stations are used, evaluation stations are not.
        cameras: The session's cameras, in its order.

    Returns:
        chi2 allows for the cameras' covariance, so that chi2 / dof is 1 if all
        stated noise is right; residuals are of the stations used, in order.

    Raises:
        InputError: cameras and session do not fit, or fewer than three calibration
            stations show all markers to two cameras (or to the only one), or fewer
            than two do with one of several mounts; names the mount.
        DegenerateMotionError: the stations do not determine the motions.
        ConvergenceError: an iteration did not settle.
    """
    arguments.record("session", session, Session)
    arguments.record("cameras", cameras, CameraCalibration)
    names = tuple(camera.name for camera in cameras.cameras)
    expected = tuple(info.name for info in session.cameras)
    if names != expected:
        raise InputError(
            f"the calibrated cameras are ({', '.join(names)}), the session's are "
            f"({', '.join(expected)}); give them in the session's order"
        )
    stations = session.indices("calibration")
    if len(stations) < 3:
        raise InputError(
            f"the session has {len(stations)} calibration stations; at least 3 needed"
        )
    observed = triangle_poses(
        session.triangle,
        cameras,
        session.pixels[:, stations],
        session.pixel_covariance[:, stations],
        session.marker_radii,
        start=_rough(cameras, stations),
    )
    if len(observed.views) < 3:
        raise InputError(
            f"only {len(observed.views)} of {len(stations)} calibration stations show "
            "all three markers to two cameras (or to the only one, in a half-turn); at "
            "least 3 are needed"
        )
    a = session.base_from_flange[stations[observed.views]]
    b = observed.reference_from_triangle
    mounts = session.mounts[stations[observed.views]]
    _check_mounts(mounts, 1 + int(session.mounts.max()))
    xs, z = solve_mounts(a, b, mounts)
    refined = refine_axzb(
        a,
        b,
        list(xs.values()),
        z,
        session.repeatability.covariance,
        observed.covariance,
        mounts,
    )
    first, *others = (Mount(x, x.apply(session.triangle.points)) for x in refined.xs)
    return HandEyeCalibration(
        cameras=cameras.cameras,
        base_from_camera=tuple(
            refined.z @ motion for motion in cameras.reference_from_camera
        ),
        flange_from_triangle=first.flange_from_triangle,
        markers=first.markers,
        other_mounts=tuple(others),
        covariance=_joint_covariance(cameras, observed, refined),
        chi2=_chi2(cameras, observed, refined),
        dof=6 * len(a) - len(refined.covariance),
        residuals=refined.residuals,
        method="AX=ZB: Shah, then maximum likelihood"
        if len(xs) == 1
        else f"AX=ZB with {len(xs)} X: Park and Martin, then maximum likelihood",
        alternatives=_alternatives(a, b, mounts),
    )


def _check_mounts(mounts: Indices, count: int) -> None:
    """Refuse mounts that have too few of the stations used, mounts of shape (n,)."""
    used = np.bincount(mounts, minlength=count)
    if count > 1 and used.min() < 2:
        raise InputError(
            f"mount {1 + int(used.argmin())} of the triangle has "
            f"{counted(int(used.min()), 'calibration station')} with all three markers "
            "in two cameras (or in the only one, in a half-turn), and each mount needs "
            "2 or more; add stations with it, or leave its stations out"
        )


def _rough(
    cameras: CameraCalibration, stations: NDArray[np.intp]
) -> NDArray[np.float64] | None:
    """Where the cameras' calibration left the triangle, (n, 4, 4), if it says so."""
    poses = cameras.details.get("reference_from_triangle")
    return None if poses is None else np.asarray(poses[stations])


def _joint_covariance(
    cameras: CameraCalibration, observed: ObservedPoses, refined: Refinement
) -> Covariance:
    """Covariance of the cameras' parameters and of all motions in the base."""
    p, q = len(cameras.covariance.labels), len(refined.covariance)
    # Everything is linear in (camera parameters, statistical error of every X and Z).
    by_sources = np.zeros((p + q, p + q))
    by_sources[:p, :p] = np.eye(p)
    by_sources[p:, :p] = np.einsum("tni,nip->tp", refined.by_b, observed.by_cameras)
    by_sources[p:, p:] = np.eye(q)
    of_xs, of_z = by_sources[p:-6], by_sources[-6:]
    rows, labels = [by_sources[:p]], list(cameras.covariance.labels)
    for i, (camera, motion) in enumerate(
        zip(cameras.cameras, cameras.reference_from_camera, strict=True)
    ):
        # Z exp(dz) M exp(dm) = Z M exp(Ad(M^-1) dz) exp(dm).
        row = motion.inverse().adjoint() @ of_z
        if i > 0:
            names = motion_labels(f"reference_from_{camera.name}")
            row[:, [labels.index(name) for name in names]] += np.eye(6)
        rows.append(row)
        labels.extend(motion_labels(f"base_from_{camera.name}"))
    rows.append(of_xs)
    for mount in range(len(refined.xs)):
        labels.extend(motion_labels(triangle_name(mount)))
    total = np.concatenate(rows)
    sources = np.zeros((p + q, p + q))
    sources[:p, :p] = cameras.covariance.matrix
    sources[p:, p:] = refined.covariance
    matrix = total @ sources @ total.T
    return Covariance(tuple(labels), 0.5 * (matrix + matrix.T))


def _chi2(
    cameras: CameraCalibration, observed: ObservedPoses, refined: Refinement
) -> float:
    """Minimum of the whitened squares over X, Z and the cameras with their prior.

    The cameras' errors are common to all stations and belong to the stated noise:
    with c = L y, L L' their covariance and y standard normal, this is the residual
    of a linear least-squares problem in (X, Z, y).
    """
    covariance = cameras.covariance.matrix
    std = np.sqrt(np.diagonal(covariance))
    values, vectors = np.linalg.eigh(cameras.covariance.correlation())
    root = std[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    by_y = refined.residuals_by_b @ observed.by_cameras @ root
    design = np.concatenate([refined.gradient, by_y], axis=2)
    weighted = np.swapaxes(design, 1, 2) @ refined.precision
    normal = np.einsum("npi,niq->pq", weighted, design)
    q = len(refined.covariance)
    normal[q:, q:] += np.eye(len(std))
    right = np.einsum("npi,ni->p", weighted, refined.residuals)
    scale = 1.0 / np.sqrt(np.diagonal(normal))
    solution = scale * np.linalg.solve(normal * scale[:, None] * scale, scale * right)
    return float(refined.chi2 - right @ solution)


def _alternatives(a: Floats, b: Floats, mounts: Indices) -> dict[str, SE3]:
    """base_from_<first camera> by every other solver; AX = ZB knows but one mount."""
    found: dict[str, SE3] = {}
    left, right = motions_by_mount(a, b, mounts)
    for method in RELATIVE_METHODS:
        with contextlib.suppress(DegenerateMotionError):
            found[method] = solve_axxb(left, right, method=method)
    if mounts.any():
        return found
    found["shah"] = solve_axzb(a, b)[1]
    with contextlib.suppress(DegenerateMotionError):
        found["li"] = solve_axzb(a, b, method="li")[1]
    return found
