from dataclasses import replace

import numpy as np
import pytest

from handeye_tri.adjustment import adjust
from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.evaluate import (
    bootstrap,
    cross_validate,
    evaluate_track,
    parametric_bootstrap,
    track_budget,
    track_part,
)
from handeye_tri.evaluate.resampling import drawn, held_out, split, station_groups
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.records import HalfTurn, Repeatability
from handeye_tri.synthesize import reference_geometry, synthesize

RNG = np.random.default_rng
ROBOT = Repeatability(3e-5, np.radians(0.005))


def calibrated(seed, half_turns=8, axis="normal", held=3, noise=1.0):
    """A session, its joint calibration, and how to calibrate a part of it.

    The true noise is ``noise`` times what the session states.
    """
    geometry = reference_geometry(
        RNG([seed, 0]), half_turns=half_turns, evaluation_stations=held, axis=axis
    )
    session, _ = synthesize(
        geometry,
        RNG([seed, 1]),
        sigma_px=0.02 * noise,
        repeatability=Repeatability(noise * ROBOT.translation, noise * ROBOT.rotation),
        marker_radii=(0.008, 0.008, 0.008),
    )
    session = replace(
        session,
        pixel_covariance=session.pixel_covariance / noise**2,
        repeatability=ROBOT,
    )
    start = calibrate_hand_eye(session, calibrate_session_cameras(session))
    whole = adjust(session, start, on_axis_correlation=0.0)

    def again(part, _index):
        return adjust(part, whole, on_axis_correlation=0.0)

    return session, whole, again


def test_half_turns_stay_together_and_every_station_is_in_one_fold():
    session, _, _ = calibrated(1)
    stations = tuple(
        replace(s, kind="calibration") if s.index == 18 else s for s in session.stations
    )
    session = replace(
        session,
        stations=stations,
        half_turns=(*session.half_turns[:-1], HalfTurn(13, 14, "normal")),
    )
    groups = station_groups(session)
    # The last two half-turns share a station; the other end of one is alone now.
    assert groups == [
        *((0, 1), (2, 3), (4, 5), (6, 7), (8, 9), (10, 11)),
        *((12, 13, 14), (15,), (18,)),
    ]
    folds = split(groups, session.mounts, 4, RNG(3))
    assert sorted(j for fold in folds for j in fold) == [*range(16), 18]
    assert max(map(len, folds)) <= 7
    for group in groups:
        assert sum(set(group) <= set(fold) for fold in folds) == 1
    assert folds != split(groups, session.mounts, 4, RNG(4))
    assert folds == split(groups, session.mounts, 4, RNG(3))


def test_what_is_held_out_reaches_neither_half_turns_nor_the_test_twice():
    session, _, _ = calibrated(1)
    part = held_out(session, (2, 3))
    assert part.indices("evaluation").tolist() == [2, 3, 16, 17, 18]
    assert np.isnan(part.pixels[:, 16:]).all()
    assert len(part.half_turns) == 7
    np.testing.assert_array_equal(part.pixels[:, :16], session.pixels[:, :16])


def test_stations_drawn_twice_weigh_twice():
    session, whole, again = calibrated(1, half_turns=6)
    groups = station_groups(session)
    once, index = drawn(session, groups[::-1])
    assert index.tolist() == [10, 11, 8, 9, 6, 7, 4, 5, 2, 3, 0, 1]
    back = adjust(once, whole)
    np.testing.assert_allclose(back.markers, whole.markers, atol=1e-9)
    twice, _ = drawn(session, groups * 2)
    doubled = adjust(twice, whole)
    np.testing.assert_allclose(doubled.markers, whole.markers, atol=1e-8)
    np.testing.assert_allclose(
        2 * doubled.covariance.matrix, whole.covariance.matrix, rtol=1e-3, atol=1e-12
    )


def test_cross_validation_is_the_track_test_of_every_fold():
    session, _, again = calibrated(2)
    told = []
    result = cross_validate(
        session, again, progress=lambda done, total: told.append((done, total))
    )
    assert told == [(k, 8) for k in range(1, 9)]
    assert result.folds == tuple((2 * k, 2 * k + 1) for k in range(8))
    assert result.track.stations.tolist() == np.repeat(np.arange(16), 3).tolist()
    part = held_out(session, (4, 5))
    alone = evaluate_track(again(part, None), part)
    rows = np.isin(result.track.stations, (4, 5))
    np.testing.assert_array_equal(result.track.observed[rows], alone.observed)
    np.testing.assert_array_equal(
        result.track.predicted_covariance[rows], alone.predicted_covariance
    )
    assert result.budget.total == pytest.approx(result.track.predicted_rms, rel=1e-9)
    parts = sum(value**2 for value in result.budget.parts().values())
    assert np.sqrt(parts) == pytest.approx(result.budget.total, rel=1e-6)


def test_cross_validation_sees_what_its_stations_own_residuals_hide():
    """Residuals of stations that were used are too small; held-out ones are not."""
    ratios, fitted = [], []
    for seed in range(4):
        session, whole, again = calibrated(seed, half_turns=5)
        track = cross_validate(session, again).track
        ratios.append(track.rms / track.predicted_rms)
        own = held_out(session, session.indices("calibration").tolist())
        own_track = evaluate_track(whole, own)
        fitted.append(own_track.rms / own_track.predicted_rms)
    assert 0.85 < np.sqrt(np.mean(np.square(ratios))) < 1.15
    assert np.mean(fitted) < np.mean(ratios) - 0.1


def test_folds_without_which_nothing_is_determined_are_named():
    session, _, again = calibrated(2, half_turns=4)

    def stubborn(part, index):
        if 0 not in part.indices("calibration"):
            raise DegenerateMotionError("not without the first")
        return again(part, index)

    result = cross_validate(session, stubborn, folds=4)
    assert result.undetermined == ((0, 1),)
    assert 0 not in result.track.stations
    with pytest.raises(InputError, match="between 2 and 4 folds"):
        cross_validate(session, again, folds=5)


def ratios(spread, calibration):
    """Resampled sigmas over the covariance's, those of equal quantities left out."""
    labels = calibration.covariance.labels
    return np.array(
        [spread.covariance.std(n) / calibration.covariance.std(n) for n in labels]
    )


@pytest.mark.parametrize("axis", ["normal", "AB"])
def test_parametric_bootstrap_finds_the_covariance(axis):
    session, whole, again = calibrated(3, half_turns=5, axis=axis)
    spread = parametric_bootstrap(session, whole, again, RNG(1), replicates=50)
    assert (spread.replicates, spread.failed, spread.units) == (50, 0, 0)
    # A sigma of 50 replicates is off by 10 % (one standard deviation).
    assert spread.relative_error == pytest.approx(0.101, abs=1e-3)
    found = ratios(spread, whole)
    assert np.abs(found - 1).max() < 4.5 * 0.101
    assert abs(np.sqrt(np.mean(found**2)) - 1) < 0.15


def test_bootstrap_of_half_turns_agrees_with_the_covariance():
    """Mean over data sets, since one of 6 half-turns is off by 32 %.

    Drawing 6 of 6 would make sigmas twice too large here.
    """
    found, track = [], []
    for seed in range(4):
        session, whole, again = calibrated(seed, half_turns=6)
        spread = bootstrap(session, whole, again, RNG([seed, 9]), replicates=20)
        assert spread.failed == 0
        assert spread.relative_error == pytest.approx(
            np.sqrt(0.5 / 19 + 0.5 / 5), rel=1e-6
        )
        found.append(ratios(spread, whole) ** 2)
        track.append(
            track_part(whole, session, spread)
            / track_budget(whole, session).calibration
        )
    assert 0.75 < np.sqrt(np.mean(found)) < 1.4
    assert 0.7 < np.mean(track) < 1.4


def test_bootstrap_sees_noise_that_nobody_stated():
    session, whole, again = calibrated(4, half_turns=8, noise=3.0)
    spread = bootstrap(session, whole, again, RNG(0), replicates=20)
    assert np.median(ratios(spread, whole)) > 2.0
    # Drawing the stated noise cannot see it.
    stated = parametric_bootstrap(session, whole, again, RNG(0), replicates=20)
    assert np.median(ratios(stated, whole)) < 1.3


def test_resampling_is_the_seed_s_alone():
    session, whole, again = calibrated(5, half_turns=5, held=0)
    one, same, other = (
        bootstrap(session, whole, again, RNG(seed), replicates=5) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one.covariance.matrix, same.covariance.matrix)
    assert (one.covariance.matrix != other.covariance.matrix).any()
    # Without held-out stations its part of the track error is that at all stations.
    assert 1e-6 < track_part(whole, session, one) < 1e-3


def test_too_little_data_for_resampling_is_said():
    session, whole, again = calibrated(5, half_turns=5)
    few = replace(
        session,
        half_turns=session.half_turns[:2],
        stations=tuple(
            replace(s, kind="evaluation") if s.index > 3 else s
            for s in session.stations
        ),
    )
    with pytest.raises(InputError, match="needs 3 half-turns"):
        bootstrap(few, whole, again, RNG(0))

    def never(part, index):
        raise DegenerateMotionError("no")

    with pytest.raises(InputError, match="only 0 of 4 replicates"):
        bootstrap(session, whole, never, RNG(0), replicates=4)
    moved = replace(whole, robot={"elbow.offset": 0.001})
    with pytest.raises(InputError, match="without parameters of the robot"):
        parametric_bootstrap(session, moved, again, RNG(0))
