"""Several cameras from general motions of the triangle: the public function.

Zhao, Liu and Zhang 2008 (doi:10.1109/TIP.2008.2005562), Appendix A, completed: the
paper's factorisation where three or more cameras see enough markers together, a sweep
over two focal lengths where not, then every camera by resection, the poses by
Procrustes, and everything by maximum likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import fdtri

from handeye_tri import arguments
from handeye_tri.calibrate_cameras.assemble import (
    MetricCamera,
    in_first_frame,
    place_all,
    triangle_poses,
)
from handeye_tri.calibrate_cameras.bundle import bundle_cameras
from handeye_tri.calibrate_cameras.bundle_input import observations
from handeye_tri.calibrate_cameras.degeneracy import least_noise
from handeye_tri.calibrate_cameras.general_motion_input import (
    check_enough,
    read_cameras,
    read_points,
)
from handeye_tri.calibrate_cameras.general_motion_starts import starts
from handeye_tri.calibrate_cameras.general_motion_views import (
    Views,
    epipolar_noise,
)
from handeye_tri.calibrate_cameras.half_turns import check_triangle, read_sigma
from handeye_tri.calibrate_cameras.options import lens_choice
from handeye_tri.camera import (
    LENS_COEFFICIENTS,
    Intrinsics,
    Lens,
    LensModel,
    PinholeCamera,
)
from handeye_tri.errors import ConvergenceError, DegenerateMotionError, InputError
from handeye_tri.records import CameraCalibration, Covariance, numeric
from handeye_tri.se3 import SE3, se3_inverse
from handeye_tri.triangle import TriangleRig

Floats = NDArray[np.float64]

# Chance that a right minimum is refused for its cost, and the least excess that is.
_CHANCE = 1e-6
_EXCESS = 1.5


def calibrate_cameras_general(
    points: ArrayLike,
    triangle: TriangleRig,
    *,
    image_sizes: tuple[int, int] | Sequence[tuple[int, int]],
    skew: bool = True,
    distortion: LensModel | Sequence[str] | None = None,
    sigma_px: float | None = None,
    covariance: ArrayLike | None = None,
    names: Sequence[str] | None = None,
) -> CameraCalibration:
    """Calibrate m cameras from n views of three markers in any motion.

    Nothing but the sides of the triangle is known. Only their ratios matter for the
    intrinsics; their size is that of all distances. Each camera's intrinsics are its
    own.

    Args:
        points: Pixels of A, B, C, shape (m, n, 3, 2); NaN where a camera does not see
            a marker. The views are simultaneous.
        triangle: The rig.
        image_sizes: (width, height), pixels, for all cameras or one each.
        skew: Whether skew factors are estimated; otherwise they are zero.
        distortion: Lens coefficients to estimate, of every camera: all of a model, or
            their names.
        sigma_px: Standard deviation of each pixel coordinate.
        covariance: Instead: covariance of each point, (m, n, 3, 2, 2), px^2. With
            neither, points count alike and the covariance of the result is scaled by
            chi2 / dof.
        names: Of the cameras; "camera0", "camera1" ... by default.

    Returns:
        The cameras; the first is the reference. ``residuals`` has one view each.
        ``cost_start`` is chi2 where the adjustment began. ``details`` is that of the
        adjustment (``reference_from_triangle``, ``station_covariance``, ``used``,
        ``iterations``, ``deviance``), and

        - "start": "factorisation" or "sweep of cameras i, j";
        - "left_out": indices of the views not used: a marker that no camera sees, or
          fewer than two markers that two cameras see;
        - "epipolar_noise_px": the noise that the epipolar geometry of pairs shows,
          with no use of K or the triangle, in units of ``sigma_px`` where it is given.

    Raises:
        InputError: an argument cannot be used.
        DegenerateMotionError: the views do not determine the cameras.
        ConvergenceError: no start led to cameras that explain the images as well as
            their epipolar geometry says that they can be explained.
    """
    check_triangle(triangle)
    arguments.flag("skew", skew)
    lens_model, lens = lens_choice(distortion)
    wanted = [LENS_COEFFICIENTS[lens_model][index] for index in lens]
    observed = read_points(points)
    m = len(observed)
    labels, sizes = read_cameras(m, names, image_sizes, observed)
    noise_known = sigma_px is not None or covariance is not None
    check_enough(labels, observed)
    spread = _covariances(observed, sigma_px, covariance)

    views = Views.of(observed, sizes, triangle)
    typical = float(np.sqrt(np.nanmedian(spread[..., [0, 1], [0, 1]])))
    best: CameraCalibration | None = None
    said: list[str] = []
    noise, noise_dof = epipolar_noise(views, typical)
    for start, cameras in starts(views, said):
        try:
            result = _adjust(
                views, cameras, observed, spread, labels, sizes, skew, lens_model
            )
        except (InputError, DegenerateMotionError, ConvergenceError) as error:
            said.append(f"{start}: {error}")
            continue
        if best is None or _cost(result) < _cost(best):
            best = replace(result, details={**result.details, "start": start})
        if _explains(best, noise, noise_dof, noise_known):
            break
    if best is None:
        raise ConvergenceError(
            f"no start led to {m} cameras; tried "
            + ("; ".join(said) if said else "nothing: no pair shares enough points")
            + ". Check the triangle's sides and the order of A, B, C, and add views in "
            "which the cameras see the triangle tilted and at different distances"
        )
    if wanted:
        best = _with_lens(best, observed, spread, triangle, skew, wanted)
    if not _explains(best, noise, noise_dof, noise_known):
        raise ConvergenceError(
            f"the adjustment ended at a root of chi2 / dof of {_cost(best) ** 0.5:.3g} "
            f"where the epipolar geometry alone leaves {noise:.3g} "
            f"({noise_dof} degrees of freedom): a wrong minimum, wrong sides of the "
            "triangle, markers exchanged, or a lens that distorts; check these, add "
            "views, or give distortion"
        )
    used = best.details["used"]
    details = {
        **best.details,
        "left_out": np.setdiff1d(np.arange(observed.shape[1]), used),
        "epipolar_noise_px": noise,
    }
    matrix = best.covariance.matrix
    factor = least_noise(_cost(best), noise_known)
    return replace(
        best,
        covariance=Covariance(best.covariance.labels, matrix * factor),
        method=f"general motion, {best.method}",
        details=details,
    )


def _cost(result: CameraCalibration) -> float:
    return result.chi2 / max(result.dof, 1)


def _covariances(
    observed: Floats, sigma_px: float | None, covariance: ArrayLike | None
) -> Floats:
    shape = (*observed.shape, 2)
    if covariance is None:
        return np.broadcast_to(read_sigma(sigma_px) ** 2 * np.eye(2), shape)
    if sigma_px is not None:
        raise InputError("give either sigma_px or covariance, not both")
    spread = numeric("covariance", covariance)
    observations(len(observed), observed, spread)
    return spread


def _explains(
    result: CameraCalibration, noise: float, freedom: int, noise_known: bool
) -> bool:
    """Whether a minimum is as low as the epipolar geometry says it can be.

    Fisher's F for the ratio of the two variances; a variance of the noise that is
    known is no bar in itself, since it may be misjudged.
    """
    limit = max(float(fdtri(result.dof, freedom, 1.0 - _CHANCE)), _EXCESS)
    floor = least_noise(0.0, noise_known) if not noise_known else 1e-6
    return _cost(result) <= limit * max(noise**2, floor)


def _adjust(
    views: Views,
    cameras: dict[int, MetricCamera],
    observed: Floats,
    spread: Floats,
    labels: list[str],
    sizes: list[tuple[int, int]],
    skew: bool,
    lens_model: LensModel,
) -> CameraCalibration:
    """Place what is left, then adjust everything."""
    m = len(observed)
    if len(cameras) < m:
        cameras = place_all(_adjusted_core(views, cameras, skew), views.images)
    if len(cameras) < m:
        lost = ", ".join(repr(labels[i]) for i in range(m) if i not in cameras)
        raise DegenerateMotionError(
            f"camera {lost} could not be placed by the markers that it shares"
        )
    poses = triangle_poses(cameras, views.images, views.triangle)
    places, stations = in_first_frame(cameras, poses)
    usable = np.asarray(np.isfinite(stations).all(axis=(1, 2)))
    start = [
        PinholeCamera(
            labels[i],
            _intrinsics(cameras[i].k, views, i, skew),
            sizes[i],
            Lens(lens_model, np.zeros(len(LENS_COEFFICIENTS[lens_model]))),
        )
        for i in range(m)
    ]
    return bundle_cameras(
        start,
        [SE3(place) for place in places],
        stations,
        np.where(usable[:, None, None], observed, np.nan),
        spread,
        views.triangle,
        skew=skew,
    )


def _intrinsics(k: Floats, views: Views, i: int, skew: bool) -> Intrinsics:
    focal = views.scale * np.diagonal(k)[:2]
    centre = views.scale * k[:2, 2] + views.centres[i]
    return Intrinsics(
        float(focal[0]),
        float(focal[1]),
        float(views.scale * k[0, 1]) if skew else 0.0,
        float(centre[0]),
        float(centre[1]),
    )


def _adjusted_core(
    views: Views, cameras: dict[int, MetricCamera], skew: bool
) -> dict[int, MetricCamera]:
    """The first few cameras alone, adjusted on the views that starts use."""
    order = sorted(cameras)
    rows = np.unique(np.concatenate([views.few, views.pair_views(order[0], order[1])]))
    images = views.images[order][:, rows]
    local = {a: cameras[i] for a, i in enumerate(order)}
    poses = triangle_poses(local, images, views.triangle)
    places, stations = in_first_frame(local, poses)
    usable = np.asarray(np.isfinite(stations).all(axis=(1, 2)))
    pixels = np.where(
        usable[:, None, None],
        images * views.scale + views.centres[order][:, None, None],
        np.nan,
    )
    size = int(2 * views.scale), int(2 * views.scale)
    result = bundle_cameras(
        [
            PinholeCamera(f"{i}", _intrinsics(cameras[i].k, views, i, skew), size)
            for i in order
        ],
        [SE3(place) for place in places],
        stations,
        pixels,
        np.broadcast_to(np.eye(2), (*pixels.shape, 2)),
        views.triangle,
        skew=skew,
    )
    adjusted = {}
    for i, camera, place in zip(
        order, result.cameras, result.reference_from_camera, strict=True
    ):
        k = camera.intrinsics.matrix
        k[:2, 2] -= views.centres[i]
        k[:2] /= views.scale
        adjusted[i] = MetricCamera(k, se3_inverse(place.matrix))
    return adjusted


def _with_lens(
    found: CameraCalibration,
    observed: Floats,
    spread: Floats,
    triangle: TriangleRig,
    skew: bool,
    wanted: Sequence[str],
) -> CameraCalibration:
    """Once more from there, with lens coefficients."""
    poses = found.details["reference_from_triangle"]
    usable = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    result = bundle_cameras(
        found.cameras,
        found.reference_from_camera,
        poses,
        np.where(usable[:, None, None], observed, np.nan),
        spread,
        triangle,
        skew=skew,
        lenses=[wanted] * len(found.cameras),
    )
    return replace(
        result,
        cost_start=found.cost_start,
        details={**result.details, "start": found.details["start"]},
    )
