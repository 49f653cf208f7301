"""Every view against what calibration and robot predict for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
from handeye_tri.evaluate.derivatives import by_tangent
from handeye_tri.records import DroppedHalfTurn, HandEyeCalibration, Session
from handeye_tri.triangle import VERTICES

Floats = NDArray[np.float64]
ViewCode = Literal["", "FAR", "UNSEEN", "LEFT OUT"]

# A residual of two normal components is longer than this many sigmas in one view of
# 25,000: exp(-4.5^2 / 2).
_FAR = 4.5


@dataclass(frozen=True, slots=True)
class ViewCheck:
    """One view and how well it fits.

    Attributes:
        camera: Name of the camera.
        station: Index of the station.
        held_out: Whether the calibration never saw the station.
        unseen: Letters of the markers that were not detected.
        rms_px: RMS distance of seen and predicted markers; NaN with none seen.
        worst: Letter of the marker with the most unlikely residual; empty with none.
        worst_px: Its distance, px.
        worst_sigmas: Its distance in standard deviations that pixel noise and the
            robot's repeatability explain (the calibration's own is left out).
        code: "FAR" beyond 4.5 sigmas, else "UNSEEN" where a marker is missing; "LEFT
            OUT" where calibration dropped the half-turn that the view belongs to.
    """

    camera: str
    station: int
    held_out: bool
    unseen: str
    rms_px: float
    worst: str
    worst_px: float
    worst_sigmas: float
    code: ViewCode


def predicted_pixels(calibration: HandEyeCalibration, session: Session) -> Floats:
    """Where every view should show the markers, by calibration and robot.

    The reported pose carries the calibrated markers before the calibrated cameras; a
    sphere is predicted by the centre of its outline.

    Returns:
        Shape (m, n, 3, 2), pixels; NaN behind a camera. Seen less predicted is the
        view's residual.
    """
    points = _reported(calibration, session)
    views = []
    for camera, motion in zip(
        calibration.cameras, calibration.base_from_camera, strict=True
    ):
        local = motion.inverse().apply(points)
        shift = sphere_shift(camera, local, session.marker_radii)
        views.append(camera.project(local) + shift)
    return np.array(views)


def check_views(
    calibration: HandEyeCalibration,
    session: Session,
    dropped: Sequence[DroppedHalfTurn] = (),
) -> tuple[ViewCheck, ...]:
    """Every view with its residual, the most unlikely first.

    Views in which nothing was seen come last; by camera and station where equal.

    Args:
        calibration: The calibrated cell.
        session: What was observed, without what was dropped.
        dropped: Half-turns that calibration left out.
    """
    left_out = {(one.camera, j) for one in dropped for j in (one.before, one.after)}
    residuals = session.pixels - predicted_pixels(calibration, session)
    expected = session.pixel_covariance + _by_robot(calibration, session)
    held_out = set(session.indices("evaluation").tolist())
    checks = []
    for i, camera in enumerate(calibration.cameras):
        for j in range(len(session.stations)):
            seen = np.isfinite(residuals[i, j]).all(axis=1)
            r = residuals[i, j]
            sigmas = np.zeros(3)
            if seen.any():
                weighed = np.linalg.solve(expected[i, j, seen], r[seen][..., None])
                square = (r[seen] * weighed[..., 0]).sum(axis=1)
                sigmas[seen] = np.sqrt(square)
            lengths = np.linalg.norm(r, axis=1)
            k = int(np.argmax(sigmas))
            unseen = "".join(VERTICES[k] for k in np.flatnonzero(~seen))
            code: ViewCode = "UNSEEN" if unseen else ""
            if (camera.name, j) in left_out:
                code = "LEFT OUT"
            checks.append(
                ViewCheck(
                    camera=camera.name,
                    station=j,
                    held_out=j in held_out,
                    unseen=unseen,
                    rms_px=float(np.sqrt(np.mean(lengths[seen] ** 2)))
                    if seen.any()
                    else float("nan"),
                    worst=VERTICES[k] if seen.any() else "",
                    worst_px=float(lengths[k]),
                    worst_sigmas=float(sigmas[k]),
                    code="FAR" if sigmas[k] > _FAR else code,
                )
            )
    return tuple(sorted(checks, key=lambda check: -check.worst_sigmas))


def _reported(calibration: HandEyeCalibration, session: Session) -> Floats:
    """Markers where the robot says that they are, shape (n, 3, 3), base, metres."""
    poses = session.base_from_flange
    markers = calibration.markers_at(session.mounts)
    turned = np.einsum("nab,nkb->nka", poses[:, :3, :3], markers)
    return np.asarray(turned + poses[:, None, :3, 3])


def _by_robot(calibration: HandEyeCalibration, session: Session) -> Floats:
    """Covariance of each projection by the repeatability, (m, n, 3, 2, 2), px^2."""
    points = _reported(calibration, session)
    rotation = session.base_from_flange[:, None, :3, :3]
    moved = rotation @ by_tangent(calibration.markers_at(session.mounts))
    views = []
    for camera, motion in zip(
        calibration.cameras, calibration.base_from_camera, strict=True
    ):
        _, by_point, _, _ = camera.project_jacobians(motion.inverse().apply(points))
        slope = by_point @ motion.rotation.T @ moved
        views.append(slope @ session.repeatability.covariance @ slope.mT)
    return np.array(views)
