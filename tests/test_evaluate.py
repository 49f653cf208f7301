"""Held-out stations: exact data, predicted against measured, truth by name."""

import dataclasses

import numpy as np
import pytest

from handeye_tri.camera import Intrinsics, PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.evaluate import (
    against_prediction,
    compare_with_truth,
    evaluate_track,
    loop_residuals,
    track_budget,
)
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.records import (
    CameraCalibration,
    Covariance,
    HandEyeCalibration,
    Repeatability,
    motion_labels,
)
from handeye_tri.se3 import SE3
from handeye_tri.synthesize import reference_geometry, synthesize

NAMES = ("fx", "fy", "skew", "cx", "cy")
LABELS = (
    *(f"left.{name}" for name in NAMES),
    *(f"right.{name}" for name in NAMES),
    *motion_labels("base_from_left"),
    *motion_labels("base_from_right"),
    *motion_labels("flange_from_triangle"),
)
STD = np.array([0.3, 0.3, 0.1, 0.2, 0.2] * 2 + ([3e-5] * 3 + [1e-4] * 3) * 3)
REPEATABILITY = Repeatability(3e-5, np.radians(0.005))


def moved(geometry, change):
    """The true cell with the labelled parameters changed, shape (28,)."""
    flange_from_triangle = geometry.flange_from_triangle @ SE3.exp(change[22:])
    return HandEyeCalibration(
        cameras=tuple(
            PinholeCamera(
                camera.name,
                Intrinsics.from_vector(
                    camera.intrinsics.vector + change[5 * i : 5 * i + 5]
                ),
                camera.image_size,
            )
            for i, camera in enumerate(geometry.cameras)
        ),
        base_from_camera=tuple(
            motion @ SE3.exp(change[10 + 6 * i : 16 + 6 * i])
            for i, motion in enumerate(geometry.base_from_camera)
        ),
        flange_from_triangle=flange_from_triangle,
        markers=flange_from_triangle.apply(geometry.triangle.points),
        covariance=Covariance(LABELS, np.diag(STD**2)),
        chi2=0.0,
        dof=1,
        residuals=np.zeros((1, 6)),
        method="drawn",
    )


@pytest.fixture(scope="module")
def geometry():
    return reference_geometry(np.random.default_rng(0))


def test_exact_data_leave_no_error(geometry):
    session, _ = synthesize(geometry, np.random.default_rng(1), sigma_px=0.0)
    track = evaluate_track(moved(geometry, np.zeros(28)), session)
    assert len(track.distances) == 18
    assert track.max < 1e-12
    np.testing.assert_array_equal(track.stations, np.repeat(np.arange(22, 28), 3))
    np.testing.assert_array_equal(track.markers, np.tile([0, 1, 2], 6))


def test_sphere_outlines_are_corrected(geometry):
    session, _ = synthesize(
        geometry, np.random.default_rng(1), sigma_px=0.0, marker_radii=(8e-3,) * 3
    )
    calibration = moved(geometry, np.zeros(28))
    assert evaluate_track(calibration, session).max < 1e-8
    ignored = dataclasses.replace(session, marker_radii=np.zeros(3))
    assert evaluate_track(calibration, ignored).max > 1e-5


def test_predicted_covariance_is_the_spread_and_splits(geometry):
    # One source of error at a time, then all: each part predicts its own.
    cases = {
        "calibration": (1.0, 1e-4, 0.0),
        "pixels": (0.0, 0.05, 0.0),
        "robot": (0.0, 1e-4, 1.0),
        "total": (1.0, 0.05, 1.0),
    }
    trials = 60
    for name, (calibration, pixels, robot) in cases.items():
        squares, nees = [], []
        repeatability = Repeatability(
            robot * REPEATABILITY.translation, robot * REPEATABILITY.rotation
        )
        for seed in range(trials):
            session, _ = synthesize(
                geometry,
                np.random.default_rng([4, seed]),
                sigma_px=pixels,
                repeatability=repeatability,
            )
            error = STD * np.random.default_rng([5, seed]).standard_normal(28)
            found = moved(geometry, calibration * error)
            if not calibration:
                found = dataclasses.replace(
                    found, covariance=Covariance(LABELS, np.zeros((28, 28)))
                )
            track = evaluate_track(found, session)
            squares.append(track.rms**2)
            whitened = np.linalg.solve(
                track.predicted_covariance, track.errors[..., None]
            )[..., 0]
            nees.append((track.errors * whitened).sum(axis=1).mean() / 3)
        budget = track_budget(found, session)
        measured = np.sqrt(np.mean(squares))
        # Rows of a trial share the calibration: 60 trials know an RMS to some 7 %.
        assert measured == pytest.approx(getattr(budget, name), rel=0.2), name
        assert np.mean(nees) == pytest.approx(1.0, rel=0.3), name
        assert budget.total == pytest.approx(track.predicted_rms, rel=1e-12)


def test_ninety_five_of_a_hundred_tracks_are_consistent(geometry):
    """All rows share the calibration: the range must know that, or be too narrow."""
    outcomes, low, high = [], [], []
    for seed in range(150):
        session, _ = synthesize(
            geometry,
            np.random.default_rng([6, seed]),
            sigma_px=0.03,
            repeatability=REPEATABILITY,
        )
        error = STD * np.random.default_rng([7, seed]).standard_normal(28)
        judged = against_prediction(moved(geometry, error), session)
        outcomes.append(judged.outcome)
        low.append(judged.low)
        high.append(judged.high)
    counts = {name: outcomes.count(name) for name in ("consistent", "better", "worse")}
    # Binomial: 142.5 of 150 expected, with a standard deviation of 2.7.
    assert counts["consistent"] >= 134
    # As many independent rows would have an RMS that is known to a tenth.
    assert np.median(np.array(high) / low) > 1.8


def test_a_track_beside_its_prediction_is_said_to_be_so(geometry):
    for factor, outcome in ((0.3, "better"), (3.0, "worse")):
        session, _ = synthesize(
            geometry,
            np.random.default_rng(8),
            sigma_px=0.05 * factor,
            repeatability=Repeatability(0.0, 0.0),
        )
        session = dataclasses.replace(
            session, pixel_covariance=session.pixel_covariance / factor**2
        )
        exact = dataclasses.replace(
            moved(geometry, np.zeros(28)),
            covariance=Covariance(LABELS, np.zeros((28, 28))),
        )
        assert against_prediction(exact, session).outcome == outcome


def test_derivative_by_the_calibration_against_differences(geometry):
    # A covariance of one parameter alone gives the derivative up to its sign.
    session, _ = synthesize(geometry, np.random.default_rng(1), sigma_px=0.0)
    base = evaluate_track(moved(geometry, np.zeros(28)), session)
    for k in range(28):
        h = 1e-3 if k < 10 else 1e-6
        spike = np.zeros((28, 28))
        spike[k, k] = 1.0
        calibration = dataclasses.replace(
            moved(geometry, np.zeros(28)), covariance=Covariance(LABELS, spike)
        )
        predicted = track_budget(calibration, session).calibration
        shifted = [
            evaluate_track(moved(geometry, sign * h * np.eye(28)[k]), session)
            for sign in (1, -1)
        ]
        slope = (shifted[0].errors - shifted[1].errors) / (2 * h)
        numeric = np.sqrt((slope**2).sum(axis=1).mean())
        # Triangulation stops at 1e-13 m; divided by h that is 1e-7 of slopes near 1.
        assert predicted == pytest.approx(numeric, rel=1e-4, abs=1e-9), LABELS[k]
    assert base.max < 1e-12


def test_markers_seen_by_one_camera_have_no_row(geometry):
    session, _ = synthesize(geometry, np.random.default_rng(1), sigma_px=0.1)
    pixels = np.array(session.pixels)
    covariance = np.array(session.pixel_covariance)
    pixels[0, 23, 1] = np.nan
    covariance[0, 23, 1] = np.nan
    session = dataclasses.replace(session, pixels=pixels, pixel_covariance=covariance)
    track = evaluate_track(moved(geometry, np.zeros(28)), session)
    rows = list(zip(track.stations.tolist(), track.markers.tolist(), strict=True))
    assert len(rows) == 17
    assert (23, 1) not in rows


def test_nothing_held_out_is_an_error(geometry):
    session, _ = synthesize(geometry, np.random.default_rng(1), sigma_px=0.1)
    stations = tuple(
        dataclasses.replace(s, kind="calibration") for s in session.stations
    )
    with pytest.raises(InputError, match="held-out"):
        evaluate_track(
            moved(geometry, np.zeros(28)),
            dataclasses.replace(session, stations=stations),
        )


def test_truth_has_a_row_for_every_label_and_the_error_is_the_tangent(geometry):
    _, truth = synthesize(geometry, np.random.default_rng(1), sigma_px=0.1)
    change = STD * np.random.default_rng(2).standard_normal(28)
    rows = compare_with_truth(moved(geometry, change), truth)
    assert [row.quantity for row in rows[:28]] == list(LABELS)
    assert rows[28].quantity == "baseline.right"
    np.testing.assert_allclose([row.error for row in rows[:28]], change, atol=1e-13)
    np.testing.assert_allclose([row.sigma for row in rows[:28]], STD, rtol=1e-12)
    for row in rows[:10]:
        assert row.error == pytest.approx(row.estimate - row.truth)
    values = np.array([dataclasses.astuple(row)[1:] for row in rows])
    assert np.isfinite(values).all()


def test_baseline_and_its_sigma_do_not_need_the_stereo_labels(geometry):
    _, truth = synthesize(geometry, np.random.default_rng(1), sigma_px=0.1)
    draws = []
    for seed in range(150):
        change = STD * np.random.default_rng([3, seed]).standard_normal(28)
        row = compare_with_truth(moved(geometry, change), truth)[-1]
        draws.append(row.error)
        assert row.truth == pytest.approx(0.25)
    assert np.std(draws) == pytest.approx(row.sigma, rel=0.2)


def test_a_rotation_vector_near_pi_keeps_its_side(geometry):
    _, truth = synthesize(geometry, np.random.default_rng(1), sigma_px=0.1)
    exact = np.zeros(28)
    calibration = moved(geometry, exact)
    near = SE3.exp((0, 0, 0, 0, np.pi - 1e-5, 0))
    beyond = SE3.exp((0, 0, 0, 0, np.pi + 1e-5, 0))
    rows = compare_with_truth(
        dataclasses.replace(calibration, flange_from_triangle=beyond),
        dataclasses.replace(truth, flange_from_triangle=near),
    )
    (row,) = (r for r in rows if r.quantity == "flange_from_triangle.ry")
    assert row.estimate - row.truth == pytest.approx(2e-5, rel=1e-6)
    assert row.error == pytest.approx(2e-5, rel=1e-6)


def test_camera_calibration_alone_compares_too(geometry):
    _, truth = synthesize(geometry, np.random.default_rng(1), sigma_px=0.1)
    first = geometry.base_from_camera[0].inverse()
    labels = ("left.fx", "left.k1", *motion_labels("reference_from_right"))
    calibration = CameraCalibration(
        geometry.cameras,
        tuple(first @ motion for motion in geometry.base_from_camera),
        Covariance(labels, np.eye(8)),
        0.0,
        1,
        np.zeros((2, 1, 3, 2)),
        1.0,
        0.0,
        "truth",
    )
    rows = compare_with_truth(calibration, truth)
    assert [row.quantity for row in rows] == [*labels, "baseline.right"]
    assert max(abs(row.error) for row in rows) < 1e-12


def test_loop_residuals_are_lengths(geometry):
    residuals = np.zeros((2, 6))
    residuals[0, :3] = (3e-3, 4e-3, 0)
    residuals[1, 3:] = (0, 0, 2e-3)
    loop = loop_residuals(
        dataclasses.replace(moved(geometry, np.zeros(28)), residuals=residuals)
    )
    assert loop.translation_max == pytest.approx(5e-3)
    assert loop.translation_rms == pytest.approx(5e-3 / np.sqrt(2))
    assert loop.rotation_max == pytest.approx(2e-3)
    assert loop.rotation_rms == pytest.approx(2e-3 / np.sqrt(2))


def test_other_cameras_are_refused(geometry):
    session, truth = synthesize(geometry, np.random.default_rng(1), sigma_px=0.1)
    calibration = moved(geometry, np.zeros(28))
    swapped = dataclasses.replace(calibration, cameras=calibration.cameras[::-1])
    with pytest.raises(InputError, match=r"right, left"):
        evaluate_track(swapped, session)
    with pytest.raises(InputError, match=r"right, left"):
        compare_with_truth(swapped, truth)


def test_after_the_hand_eye_step(geometry):
    session, _ = synthesize(
        geometry, np.random.default_rng(6), sigma_px=0.03, repeatability=REPEATABILITY
    )
    first = geometry.base_from_camera[0].inverse()
    labels = (*LABELS[:10], *motion_labels("reference_from_right"))
    cameras = CameraCalibration(
        geometry.cameras,
        tuple(first @ motion for motion in geometry.base_from_camera),
        Covariance(labels, np.diag(np.r_[STD[:10] ** 2, np.full(6, 1e-12)])),
        0.0,
        1,
        np.zeros((2, 22, 3, 2)),
        1.0,
        0.0,
        "truth",
    )
    found = calibrate_hand_eye(session, cameras)
    track = evaluate_track(found, session)
    assert 2e-5 < track.rms < 3e-4
    budget = track_budget(found, session)
    assert min(budget.calibration, budget.pixels, budget.robot) > 1e-6
