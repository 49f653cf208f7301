"""Every view against its prediction: exact data, likelihood, reasons."""

from dataclasses import replace

import numpy as np
import pytest
from finished_session import finished

from handeye_tri.evaluate.views import check_views, predicted_pixels
from handeye_tri.records import DroppedHalfTurn, Repeatability
from handeye_tri.synthesize import reference_geometry, synthesize


def truth_as_result(geometry, calibration):
    """The true cell in the place of an estimate."""
    return replace(
        calibration,
        cameras=geometry.cameras,
        base_from_camera=geometry.base_from_camera,
        flange_from_triangle=geometry.flange_from_triangle,
        markers=geometry.flange_from_triangle.apply(geometry.triangle.points),
    )


@pytest.fixture(scope="module")
def geometry():
    return reference_geometry(np.random.default_rng(5), half_turns=6)


def test_exact_views_are_predicted_exactly(geometry):
    session, _ = synthesize(
        geometry, np.random.default_rng(1), sigma_px=0.0, marker_radii=(0.01,) * 3
    )
    calibration = truth_as_result(geometry, finished().calibration)
    residuals = session.pixels - predicted_pixels(calibration, session)
    assert np.nanmax(np.abs(residuals)) < 1e-9


def test_sigmas_are_those_of_pixels_and_robot(geometry):
    """Squared sigmas of two normal components have the mean 2."""
    calibration = truth_as_result(geometry, finished().calibration)
    largest = []
    for seed in range(12):
        session, _ = synthesize(
            geometry,
            np.random.default_rng([2, seed]),
            sigma_px=0.03,
            repeatability=Repeatability(5e-5, np.radians(0.01)),
            marker_radii=(0.008,) * 3,
        )
        largest += [check.worst_sigmas for check in check_views(calibration, session)]
    # The largest of three that share the robot's error: between one and three
    # independent draws, whose mean squares are 2 and 11/3; 432 views.
    mean_square = np.mean(np.square(largest))
    assert 2.0 < mean_square < 11 / 3
    assert max(largest) < 5.5


def test_the_worst_comes_first_and_a_far_marker_is_named(geometry):
    session, _ = synthesize(geometry, np.random.default_rng(3), sigma_px=0.03)
    pixels = session.pixels.copy()
    pixels[1, 4, 2] += [0.5, -0.5]
    session = replace(session, pixels=pixels)
    calibration = truth_as_result(geometry, finished().calibration)
    checks = check_views(calibration, session)
    assert len(checks) == 2 * len(session.stations)
    first = checks[0]
    assert (first.camera, first.station, first.worst) == ("right", 4, "C")
    assert first.code == "FAR"
    assert first.worst_px == pytest.approx(np.hypot(0.5, 0.5), abs=0.15)
    assert not first.held_out
    assert checks[-1].worst_sigmas <= checks[1].worst_sigmas
    assert {check.code for check in checks[1:]} == {""}


def test_what_was_not_seen_is_named_and_comes_last(geometry):
    session, _ = synthesize(geometry, np.random.default_rng(3), sigma_px=0.03)
    pixels = session.pixels.copy()
    covariance = session.pixel_covariance.copy()
    for place in ((0, 1), (1, 2, 0)):
        pixels[place], covariance[place] = np.nan, np.nan
    session = replace(session, pixels=pixels, pixel_covariance=covariance)
    checks = check_views(truth_as_result(geometry, finished().calibration), session)
    blind = checks[-1]
    assert (blind.camera, blind.station, blind.unseen) == ("left", 1, "ABC")
    assert (blind.worst, blind.code) == ("", "UNSEEN")
    dropped = [DroppedHalfTurn("left", 0, 0, 1, "stale")]
    found = check_views(
        truth_as_result(geometry, finished().calibration), session, dropped
    )
    codes = {(one.camera, one.station): one.code for one in found}
    assert (codes["left", 1], codes["right", 1]) == ("LEFT OUT", "")
    (partly,) = [check for check in checks if check.unseen == "A"]
    assert partly.worst in "BC"
    assert np.isfinite(partly.rms_px)
