"""Sessions without images: known marker centres projected, and noise added.

The result has the same form as one from rendered images or from a real robot, so
that estimators can be measured in milliseconds against a known truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.camera.outlines import outline_centroids
from handeye_tri.errors import InputError, NoPlanError
from handeye_tri.records import (
    CameraInfo,
    GroundTruth,
    HalfTurn,
    Mount,
    Repeatability,
    Session,
    Station,
    StationKind,
)
from handeye_tri.se3 import SE3, se3_exp, se3_inverse, so3_exp
from handeye_tri.triangle import Axis, TriangleRig

Floats = NDArray[np.float64]

REFERENCE_TRIANGLE = TriangleRig(0.13, 0.12, float(np.radians(65)))
_FLANGE_FROM_TRIANGLE = SE3.exp((0.02, -0.03, 0.09, 0.15, -0.1, 0.35))
# The same triangle on another holder.
_SECOND_MOUNT = SE3.exp((-0.04, 0.02, 0.11, 1.2, 0.4, -0.6))
# The box in which the reference stations keep the triangle's centroid, metres in base.
_WORKSPACE = np.array([[0.35, -0.15, 0.27], [0.60, 0.15, 0.57]])
_LOOK_AT = np.array([0.45, 0.0, 0.42])
_TILT = np.radians([10.0, 55.0])
_MIN_PLANE_ANGLE = np.radians(20.0)
# Markers stay this far from the image's border, pixels.
_MARGIN = 25.0
_MAX_CANDIDATES = 400


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """A cell as it truly is, and where the robot is told to go.

    Attributes:
        triangle: The three-point rig.
        flange_from_triangle: How it sits on the flange.
        cameras: The m cameras.
        base_from_camera: Where they stand.
        stations: The n stations with their commanded poses.
        half_turns: Pairs of calibration stations.
        other_mounts: How the triangle sits after a tool change.
    """

    triangle: TriangleRig
    flange_from_triangle: SE3
    cameras: tuple[PinholeCamera, ...]
    base_from_camera: tuple[SE3, ...]
    stations: tuple[Station, ...]
    half_turns: tuple[HalfTurn, ...]
    other_mounts: tuple[SE3, ...] = ()

    def followed_by(self, then: Geometry) -> Geometry:
        """This programme, a tool change, then the other one.

        Args:
            then: The same triangle and cameras; its own mount becomes the last.

        Raises:
            InputError: it has a tool change already.
        """
        if then.other_mounts:
            raise InputError(
                "then must have one mount, got "
                f"{1 + len(then.other_mounts)}; follow with one after the other"
            )
        count, mount = len(self.stations), 1 + len(self.other_mounts)
        stations = (
            replace(station, index=count + station.index, mount=mount)
            for station in then.stations
        )
        turns = (
            HalfTurn(count + turn.before, count + turn.after, turn.axis)
            for turn in then.half_turns
        )
        return replace(
            self,
            stations=(*self.stations, *stations),
            half_turns=(*self.half_turns, *turns),
            other_mounts=(*self.other_mounts, then.flange_from_triangle),
        )


def look_at(position: ArrayLike, target: ArrayLike) -> SE3:
    """Optical frame of a camera whose rows are level (base z is up).

    Args:
        position: Shape (3,), metres.
        target: A point on the optical axis, shape (3,), metres.

    Returns:
        ``base_from_camera``.

    Raises:
        InputError: the camera would look straight up or down.
    """
    centre = np.asarray(position, dtype=float)
    forward = np.asarray(target, dtype=float) - centre
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-6:
        raise InputError("look_at: position and target must not be above each other")
    right /= np.linalg.norm(right)
    return SE3.from_parts(
        np.stack([right, np.cross(forward, right), forward], axis=1), centre
    )


def reference_geometry(
    rng: np.random.Generator,
    *,
    half_turns: int = 11,
    evaluation_stations: int = 6,
    axis: Axis = "normal",
    skew: float = 0.0,
    lens: Lens | None = None,
    triangle: TriangleRig = REFERENCE_TRIANGLE,
    flange_from_triangle: SE3 = _FLANGE_FROM_TRIANGLE,
    baseline: float = 0.25,
    distance: float = 0.9,
) -> Geometry:
    """A converging stereo pair before a rig that makes half-turns.

    No robot model: poses are drawn freely in a box before the cameras, with the
    triangle's plane tilted 10 to 55 degrees, in view of both cameras before and
    after each half-turn, and successive planes at least 20 degrees apart
    (Proposition 1 of Zhao, Liu and Zhang 2008, doi:10.1109/TIP.2008.2005562).

    Args:
        rng: Source of the poses.
        half_turns: How many; two calibration stations each.
        evaluation_stations: How many held-out stations follow.
        axis: What the half-turns turn about.
        skew: Skew factor of both cameras, pixels.
        lens: Lens of both cameras; None for pinholes.
        triangle: The rig.
        flange_from_triangle: How it sits on the flange.
        baseline: Distance of the two cameras, metres.
        distance: From the cameras to the workspace, metres.

    Raises:
        NoPlanError: a station found no pose in 400 candidates.
    """
    values = ((1720.0, 1715.0, 519.3, 377.8), (1712.0, 1718.0, 503.6, 390.2))
    cameras = tuple(
        PinholeCamera(name, Intrinsics(fx, fy, skew, cx, cy), (1024, 768), lens)
        if lens is not None
        else PinholeCamera(name, Intrinsics(fx, fy, skew, cx, cy), (1024, 768))
        for name, (fx, fy, cx, cy) in zip(("left", "right"), values, strict=True)
    )
    base_from_camera = tuple(
        look_at(_LOOK_AT + (distance, sign * 0.5 * baseline, 0.03), _LOOK_AT)
        for sign in (1.0, -1.0)
    )
    turn = triangle.half_turn(
        axis, triangle.circumcentre if axis == "normal" else None
    ).matrix
    triangle_from_flange = se3_inverse(flange_from_triangle.matrix)
    poses: list[Floats] = []
    turns: list[HalfTurn] = []
    normal: Floats | None = None
    for number in range(half_turns + evaluation_stations):
        calibrating = number < half_turns
        base_from_triangle = _draw_triangle_pose(
            rng,
            triangle,
            cameras,
            base_from_camera,
            turn if calibrating else None,
            normal,
        )
        normal = base_from_triangle[:3, 2]
        poses.append(base_from_triangle @ triangle_from_flange)
        if calibrating:
            poses.append(base_from_triangle @ turn @ triangle_from_flange)
            turns.append(HalfTurn(2 * number, 2 * number + 1, axis))
    stations = tuple(
        Station(j, _kind(j, 2 * half_turns), np.empty(0), SE3(pose))
        for j, pose in enumerate(poses)
    )
    return Geometry(
        triangle,
        flange_from_triangle,
        cameras,
        base_from_camera,
        stations,
        tuple(turns),
    )


def two_mount_geometry(
    rng: np.random.Generator,
    *,
    half_turns: int = 6,
    evaluation_stations: int = 3,
    axes: tuple[Axis, Axis] = ("normal", "BC"),
    lens: Lens | None = None,
) -> Geometry:
    """The reference cell with a tool change between two programmes.

    Args:
        rng: Source of the poses.
        half_turns: How many with each mount.
        evaluation_stations: How many held-out stations with each mount.
        axes: What the half-turns turn about, by mount.
        lens: Lens of both cameras; None for pinholes.

    Raises:
        NoPlanError: a station found no pose in 400 candidates.
    """
    first, then = (
        reference_geometry(
            rng,
            half_turns=half_turns,
            evaluation_stations=evaluation_stations,
            axis=axis,
            lens=lens,
            flange_from_triangle=mount,
        )
        for axis, mount in zip(
            axes, (_FLANGE_FROM_TRIANGLE, _SECOND_MOUNT), strict=True
        )
    )
    return first.followed_by(then)


def _kind(index: int, calibration_stations: int) -> StationKind:
    return "calibration" if index < calibration_stations else "evaluation"


def _draw_triangle_pose(
    rng: np.random.Generator,
    triangle: TriangleRig,
    cameras: tuple[PinholeCamera, ...],
    base_from_camera: tuple[SE3, ...],
    turn: Floats | None,
    previous_normal: Floats | None,
) -> Floats:
    """Draw base_from_triangle, (4, 4), until every marker is in every view."""
    rejected = {"plane_angle": 0, "view": 0}
    middle = np.mean([motion.translation for motion in base_from_camera], axis=0)
    points = np.append(triangle.points, np.ones((3, 1)), axis=1).T
    for _ in range(_MAX_CANDIDATES):
        centre = rng.uniform(*_WORKSPACE)
        toward = middle - centre
        facing = look_at(centre, centre + toward).rotation
        tilt, azimuth, spin = rng.uniform(
            (_TILT[0], 0.0, 0.0), (_TILT[1], 2 * np.pi, 2 * np.pi)
        )
        rotation = (
            facing
            @ so3_exp(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
            @ so3_exp((0.0, 0.0, spin))
        )
        if previous_normal is not None and abs(
            rotation[:, 2] @ previous_normal
        ) > np.cos(_MIN_PLANE_ANGLE):
            rejected["plane_angle"] += 1
            continue
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = centre - rotation @ triangle.points.mean(axis=0)
        chains = [pose] if turn is None else [pose, pose @ turn]
        markers = np.concatenate([(chain @ points).T[:, :3] for chain in chains])
        if all(
            _inside(camera, camera.project(motion.inverse().apply(markers))).all()
            for camera, motion in zip(cameras, base_from_camera, strict=True)
        ):
            return pose
        rejected["view"] += 1
    raise NoPlanError(
        f"no pose in {_MAX_CANDIDATES} candidates keeps the markers in every view: "
        f"{rejected['view']} fell outside an image, {rejected['plane_angle']} were "
        "within 20 degrees of the plane before; bring the cameras farther away",
        rejected,
    )


def _inside(camera: PinholeCamera, pixels: Floats) -> NDArray[np.bool_]:
    size = np.array(camera.image_size, dtype=float)
    return np.asarray(((pixels > _MARGIN) & (pixels < size - 1 - _MARGIN)).all(axis=-1))


def synthesize(
    geometry: Geometry,
    rng: np.random.Generator,
    *,
    sigma_px: float,
    repeatability: Repeatability | None = None,
    marker_radii: ArrayLike = (0.0, 0.0, 0.0),
    estimate_skew: bool = True,
) -> tuple[Session, GroundTruth]:
    """Project the marker centres at every station and add noise.

    The robot reports the commanded pose and stands at
    ``commanded @ exp(xi)``, xi normal with the repeatability as its covariance. A
    marker with a radius is a sphere; the centroid of the area that it covers in the
    image is observed. What leaves an image is unseen.

    Args:
        geometry: Cell and programme.
        rng: Source of the noise; the draws do not depend on the sigmas.
        sigma_px: Standard deviation of each pixel coordinate; 0 for exact pixels.
        repeatability: The robot's; None for an exact robot.
        marker_radii: Shape (3,), metres; 0 for points.
        estimate_skew: Whether the session asks for the skew factor. Of the lens it
            asks for the coefficients that are not zero in truth.

    Returns:
        The session, and the truth that estimators must not see. With sigma_px = 0
        the session states a pixel covariance of 1 px^2, since zero has no weight.

    Raises:
        InputError: a sigma is negative or not finite, or the radii do not fit.
    """
    if not (np.isfinite(sigma_px) and sigma_px >= 0):
        raise InputError(f"sigma_px must be finite and not negative, got {sigma_px}")
    radii = np.asarray(marker_radii, dtype=float)
    if radii.shape != (3,) or not (np.isfinite(radii) & (radii >= 0)).all():
        raise InputError(
            f"marker_radii must be three lengths in metres, 0 or more, got {radii}"
        )
    reported = np.array([s.base_from_flange.matrix for s in geometry.stations])
    m, n = len(geometry.cameras), len(reported)
    repeats = repeatability or Repeatability(0.0, 0.0)
    sigma = np.repeat([repeats.translation, repeats.rotation], 3)
    executed = reported @ se3_exp(sigma * rng.standard_normal((n, 6)))
    noise = sigma_px * rng.standard_normal((m, n, 3, 2))
    mounts = tuple(
        Mount(motion, motion.apply(geometry.triangle.points))
        for motion in (geometry.flange_from_triangle, *geometry.other_mounts)
    )
    carried = [station.mount for station in geometry.stations]
    flange_points = np.array([mount.markers for mount in mounts])[carried]
    base_points = (
        np.einsum("nab,nkb->nka", executed[:, :3, :3], flange_points)
        + executed[:, None, :3, 3]
    )
    pixels = np.empty((m, n, 3, 2))
    for i, camera in enumerate(geometry.cameras):
        points = geometry.base_from_camera[i].inverse().apply(base_points)
        exact = outline_centroids(camera, points, radii)
        limit = np.array(camera.image_size, dtype=float) - 0.5
        inside = ((exact > -0.5) & (exact < limit)).all(axis=-1, keepdims=True)
        pixels[i] = np.where(inside, exact + noise[i], np.nan)
    variance = sigma_px**2 if sigma_px > 0 else 1.0
    covariance = np.where(np.isfinite(pixels)[..., None], variance * np.eye(2), np.nan)
    session = Session(
        triangle=geometry.triangle,
        marker_radii=radii,
        cameras=tuple(
            CameraInfo(
                camera.name,
                camera.image_size,
                estimate_skew,
                tuple(
                    name
                    for name, value in zip(
                        camera.lens.names, camera.lens.coefficients, strict=True
                    )
                    if value != 0
                ),
                camera.lens.model,
            )
            for camera in geometry.cameras
        ),
        stations=geometry.stations,
        half_turns=geometry.half_turns,
        pixels=pixels,
        pixel_covariance=covariance,
        repeatability=repeats,
        simulated=True,
    )
    truth = GroundTruth(
        geometry.cameras,
        geometry.base_from_camera,
        geometry.flange_from_triangle,
        executed,
        mounts[0].markers,
        mounts[1:],
    )
    return session, truth
