"""A cell whose triangle changes its mount, calibrated by hand from the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import Intrinsics, PinholeCamera
from handeye_tri.records import (
    Covariance,
    HandEyeCalibration,
    Mount,
    Repeatability,
    Session,
    marker_labels,
    motion_labels,
)
from handeye_tri.se3 import SE3
from handeye_tri.synthesize import Geometry, synthesize, two_mount_geometry

Floats = NDArray[np.float64]
RNG = np.random.default_rng
REPEATABILITY = Repeatability(3e-5, float(np.radians(0.005)))
NAMES = ("left", "right")
LABELS = (
    *(f"{name}.{one}" for name in NAMES for one in ("fx", "fy", "skew", "cx", "cy")),
    *(label for name in NAMES for label in motion_labels(f"base_from_{name}")),
    *(label for name in NAMES[1:] for label in motion_labels(f"reference_from_{name}")),
    *marker_labels(0),
    *marker_labels(1),
    *motion_labels("flange_from_triangle"),
    *motion_labels("flange_from_triangle_2"),
)
# Free parameters; other motions follow from them.
FREE = 40
_FOLLOWING = ("reference_from", "flange_from_triangle")
_STD = np.array(
    [0.3, 0.3, 0.1, 0.2, 0.2] * 2
    + ([3e-5] * 3 + [1e-4] * 3) * 2
    + [2e-5] * 9
    + [6e-5] * 9
)


def geometry(seed: int = 0, **options: object) -> Geometry:
    return two_mount_geometry(RNG([seed, 0]), **options)  # type: ignore[arg-type]


def observed(true: Geometry, seed: int, sigma_px: float = 0.02) -> Session:
    session, _ = synthesize(
        true,
        RNG([seed, 1]),
        sigma_px=sigma_px,
        repeatability=REPEATABILITY,
        marker_radii=(0.008, 0.008, 0.008),
    )
    return session


def free_covariance(seed: int = 9) -> Floats:
    """Of the free parameters, correlated, shape (40, 40)."""
    mixed = RNG(seed).normal(size=(FREE, FREE)) / np.sqrt(FREE) + np.eye(FREE)
    root = _STD[:, None] * mixed
    return root @ root.T


def calibrated(true: Geometry, covariance: Floats, step: Floats) -> HandEyeCalibration:
    """The true cell with its free parameters changed by a step, shape (40,)."""
    places = tuple(
        motion @ SE3.exp(step[10 + 6 * i : 16 + 6 * i])
        for i, motion in enumerate(true.base_from_camera)
    )
    mounts = []
    for k, motion in enumerate((true.flange_from_triangle, *true.other_mounts)):
        move = step[22 + 9 * k : 31 + 9 * k].reshape(3, 3)
        mounts.append(Mount(motion, motion.apply(true.triangle.points) + move))
    whole = np.zeros((len(LABELS), len(LABELS)))
    rows = [k for k, name in enumerate(LABELS) if not name.startswith(_FOLLOWING)]
    whole[np.ix_(rows, rows)] = covariance
    return HandEyeCalibration(
        cameras=tuple(
            PinholeCamera(
                camera.name,
                Intrinsics.from_vector(
                    camera.intrinsics.vector + step[5 * i : 5 * i + 5]
                ),
                camera.image_size,
            )
            for i, camera in enumerate(true.cameras)
        ),
        base_from_camera=places,
        flange_from_triangle=mounts[0].flange_from_triangle,
        markers=mounts[0].markers,
        covariance=Covariance(LABELS, whole),
        chi2=0.0,
        dof=1,
        residuals=np.zeros((1, 6)),
        method="drawn",
        other_mounts=tuple(mounts[1:]),
    )


def only_camera(calibration: HandEyeCalibration) -> HandEyeCalibration:
    """What is known of the first camera and the rig."""
    labels = [name for name in LABELS if "right" not in name]
    return replace(
        calibration,
        cameras=calibration.cameras[:1],
        base_from_camera=calibration.base_from_camera[:1],
        covariance=Covariance(tuple(labels), calibration.covariance.block(labels)),
    )


def seen_by_the_first(session: Session) -> Session:
    return replace(
        session,
        cameras=session.cameras[:1],
        pixels=session.pixels[:1],
        pixel_covariance=session.pixel_covariance[:1],
    )
