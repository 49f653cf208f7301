"""The triangle's pose from all cameras: exact data, derivatives, covariance."""

import dataclasses

import numpy as np
import pytest

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.errors import ConvergenceError, InputError
from handeye_tri.hand_eye.camera_parameters import project_with_parameters
from handeye_tri.hand_eye.observed_poses import triangle_poses
from handeye_tri.records import CameraCalibration, Covariance, motion_labels
from handeye_tri.se3 import SE3, se3_inverse, se3_log
from handeye_tri.synthesize import reference_geometry, synthesize

LENS = Lens("radtan", np.array([-0.1, 0.05, 1e-3, -5e-4, 0.0]))
NAMES = ("fx", "fy", "skew", "cx", "cy", "k1", "k2", "p1", "p2")
LABELS = (
    *(f"left.{name}" for name in NAMES),
    *(f"right.{name}" for name in NAMES),
    *motion_labels("reference_from_right"),
)


def shifted(geometry, change):
    """The true cameras with a change, shape (24,), of the labelled parameters."""
    cameras = []
    for i, camera in enumerate(geometry.cameras):
        part = change[9 * i : 9 * i + 9]
        cameras.append(
            PinholeCamera(
                camera.name,
                Intrinsics.from_vector(camera.intrinsics.vector + part[:5]),
                camera.image_size,
                Lens("radtan", camera.lens.coefficients + np.append(part[5:], 0.0)),
            )
        )
    first = geometry.base_from_camera[0].inverse()
    motion = first @ geometry.base_from_camera[1] @ SE3.exp(change[18:])
    return CameraCalibration(
        tuple(cameras),
        (SE3.identity(), motion),
        Covariance(LABELS, np.eye(24)),
        0.0,
        1,
        np.zeros((2, 1, 3, 2)),
        1.0,
        0.0,
        "truth",
    )


@pytest.fixture(scope="module")
def geometry():
    return reference_geometry(
        np.random.default_rng(0),
        half_turns=3,
        evaluation_stations=0,
        skew=1.0,
        lens=LENS,
    )


def true_poses(geometry, truth):
    return (
        se3_inverse(geometry.base_from_camera[0].matrix)
        @ truth.base_from_flange
        @ geometry.flange_from_triangle.matrix
    )


def test_parameter_columns_against_differences(geometry):
    points = np.array([[0.05, -0.1, 0.9], [-0.1, 0.05, 1.0]])
    for i, name in enumerate(("left", "right")):
        cameras = shifted(geometry, np.zeros(24))
        frame = cameras.reference_from_camera[i].apply(points)
        _, by_point, columns = project_with_parameters(
            cameras.cameras[i], points, LABELS, "reference"
        )
        for k, label in enumerate(LABELS):
            h = 1e-3 if label.endswith(("fx", "fy", "skew", "cx", "cy")) else 1e-6
            pair = []
            for sign in (h, -h):
                moved = shifted(geometry, sign * np.eye(24)[k])
                local = moved.reference_from_camera[i].inverse().apply(frame)
                pair.append(moved.cameras[i].project(local))
            numeric = (pair[0] - pair[1]) / (2 * h)
            # Pixels of 1e3 carry 1e-13 of rounding, divided by h = 1e-6.
            np.testing.assert_allclose(columns[..., k], numeric, atol=3e-6)
            other = {"left": "right", "right": "left"}[name]
            if label.startswith(other) or label.startswith(f"reference_from_{other}"):
                assert not columns[..., k].any()
        assert by_point.shape == (2, 2, 3)


def test_exact_pixels_give_exact_poses(geometry):
    session, truth = synthesize(geometry, np.random.default_rng(1), sigma_px=0.0)
    found = triangle_poses(
        geometry.triangle,
        shifted(geometry, np.zeros(24)),
        session.pixels,
        session.pixel_covariance,
    )
    np.testing.assert_allclose(
        found.reference_from_triangle, true_poses(geometry, truth), atol=1e-12
    )
    np.testing.assert_array_equal(found.views, np.arange(6))
    assert found.chi2.max() < 1e-16


def test_sphere_outlines_are_corrected():
    plain = reference_geometry(np.random.default_rng(0), half_turns=3)
    radii = np.array([10e-3, 8e-3, 6.5e-3])
    session, truth = synthesize(
        plain, np.random.default_rng(1), sigma_px=0.0, marker_radii=radii
    )
    labels = motion_labels("reference_from_right")
    cameras = dataclasses.replace(
        shifted(plain, np.zeros(24)), covariance=Covariance(labels, np.eye(6))
    )
    expected = true_poses(plain, truth)
    for used, tolerance in ((radii, 1e-8), (np.zeros(3), None)):
        found = triangle_poses(
            plain.triangle, cameras, session.pixels, session.pixel_covariance, used
        )
        error = np.abs(found.reference_from_triangle - expected).max()
        if tolerance is None:
            assert error > 1e-5
        else:
            assert error < tolerance


def test_unseen_markers_cost_a_view_only_below_two_cameras(geometry):
    session, truth = synthesize(geometry, np.random.default_rng(1), sigma_px=0.0)
    pixels = np.array(session.pixels)
    pixels[0, 2, 1] = np.nan
    found = triangle_poses(
        geometry.triangle,
        shifted(geometry, np.zeros(24)),
        pixels,
        session.pixel_covariance,
    )
    np.testing.assert_array_equal(found.views, [0, 1, 3, 4, 5])
    np.testing.assert_allclose(
        found.reference_from_triangle,
        true_poses(geometry, truth)[found.views],
        atol=1e-12,
    )
    pixels[1] = np.nan
    with pytest.raises(InputError, match="none of the 6 views"):
        triangle_poses(
            geometry.triangle,
            shifted(geometry, np.zeros(24)),
            pixels,
            session.pixel_covariance,
        )


def test_a_third_camera_that_misses_a_marker_still_helps(geometry):
    third = PinholeCamera("third", geometry.cameras[0].intrinsics, (1024, 768))
    where = geometry.base_from_camera[0] @ SE3.exp((0.0, 0.1, 0.0, 0.0, 0.0, 0.0))
    three = dataclasses.replace(
        geometry,
        cameras=(*geometry.cameras, third),
        base_from_camera=(*geometry.base_from_camera, where),
    )
    session, truth = synthesize(three, np.random.default_rng(1), sigma_px=0.0)
    pair = shifted(geometry, np.zeros(24))
    cameras = dataclasses.replace(
        pair,
        cameras=three.cameras,
        residuals=np.zeros((3, 1, 3, 2)),
        reference_from_camera=(
            *pair.reference_from_camera,
            geometry.base_from_camera[0].inverse() @ where,
        ),
    )
    pixels = np.array(session.pixels)
    pixels[2, :, 0] = np.nan
    found = triangle_poses(geometry.triangle, cameras, pixels, session.pixel_covariance)
    two = triangle_poses(
        geometry.triangle, pair, pixels[:2], session.pixel_covariance[:2]
    )
    np.testing.assert_allclose(
        found.reference_from_triangle, true_poses(three, truth), atol=1e-12
    )
    smaller = np.linalg.eigvalsh(two.covariance - found.covariance)
    assert smaller.min() > -1e-12
    assert smaller.max(axis=1).min() > 0


def test_derivative_by_the_cameras_against_the_estimator_itself(geometry):
    session, _ = synthesize(geometry, np.random.default_rng(1), sigma_px=0.05)
    arguments = (session.pixels, session.pixel_covariance)
    found = triangle_poses(
        geometry.triangle, shifted(geometry, np.zeros(24)), *arguments
    )
    rng = np.random.default_rng(2)
    scale = np.array([0.02] * 5 + [1e-5] * 4 + [0.02] * 5 + [1e-5] * 4 + [1e-6] * 6)
    change = scale * rng.standard_normal(24)
    moved = triangle_poses(geometry.triangle, shifted(geometry, change), *arguments)
    measured = se3_log(
        se3_inverse(found.reference_from_triangle) @ moved.reference_from_triangle
    )
    predicted = found.by_cameras @ change
    # Left out: terms in the residuals (0.05 px of 1e2 px of parallax) and squares.
    np.testing.assert_allclose(measured, predicted, atol=0.01 * np.abs(predicted).max())


def test_covariance_is_the_spread(geometry):
    cameras = shifted(geometry, np.zeros(24))
    nees, chi2 = [], []
    for seed in range(60):
        session, truth = synthesize(
            geometry, np.random.default_rng([3, seed]), sigma_px=0.1
        )
        found = triangle_poses(
            geometry.triangle, cameras, session.pixels, session.pixel_covariance
        )
        error = se3_log(
            se3_inverse(found.reference_from_triangle) @ true_poses(geometry, truth)
        )
        nees.extend(
            np.einsum(
                "ni,ni->n",
                error,
                np.linalg.solve(found.covariance, error[..., None])[..., 0],
            )
            / 6
        )
        chi2.extend(found.chi2 / 6)
    # 360 normalised chi-squares of 6 degrees of freedom: standard deviation 0.030.
    assert abs(np.mean(nees) - 1) < 0.12
    assert abs(np.mean(chi2) - 1) < 0.12


def test_bad_input_is_named(geometry):
    session, _ = synthesize(geometry, np.random.default_rng(1), sigma_px=0.1)
    cameras = shifted(geometry, np.zeros(24))
    with pytest.raises(InputError, match=r"pixels must have shape \(2, n, 3, 2\)"):
        triangle_poses(
            geometry.triangle, cameras, session.pixels[:1], session.pixel_covariance
        )
    with pytest.raises(InputError, match="covariance must have shape"):
        triangle_poses(
            geometry.triangle, cameras, session.pixels, session.pixel_covariance[:1]
        )


def test_views_in_a_wrong_order_are_reported(geometry):
    session, _ = synthesize(geometry, np.random.default_rng(1), sigma_px=0.01)
    # The right camera's views belong to other stations: no pose explains both.
    pixels = np.array(session.pixels)
    pixels[1] = np.roll(pixels[1], 1, axis=0)
    with pytest.raises((ConvergenceError, InputError)):
        triangle_poses(
            geometry.triangle,
            shifted(geometry, np.zeros(24)),
            pixels,
            session.pixel_covariance,
        )


def test_a_camera_over_the_circumcircle_loses_views_that_have_no_pose(geometry):
    """Three points and one camera: near that cylinder two poses merge into one."""
    triangle = geometry.triangle
    radius = np.linalg.norm(triangle.circumcentre)
    out = 0.97 * radius * np.array([-0.6, -0.8])
    over = np.append(triangle.circumcentre + out, 0.0)
    # Upside down, so that the triangle looks at the camera 0.9 m away.
    facing = np.diag([1.0, -1.0, -1.0])
    pose = SE3.from_parts(facing, np.array([0.0, 0.0, 0.9]) - facing @ over)
    camera = PinholeCamera("left", Intrinsics(1720.0, 1715.0, 0.0, 511.5, 383.5),
                           (1024, 768))  # fmt: skip
    calibrated = CameraCalibration(
        (camera,),
        (SE3.identity(),),
        Covariance(("left.fx",), np.eye(1)),
        0.0,
        1,
        np.zeros((1, 1, 3, 2)),
        1.0,
        0.0,
        "truth",
    )
    pixels = camera.project(pose.apply(triangle.points))
    pixels = pixels + 0.1 * np.random.default_rng(0).normal(size=(1, 40, 3, 2))
    covariance = np.broadcast_to(0.01 * np.eye(2), (1, 40, 3, 2, 2))
    start = np.tile(pose.matrix, (40, 1, 1))
    found = triangle_poses(triangle, calibrated, pixels, covariance, start=start)
    # Noise leaves many of them without a pose that has these pixels.
    assert 5 < len(found.views) < 35
    assert found.chi2.max() < 1e-6
    assert len(found.reference_from_triangle) == len(found.views)
    lost = np.setdiff1d(np.arange(40), found.views)
    with pytest.raises(ConvergenceError, match="did not settle"):
        triangle_poses(
            triangle,
            calibrated,
            pixels[:, lost],
            covariance[:, lost],
            start=start[lost],
        )
