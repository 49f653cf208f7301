"""All cameras of a session: each alone, then the stereo motion, then together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri import arguments
from handeye_tri.calibrate_cameras.bundle import TurnNoise, bundle_cameras
from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
from handeye_tri.calibrate_cameras.session_camera import (
    alone_without_outliers,
    turn_covariance,
)
from handeye_tri.camera import LENS_COEFFICIENTS, Lens, PinholeCamera, triangulate
from handeye_tri.errors import DegenerateMotionError
from handeye_tri.records import (
    CameraCalibration,
    CameraInfo,
    DroppedHalfTurn,
    Session,
)
from handeye_tri.se3 import SE3, nearest_rotation, se3_inverse

Floats = NDArray[np.float64]

# Correlations of detection errors that are tried where markers lie on the axis.
_CORRELATIONS = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 0.96, 0.985)


def calibrate_session_cameras(session: Session) -> CameraCalibration:
    """Calibrate all cameras of a session from its calibration stations.

    In steps: (1) each camera alone from the half-turns that it saw whole (Zhao, Liu
    and Zhang 2008, doi:10.1109/TIP.2008.2005562, Sec. III); (2) the same again with
    the eccentricity of the spheres removed, and, where chi2 is more than noise
    explains, without the half-turns that disagree with the others; (3) the cameras'
    places from the poses that several of them saw (mean of the relative poses); (4)
    everything adjusted together, with all stations that can be used, twice, so that
    the eccentricity removed is that of the final cameras.

    In step (4) the two stations of a half-turn are independent of each other. Tying
    them together by the robot's repeatability (0.03 mm, 0.005 degrees, at 0.015 px)
    would lower the sigma of fx by 5 to 12 %, not enough to let a robot that repeats
    worse than it says, or does not turn by 180 degrees, into the cameras. A single
    camera cannot do without the tie. Where the triangle changes its mount, the cameras
    have the half-turns of all mounts; where the axes run in the triangle is every
    mount's own.

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
        - "sphere_shift": what was removed from the pixels, shape (m, n, 3, 2);
        - "dropped": a :class:`DroppedHalfTurn` for each half-turn that disagrees with
          the others, as one camera saw it: a wrong point, exchanged labels, a repeated
          image, a turn by another angle. That camera's views of it are not used;
          ``session.without(dropped)`` is the session for the steps that follow.

    Raises:
        InputError: a camera's data cannot be used; names the camera.
        DegenerateMotionError: a camera saw too few half-turns, or cameras share none;
            names the camera, how many it saw, how many it needs.
        ConvergenceError: an iteration did not settle.
    """
    arguments.record("session", session, Session)
    m, n = len(session.cameras), len(session.stations)
    if not session.half_turns:
        raise DegenerateMotionError(
            "the session has no half_turns, and each camera needs at least 3"
        )
    shift = np.zeros((m, n, 3, 2))
    spheres = bool(session.marker_radii.any())
    dropped: list[DroppedHalfTurn] = []
    separate = []
    for i in range(m):
        if spheres:
            first, _ = alone_without_outliers(
                session, i, shift[i], only_to_succeed=True
            )
            shift[i] = _shift(session, first.camera, _half_turn_poses(session, first))
        found, lost = alone_without_outliers(session, i, shift[i])
        separate.append(found)
        dropped += lost
    session = session.without(dropped)
    views = np.array([_half_turn_poses(session, one) for one in separate])
    places = _places([info.name for info in session.cameras], views)
    cameras = tuple(
        _with_lens_model(one.camera, info)
        for one, info in zip(separate, session.cameras, strict=True)
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
        "dropped": tuple(dropped),
    }
    return replace(result, details=details)


def _half_turn_poses(session: Session, separate: CameraCalibration) -> Floats:
    """camera_from_triangle at each station, (n, 4, 4), NaN where it is not known."""
    poses = np.full((len(session.stations), 4, 4), np.nan)
    poses[[t.before for t in session.half_turns]] = separate.details[
        "camera_from_triangle"
    ]
    poses[[t.after for t in session.half_turns]] = separate.details[
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
        mounts=session.mounts,
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
