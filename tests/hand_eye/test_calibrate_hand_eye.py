"""The hand-eye step of a session: exact data, joint covariance, errors."""

import dataclasses

import numpy as np
import pytest

from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.camera import Intrinsics, PinholeCamera
from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.evaluate import compare_with_truth, evaluate_track
from handeye_tri.hand_eye import RELATIVE_METHODS, calibrate_hand_eye
from handeye_tri.records import (
    CameraCalibration,
    Covariance,
    Repeatability,
    motion_labels,
    triangle_name,
)
from handeye_tri.se3 import SE3
from handeye_tri.synthesize import (
    reference_geometry,
    synthesize,
    two_mount_geometry,
)

NAMES = ("fx", "fy", "skew", "cx", "cy")
LABELS = (
    *(f"left.{name}" for name in NAMES),
    *(f"right.{name}" for name in NAMES),
    *motion_labels("reference_from_right"),
)
# Pixels, metres and radians; small enough that the pixels hardly object.
STD = np.array([0.1, 0.1, 0.02, 0.06, 0.06] * 2 + [3e-6] * 3 + [6e-6] * 3)
REPEATABILITY = Repeatability(3e-5, np.radians(0.005))


def drawn_cameras(geometry, rng=None):
    """The true cameras, or with rng cameras off by errors of the stated covariance."""
    error = np.zeros(16) if rng is None else STD * rng.standard_normal(16)
    cameras = tuple(
        PinholeCamera(
            camera.name,
            Intrinsics.from_vector(camera.intrinsics.vector - error[5 * i : 5 * i + 5]),
            camera.image_size,
        )
        for i, camera in enumerate(geometry.cameras)
    )
    first = geometry.base_from_camera[0].inverse()
    motion = first @ geometry.base_from_camera[1] @ SE3.exp(-error[10:])
    return CameraCalibration(
        cameras,
        (SE3.identity(), motion),
        Covariance(LABELS, np.diag(STD**2)),
        0.0,
        1,
        np.zeros((2, 22, 3, 2)),
        1.0,
        0.0,
        "drawn",
    )


@pytest.fixture(scope="module")
def geometry():
    return reference_geometry(np.random.default_rng(0))


def test_exact_data_give_the_exact_cell(geometry):
    session, truth = synthesize(geometry, np.random.default_rng(1), sigma_px=0.0)
    found = calibrate_hand_eye(session, drawn_cameras(geometry))
    for row in compare_with_truth(found, truth):
        assert abs(row.error) < 1e-12, row
    np.testing.assert_allclose(
        found.markers,
        geometry.flange_from_triangle.apply(geometry.triangle.points),
        atol=1e-12,
    )
    assert set(found.alternatives) == {*RELATIVE_METHODS, "shah", "li"}
    for motion in found.alternatives.values():
        np.testing.assert_allclose(
            motion.matrix, truth.base_from_camera[0].matrix, atol=1e-11
        )
    assert found.chi2 < 1e-15
    assert found.dof == 6 * 22 - 12
    assert np.abs(found.residuals).max() < 1e-12


@pytest.fixture(scope="module")
def both():
    return two_mount_geometry(np.random.default_rng(0), half_turns=5)


def test_exact_data_give_both_mounts(both):
    session, truth = synthesize(both, np.random.default_rng(1), sigma_px=0.0)
    found = calibrate_hand_eye(session, drawn_cameras(both))
    rows = compare_with_truth(found, truth)
    assert {"flange_from_triangle.x", "flange_from_triangle_2.x"} <= {
        row.quantity for row in rows
    }
    for row in rows:
        assert abs(row.error) < 1e-12, row
    (second,) = found.other_mounts
    np.testing.assert_allclose(
        second.markers, truth.other_mounts[0].markers, atol=1e-12
    )
    assert set(found.alternatives) == set(RELATIVE_METHODS)
    for motion in found.alternatives.values():
        np.testing.assert_allclose(
            motion.matrix, truth.base_from_camera[0].matrix, atol=1e-11
        )
    assert found.dof == 6 * 20 - 18
    assert found.chi2 < 1e-15
    assert np.abs(found.residuals).max() < 1e-12


def about(geometry, axis, *, turn=0.5, count=6):
    """The geometry with its first poses turned about one axis of the base."""
    first = geometry.stations[0].base_from_flange
    pivot = SE3.from_parts(np.eye(3), (0.45, 0.0, 0.42))
    motions = [
        pivot @ SE3.exp((0, 0, 0, *(angle * np.asarray(axis)))) @ pivot.inverse()
        for angle in np.linspace(-turn, turn, count)
    ]
    stations = tuple(
        dataclasses.replace(
            geometry.stations[0], index=j, base_from_flange=motion @ first
        )
        for j, motion in enumerate(motions)
    )
    return dataclasses.replace(geometry, stations=stations, half_turns=())


def test_one_axis_with_each_mount_is_enough_if_they_differ():
    rng = np.random.default_rng(0)
    one, two = (reference_geometry(rng, half_turns=1) for _ in range(2))
    turned = about(one, (0, 0, 1)), about(two, (0, 1, 0))
    other = SE3.exp((-0.03, 0.01, 0.05, 0.1, 0.2, -0.1)) @ two.flange_from_triangle
    two = dataclasses.replace(turned[1], flange_from_triangle=other)
    session, truth = synthesize(turned[0].followed_by(two), rng, sigma_px=0.0)
    found = calibrate_hand_eye(session, drawn_cameras(one))
    for row in compare_with_truth(found, truth):
        assert abs(row.error) < 1e-11, row
    # Each by itself, and both about the same axis, leave the cameras open.
    parallel = dataclasses.replace(about(one, (0, 0, 1)), flange_from_triangle=other)
    for geometry in (turned[0], turned[1], turned[0].followed_by(parallel)):
        session, _ = synthesize(geometry, rng, sigma_px=0.0)
        with pytest.raises(DegenerateMotionError, match="parallel"):
            calibrate_hand_eye(session, drawn_cameras(one))


def test_one_half_turn_with_each_mount_leaves_two_answers():
    rng = np.random.default_rng(0)
    few = two_mount_geometry(rng, half_turns=1, evaluation_stations=0)
    session, _ = synthesize(few, rng, sigma_px=0.0)
    with pytest.raises(DegenerateMotionError, match="ambiguous"):
        calibrate_hand_eye(session, drawn_cameras(few))


@pytest.mark.parametrize(
    ("kept", "words"),
    [
        ([], "mount 2 .* 0 calibration stations .* add"),
        ([13], "mount 2 .* 1 calibration station with .* leave its stations out"),
    ],
)
def test_a_mount_without_enough_stations_is_named(both, kept, words):
    session, _ = synthesize(both, np.random.default_rng(1), sigma_px=0.1)
    pixels = np.array(session.pixels)
    lost = np.setdiff1d(np.flatnonzero(session.mounts == 1), kept)
    pixels[0, lost, 1] = np.nan
    with pytest.raises(InputError, match=words):
        calibrate_hand_eye(
            dataclasses.replace(session, pixels=pixels), drawn_cameras(both)
        )


def test_covariance_of_both_mounts_is_the_spread(both):
    keep = [
        *LABELS[:10],
        *motion_labels("base_from_left"),
        *motion_labels("base_from_right"),
        *motion_labels(triangle_name(0)),
        *motion_labels(triangle_name(1)),
    ]
    nees, chi2 = [], []
    for seed in range(30):
        session, truth = synthesize(
            both,
            np.random.default_rng([1, seed]),
            sigma_px=0.05,
            repeatability=REPEATABILITY,
        )
        found = calibrate_hand_eye(
            session, drawn_cameras(both, np.random.default_rng([2, seed]))
        )
        rows = {row.quantity: row.error for row in compare_with_truth(found, truth)}
        error = np.array([rows[label] for label in keep])
        nees.append(error @ np.linalg.solve(found.covariance.block(keep), error) / 34)
        chi2.append(found.chi2 / found.dof)
    # Means of 30 normalised chi-squares of 34 and 102 degrees of freedom: standard
    # deviations of 0.044 and 0.026.
    assert abs(np.mean(nees) - 1) < 0.18
    assert abs(np.mean(chi2) - 1) < 0.1


def test_joint_covariance_is_the_spread(geometry):
    keep = [
        *LABELS[:10],
        *motion_labels("base_from_left"),
        *motion_labels("base_from_right"),
        *motion_labels("flange_from_triangle"),
    ]
    nees, chi2 = [], []
    for seed in range(60):
        session, truth = synthesize(
            geometry,
            np.random.default_rng([1, seed]),
            sigma_px=0.05,
            repeatability=REPEATABILITY,
        )
        found = calibrate_hand_eye(
            session, drawn_cameras(geometry, np.random.default_rng([2, seed]))
        )
        rows = {row.quantity: row.error for row in compare_with_truth(found, truth)}
        error = np.array([rows[label] for label in keep])
        # Not an inverse of the whole: the stereo motion repeats the two in the base.
        nees.append(error @ np.linalg.solve(found.covariance.block(keep), error) / 28)
        chi2.append(found.chi2 / found.dof)
    # Means of 60 normalised chi-squares of 28 and 120 degrees of freedom: standard
    # deviations of 0.035 and 0.017.
    assert abs(np.mean(nees) - 1) < 0.14
    assert abs(np.mean(chi2) - 1) < 0.07


def test_covariance_is_consistent_across_its_blocks(geometry):
    session, _ = synthesize(
        geometry, np.random.default_rng(1), sigma_px=0.05, repeatability=REPEATABILITY
    )
    cameras = drawn_cameras(geometry)
    found = calibrate_hand_eye(session, cameras)
    np.testing.assert_allclose(
        found.covariance.block(LABELS), cameras.covariance.matrix, rtol=1e-12
    )
    # base_from_right = base_from_left @ reference_from_right, errors included.
    left = list(motion_labels("base_from_left"))
    stereo = list(motion_labels("reference_from_right"))
    motion = cameras.reference_from_camera[1]
    chain = np.hstack([motion.inverse().adjoint(), np.eye(6)])
    expected = chain @ found.covariance.block(left + stereo) @ chain.T
    actual = found.covariance.block(motion_labels("base_from_right"))
    np.testing.assert_allclose(actual, expected, atol=1e-9 * np.abs(expected).max())


def test_camera_errors_move_the_result_as_the_covariance_says(geometry):
    # One camera error at a time, noise-free: the joint covariance's cross block over
    # the camera's variance is the derivative.
    session, _ = synthesize(geometry, np.random.default_rng(1), sigma_px=0.0)
    base = drawn_cameras(geometry)
    found = calibrate_hand_eye(session, base)
    for k, label in ((0, "left.fx"), (6, "right.fy"), (12, "reference_from_right.z")):
        rows = [
            *motion_labels("base_from_left"),
            *motion_labels("flange_from_triangle"),
        ]
        block = found.covariance.block([label, *rows])
        derivative = block[1:, 0] / block[0, 0]
        change = np.zeros(16)
        change[k] = 0.01 if k < 10 else 1e-6
        moved_cameras = dataclasses.replace(
            base,
            cameras=tuple(
                PinholeCamera(
                    c.name,
                    Intrinsics.from_vector(
                        c.intrinsics.vector + change[5 * i : 5 * i + 5]
                    ),
                    c.image_size,
                )
                for i, c in enumerate(base.cameras)
            ),
            reference_from_camera=(
                SE3.identity(),
                base.reference_from_camera[1] @ SE3.exp(change[10:]),
            ),
        )
        moved = calibrate_hand_eye(session, moved_cameras)
        measured = np.append(
            (found.base_from_camera[0].inverse() @ moved.base_from_camera[0]).log(),
            (found.flange_from_triangle.inverse() @ moved.flange_from_triangle).log(),
        )
        np.testing.assert_allclose(
            measured,
            derivative * change[k],
            atol=0.01 * np.abs(measured).max(),
        )


def test_evaluation_stations_are_never_used(geometry):
    session, _ = synthesize(geometry, np.random.default_rng(1), sigma_px=0.1)
    pixels = np.array(session.pixels)
    pixels[:, session.indices("evaluation")] = 0.0
    cameras = drawn_cameras(geometry)
    first = calibrate_hand_eye(session, cameras)
    second = calibrate_hand_eye(dataclasses.replace(session, pixels=pixels), cameras)
    np.testing.assert_array_equal(first.markers, second.markers)


def test_a_station_with_a_hidden_marker_is_left_out(geometry):
    session, truth = synthesize(geometry, np.random.default_rng(1), sigma_px=0.0)
    pixels = np.array(session.pixels)
    pixels[0, 3, 2] = np.nan
    found = calibrate_hand_eye(
        dataclasses.replace(session, pixels=pixels), drawn_cameras(geometry)
    )
    assert len(found.residuals) == 21
    assert found.dof == 6 * 21 - 12
    error = truth.base_from_camera[0].inverse() @ found.base_from_camera[0]
    assert np.abs(error.log()).max() < 1e-12


def test_cameras_of_another_session_are_refused(geometry):
    session, _ = synthesize(geometry, np.random.default_rng(1), sigma_px=0.1)
    cameras = drawn_cameras(geometry)
    swapped = dataclasses.replace(cameras, cameras=cameras.cameras[::-1])
    with pytest.raises(InputError, match=r"\(right, left\), the session's are"):
        calibrate_hand_eye(session, swapped)


def test_too_few_stations_are_refused(geometry):
    session, _ = synthesize(geometry, np.random.default_rng(1), sigma_px=0.1)
    pixels = np.array(session.pixels)
    pixels[0, 2:22, 0] = np.nan
    with pytest.raises(InputError, match="only 2 of 22 calibration stations"):
        calibrate_hand_eye(
            dataclasses.replace(session, pixels=pixels), drawn_cameras(geometry)
        )


def test_a_single_half_turn_seen_twice_is_degenerate(geometry):
    session, _ = synthesize(geometry, np.random.default_rng(1), sigma_px=0.0)
    again = tuple(
        dataclasses.replace(session.stations[j % 2], index=j) for j in range(4)
    )
    repeated = dataclasses.replace(
        session,
        stations=again,
        half_turns=session.half_turns[:1],
        pixels=session.pixels[:, [0, 1, 0, 1]],
        pixel_covariance=session.pixel_covariance[:, [0, 1, 0, 1]],
    )
    with pytest.raises(DegenerateMotionError, match="parallel"):
        calibrate_hand_eye(repeated, drawn_cameras(geometry))


@pytest.mark.parametrize("axis", ["normal", "CA", "normal, then BC"])
def test_sigmas_hold_after_calibrating_the_cameras_from_the_same_pixels(axis):
    # The propagation takes camera errors and pose errors as uncorrelated although
    # both come from the same pixels; measured on the whole chain.
    nees, chi2, track = [], [], []
    for seed in range(15):
        rng = np.random.default_rng([7, seed])
        if "then" in axis:
            cell = two_mount_geometry(rng)
        else:
            cell = reference_geometry(rng, axis=axis)
        session, truth = synthesize(
            cell,
            np.random.default_rng([8, seed]),
            sigma_px=0.05,
            repeatability=REPEATABILITY,
        )
        found = calibrate_hand_eye(session, calibrate_session_cameras(session))
        rows = [
            row
            for row in compare_with_truth(found, truth)
            if not row.quantity.startswith(("reference_from", "baseline"))
        ]
        error = np.array([row.error / row.sigma for row in rows])
        block = found.covariance.block([row.quantity for row in rows])
        std = np.sqrt(np.diagonal(block))
        correlation = block / np.outer(std, std)
        nees.append(error @ np.linalg.solve(correlation, error) / len(rows))
        chi2.append(found.chi2 / found.dof)
        evaluation = evaluate_track(found, session)
        track.append((evaluation.rms, evaluation.predicted_rms))
    # Means of 15 normalised chi-squares of 28 (34 with two mounts) and 120 degrees of
    # freedom: standard deviations of 0.07 and 0.034.
    assert abs(np.mean(nees) - 1) < 0.28
    assert abs(np.mean(chi2) - 1) < 0.14
    measured, predicted = np.sqrt(np.mean(np.square(track), axis=0))
    assert measured == pytest.approx(predicted, rel=0.2)
