"""A track whose stations have two mounts: exact, and as far off as predicted."""

from dataclasses import replace

import numpy as np
import pytest
from two_mount_cell import (
    FREE,
    LABELS,
    RNG,
    calibrated,
    free_covariance,
    geometry,
    observed,
    only_camera,
    seen_by_the_first,
)

from handeye_tri.errors import InputError
from handeye_tri.evaluate import (
    against_prediction,
    bootstrap,
    compare_with_truth,
    cross_validate,
    evaluate_track,
    part_changes,
    predicted_track_error,
    track_budget,
    track_map,
    track_poses,
)
from handeye_tri.evaluate.resampling import split, station_groups
from handeye_tri.evaluate.views import check_views, predicted_pixels
from handeye_tri.records import Covariance
from handeye_tri.synthesize import synthesize

NOTHING = np.zeros(FREE)


@pytest.fixture(scope="module")
def true():
    return geometry()


@pytest.fixture(scope="module")
def exact(true):
    return calibrated(true, free_covariance(), NOTHING)


def only(calibration, prefix, sigma=1e-4):
    """The same calibration of which nothing but one quantity's error is left."""
    rows = [name.startswith(prefix) for name in LABELS]
    matrix = np.diag(np.where(rows, sigma**2, 0.0))
    return replace(calibration, covariance=Covariance(LABELS, matrix))


def test_exact_data_leave_no_error_with_either_mount(true, exact):
    session, truth = synthesize(true, RNG(1), sigma_px=0.0)
    track = evaluate_track(exact, session)
    assert len(track.distances) == 18
    assert set(session.mounts[track.stations]) == {0, 1}
    assert track.max < 1e-12
    alone = evaluate_track(only_camera(exact), seen_by_the_first(session))
    assert len(alone.distances) == 18
    assert alone.max < 1e-10
    np.testing.assert_allclose(predicted_pixels(exact, session), session.pixels)
    poses = track_poses(exact, track, session.mounts)
    np.testing.assert_allclose(
        poses.observed[:, :3, :3],
        session.base_from_flange[track.stations, :3, :3],
        atol=1e-9,
    )
    assert all(abs(row.error) < 1e-9 for row in compare_with_truth(exact, truth))


@pytest.mark.parametrize("cameras", [1, 2])
def test_the_track_is_as_far_off_as_its_covariance_says(true, cameras):
    """NEES of single markers, by mount, and how many tracks are called consistent."""
    covariance, trials = free_covariance(), 120
    root = np.linalg.cholesky(covariance)
    nees, consistent = [], []
    for seed in range(trials):
        found = calibrated(true, covariance, root @ RNG([5, seed]).normal(size=FREE))
        session = observed(true, seed)
        if cameras == 1:
            found, session = only_camera(found), seen_by_the_first(session)
        track = evaluate_track(found, session)
        errors = track.errors
        whitened = np.linalg.solve(track.predicted_covariance, errors[..., None])
        each = (errors * whitened[..., 0]).sum(axis=1) / 3
        second = session.mounts[track.stations] == 1
        nees.append([each[~second].mean(), each[second].mean()])
        outcome = against_prediction(found, session).outcome
        consistent.append(outcome == "consistent")
    # Were all rows of a trial one and the same, a mean of three squares over the
    # trials would have this deviation; it has less.
    sigma = np.sqrt(2 / 3 / trials)
    np.testing.assert_allclose(np.mean(nees, axis=0), 1.0, atol=3.5 * sigma)
    spread = np.sqrt(0.05 * 0.95 / trials)
    assert np.mean(consistent) == pytest.approx(0.95, abs=4 * spread)


def test_each_mount_answers_for_its_own_rig(true, exact):
    session = observed(true, 1)
    parts = track_budget(exact, session).calibration_parts
    names = ["left camera", "right camera", "stereo", "hand-eye"]
    assert list(parts) == [*names, "rig, mount 1", "rig, mount 2"]
    total = track_budget(exact, session).calibration
    assert np.sqrt(sum(part**2 for part in parts.values())) == pytest.approx(total)
    second = track_budget(
        only(exact, ("marker_A_2", "marker_B_2", "marker_C_2")), session
    )
    # Three axes of 0.1 mm at the half of the rows that has the second mount.
    assert second.calibration == pytest.approx(1e-4 * np.sqrt(1.5))
    assert second.calibration_parts["rig, mount 2"] == pytest.approx(second.calibration)
    assert second.calibration_parts["rig, mount 1"] == 0.0


def test_over_the_workspace_both_mounts_count_alike(true, exact):
    session = observed(true, 1)
    for prefix in ("marker_A.", "marker_A_2."):
        found = track_map(only(exact, prefix, 1e-3), session, (2, 2, 2))
        none = track_map(only(exact, "nothing"), session, (2, 2, 2))
        seen = np.isfinite(found.rms)
        assert seen.any()
        # Three axes of 1 mm of one marker in three, with one mount of two.
        np.testing.assert_allclose(
            found.rms[seen] ** 2 - none.rms[seen] ** 2, 3e-6 / 6, rtol=1e-9
        )


def test_mounts_that_are_one_and_the_same_are_as_good_as_one(true, exact):
    """Whichever stations are said to have which of the two."""
    first = [
        name for name in LABELS if name.startswith("marker_") and "_2." not in name
    ]
    change = np.eye(len(LABELS))
    for name in first:
        change[LABELS.index(name.replace(".", "_2."))] = change[LABELS.index(name)]
    twice = replace(
        exact,
        other_mounts=exact.mounts[:1],
        covariance=Covariance(LABELS, change @ exact.covariance.matrix @ change.T),
    )
    session = observed(true, 1)
    one = replace(
        session, stations=tuple(replace(s, mount=0) for s in session.stations)
    )
    expected = track_map(replace(twice, other_mounts=()), one, (2, 2, 2)).covariance
    found = track_map(twice, session, (2, 2, 2)).covariance
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-18)


def test_one_camera_has_the_mean_of_those_mounts_that_it_can_place(true, exact):
    alone, session = only_camera(exact), seen_by_the_first(observed(true, 1))
    found = track_map(alone, session, (2, 2, 2))
    sigma = np.sqrt(np.nanmedian(session.pixel_covariance[..., [0, 1], [0, 1]]))
    each = [
        predicted_track_error(
            alone,
            found.points,
            session.base_from_flange[session.mounts == mount, :3, :3],
            sigma_px=sigma,
            repeatability=session.repeatability,
            mount=mount,
        )
        for mount in (0, 1)
    ]
    placed = np.isfinite(each).all(axis=(0, -2, -1))
    assert placed.any()
    np.testing.assert_allclose(found.covariance[placed], np.mean(each, axis=0)[placed])


def test_all_mounts_are_compared_with_the_truth(true):
    _, truth = synthesize(true, RNG(1), sigma_px=0.0)
    step = NOTHING.copy()
    step[-1] = 3e-4
    rows = {
        row.quantity: row
        for row in compare_with_truth(calibrated(true, free_covariance(), step), truth)
    }
    assert rows["marker_C_2.z"].error == pytest.approx(3e-4)
    assert rows["marker_C.z"].error == 0.0
    assert rows["flange_from_triangle_2.rx"].error == 0.0
    motion = true.other_mounts[0]
    assert rows["flange_from_triangle_2.x"].truth == pytest.approx(
        motion.translation[0]
    )


def test_views_of_both_mounts_fit(true, exact):
    session = observed(true, 3)
    checks = check_views(exact, session)
    assert len(checks) == 60
    assert not [check for check in checks if check.code]
    exchanged = replace(
        session,
        stations=tuple(
            replace(station, mount=1 - station.mount) for station in session.stations
        ),
    )
    assert all(check.code == "FAR" for check in check_views(exact, exchanged))


def test_a_rig_that_slipped_is_named_with_its_mount(true, exact):
    step = NOTHING.copy()
    step[31:] = np.tile([1e-3, 0.0, 0.0], 3)
    later = calibrated(true, free_covariance(), step)
    changed = [row for row in part_changes(exact, later) if row.changed]
    assert [(row.part, row.mount) for row in changed] == [("rig", 1)]
    assert changed[0].moved == pytest.approx(1e-3)
    assert not any(row.changed for row in part_changes(exact, exact))
    with pytest.raises(InputError, match="are 2 mounts of the rig, after there is 1"):
        part_changes(exact, replace(exact, other_mounts=()))


def test_a_session_with_more_mounts_than_the_calibration_is_refused(true, exact):
    with pytest.raises(InputError, match="stations with mount 2 of the rig"):
        evaluate_track(replace(exact, other_mounts=()), observed(true, 1))


def test_no_fold_takes_a_mount_that_has_more_than_one_half_turn(true, exact):
    session = observed(true, 1)
    groups = station_groups(session)
    for seed in range(20):
        for fold in split(groups, session.mounts, 2, RNG(seed)):
            assert sorted(session.mounts[list(fold)]) == 6 * [0] + 6 * [1]
    seen = []

    def recalibrate(part, index):
        seen.append(set(part.mounts[part.indices("calibration")]))
        return exact

    few = geometry(half_turns=3)
    lone = replace(few, half_turns=few.half_turns[:4], stations=few.stations[:11])
    result = cross_validate(observed(lone, 1), recalibrate)
    # Without its only half-turn the second mount is not calibrated at all.
    assert result.undetermined == ((9, 10),)
    assert len(result.folds) == 3
    assert seen == 3 * [{0, 1}]
    with pytest.raises(InputError, match="with each mount, got 1 with mount 2"):
        bootstrap(observed(lone, 1), exact, recalibrate, RNG(1), replicates=2)


def test_half_turns_are_drawn_again_mount_by_mount(true, exact):
    session = observed(true, 1)
    drawn = []

    def recalibrate(part, index):
        drawn.append(part)
        return exact

    bootstrap(session, exact, recalibrate, RNG(1), replicates=5)
    for part in drawn:
        assert np.bincount(part.mounts).tolist() == [24, 24]
        for turn in part.half_turns:
            mount = part.stations[turn.before].mount
            assert turn.axis == ("normal", "BC")[mount]
