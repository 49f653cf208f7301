"""A flat target's views: poses, both noises, real images."""

import json
from pathlib import Path

import numpy as np
import pytest
from pose_scene import random_poses

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.hand_eye import adjust_target_views, target_views
from handeye_tri.se3 import (
    SE3,
    rotation_from_quaternion_wxyz,
    se3_exp,
    se3_inverse,
    se3_log,
    so3_exp,
    so3_log,
)

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "rct_10x10"
CAMERA = PinholeCamera(
    "wrist",
    Intrinsics(900, 905, 0.0, 640, 360),
    (1280, 720),
    Lens("radtan", np.array([-0.1, 0.02, 1e-3, -5e-4, 0.0])),
)
GRID = np.array([[i % 7, i // 7, 0] for i in range(35)]) * 0.03


def seen_poses(rng, n, tilt=0.5):
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = so3_exp(tilt * rng.standard_normal((n, 3)))
    poses[:, :3, 3] = (-0.09, -0.06, 0.7) + 0.06 * rng.standard_normal((n, 3))
    return poses


def project(poses, rng=None, sigma=0.0):
    local = GRID @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    pixels = CAMERA.project(local)
    return pixels if rng is None else pixels + sigma * rng.standard_normal(pixels.shape)


def test_exact_pixels_give_the_exact_pose_through_a_lens():
    poses = seen_poses(np.random.default_rng(0), 40)
    found = target_views(CAMERA, GRID, project(poses), 0.1)
    np.testing.assert_allclose(found.camera_from_target, poses, atol=1e-9)
    assert found.residuals(found.camera_from_target).max() < 1e-7


def test_the_mirrored_pose_is_not_taken_for_the_right_one():
    # Far, small and noisy: one start alone ends in the wrong minimum now and then.
    rng = np.random.default_rng(1)
    poses = seen_poses(rng, 60, 0.4)
    poses[:, :3, 3] *= 3
    found = target_views(CAMERA, GRID, project(poses, rng, 0.05))
    off = so3_log((se3_inverse(poses) @ found.camera_from_target)[:, :3, :3])
    assert np.degrees(np.linalg.norm(off, axis=1)).max() < 5


def test_covariance_is_the_spread_and_the_noise_is_found():
    rng = np.random.default_rng(2)
    poses = seen_poses(rng, 400)
    found = target_views(CAMERA, GRID, project(poses, rng, 0.2))
    assert found.sigma_px == pytest.approx(0.2, rel=0.02)
    e = se3_log(se3_inverse(found.camera_from_target) @ poses)
    nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.covariance), e) / 6
    # The mean of 400 normalised chi-squares of 6: 0.029.
    assert abs(nees.mean() - 1) < 0.1


def test_unseen_points_are_left_out():
    rng = np.random.default_rng(3)
    poses = seen_poses(rng, 5)
    pixels = project(poses)
    pixels[2, 5:20] = np.nan
    found = target_views(CAMERA, GRID, pixels, 0.1)
    np.testing.assert_allclose(found.camera_from_target, poses, atol=1e-9)
    assert (np.diagonal(found.covariance[2]) > np.diagonal(found.covariance[1])).any()


def robot_and_views(seed, mounting, robot_sigma, sigma_px, n=25):
    rng = np.random.default_rng([4, seed])
    x, z = random_poses(rng, 2, 0.1)
    poses = seen_poses(rng, n)
    b = se3_inverse(poses) if mounting == "eye_in_hand" else poses
    a = z @ b @ se3_inverse(x)
    sigma = np.repeat(robot_sigma, 3)
    reported = a @ se3_exp(sigma * rng.standard_normal((n, 6)))
    views = target_views(CAMERA, GRID, project(poses, rng, sigma_px), sigma_px)
    return views, reported, x, z, poses


@pytest.mark.parametrize("mounting", ["eye_in_hand", "eye_to_hand"])
def test_both_noises_are_told_apart_and_the_covariance_holds(mounting):
    nees, robot, factors = [], [], []
    for seed in range(12):
        views, a, x, z, _ = robot_and_views(seed, mounting, (4e-4, 1e-3), 0.3)
        found = adjust_target_views(views, a, mounting)
        e = np.append(
            (found.x.inverse() @ SE3(x)).log(), (found.z.inverse() @ SE3(z)).log()
        )
        nees.append(e @ np.linalg.solve(found.covariance, e) / 12)
        robot.append([found.robot_translation, found.robot_rotation])
        factors.append(found.pixel_factor)
    np.testing.assert_allclose(np.mean(robot, axis=0), (4e-4, 1e-3), rtol=0.25)
    assert np.mean(factors) == pytest.approx(1.0, abs=0.15)
    assert 0.65 < np.mean(nees) < 1.4


def test_robot_corrections_move_towards_the_truth():
    views, a, x, z, poses = robot_and_views(0, "eye_in_hand", (3e-3, 5e-3), 0.1)
    found = adjust_target_views(views, a, "eye_in_hand", (3e-3, 5e-3))
    true = z @ se3_inverse(poses) @ se3_inverse(x)
    before = se3_log(se3_inverse(a) @ true)
    after = se3_log(se3_inverse(a @ se3_exp(found.robot_corrections)) @ true)
    assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))
    exact = views.residuals(found.predicted)
    both = views.residuals(found.camera_from_target)
    assert both.mean() < 0.2 * exact.mean()


def test_weighing_both_beats_trusting_the_robot():
    errors = np.zeros(2)
    for seed in range(8):
        views, a, x, _, _ = robot_and_views(seed, "eye_in_hand", (1e-3, 3e-3), 0.05)
        for k, noise in enumerate((None, (1e-6, 1e-6))):
            found = adjust_target_views(views, a, "eye_in_hand", noise)
            errors[k] += np.sum((found.x.translation - x[:3, 3]) ** 2)
    assert errors[0] < 0.6 * errors[1]


@pytest.mark.parametrize(
    ("points", "pixels", "message"),
    [
        (GRID[:3], np.zeros((1, 3, 2)), r"points must have shape \(p, 3\), p >= 4"),
        (GRID + 0.1, np.zeros((1, 35, 2)), "z = 0.*0.1 m"),
        (GRID, np.zeros((1, 34, 2)), r"pixels must have shape \(n, 35, 2\)"),
        (GRID, np.full((2, 35, 2), np.nan), "view 0 shows 0 of 35 points"),
    ],
)
def test_bad_input_is_named(points, pixels, message):
    with pytest.raises(InputError, match=message):
        target_views(CAMERA, points, pixels)


def recorded():
    """Dots of 15 real images and the wrist's poses beside them."""
    if not DATA.is_dir():
        pytest.skip(f"the data set rct_10x10 is not at {DATA}")
    dots = json.loads((DATA / "dots.json").read_text())
    pixels = np.array([dots[str(i)] for i in range(15)])
    points = np.array([[i % 10, i // 10, 0] for i in range(100)]) * 0.0254
    base_from_wrist = []
    for i in range(15):
        lines = (DATA / "poses" / f"{i}.yaml").read_text().splitlines()
        v = {k: float(t) for k, t in (line.split(":") for line in lines if line)}
        rotation = rotation_from_quaternion_wxyz([v[f"q{k}"] for k in "wxyz"])
        base_from_wrist.append(SE3.from_parts(rotation, [v[k] for k in "xyz"]).matrix)
    return points, pixels, np.array(base_from_wrist)


@pytest.mark.parametrize(
    ("intrinsics", "reprojection_px"),
    [
        ((550, 550, 0, 320, 240), 2.292),
        ((542.324, 543.515, 0, 320.474, 226.039), 1.938),
    ],
    ids=["nominal", "calibrated"],
)
def test_real_images_reproduce_the_published_answer(intrinsics, reprojection_px):
    points, pixels, a = recorded()
    camera = PinholeCamera("kinect", Intrinsics(*intrinsics), (640, 480))
    views = target_views(camera, points, pixels)
    # A robot without noise leaves the reprojection optimum; it stops a little short of
    # it, since each view's pixels enter through their pose.
    exact = adjust_target_views(views, a, "eye_in_hand", (1e-5, 1e-5))
    rms = np.sqrt(np.mean(views.residuals(exact.predicted) ** 2))
    assert rms == pytest.approx(reprojection_px, rel=0.01)
    # Published for the nominal camera: root of the cost (half the squares, per
    # coordinate) under 1.5 px, and on average under 20 mm and 3 degrees between the
    # target's poses by the robot and by each view alone.
    assert rms / 2 < 1.5
    found = adjust_target_views(views, a, "eye_in_hand")
    apart = found.predicted[:, :3, 3] - views.camera_from_target[:, :3, 3]
    turned = so3_log(
        (se3_inverse(views.camera_from_target) @ found.predicted)[:, :3, :3]
    )
    assert np.linalg.norm(apart, axis=1).mean() < 0.020
    assert np.degrees(np.linalg.norm(turned, axis=1).mean()) < 3.0
    # Modelled, both noises share the misfit and the target comes nearer to its views.
    assert (
        np.linalg.norm(apart, axis=1).mean()
        < 0.7
        * np.linalg.norm(
            exact.predicted[:, :3, 3] - views.camera_from_target[:, :3, 3], axis=1
        ).mean()
    )
    both = np.sqrt(np.mean(views.residuals(found.camera_from_target) ** 2))
    assert both < 0.6 * rms
    assert 2e-4 < found.robot_translation < 5e-3
    assert 0.05 < np.degrees(found.robot_rotation) < 0.6
