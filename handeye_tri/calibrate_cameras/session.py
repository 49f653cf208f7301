"""All cameras of a session: each alone, then the stereo motion, then together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.bundle import TurnNoise, bundle_cameras
from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
from handeye_tri.calibrate_cameras.single_camera import calibrate_camera
from handeye_tri.camera import LENS_COEFFICIENTS, Lens, PinholeCamera, triangulate
from handeye_tri.errors import (
    ConvergenceError,
    DegenerateMotionError,
    InputError,
)
from handeye_tri.records import CameraCalibration, CameraInfo, Repeatability, Session
from handeye_tri.se3 import SE3, nearest_rotation, se3_inverse

Floats = NDArray[np.float64]

# How far from the flange the rig is taken to be, which nobody knows before the
# hand-eye step: by this lever an orientation error of the robot moves the rig; metres.
_LEVER = 0.1
# Correlations of detection errors that are tried where markers lie on the axis.
_CORRELATIONS = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 0.96, 0.985)


def turn_covariance(repeatability: Repeatability) -> Floats:
    """How far a half-turn of the rig misses, from how far the robot repeats.

    Two executed poses make a half-turn, each off by the repeatability, and the rig is
    0.1 m from the flange: 2 (s_t^2 + (0.1 m)^2 s_r^2) for each translation, 2 s_r^2 for
    each rotation, correlations left out.

    Returns:
        Covariance of the tangent (translation m, rotation rad), shape (6, 6).
    """
    rotation = 2.0 * repeatability.rotation**2
    translation = 2.0 * repeatability.translation**2 + _LEVER**2 * rotation
    return np.diag([translation] * 3 + [rotation] * 3)


def calibrate_session_cameras(session: Session) -> CameraCalibration:
    """Calibrate all cameras of a session from its calibration stations.

    In steps: (1) each camera alone from the half-turns that it saw whole (Zhao, Liu
    and Zhang 2008, doi:10.1109/TIP.2008.2005562, Sec. III); (2) the same again with
    the eccentricity of the spheres removed; (3) the cameras' places from the poses
    that several of them saw (mean of the relative poses); (4) everything adjusted
    together, with all stations that can be used, twice, so that the eccentricity
    removed is that of the final cameras.

    In step (4) the two stations of a half-turn are independent of each other. Tying
    them together by the robot's repeatability (0.03 mm, 0.005 degrees, at 0.015 px)
    would lower the sigma of fx by 5 to 12 %, not enough to let a robot that repeats
    worse than it says, or does not turn by 180 degrees, into the cameras. A single
    camera cannot do without the tie.

    Markers on an edge axis are seen twice at the same place, and much of what detection
    gets wrong there, it gets wrong twice (in rendered images the two errors correlate
    by 0.2 to 0.6). This correlation is estimated by restricted maximum likelihood,
    since without it the stated sigmas would be too small. The calibrations of each
    camera alone do not know of it.

    Args:
        session: Half-turns and pixels. Evaluation stations are not read.

    Returns:
        The cameras. ``residuals`` has one view per station of the session, NaN where
        not used. ``details`` is that of ``bundle_cameras`` over the session's
        stations, and

        - "separate": the calibration of each camera alone, after step (2);
        - "separate_reference_from_camera": the cameras' places after step (3);
        - "on_axis_correlation": what was found where markers lie on the axis, else 0;
        - "sphere_shift": what was removed from the pixels, shape (m, n, 3, 2).

    Raises:
        InputError: a camera's data cannot be used; names the camera.
        DegenerateMotionError: a camera saw too few half-turns, or cameras share none;
            names the camera, how many it saw, how many it needs.
        ConvergenceError: an iteration did not settle.
    """
    m, n = len(session.cameras), len(session.stations)
    if not session.half_turns:
        raise DegenerateMotionError(
            "the session has no half_turns, and each camera needs at least 3"
        )
    shift = np.zeros((m, n, 3, 2))
    separate = [_alone(session, i, shift[i]) for i in range(m)]
    spheres = bool(session.marker_radii.any())
    if spheres:
        for i in range(m):
            shift[i] = _shift(
                session, separate[i].camera, _half_turn_poses(session, separate[i])
            )
        separate = [_alone(session, i, shift[i]) for i in range(m)]
    views = np.array([_half_turn_poses(session, alone) for alone in separate])
    places = _places([info.name for info in session.cameras], views)
    cameras = tuple(
        _with_lens_model(alone.camera, info)
        for alone, info in zip(separate, session.cameras, strict=True)
    )
    start = _station_starts(session, cameras, places, views, shift)
    result = _together(session, cameras, places, start, shift, 0.0)
    if spheres:
        poses = result.details["reference_from_triangle"]
        for i, camera in enumerate(result.cameras):
            local = result.reference_from_camera[i].inverse().matrix @ poses
            shift[i] = _shift(session, camera, local)
        result = _again(session, result, shift, 0.0)
    correlation = 0.0
    if m > 1 and any(turn.axis != "normal" for turn in session.half_turns):
        for tried in _CORRELATIONS:
            other = _again(session, result, shift, tried)
            if other.details["deviance"] > result.details["deviance"]:
                break
            result, correlation = other, tried
    shift.setflags(write=False)
    details = {
        **result.details,
        "separate": tuple(separate),
        "separate_reference_from_camera": tuple(places),
        "on_axis_correlation": correlation,
        "sphere_shift": shift,
    }
    return replace(result, details=details)


def _alone(session: Session, i: int, shift: Floats) -> CameraCalibration:
    """Calibrate camera i from its half-turns, pixels less a shift (n, 3, 2)."""
    info = session.cameras[i]
    before = [turn.before for turn in session.half_turns]
    after = [turn.after for turn in session.half_turns]
    pixels, covariance = session.pixels[i] - shift, session.pixel_covariance[i]
    whole = np.asarray(np.isfinite(pixels).all(axis=(1, 2)))
    count = int((whole[before] & whole[after]).sum())
    need = 3 if info.skew else 2
    if count < need:
        raise DegenerateMotionError(
            f"camera {info.name!r} saw all three markers before and after in only "
            f"{count} of {len(before)} half-turns, and needs at least {need}"
            f"{' with skew' if info.skew else ''}; add half-turns in its view"
        )
    try:
        return calibrate_camera(
            pixels[before],
            pixels[after],
            session.triangle,
            image_size=info.image_size,
            axis=[turn.axis for turn in session.half_turns],
            skew=info.skew,
            distortion=info.lens or None,
            covariance=np.stack([covariance[before], covariance[after]], axis=1),
            turn_covariance=turn_covariance(session.repeatability),
            name=info.name,
        )
    except (InputError, DegenerateMotionError, ConvergenceError) as error:
        raise type(error)(f"camera {info.name!r}: {error}") from error


def _half_turn_poses(session: Session, alone: CameraCalibration) -> Floats:
    """camera_from_triangle at each station, (n, 4, 4), NaN where it is not known."""
    poses = np.full((len(session.stations), 4, 4), np.nan)
    poses[[t.before for t in session.half_turns]] = alone.details[
        "camera_from_triangle"
    ]
    poses[[t.after for t in session.half_turns]] = alone.details[
        "camera_from_triangle_after"
    ]
    return poses


def _shift(session: Session, camera: PinholeCamera, poses: Floats) -> Floats:
    """Eccentricity at each station, (n, 3, 2), px; 0 where the pose is not known."""
    points = (
        session.triangle.points @ np.swapaxes(poses[:, :3, :3], -1, -2)
        + poses[:, None, :3, 3]
    )
    return np.nan_to_num(sphere_shift(camera, points, session.marker_radii))


def _places(names: Sequence[str], views: Floats) -> list[SE3]:
    """Where the cameras stand, from poses that several saw.

    Each camera is placed by one that already is, the one with which it shares most.

    Args:
        names: Of the m cameras.
        views: camera_from_triangle, (m, n, 4, 4), NaN where not seen.

    Raises:
        DegenerateMotionError: a camera shares no half-turn with those placed.
    """
    seen = np.asarray(np.isfinite(views).all(axis=(2, 3)))
    common = seen.astype(int) @ seen.T.astype(int)
    places: dict[int, SE3] = {0: SE3.identity()}
    while len(places) < len(names):
        done = list(places)
        left = [i for i in range(len(names)) if i not in places]
        table = common[np.ix_(left, done)]
        if table.max() == 0:
            lost = ", ".join(repr(names[i]) for i in left)
            raise DegenerateMotionError(
                f"camera {lost} shares no whole half-turn with "
                f"{', '.join(repr(names[i]) for i in done)}, so that where they stand "
                "to each other is unknown; add half-turns that both see"
            )
        row, column = np.unravel_index(int(table.argmax()), table.shape)
        new, old = left[row], done[column]
        both = seen[new] & seen[old]
        relative = views[old, both] @ se3_inverse(views[new, both])
        places[new] = places[old] @ SE3.mean([SE3(motion) for motion in relative])
    return [places[i] for i in range(len(names))]


def _with_lens_model(camera: PinholeCamera, info: CameraInfo) -> PinholeCamera:
    """The same camera with its lens written in the model that the session names."""
    coefficients = np.zeros(len(LENS_COEFFICIENTS[info.lens_model]))
    coefficients[: len(camera.lens.coefficients)] = camera.lens.coefficients
    return replace(camera, lens=Lens(info.lens_model, coefficients))


def _station_starts(
    session: Session,
    cameras: Sequence[PinholeCamera],
    places: Sequence[SE3],
    views: Floats,
    shift: Floats,
) -> Floats:
    """reference_from_triangle at each station, (n, 4, 4), NaN where there is none.

    From the half-turn as the first camera that saw it whole sees it; otherwise the
    triangle is fitted to its markers, triangulated where two or more cameras see them.
    """
    n = len(session.stations)
    start = np.full((n, 4, 4), np.nan)
    for place, poses in reversed(list(zip(places, views, strict=True))):
        known = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
        start[known] = place.matrix @ poses[known]
    if len(cameras) < 2:
        return start
    m = len(cameras)
    points, _ = triangulate(
        cameras,
        places,
        (session.pixels - shift).reshape(m, -1, 2),
        session.pixel_covariance.reshape(m, -1, 2, 2),
    )
    markers = points.reshape(n, 3, 3)
    fitted = np.asarray(
        np.isfinite(markers).all(axis=(1, 2)) & np.isnan(start[:, 0, 0])
    )
    wanted = session.triangle.points - session.triangle.points.mean(axis=0)
    middle = markers[fitted].mean(axis=1)
    spread = markers[fitted] - middle[:, None]
    rotation = nearest_rotation(np.swapaxes(spread, -1, -2) @ wanted)
    start[fitted] = np.eye(4)
    start[fitted, :3, :3] = rotation
    start[fitted, :3, 3] = middle - rotation @ session.triangle.points.mean(axis=0)
    return start


def _together(
    session: Session,
    cameras: Sequence[PinholeCamera],
    places: Sequence[SE3],
    start: Floats,
    shift: Floats,
    correlation: float,
) -> CameraCalibration:
    """Adjust everything, at the calibration stations whose pose is known roughly."""
    usable = np.asarray(np.isfinite(start).all(axis=(1, 2)))
    usable &= [station.kind == "calibration" for station in session.stations]
    pixels = np.where(usable[:, None, None], session.pixels - shift, np.nan)
    noise = None
    if len(cameras) == 1:
        noise = TurnNoise(turn_covariance(session.repeatability))
    elif correlation > 0:
        noise = TurnNoise(None, correlation)
    return bundle_cameras(
        cameras,
        places,
        start,
        pixels,
        session.pixel_covariance,
        session.triangle,
        skew=[info.skew for info in session.cameras],
        lenses=[info.lens for info in session.cameras],
        half_turns=session.half_turns,
        turn_noise=noise,
    )


def _again(
    session: Session, result: CameraCalibration, shift: Floats, correlation: float
) -> CameraCalibration:
    """Adjust everything once more from where it ended."""
    return _together(
        session,
        result.cameras,
        result.reference_from_camera,
        result.details["reference_from_triangle"],
        shift,
        correlation,
    )
