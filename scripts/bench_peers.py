"""Peers of the cameras' rows; runs in their environment, which has no handeye_tri.

Each function takes data and returns the call that is measured.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


def opencv_camera(points: Any, pixels: Any, size: tuple[int, int]) -> Callable[[], Any]:
    """cv2.calibrateCamera: K without skew and the five lens coefficients.

    Args:
        points: Of the target, (p, 3), metres.
        pixels: Shape (n, p, 2).
        size: Of the image.
    """
    import cv2

    cv2.setNumThreads(1)
    target = [np.asarray(points, np.float32)] * len(pixels)
    views = list(np.asarray(pixels, np.float32))

    def calibrate() -> Any:
        rms, k, lens, *_ = cv2.calibrateCamera(target, views, size, None, None)
        return rms, k, lens.ravel()

    return calibrate


def opencv_pinhole_trials(
    points: Any, pixels: Any, size: tuple[int, int]
) -> Callable[[], Any]:
    """cv2.calibrateCamera without lens on each of t sets of views.

    Args:
        points: Of the target, (p, 3), metres.
        pixels: Shape (t, n, p, 2).
        size: Of the image.
    """
    import cv2

    cv2.setNumThreads(1)
    target = [np.asarray(points, np.float32)] * pixels.shape[1]
    trials = [list(np.asarray(views, np.float32)) for views in pixels]
    flags = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    flags |= cv2.CALIB_ZERO_TANGENT_DIST

    def calibrate() -> Any:
        return np.array(
            [
                cv2.calibrateCamera(target, views, size, None, None, flags=flags)[0]
                for views in trials
            ]
        )

    return calibrate


def opencv_stereo(points: Any, pixels: Any, size: tuple[int, int]) -> Callable[[], Any]:
    """Two calibrateCamera and a stereoCalibrate that starts from them.

    Everything is estimated together at the end, as it is on our side.

    Args:
        points: Of the target, (p, 3), metres.
        pixels: Shape (2, n, p, 2).
        size: Of the images.
    """
    import cv2

    cv2.setNumThreads(1)
    target = [np.asarray(points, np.float32)] * pixels.shape[1]
    left, right = (list(np.asarray(one, np.float32)) for one in pixels)

    def calibrate() -> Any:
        _, k1, d1, *_ = cv2.calibrateCamera(target, left, size, None, None)
        _, k2, d2, *_ = cv2.calibrateCamera(target, right, size, None, None)
        rms, *_ = cv2.stereoCalibrate(
            target,
            left,
            right,
            k1,
            d1,
            k2,
            d2,
            size,
            flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        )
        return rms

    return calibrate


def opencv_stereo_fixed(
    points: Any, pixels: Any, size: tuple[int, int]
) -> Callable[[], Any]:
    """The same with the cameras fixed in stereoCalibrate, its default."""
    import cv2

    cv2.setNumThreads(1)
    target = [np.asarray(points, np.float32)] * pixels.shape[1]
    left, right = (list(np.asarray(one, np.float32)) for one in pixels)

    def calibrate() -> Any:
        _, k1, d1, *_ = cv2.calibrateCamera(target, left, size, None, None)
        _, k2, d2, *_ = cv2.calibrateCamera(target, right, size, None, None)
        return cv2.stereoCalibrate(target, left, right, k1, d1, k2, d2, size)[0]

    return calibrate


def gtsam_camera(points: Any, pixels: Any, start: tuple[Any, ...]) -> Callable[[], Any]:
    """GTSAM's Levenberg-Marquardt over K, lens without k3 and poses.

    It has no closed form, so that its start is given, and building its graph is not
    measured.

    Args:
        points: Of the target, (p, 3), metres.
        pixels: Shape (n, p, 2).
        start: fx, fy, cx, cy and the poses camera_from_target, (n, 4, 4).
    """
    import gtsam

    (fx, fy, cx, cy), poses = start
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    # Its optimiser gives up on points that are fixed altogether.
    fixed = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    camera = gtsam.symbol("k", 0)
    values.insert(camera, gtsam.Cal3DS2(fx, fy, 0.0, cx, cy, 0.0, 0.0, 0.0, 0.0))
    # Its K has a skew, which neither we nor OpenCV estimate.
    free = np.array([1e4, 1e4, 1e-4, 1e4, 1e4, 10.0, 10.0, 10.0, 10.0])
    prior = gtsam.noiseModel.Diagonal.Sigmas(free)
    graph.add(gtsam.PriorFactorCal3DS2(camera, values.atCal3DS2(camera), prior))
    for j, point in enumerate(np.asarray(points, float)):
        values.insert(gtsam.symbol("p", j), point)
        graph.add(gtsam.PriorFactorPoint3(gtsam.symbol("p", j), point, fixed))
    for i, pose in enumerate(np.linalg.inv(poses)):
        values.insert(gtsam.symbol("x", i), gtsam.Pose3(pose))
        for j, pixel in enumerate(np.asarray(pixels[i], float)):
            graph.add(
                gtsam.GeneralSFMFactor2Cal3DS2(
                    pixel,
                    noise,
                    gtsam.symbol("x", i),
                    gtsam.symbol("p", j),
                    camera,
                )
            )

    def calibrate() -> Any:
        found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        return np.sqrt(2.0 * graph.error(found) / (pixels.shape[0] * pixels.shape[1]))

    return calibrate


def vision_calibration_rig(points: Any, pixels: Any) -> Callable[[], Any]:
    """calibration-rs, run_rig_extrinsics with its defaults.

    Args:
        points: Of the target, (p, 3), metres.
        pixels: Shape (m, n, p, 2).

    Returns a call that gives, of each camera, fx fy cx cy, k1 k2 p1 p2, and its place
    as quaternion x y z w and translation of camera_from_rig.
    """
    import vision_calibration as vc

    target = [tuple(map(float, point)) for point in points]
    views = [
        vc.RigExtrinsicsView(
            cameras=[
                vc.Observation(
                    points_3d=target,
                    points_2d=[tuple(map(float, pixel)) for pixel in one],
                )
                for one in view
            ]
        )
        for view in np.swapaxes(pixels, 0, 1)
    ]
    data = vc.RigExtrinsicsDataset(num_cameras=len(pixels), views=views)

    def calibrate() -> Any:
        found = vc.run_rig_extrinsics(data)
        return [
            (
                [c.intrinsics.fx, c.intrinsics.fy, c.intrinsics.cx, c.intrinsics.cy],
                [c.distortion.k1, c.distortion.k2, c.distortion.p1, c.distortion.p2],
                list(pose.rotation_xyzw),
                list(pose.translation_xyz),
            )
            for c, pose in zip(found.cameras, found.cam_se3_rig, strict=True)
        ]

    return calibrate
