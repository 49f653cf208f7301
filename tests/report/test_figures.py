"""The report's figures draw the numbers that they are given."""

import re

import numpy as np
import pytest
from finished_session import finished

from handeye_tri.evaluate.views import predicted_pixels
from handeye_tri.records import TrackEvaluation
from handeye_tri.report import figures, geometry


def words(svg):
    return re.findall(r"<text[^>]*>([^<]*)</text>", svg)


def bars(svg):
    """Heights of the filled rectangles of a colour, px, in the order drawn."""
    found = []
    for path in re.findall(rf'd="([^"]*)"[^>]*style="fill: {figures.HELD_OUT}"', svg):
        y = [float(v) for v in re.findall(r"[ML] \S+ (\S+)", path)]
        found.append(max(y) - min(y))
    return np.array(found)


def test_bars_are_as_high_as_the_distances():
    track = finished().track
    svg = figures.held_out_track(track, [0.1] * len(track.stations))
    heights = bars(svg)
    assert len(heights) == len(track.distances)
    ratio = heights / track.distances
    assert np.allclose(ratio, ratio[0], rtol=1e-4)
    assert words(svg).count("A") == len(set(track.stations.tolist()))


def test_many_stations_are_named_by_their_numbers_alone():
    track = finished().track
    few = words(figures.held_out_track(track, [0.1] * len(track.stations)))
    assert f"station {track.stations[0]}" in few
    numbers = np.repeat(np.arange(20, 29), 3)
    rows = np.resize(np.arange(len(track.stations)), 27)
    many = TrackEvaluation(
        numbers,
        np.tile([0, 1, 2], 9),
        *(track.reported[rows], track.observed[rows]),
        track.predicted_covariance[rows],
    )
    text = words(figures.held_out_track(many, [0.1] * 27))
    assert text.count("station") == 1
    assert {str(station) for station in range(20, 29)} <= set(text)


def test_shares_of_the_budget_are_of_its_square():
    svg = figures.origin_of_error({"pixels": 0.03, "robot": 0.04})
    text = " ".join(words(svg))
    assert "64 %" in text
    assert "36 %" in text


def test_the_map_shows_what_is_seen_and_crosses_where_not():
    points = np.stack(
        np.meshgrid([0.3, 0.4, 0.5], [-0.1, 0.1], [0.4], indexing="ij"), axis=-1
    )[:, :, 0]
    covariance = np.tile(np.diag([4.0, 1.0, 1.0]) * 1e-10, (3, 2, 1, 1))
    radii = np.full((3, 2), 0.05)
    covariance[2, 1], radii[2, 1] = np.nan, np.nan
    text = words(figures.workspace_map(points, covariance, radii))
    assert text.count("0.050") == 5
    assert "height 400 mm; ellipses 500 times too large" in text


@pytest.mark.parametrize("tilt", [0, 30, 60])
def test_a_plane_is_drawn_at_its_tilt_from_the_cameras(tilt):
    """All planes at one tilt lie on that circle of the picture."""
    done = finished()
    places = geometry.on_half_sphere(
        np.array(
            [
                [
                    np.sin(np.radians(tilt)) * np.cos(a),
                    np.sin(np.radians(tilt)) * np.sin(a),
                    np.cos(np.radians(tilt)),
                ]
                for a in np.linspace(0, 6, 7)
            ]
        ),
        np.array([0.0, 0.0, 1.0]),
    )
    radius = np.sqrt(2 * (1 - np.cos(np.radians(tilt))))
    assert np.allclose(np.linalg.norm(places, axis=1), radius, atol=1e-9)
    assert len(words(geometry.plane_directions(done.session, done.calibration))) >= 9


def test_a_normal_away_from_the_cameras_is_drawn_as_its_opposite():
    normal = np.array([[0.3, 0.2, 0.9]])
    eye = np.array([0.0, 0.0, 1.0])
    there, back = (geometry.on_half_sphere(sign * normal, eye) for sign in (1, -1))
    assert np.allclose(there, back)


def test_residual_arrows_fit_their_image():
    session = finished().session
    predicted = predicted_pixels(finished().calibration, session)
    svg, factor = figures.residual_maps(session, predicted)
    largest = np.nanmax(np.linalg.norm(session.pixels - predicted, axis=-1))
    assert factor * largest <= 0.12 * 1024 < 3 * factor * largest
    assert {"left", "right"} <= set(words(svg))
