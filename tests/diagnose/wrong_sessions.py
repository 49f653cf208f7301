"""Synthesised sessions with one thing wrong in each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.adjustment import adjust
from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.diagnose import Evidence, session_causes
from handeye_tri.diagnose.gates import Finding
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.records import Repeatability, Session
from handeye_tri.se3 import SE3
from handeye_tri.synthesize import Geometry, reference_geometry, synthesize

REPEATABILITY = Repeatability(3e-5, float(np.radians(0.005)))


def geometry(seed: int) -> Geometry:
    return reference_geometry(np.random.default_rng([seed, 0]))


def at_poses(cell: Geometry, poses: NDArray[np.float64]) -> Geometry:
    """The cell whose robot reports other poses, shape (n, 4, 4), metres."""
    return replace(
        cell,
        stations=tuple(
            replace(station, base_from_flange=SE3(pose))
            for station, pose in zip(cell.stations, poses, strict=True)
        ),
    )


def observed(seed: int, true: Geometry | None = None) -> Session:
    """What is seen of a cell; the same noise for the same seed."""
    session, _ = synthesize(
        geometry(seed) if true is None else true,
        np.random.default_rng([seed, 1]),
        sigma_px=0.02,
        repeatability=REPEATABILITY,
        marker_radii=(0.008, 0.008, 0.008),
    )
    return session


def with_views(session: Session, other: Session, views: object) -> Session:
    """The session with some views, an index of (m, n), of another one."""
    pixels, covariance = session.pixels.copy(), session.pixel_covariance.copy()
    pixels[views] = other.pixels[views]
    covariance[views] = other.pixel_covariance[views]
    return replace(session, pixels=pixels, pixel_covariance=covariance)


def moved(millimetres: float, degrees: float, seed: int) -> SE3:
    """A motion of that size in a random direction."""
    ways = np.random.default_rng(seed).normal(size=(2, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return SE3.exp(np.r_[1e-3 * millimetres * ways[0], np.radians(degrees) * ways[1]])


def told(session: Session, **evidence: object) -> tuple[Finding, ...]:
    """Calibrate jointly as a session's stages do, and name what is wrong."""
    cameras = calibrate_session_cameras(session)
    dropped = cameras.details["dropped"]
    used = session.without(dropped)
    calibration = adjust(used, calibrate_hand_eye(used, cameras))
    return session_causes(Evidence(session, calibration, dropped, **evidence))  # type: ignore[arg-type]
