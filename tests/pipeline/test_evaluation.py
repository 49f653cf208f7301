from types import SimpleNamespace

import numpy as np
import pytest

from handeye_tri.adjustment import adjust
from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.pipeline.evaluation import judged_track, track_json
from handeye_tri.records import Repeatability
from handeye_tri.synthesize import reference_geometry, synthesize


@pytest.fixture(scope="module")
def without_test():
    """A session whose stations were all used, and its joint calibration."""
    session, _ = synthesize(
        reference_geometry(
            np.random.default_rng(1), half_turns=6, evaluation_stations=0
        ),
        np.random.default_rng(2),
        sigma_px=0.02,
        repeatability=Repeatability(3e-5, np.radians(0.005)),
    )
    start = calibrate_hand_eye(session, calibrate_session_cameras(session))
    return session, adjust(session, start)


@pytest.mark.parametrize("method", ["joint", "separate"])
def test_without_held_out_stations_they_are_held_out_in_turn(without_test, method):
    session, calibration = without_test
    run = SimpleNamespace(method=method, robot_errors=(), seed=1)
    told = []
    judged = judged_track(run, session, calibration, lambda *done: told.append(done))
    assert told[-1] == (6, 6)
    result = track_json(judged)
    assert result["source"] == "cross-validation"
    assert result["stations"] == 12
    assert len(result["positions"]) == 36
    assert 0.5 < result["rms_mm"] / result["predicted_rms_mm"] < 1.6
    again = judged_track(run, session, calibration)
    np.testing.assert_array_equal(again.track.observed, judged.track.observed)
