"""What the recording tells: positions, predictions, half-turn lines, scales."""

from dataclasses import replace

import numpy as np
import pytest
from finished_session import finished, finished_on_two_mounts

from handeye_tri.adjustment import adjust
from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.evaluate import cross_validate
from handeye_tri.evaluate.resampling import drawn
from handeye_tri.records import DroppedHalfTurn
from handeye_tri.replay.half_turns import HalfTurnView, half_turn_view
from handeye_tri.replay.shapes import vertex_normals
from handeye_tri.replay.story import tell, worst_station
from handeye_tri.replay.words import changes_of_mount, look_at, verdict_markdown
from handeye_tri.triangle import AXES


def story_of(done):
    return tell(done.session, done.calibration, done.track, done.truth)


def test_held_out_positions_are_the_evaluated_ones_bit_by_bit():
    done = finished()
    story = story_of(done)
    at = (done.track.stations, done.track.markers)
    assert np.array_equal(story.reported[at], done.track.reported)
    assert np.array_equal(story.observed[at], done.track.observed)


def test_used_stations_have_both_tracks_too():
    done = finished()
    story = story_of(done)
    gaps = np.linalg.norm(story.observed - story.reported, axis=-1)[~story.held_out]
    assert np.isfinite(gaps).all()
    # The robot repeats to 0.05 mm and the cameras see to 0.03 mm.
    assert 0 < gaps.max() < 5e-4


def test_each_station_is_told_with_its_own_mount():
    done = finished_on_two_mounts()
    story = story_of(done)
    for markers in (story.observed, story.actual):
        # Another mount holds them centimetres away.
        assert np.linalg.norm(markers - story.reported, axis=-1).max() < 5e-4
    assert np.abs(done.session.pixels - story.predicted).max() < 1.0
    assert changes_of_mount(story) == [(8, "mount 2 (about its edge BC)")]
    assert changes_of_mount(story_of(finished())) == []
    kinds = [
        {turn.edge is None for turn in story.turns[0][part] if turn.lines}
        for part in (slice(8), slice(8, None))
    ]
    assert kinds == [{True}, {False}]


def test_predictions_lie_where_the_markers_are_seen():
    done = finished()
    story = story_of(done)
    residual = (done.session.pixels - story.predicted)[:, ~story.held_out]
    # Without the shift of a sphere's outline this would have a mean of its own.
    assert np.abs(np.nanmean(residual, axis=(1, 2))).max() < 0.03
    assert np.sqrt(np.nanmean(residual**2)) < 0.15


@pytest.mark.parametrize("axis", AXES)
def test_half_turn_lines_meet_in_the_image_of_the_foot(axis):
    done = finished(3, axis)
    session = done.session
    story = story_of(done)
    foot = np.append(
        session.triangle.circumcentre
        if axis == "normal"
        else session.triangle.foot(axis),
        0.0,
    )
    for turn in session.half_turns:
        for i, camera in enumerate(done.truth.cameras):
            base_from_triangle = (
                done.truth.base_from_flange[turn.before]
                @ done.truth.flange_from_triangle.matrix
            )
            point = base_from_triangle[:3, :3] @ foot + base_from_triangle[:3, 3]
            o = camera.project(done.truth.base_from_camera[i].inverse().apply(point))
            view = story.turns[i][turn.before]
            assert view is story.turns[i][turn.after]
            assert len(view.lines) == (3 if axis == "normal" else 1)
            # Spheres, pixel noise and the robot's repeatability, far apart markers.
            assert np.linalg.norm(view.centre - o) < 1.0


def test_half_turn_lines_bend_with_the_lens():
    lens = Lens("radtan", np.array([-0.25, 0.0, 0.0, 0.0, 0.0]))
    straight = PinholeCamera("c", Intrinsics(900, 900, 0, 512, 384), (1024, 768))
    bent = replace(straight, lens=lens)
    before = np.array([[100.0, 100.0], [300.0, 80.0], [200.0, 250.0]])
    after = 2 * np.array([250.0, 200.0]) - before
    ideal = straight.normalised(np.stack([before, after]))
    view = half_turn_view(bent, *bent.pixels(ideal), "normal")
    centre = bent.pixels(straight.normalised(np.array([250.0, 200.0])))
    assert np.allclose(view.centre, centre, atol=1e-6)
    for line in view.lines:
        # Each point lies on the straight line once the lens is taken away.
        ideal = straight.pixels(bent.normalised(line))
        along = (ideal[-1] - ideal[0]) / np.linalg.norm(ideal[-1] - ideal[0])
        across = (ideal - ideal[0]) @ [-along[1], along[0]]
        assert np.abs(across).max() < 1e-9
    start, middle, end = (view.lines[1][k] for k in (0, 8, 16))
    assert np.linalg.norm(middle - 0.5 * (start + end)) > 1.0


def test_a_view_without_half_turn_shows_none():
    done = finished()
    j = int(done.session.indices("evaluation")[0])
    view = story_of(done).turns[0][j]
    assert view.lines == ()
    assert np.isnan(view.centre).all()


def test_an_unseen_marker_leaves_the_rest():
    camera = PinholeCamera("c", Intrinsics(900, 900, 0, 512, 384), (1024, 768))
    before = np.array([[100.0, 100.0], [300.0, 80.0], [np.nan, np.nan]])
    after = np.array([[400.0, 300.0], [200.0, 320.0], [300.0, 150.0]])
    view = half_turn_view(camera, before, after, "normal")
    assert isinstance(view, HalfTurnView)
    assert len(view.lines) == 2
    assert np.allclose(view.centre, [250.0, 200.0])


def test_a_track_of_another_session_is_refused():
    done = finished()
    other = replace(done.track, stations=np.zeros_like(done.track.stations))
    with pytest.raises(InputError, match="does not hold out"):
        tell(done.session, done.calibration, other, None)


def test_without_held_out_stations_each_was_held_out_in_turn():
    done = finished()
    used = tuple(done.session.indices("calibration"))
    session, _ = drawn(done.session, [used])
    result = cross_validate(
        session, lambda part, _index: adjust(part, done.calibration)
    )
    story = tell(session, done.calibration, result.track, None)
    assert story.held_out.tolist() == [True] * 10
    at = (result.track.stations, result.track.markers)
    assert np.array_equal(story.observed[at], result.track.observed)


def test_far_tracks_are_the_gaps_magnified():
    done = finished()
    story = story_of(done)
    tracks = story.tracks()
    assert set(tracks) == {"robot", "cameras", "truth"}
    gap = (story.observed - story.reported)[story.held_out].mean(axis=1)
    drawn = tracks["cameras"] - tracks["robot"]
    assert np.allclose(drawn, story.magnification * gap, atol=1e-12)
    blind = tell(done.session, done.calibration, done.track, None)
    assert set(blind.tracks()) == {"robot", "cameras"}


def test_worst_station_is_the_one_with_the_largest_error():
    done = finished()
    row = int(np.argmax(np.linalg.norm(done.track.errors, axis=1)))
    assert worst_station(done.track) == done.track.stations[row]


def test_a_station_that_the_first_finding_is_about_is_shown():
    done = finished()
    findings = [{"code": "SLIP", "stations": [2, 3]}]
    arguments = (done.session, done.calibration, done.track, None)
    story = tell(*arguments, about=findings[0]["stations"])
    worst = np.nanmax(story.distances_mm[[2, 3]], axis=1).argmax() + 2
    assert story.shown == worst
    assert f"**station {worst}**, where SLIP was found" in look_at(story, findings)
    # What was left out has no gap, and is shown all the same.
    turn = done.session.half_turns[1]
    lost = [
        DroppedHalfTurn(camera.name, 1, turn.before, turn.after, "stale")
        for camera in done.session.cameras
    ]
    used = done.session.without(lost)
    told = tell(*(used, *arguments[1:]), dropped=lost, about=[turn.before, turn.after])
    assert told.shown == turn.before
    assert look_at(told, []).endswith("left out.")


def test_without_a_used_station_the_worst_held_out_is_shown():
    done = finished()
    pixels = done.session.pixels.copy()
    pixels[0, list(done.session.indices("calibration"))] = np.nan
    covariance = done.session.pixel_covariance.copy()
    covariance[~np.isfinite(pixels).all(axis=-1)] = np.nan
    session = replace(done.session, pixels=pixels, pixel_covariance=covariance)
    story = tell(session, done.calibration, done.track, None)
    assert story.shown == worst_station(done.track)


def test_normals_of_a_tetrahedron_point_outward():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    normals = vertex_normals(corners, faces)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert ((corners - corners.mean(axis=0)) * normals).sum(axis=1).min() > 0


def test_the_verdict_names_station_gates_and_source():
    evaluation = {
        "verdict": "FAIL",
        "sentence": "Within 2 mm.",
        "nearest": "loop 1.9",
        "simulated": False,
        "gates": [{"verdict": "bad"}, {"verdict": "good"}, {"verdict": "not run"}],
        "findings": [
            {"code": "SLIP", "cause": "slid", "evidence": "2 mm", "remedy": "look"}
            | {"follows": "", "stations": []},
            {"code": "LOOP", "follows": "SLIP"},
        ],
        "track": {
            **{key: 1.5 for key in ("mean_mm", "rms_mm", "max_mm")},
            **{"predicted_rms_mm": 0.5, "worst_station": 24, "worst_marker": "B"},
        },
    }
    done = finished()
    text = verdict_markdown(evaluation, story_of(done), done.track)
    # The verdict and what is wrong come before the numbers.
    assert text.startswith(
        "# FAIL\nWithin 2 mm.\n\n**SLIP** slid (2 mm). Do: look.\n\n"
        "What likely follows from it: LOOP.\n"
    )
    worst = worst_station(done.track)
    for part in ("1 of 2 gates met, 1 not run", "REAL", f"worst at station {worst}"):
        assert part in text
