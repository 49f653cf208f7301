"""The track error to expect anywhere the robot works, not only where it was tested."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.camera import triangulate
from handeye_tri.errors import InputError
from handeye_tri.evaluate.derivatives import (
    by_tangent,
    markers_by_parameters,
    observed_by_parameters,
)
from handeye_tri.evaluate.one_view import fixed_by_view, markers_by_view
from handeye_tri.records import HandEyeCalibration, Repeatability, Session

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TrackMap:
    """Predicted track error on a grid.

    Attributes:
        points: Of the grid in the base, shape (a, b, c, 3), metres.
        covariance: Of observed less reported position of a marker there, shape
            (a, b, c, 3, 3), m^2; NaN where fewer than two cameras see it (or the
            only one, whatever the orientation).
    """

    points: Floats
    covariance: Floats

    @property
    def rms(self) -> Floats:
        """Root mean square distance, shape (a, b, c), metres; NaN where unseen."""
        return np.asarray(np.sqrt(np.trace(self.covariance, axis1=-2, axis2=-1)))


def predicted_track_error(
    calibration: HandEyeCalibration,
    points: ArrayLike,
    orientations: ArrayLike,
    *,
    sigma_px: float = 0.0,
    repeatability: Repeatability | None = None,
    mount: int = 0,
) -> Floats:
    """Covariance of a marker's observed less reported position anywhere.

    Averaged over the three markers and over the flange's orientations, since how an
    error of the markers in the flange shows depends on them; with a single camera, over
    those orientations at which its view fixes the triangle's pose. Errors of estimated
    parameters of the robot are left out: they depend on its joints, not on where
    the marker is.

    Args:
        calibration: The cell with its covariance.
        points: Where the marker is, in the base, shape (..., 3), metres.
        orientations: Rotations base_from_flange, equally likely, shape (q, 3, 3).
        sigma_px: Noise of the views there, px; 0 for the calibration's part alone.
        repeatability: The robot's; None for the calibration's part alone.
        mount: Which mount holds the triangle, from 0.

    Returns:
        Shape (..., 3, 3), m^2; NaN where the point is in fewer than two images, or a
        single camera does not fix the triangle at any orientation.

    Raises:
        InputError: a shape does not fit.
    """
    where = np.asarray(points, dtype=float)
    turns = np.asarray(orientations, dtype=float)
    if where.ndim < 1 or where.shape[-1] != 3:
        raise InputError(f"points must have shape (..., 3), got {where.shape}")
    if turns.ndim != 3 or turns.shape[1:] != (3, 3) or len(turns) == 0:
        raise InputError(
            f"orientations must have shape (q, 3, 3), q at least 1, got {turns.shape}"
        )
    flat = where.reshape(-1, 3)
    if len(calibration.cameras) == 1:
        result = _by_one_view(calibration, flat, turns, sigma_px, repeatability, mount)
        return result.reshape(*where.shape, 3)
    pixels = np.full((len(calibration.cameras), len(flat), 2), np.nan)
    for i, camera in enumerate(calibration.cameras):
        seen = camera.project(calibration.base_from_camera[i].inverse().apply(flat))
        limit = np.array(camera.image_size, dtype=float) - 0.5
        inside = ((seen > -0.5) & (seen < limit)).all(axis=-1, keepdims=True)
        pixels[i] = np.where(inside, seen, np.nan)
    seen_by = np.isfinite(pixels).all(axis=-1)
    rows = np.flatnonzero(seen_by.sum(axis=0) >= 2)
    noise = np.where(seen_by[..., None, None], np.eye(2), np.nan)[:, rows]
    result = np.full((len(flat), 3, 3), np.nan)
    if len(rows):
        _, unit = triangulate(
            calibration.cameras, calibration.base_from_camera, pixels[:, rows], noise
        )
        observed = observed_by_parameters(calibration, flat[rows], unit, noise)
        matrix = calibration.covariance.matrix
        # Reported is R_j p_k: its first and second moments over j and k are enough.
        reported = turns[:, None] @ markers_by_parameters(calibration)[mount]
        mean = reported.mean(axis=(0, 1))
        cross = observed @ matrix @ mean.T
        result[rows] = (
            observed @ matrix @ observed.mT
            - cross
            - cross.mT
            + (reported @ matrix @ reported.mT).mean(axis=(0, 1))
            + sigma_px**2 * unit
        )
        if repeatability is not None:
            moved = turns[:, None] @ by_tangent(calibration.mounts[mount].markers)
            spread = moved @ repeatability.covariance @ moved.mT
            result[rows] += spread.mean(axis=(0, 1))
    return result.reshape(*where.shape, 3)


def _by_one_view(
    calibration: HandEyeCalibration,
    points: Floats,
    turns: Floats,
    sigma_px: float,
    repeatability: Repeatability | None,
    mount: int,
) -> Floats:
    """The same before a single camera, at points (k, 3): shape (k, 3, 3), m^2."""
    matrix = calibration.covariance.matrix
    total, count = np.zeros((len(points), 3, 3)), np.zeros(len(points))
    markers = calibration.mounts[mount].markers
    by_markers = markers_by_parameters(calibration)[mount]
    by_error = by_tangent(markers)
    held = np.full(len(points), mount)
    for turn in turns:
        for k, marker in enumerate(markers):
            poses = np.tile(np.eye(4), (len(points), 1, 1))
            poses[:, :3, :3], poses[:, :3, 3] = turn, points - turn @ marker
            rows = np.flatnonzero(fixed_by_view(calibration, poses, held))
            seen, by_pixels = markers_by_view(calibration, poses[rows], held[rows])
            caused = seen[:, k] - turn @ by_markers[k]
            total[rows] += caused @ matrix @ caused.mT
            total[rows] += sigma_px**2 * by_pixels[:, k] @ by_pixels[:, k].mT
            if repeatability is not None:
                moved = turn @ by_error[k]
                total[rows] += moved @ repeatability.covariance @ moved.T
            count[rows] += 1
    with np.errstate(invalid="ignore"):
        return np.asarray(total / count[:, None, None])


def track_map(
    calibration: HandEyeCalibration, session: Session, shape: tuple[int, int, int]
) -> TrackMap:
    """Predicted track error over the box in which the session's markers were.

    With the noise of the session's detections (its median) and robot, and with the
    orientations that its stations had. With several mounts it is the mean of theirs,
    each at the orientations of its own stations; where only some of them can be
    placed, of those.

    Args:
        calibration: The cell.
        session: Stations and noise.
        shape: Grid points along x, y, z of the base, each at least 2.

    Raises:
        InputError: the grid is too small, or nothing was detected.
    """
    if min(shape) < 2:
        raise InputError(f"shape must be at least 2 along each axis, got {shape}")
    variance = np.diagonal(session.pixel_covariance, axis1=-2, axis2=-1)
    if not np.isfinite(variance).any():
        raise InputError("the session has no detected marker; there is no noise to map")
    poses, mounts = session.base_from_flange, session.mounts
    markers = calibration.markers_at(mounts) @ poses[:, :3, :3].mT
    markers += poses[:, None, :3, 3]
    low, high = markers.min(axis=(0, 1)), markers.max(axis=(0, 1))
    axes = [np.linspace(low[k], high[k], shape[k]) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    by_mount = np.array(
        [
            predicted_track_error(
                calibration,
                points,
                poses[mounts == mount, :3, :3],
                sigma_px=float(np.sqrt(np.nanmedian(variance))),
                repeatability=session.repeatability,
                mount=mount,
            )
            for mount in np.unique(mounts).tolist()
        ]
    )
    placed = np.isfinite(by_mount).all(axis=(-2, -1), keepdims=True)
    with np.errstate(invalid="ignore"):
        mean = np.where(placed, by_mount, 0.0).sum(axis=0) / placed.sum(axis=0)
    return TrackMap(points, mean)
