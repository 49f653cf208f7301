"""A cell of one camera: the three markers of a view place the whole triangle."""

from dataclasses import replace

import numpy as np
import pytest

from handeye_tri.adjustment import adjust
from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.errors import InputError
from handeye_tri.evaluate import (
    against_prediction,
    evaluate_track,
    predicted_track_error,
    track_budget,
)
from handeye_tri.evaluate.one_view import seen_by_one
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.records import Covariance, Repeatability
from handeye_tri.se3 import SE3, se3_exp
from handeye_tri.synthesize import reference_geometry, synthesize

ROBOT = Repeatability(3e-5, float(np.radians(0.005)))
SIGMA = 0.03


def one_camera(seed, sigma_px=SIGMA, robot=ROBOT, radii=(0.0, 0.0, 0.0), stations=6):
    """The reference cell without its right camera."""
    geometry = reference_geometry(
        np.random.default_rng([1, seed]), evaluation_stations=stations
    )
    geometry = replace(
        geometry,
        cameras=geometry.cameras[:1],
        base_from_camera=geometry.base_from_camera[:1],
    )
    return synthesize(
        geometry,
        np.random.default_rng([2, seed]),
        sigma_px=sigma_px,
        repeatability=robot,
        marker_radii=radii,
    )


def calibrated(session):
    return adjust(
        session, calibrate_hand_eye(session, calibrate_session_cameras(session))
    )


@pytest.fixture(scope="module")
def cell():
    session, _ = one_camera(3)
    return calibrated(session), session


@pytest.mark.parametrize("radii", [(0.0, 0.0, 0.0), (0.006, 0.008, 0.01)])
def test_exact_pixels_give_the_exact_cell(radii):
    session, truth = one_camera(0, 0.0, None, radii)
    found = calibrated(session)
    assert evaluate_track(found, session).max < 1e-8
    np.testing.assert_allclose(found.markers, truth.markers, atol=1e-8)
    np.testing.assert_allclose(
        found.base_from_camera[0].matrix, truth.base_from_camera[0].matrix, atol=1e-8
    )


def test_the_reported_pose_only_says_which_of_the_poses_is_meant(cell):
    found, session = cell
    places = session.indices("evaluation")
    reported = session.base_from_flange[places]
    view = session.pixels[0, places], session.pixel_covariance[0, places]
    first = seen_by_one(
        found, *view, session.marker_radii, reported, session.mounts[places]
    )
    off = reported @ se3_exp(np.array([0.002, -0.001, 0.003, 0.004, 0.003, -0.002]))
    second = seen_by_one(
        found, *view, session.marker_radii, off, session.mounts[places]
    )
    assert len(first.views) == len(places)
    np.testing.assert_allclose(first.points, second.points, atol=1e-10)


def test_derivatives_are_those_of_the_placed_markers(cell):
    found, session = cell
    places = session.indices("evaluation")
    reported = session.base_from_flange[places]
    pixels, noise = session.pixels[0, places], session.pixel_covariance[0, places]
    radii = session.marker_radii
    mounts = session.mounts[places]
    seen = seen_by_one(found, pixels, noise, radii, reported, mounts)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-3
        plus, minus = (
            seen_by_one(
                found,
                pixels + sign * step.reshape(3, 2),
                noise,
                radii,
                reported,
                mounts,
            ).points
            for sign in (1, -1)
        )
        # The noise is SIGMA times the identity.
        expected = SIGMA * (plus - minus) / 2e-3
        np.testing.assert_allclose(seen.by_pixels[..., k], expected, atol=1e-9)

    def moved(label, step):
        camera, place = found.cameras[0], found.base_from_camera[0]
        if label == "left.fx":
            k = camera.intrinsics
            camera = replace(camera, intrinsics=replace(k, fx=k.fx + step))
        markers = np.array(found.markers)
        if label == "marker_B.y":
            markers[1, 1] += step
        if label == "base_from_left.ry":
            place = place @ SE3.exp([0, 0, 0, 0, step, 0])
        other = replace(
            found, cameras=(camera,), base_from_camera=(place,), markers=markers
        )
        return seen_by_one(other, pixels, noise, radii, reported, mounts).points

    labels = found.covariance.labels
    for label, step in (
        ("left.fx", 1e-2), ("marker_B.y", 1e-6), ("base_from_left.ry", 1e-6)
    ):  # fmt: skip
        expected = (moved(label, step) - moved(label, -step)) / (2 * step)
        found_slope = seen.by_parameters[..., labels.index(label)]
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found_slope, expected, atol=1e-4 * scale)


def test_the_track_is_as_predicted_and_its_parts_add_up():
    """24 cells of 18 rows: a ratio is known to some 7 %, chi2/dof to 2 %."""
    squares, predicted, chi2, inside = [], [], [], 0
    for seed in range(24):
        session, _ = one_camera(seed)
        found = calibrated(session)
        track = evaluate_track(found, session)
        squares.append(track.rms**2)
        predicted.append(track.predicted_rms**2)
        chi2.append(found.chi2 / found.dof)
        inside += against_prediction(found, session).outcome == "consistent"
        parts = list(track_budget(found, session).parts().values())
        assert np.linalg.norm(parts) == pytest.approx(track.predicted_rms)
    assert np.sqrt(np.mean(squares) / np.mean(predicted)) == pytest.approx(1, abs=0.2)
    assert np.mean(chi2) == pytest.approx(1, abs=0.08)
    assert inside >= 20


def test_the_map_is_the_mean_of_simulated_views(cell):
    found, session = cell
    turns = session.base_from_flange[:3, :3, :3]
    point = np.array([0.47, 0.02, 0.42])
    exact = replace(
        found,
        covariance=Covariance(
            found.covariance.labels, np.zeros_like(found.covariance.matrix)
        ),
    )
    expected = predicted_track_error(exact, point, turns, sigma_px=SIGMA)
    camera, place = found.cameras[0], found.base_from_camera[0]
    rng, squares = np.random.default_rng(5), []
    for turn in turns:
        for k in range(3):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turn, point - turn @ found.markers[k]
            seen = camera.project(
                place.inverse().apply(found.markers @ turn.T + pose[:3, 3])
            )
            noisy = seen + SIGMA * rng.normal(size=(400, 3, 2))
            noise = np.broadcast_to(SIGMA**2 * np.eye(2), (400, 3, 2, 2))
            points = seen_by_one(
                found,
                noisy,
                noise,
                np.zeros(3),
                np.tile(pose, (400, 1, 1)),
                np.zeros(400, int),
            ).points
            squares.append(np.square(points[:, k] - point).sum(axis=1).mean())
    assert np.sqrt(np.trace(expected)) == pytest.approx(
        np.sqrt(np.mean(squares)), rel=0.05
    )
    away = predicted_track_error(found, [5.0, 5.0, 5.0], turns)
    assert np.isnan(away).all()


def test_a_view_that_lacks_a_marker_places_nothing(cell):
    found, session = cell
    first, *rest = session.indices("evaluation").tolist()
    pixels = np.array(session.pixels)
    pixels[0, first, 1] = np.nan
    covariance = np.where(
        np.isfinite(pixels)[..., None], session.pixel_covariance, np.nan
    )
    part = replace(session, pixels=pixels, pixel_covariance=covariance)
    assert set(evaluate_track(found, part).stations.tolist()) == set(rest)
    pixels[0, rest] = np.nan
    covariance = np.where(
        np.isfinite(pixels)[..., None], session.pixel_covariance, np.nan
    )
    part = replace(session, pixels=pixels, pixel_covariance=covariance)
    with pytest.raises(InputError, match="only camera"):
        evaluate_track(found, part)
