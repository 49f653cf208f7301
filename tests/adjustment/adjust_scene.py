"""Cells for the adjustment's tests: true, and as separate steps would leave them."""

import dataclasses

import numpy as np

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.records import (
    Covariance,
    HandEyeCalibration,
    Mount,
    Repeatability,
    Station,
    marker_labels,
    triangle_name,
)
from handeye_tri.se3 import SE3, se3_exp
from handeye_tri.synthesize import (
    Geometry,
    look_at,
    reference_geometry,
    synthesize,
    two_mount_geometry,
)

ROBOT = Repeatability(3e-5, float(np.radians(0.005)))
EXACT = Repeatability(0.0, 0.0)
LENS = Lens("radtan", np.array([-0.12, 0.04, 5e-4, -3e-4, 0.0]))


def rough(truth, rng, size=1.0):
    """A cell near the true one: 0.5 % in focal length, 1 mm, 2 mrad."""
    cameras = []
    for camera in truth.cameras:
        change = size * np.array([8.0, 8.0, 0.0, 4.0, 4.0]) * rng.normal(size=5)
        cameras.append(
            PinholeCamera(
                camera.name,
                Intrinsics.from_vector(camera.intrinsics.vector + change),
                camera.image_size,
                Lens(camera.lens.model, camera.lens.coefficients * (1 + 0.05 * size)),
            )
        )

    def moved(motion):
        tangent = np.r_[1e-3 * rng.normal(size=3), 2e-3 * rng.normal(size=3)]
        return motion @ SE3.exp(size * tangent)

    frame = moved(truth.flange_from_triangle)
    points = truth.flange_from_triangle.inverse().apply(truth.markers)
    places = tuple(moved(motion) for motion in truth.base_from_camera)
    others = [moved(mount.flange_from_triangle) for mount in truth.other_mounts]
    return HandEyeCalibration(
        tuple(cameras),
        places,
        frame,
        frame.apply(points),
        Covariance(("left.fx",), np.eye(1)),
        0.0,
        1,
        np.zeros((1, 6)),
        "drawn",
        {"shah": truth.base_from_camera[0]},
        other_mounts=tuple(Mount(motion, motion.apply(points)) for motion in others),
    )


def cell(seed=0, noise=1, **options):
    """Session, truth and a rough start; options split between the two makers.

    ``axes`` instead of ``axis``: two mounts, with as many stations each.
    """
    make = two_mount_geometry if "axes" in options else reference_geometry
    keys = ("axis", "axes", "skew", "lens", "half_turns", "evaluation_stations")
    made = {key: options.pop(key) for key in keys if key in options}
    geometry = make(np.random.default_rng([seed, 0]), **made)
    session, truth = synthesize(
        geometry, np.random.default_rng([seed, noise]), **options
    )
    return session, truth, rough(truth, np.random.default_rng([seed, 2]))


def ring(m, n, rng, sigma_px=0.1, repeatability=ROBOT, half_turns=()):
    """m cameras on an arc around n stations, all turned about all axes."""
    base = reference_geometry(np.random.default_rng(0), half_turns=3)
    target = np.array([0.45, 0.0, 0.42])
    cameras, places = [], []
    for i in range(m):
        angle = (i - 0.5 * (m - 1)) * min(0.28, 1.6 / max(m - 1, 1))
        position = target + 0.9 * np.array([np.cos(angle), np.sin(angle), 0.1])
        places.append(look_at(position, target))
        intrinsics = Intrinsics(1720.0 + i, 1715.0 - i, 0.0, 511.0 + i, 383.0)
        cameras.append(PinholeCamera(f"camera_{i}", intrinsics, (1024, 768)))
    nominal = np.array([s.base_from_flange.matrix for s in base.stations[:6:2]])
    poses = nominal[rng.integers(0, 3, n)] @ se3_exp(
        np.r_[np.full(3, 0.01), np.full(3, 0.25)] * rng.normal(size=(n, 6))
    )
    stations = tuple(
        Station(j, "calibration", np.empty(0), SE3(pose))
        for j, pose in enumerate(poses)
    )
    geometry = Geometry(
        base.triangle,
        base.flange_from_triangle,
        tuple(cameras),
        tuple(places),
        stations,
        half_turns,
    )
    return synthesize(
        geometry,
        rng,
        sigma_px=sigma_px,
        repeatability=repeatability,
        estimate_skew=False,
    )


def hide(session, hidden):
    """The session without the detections where hidden, (m, n, 3), is true."""
    return dataclasses.replace(
        session,
        pixels=np.where(hidden[..., None], np.nan, session.pixels),
        pixel_covariance=np.where(
            hidden[..., None, None], np.nan, session.pixel_covariance
        ),
    )


def errors(found, truth):
    """Truth less estimate of the labelled quantities: tangents of motions."""
    values = {}
    first = truth.base_from_camera[0].inverse()
    reference = found.base_from_camera[0].inverse()
    true_first = Mount(truth.flange_from_triangle, truth.markers)
    mounts = list(zip(found.mounts, (true_first, *truth.other_mounts), strict=True))
    motions = {
        triangle_name(k): (mine.flange_from_triangle, true.flange_from_triangle)
        for k, (mine, true) in enumerate(mounts)
    }
    for i, (a, b) in enumerate(zip(found.cameras, truth.cameras, strict=True)):
        names = ("fx", "fy", "skew", "cx", "cy", *a.lens.names)
        left = np.r_[a.intrinsics.vector, a.lens.coefficients]
        right = np.r_[b.intrinsics.vector, b.lens.coefficients]
        for name, value in zip(names, right - left, strict=True):
            values[f"{a.name}.{name}"] = value
        pair = found.base_from_camera[i], truth.base_from_camera[i]
        motions[f"base_from_{a.name}"] = pair
        motions[f"reference_from_{a.name}"] = reference @ pair[0], first @ pair[1]
    for owner, (a, b) in motions.items():
        tangent = (a.inverse() @ b).log()
        for name, value in zip(("x", "y", "z", "rx", "ry", "rz"), tangent, strict=True):
            values[f"{owner}.{name}"] = value
    for k, (mine, true) in enumerate(mounts):
        difference = (true.markers - mine.markers).ravel()
        values |= dict(zip(marker_labels(k), difference, strict=True))
    return values
