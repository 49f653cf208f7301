"""The track as poses: what a robot's and the cameras' trajectory files hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.records import HandEyeCalibration, TrackEvaluation
from handeye_tri.se3 import nearest_rotation, so3_log

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TrackPoses:
    """Both tracks marker by marker: its position, and the flange's orientation.

    Attributes:
        rows: Rows of the evaluation that are in here, those of stations at which all
            three markers were observed, shape (r,).
        times: A number that increases and names station and marker, shape (r,): the
            station's index and a tenth for each marker after A.
        reported: In the base, shape (r, 4, 4), metres.
        observed: The same as the cameras see it, shape (r, 4, 4), metres.
    """

    rows: NDArray[np.intp]
    times: Floats
    reported: Floats
    observed: Floats

    @property
    def rotation_errors(self) -> Floats:
        """Angle between both orientations, one per station, shape (r / 3,), rad."""
        turn = self.reported[::3, :3, :3].mT @ self.observed[::3, :3, :3]
        return np.asarray(np.linalg.norm(so3_log(turn), axis=-1))


def track_poses(
    calibration: HandEyeCalibration,
    track: TrackEvaluation,
    mounts: NDArray[np.intp],
) -> TrackPoses:
    """Both tracks as poses.

    The observed orientation is that which turns the calibrated markers onto the
    observed ones with the least squares of distances (Kabsch 1976,
    doi:10.1107/S0567739476001873).

    Args:
        calibration: Has the markers on the flange.
        track: Both tracks.
        mounts: Which mount holds them at each station of the session, shape (n,).
    """
    complete = [
        j for j in np.unique(track.stations) if (track.stations == j).sum() == 3
    ]
    rows = np.flatnonzero(np.isin(track.stations, complete))
    stations, markers = track.stations[rows], track.markers[rows]
    count = len(complete)
    reported = np.tile(np.eye(4), (len(rows), 1, 1))
    observed = reported.copy()
    reported[:, :3, 3], observed[:, :3, 3] = track.reported[rows], track.observed[rows]
    carried = calibration.markers_at(mounts[stations[::3]])
    shape = carried - carried.mean(axis=1, keepdims=True)
    for poses in (reported, observed):
        seen = poses[:, :3, 3].reshape(count, 3, 3)
        seen = seen - seen.mean(axis=1, keepdims=True)
        poses[:, :3, :3] = np.repeat(nearest_rotation(seen.mT @ shape), 3, axis=0)
    return TrackPoses(rows, stations + 0.1 * markers, reported, observed)
