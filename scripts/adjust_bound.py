"""The Cramer-Rao bound of a cell that is adjusted jointly, for `check_adjust.py`.

From numerical derivatives of the cameras' projections at the truth, not from the
package's own Jacobians. Unknown are two cameras (intrinsics 5, place 6 each), the
markers on each mount of the triangle (9) and the pose of the flange at each station.
"""

import numpy as np

from handeye_tri.camera import Intrinsics, PinholeCamera
from handeye_tri.se3 import SE3, se3_exp

CAMERAS = 22


def markers_of(truth):
    """A, B, C in the flange frame on each mount, (k, 3, 3), metres."""
    return np.array([truth.markers, *(mount.markers for mount in truth.other_mounts)])


def forward(truth, mounts, poses, change, own):
    """Pixels (m, n, 3, 2) with the shared unknowns and each pose changed."""
    poses = poses @ se3_exp(own)
    markers = markers_of(truth) + change[CAMERAS:].reshape(-1, 3, 3)
    points = np.einsum("nab,nkb->nka", poses[:, :3, :3], markers[mounts])
    points = points + poses[:, None, :3, 3]
    views = []
    for i, camera in enumerate(truth.cameras):
        step = change[11 * i : 11 * i + 11]
        place = truth.base_from_camera[i] @ SE3.exp(step[5:])
        vector = camera.intrinsics.vector + step[:5]
        seen = PinholeCamera(
            camera.name, Intrinsics.from_vector(vector), camera.image_size
        )
        views.append(seen.project(place.inverse().apply(points)))
    return np.array(views)


def slopes(truth, mounts, poses):
    """Derivatives of pixels by the shared unknowns and by each pose, by differences."""
    g = CAMERAS + markers_of(truth).size
    step = np.r_[np.tile([*[1e-2] * 5, *[1e-5] * 6], 2), np.full(g - CAMERAS, 1e-5)]
    zero, still = np.zeros(g), np.zeros((len(poses), 6))
    shared, own = [], []
    for k in range(g):
        change = step[k] * np.eye(g)[k]
        plus = forward(truth, mounts, poses, change, still)
        shared.append(
            (plus - forward(truth, mounts, poses, -change, still)) / (2 * step[k])
        )
    for k in range(6):
        turn = 1e-5 * np.eye(6)[k]
        plus = forward(truth, mounts, poses, zero, still + turn)
        own.append((plus - forward(truth, mounts, poses, zero, still - turn)) / 2e-5)
    return np.stack(shared, -1), np.stack(own, -1)


def bound(session, truth, sigma_px, robot):
    """Covariances of observed less reported that no unbiased estimator beats."""
    reported, mounts = session.base_from_flange, session.mounts
    markers = markers_of(truth)
    g = CAMERAS + markers.size
    kinds = np.array([station.kind == "calibration" for station in session.stations])
    seen = np.isfinite(session.pixels)[..., None]
    shared, own = slopes(truth, mounts, reported)
    shared, own = (np.where(seen, slope, 0.0) / sigma_px for slope in (shared, own))
    information = np.zeros((g, g))
    for j in np.flatnonzero(kinds):
        by_shared, by_own = shared[:, j].reshape(-1, g), own[:, j].reshape(-1, 6)
        noise = np.eye(len(by_own)) + by_own @ robot.covariance @ by_own.T
        information += by_shared.T @ np.linalg.solve(noise, by_shared)
    scale = 1 / np.sqrt(np.diagonal(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale))
    covariance *= np.outer(scale, scale)
    parts = []
    for j in np.flatnonzero(~kinds):
        rotation = reported[j, :3, :3]
        for k in range(3):
            if not seen[:, j, k].all():
                continue
            # A point's slope is that of the pose's translation, turned into the base.
            by_point = own[:, j, k].reshape(-1, 6)[:, :3] @ rotation.T
            by_camera = shared[:, j, k].reshape(-1, g).copy()
            by_camera[:, CAMERAS:] = 0.0
            inverse = np.linalg.inv(by_point.T @ by_point)
            slope = -inverse @ by_point.T @ by_camera
            start = CAMERAS + 9 * mounts[j] + 3 * k
            slope[:, start : start + 3] -= rotation
            lever = markers[mounts[j], k]
            cross = np.cross(np.eye(3), lever).T
            by_robot = rotation @ np.hstack([np.eye(3), -cross.T])
            parts.append(
                slope @ covariance @ slope.T
                + inverse
                + by_robot @ robot.covariance @ by_robot.T
            )
    return np.array(parts)


def mean_length(covariances, rng):
    """Mean length of normal errors with these covariances, m."""
    roots = np.linalg.cholesky(covariances)
    draws = roots @ rng.standard_normal((len(roots), 3, 4000))
    return float(np.linalg.norm(draws, axis=1).mean())
