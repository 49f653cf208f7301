from dataclasses import replace

import numpy as np
import pytest
from bundle_scene import (
    LENS,
    ROBOT,
    errors,
    near,
    nees,
    observe,
    scene,
    true_motions,
    two_feet,
)

from handeye_tri.calibrate_cameras.bundle import TurnNoise, bundle_cameras
from handeye_tri.calibrate_cameras.session_camera import turn_covariance
from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.records import HalfTurn
from handeye_tri.se3 import SE3, se3_exp, se3_inverse, se3_log

NOISE = TurnNoise(turn_covariance(ROBOT))
EXACT_ROBOT = TurnNoise(np.zeros((6, 6)))


def adjust(session, truth, *, size=1.0, **options):
    cameras, places, poses = near(truth, size=size, mounts=session.mounts)
    options.setdefault("half_turns", session.half_turns)
    options.setdefault("lenses", [info.lens for info in session.cameras])
    options.setdefault("skew", [info.skew for info in session.cameras])
    return bundle_cameras(
        cameras,
        places,
        poses,
        options.pop("pixels", session.pixels),
        options.pop("covariance", session.pixel_covariance),
        session.triangle,
        **options,
    )


@pytest.mark.parametrize("axis", ["normal", "BC"])
@pytest.mark.parametrize("lens", [None, LENS])
@pytest.mark.parametrize(
    ("count", "turn_noise"),
    [(1, EXACT_ROBOT), (1, NOISE), (2, None), (2, EXACT_ROBOT), (2, NOISE), (3, None)],
)
def test_exact_data(axis, lens, turn_noise, count):
    geometry = scene(count=count, axis=axis, lens=lens, skew=1.2)
    session, truth = observe(geometry, sigma_px=0.0, robot=None)
    result = adjust(session, truth, turn_noise=turn_noise)
    scale = np.array(
        [1700.0 if "." in x and x[0] != "r" else 1.0 for x in result.covariance.labels]
    )
    np.testing.assert_allclose(errors(result, truth) / scale, 0, atol=1e-9)
    np.testing.assert_allclose(
        result.details["reference_from_triangle"], true_motions(truth)[1], atol=1e-9
    )
    assert np.nanmax(np.abs(result.residuals)) < 1e-8
    assert result.cost_start > 100


def test_many_cameras_exact():
    session, truth = observe(scene(count=64), sigma_px=0.0, robot=None)
    result = adjust(session, truth)
    assert len(result.covariance.labels) == 64 * 5 + 63 * 6
    np.testing.assert_allclose(errors(result, truth), 0, atol=1e-6)
    assert result.residuals.shape == (64, 16, 3, 2)


def model_of(session, truth, monkeypatch, **options):
    """Model and final state inside bundle_cameras."""
    from handeye_tri.calibrate_cameras import bundle

    caught = {}
    original = bundle._minimum

    def catch(model, start, names):
        end = original(model, start, names)
        caught.update(model=model, end=end)
        return end

    monkeypatch.setattr(bundle, "_minimum", catch)
    result = adjust(session, truth, **options)
    return caught["model"], caught["end"], result


def dense(normal):
    """The whole normal matrix, own unknowns first."""
    b, size, g = normal.cross.shape
    matrix = np.zeros((b * size + g, b * size + g))
    for k in range(b):
        rows = slice(k * size, (k + 1) * size)
        matrix[rows, rows] = normal.own[k]
        matrix[rows, b * size :] = normal.cross[k]
        matrix[b * size :, rows] = normal.cross[k].T
    matrix[b * size :, b * size :] = normal.shared
    return matrix


@pytest.mark.parametrize("axis", ["normal", "AB"])
@pytest.mark.parametrize(
    "turn_noise",
    [
        None,
        TurnNoise(None, on_axis_correlation=0.6),
        TurnNoise(turn_covariance(ROBOT), on_axis_correlation=0.6),
    ],
)
def test_derivatives_against_differences(axis, turn_noise, monkeypatch):
    geometry = scene(count=3, half_turns=4, axis=axis, lens=LENS, skew=1.2)
    session, truth = observe(geometry, sigma_px=0.0, robot=None)
    pixels = session.pixels.copy()
    pixels[1, 2] = np.nan
    pixels[0, 5, 1] = np.nan
    model, end, _ = model_of(
        session, truth, monkeypatch, turn_noise=turn_noise, pixels=pixels
    )
    matrix = dense(end.blocks.normal)
    b, size, g = end.blocks.normal.cross.shape
    scale = 1 / np.sqrt(np.diagonal(matrix))
    # Residuals vanish here, so that the gradient a step away is the normal matrix
    # times the step, up to the step's square; central differences cancel that
    # and leave the cube. Steps of 1e-2 sigma: relative 1e-7 of curvature terms.
    for column in range(len(matrix)):
        step = np.zeros(len(matrix))
        step[column] = 1e-2 * scale[column]
        gradients = []
        for sign in (1, -1):
            moved = model.retract(
                end.state,
                sign * step[: b * size].reshape(b, size),
                sign * step[b * size :],
            )
            normal = model.evaluate(moved).normal
            gradients.append(
                np.concatenate([normal.own_gradient.ravel(), normal.shared_gradient])
            )
        difference = 0.5 * (gradients[0] - gradients[1])
        np.testing.assert_allclose(
            difference * scale, matrix[:, column] * scale * step[column], atol=1e-7
        )


@pytest.mark.parametrize("axis", ["normal", "AB"])
@pytest.mark.parametrize("turn_noise", [None, TurnNoise(None, 0.5), NOISE])
def test_covariance_is_the_dense_inverse(axis, turn_noise, monkeypatch):
    session, truth = observe(scene(count=2, half_turns=5, axis=axis))
    model, end, result = model_of(session, truth, monkeypatch, turn_noise=turn_noise)
    matrix = dense(end.blocks.normal)
    b, size, g = end.blocks.normal.cross.shape
    scale = 1 / np.sqrt(np.diagonal(matrix))
    whole = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
    mine = result.covariance
    labels = [f"left.{q}" for q in ("fx", "fy", "skew", "cx", "cy")]
    np.testing.assert_allclose(
        mine.block(labels), whole[b * size :, b * size :][:5, :5], rtol=1e-6
    )
    place = [f"reference_from_right.{q}" for q in ("x", "y", "z", "rx", "ry", "rz")]
    np.testing.assert_allclose(
        mine.block(place), whole[b * size + 10 :, b * size + 10 :][:6, :6], rtol=1e-6
    )
    # Stations: first order propagation of the whole covariance through poses().
    at = model.poses(end.state)
    rows = np.empty((b, at.shape[1], 6, len(whole)))
    for column in range(len(whole)):
        step = np.zeros(len(whole))
        step[column] = 1e-6 if column < b * size else 1e-6
        moved = model.poses(
            model.retract(
                end.state, step[: b * size].reshape(b, size), step[b * size :]
            )
        )
        rows[..., column] = se3_log(se3_inverse(at) @ moved) / 1e-6
    expected = rows @ whole @ np.swapaxes(rows, -1, -2)
    stations = result.details["station_covariance"]
    for k, turn in enumerate(session.half_turns):
        if turn_noise is None:
            np.testing.assert_allclose(
                stations[turn.after], expected[turn.after, 0], rtol=1e-4, atol=1e-16
            )
        else:
            for w, station in enumerate((turn.before, turn.after)):
                np.testing.assert_allclose(
                    stations[station], expected[k, w], rtol=1e-3, atol=1e-13
                )


@pytest.mark.parametrize(
    ("options", "turn_noise"),
    [({}, None), ({"axis": "BC"}, NOISE), ({"lens": LENS}, None)],
)
def test_covariance_against_sampling(options, turn_noise):
    geometry = scene(count=2, half_turns=11, **options)
    scores, chi2, dof = [], 0.0, 0
    for seed in range(40):
        session, truth = observe(geometry, seed)
        result = adjust(session, truth, turn_noise=turn_noise, size=0.1)
        scores.append(nees(result, truth))
        chi2, dof = chi2 + result.chi2, dof + result.dof
    # The mean of 40 trials of 16 or more unknowns spreads by 0.056: 3 of those.
    assert np.mean(scores) == pytest.approx(1, abs=0.17)
    assert chi2 / dof == pytest.approx(1, abs=4 * np.sqrt(2 / dof))


def test_correlated_detection_errors_on_the_axis():
    geometry = scene(count=2, half_turns=11, axis="CA")
    session, truth = observe(geometry, sigma_px=0.0, robot=ROBOT)
    scores = {0.0: [], 0.8: []}
    chi2 = {0.0: 0.0, 0.8: 0.0}
    for seed in range(25):
        rng = np.random.default_rng([seed, 5])
        noise = rng.standard_normal(session.pixels.shape)
        common = rng.standard_normal(session.pixels.shape)
        for turn in session.half_turns:
            for k in (0, 2):
                for j in (turn.before, turn.after):
                    noise[:, j, k] *= np.sqrt(0.2)
                    noise[:, j, k] += np.sqrt(0.8) * common[:, turn.before, k]
        for correlation in scores:
            result = adjust(
                session,
                truth,
                size=0.1,
                pixels=session.pixels + 0.015 * noise,
                covariance=session.pixel_covariance * 0.015**2,
                turn_noise=TurnNoise(None, correlation),
            )
            scores[correlation].append(nees(result, truth))
            chi2[correlation] += result.chi2 / result.dof / 25
    # 25 trials of 16 unknowns spread by 0.07, of 116 degrees of freedom by 0.03.
    assert np.mean(scores[0.8]) == pytest.approx(1, abs=0.21)
    assert np.mean(scores[0.0]) > 1.2, "ignored, it makes the sigmas too small"
    assert chi2[0.8] == pytest.approx(1, abs=0.09)


def test_inexact_half_turns_leave_untied_cameras_alone():
    geometry = scene(count=2)
    stations = list(geometry.stations)
    for turn in geometry.half_turns:
        pose = stations[turn.after].base_from_flange @ SE3.exp(
            [0.002, 0.0, 0.0, 0.0, 0.0, np.radians(3.0)]
        )
        stations[turn.after] = replace(stations[turn.after], base_from_flange=pose)
    geometry = replace(geometry, stations=tuple(stations))
    session, truth = observe(geometry, sigma_px=0.0, robot=None)
    untied = adjust(session, truth)
    np.testing.assert_allclose(errors(untied, truth), 0, atol=1e-6)
    tied = adjust(
        session, truth, turn_noise=NOISE, covariance=session.pixel_covariance * 0.015**2
    )
    assert tied.chi2 / tied.dof > 20, "a tie that does not hold must show"


@pytest.mark.parametrize("axis", ["normal", "CA"])
def test_axis_that_runs_beside_where_it_was_built(axis):
    # The rig sits askew on the flange: the line is estimated, nothing is biased.
    geometry = scene(count=2, axis=axis)
    askew = SE3.exp([0.001, -0.002, 0.0015, 0.02, -0.01, 0.015])
    ideal = geometry.flange_from_triangle
    geometry = replace(geometry, flange_from_triangle=ideal @ askew)
    session, truth = observe(geometry, sigma_px=0.0, robot=None)
    result = adjust(session, truth, turn_noise=EXACT_ROBOT)
    np.testing.assert_allclose(errors(result, truth), 0, atol=1e-6)
    line = SE3(result.details["triangle_from_axis"][0])
    half_turn = SE3(np.diag([-1.0, -1.0, 1.0, 1.0]))
    turn = session.half_turns[0]
    poses = true_motions(truth)[1]
    np.testing.assert_allclose(
        poses[turn.before] @ (line @ half_turn @ line.inverse()).matrix,
        poses[turn.after],
        atol=1e-9,
    )
    np.testing.assert_allclose(result.details["turn_sigmas"], 0, atol=1e-6)


@pytest.mark.parametrize(
    ("axes", "lines"),
    [
        (("normal", "normal"), (("normal", 0), ("normal", 1))),
        (("BC", "normal"), (("BC", 0), ("normal", 1))),
    ],
)
@pytest.mark.parametrize("count", [1, 2])
def test_each_mount_has_axes_of_its_own(axes, lines, count):
    session, truth = observe(two_feet(count=count, axes=axes), sigma_px=0.0, robot=None)
    result = adjust(session, truth, turn_noise=EXACT_ROBOT, mounts=session.mounts)
    np.testing.assert_allclose(errors(result, truth), 0, atol=1e-6)
    found = result.details
    assert tuple(zip(found["axes"], found["axis_mounts"], strict=True)) == lines
    foot = session.triangle.circumcentre + (0.012, -0.009)
    line = found["triangle_from_axis"][1]
    along = line[:3, 2] / line[2, 2]
    np.testing.assert_allclose((line[:3, 3] - line[2, 3] * along)[:2], foot, atol=1e-8)
    if axes[0] == "normal":
        # One line for both would have to lie between them.
        spoiled = adjust(session, truth, turn_noise=NOISE)
        assert spoiled.chi2 > 100


def test_unseen_markers_views_and_stations():
    session, truth = observe(scene(count=3), sigma_px=0.0, robot=None)
    pixels = session.pixels.copy()
    pixels[0, 3] = np.nan  # a camera misses a station
    pixels[1, 4, 2] = np.nan  # a camera misses a marker
    pixels[2, :8] = np.nan  # a camera misses half of all
    pixels[:, 6, 0] = np.nan  # nobody sees a marker: this station is of no use
    pixels[:2, 9] = np.nan  # only one camera sees a station
    for turn_noise in (None, TurnNoise(), EXACT_ROBOT):
        result = adjust(session, truth, pixels=pixels, turn_noise=turn_noise)
        np.testing.assert_allclose(errors(result, truth), 0, atol=1e-6)
        assert 6 not in result.details["used"]
        assert np.isnan(result.residuals[:, 6]).all()
        assert np.isnan(result.details["reference_from_triangle"][6]).all()
        used = result.details["used"]
        np.testing.assert_array_equal(
            np.isnan(result.residuals[:, used]), np.isnan(pixels[:, used])
        )
    assert np.isnan(result.details["turn_sigmas"][3]).all()
    assert np.isfinite(result.details["turn_sigmas"][4]).all()


def test_result_does_not_depend_on_where_the_reference_was():
    session, truth = observe(scene(count=2))
    cameras, places, poses = near(truth)
    elsewhere = SE3.exp([1.0, 2.0, -1.0, 0.3, -0.2, 0.5])
    results = [
        bundle_cameras(
            cameras,
            [shift @ place for place in places],
            shift.matrix @ poses,
            session.pixels,
            session.pixel_covariance,
            session.triangle,
        )
        for shift in (SE3.identity(), elsewhere)
    ]
    np.testing.assert_allclose(
        results[0].covariance.matrix, results[1].covariance.matrix, rtol=1e-5
    )
    np.testing.assert_allclose(
        results[0].reference_from_camera[1].matrix,
        results[1].reference_from_camera[1].matrix,
        atol=1e-9,
    )
    assert results[0].chi2 == pytest.approx(results[1].chi2, rel=1e-9)


def test_robust_loss_bounds_an_outlier():
    session, truth = observe(scene(count=2, half_turns=11))
    pixels = session.pixels.copy()
    pixels[0, 5, 1] += (8.0, -6.0)
    plain = adjust(session, truth, pixels=pixels)
    robust = adjust(session, truth, pixels=pixels, huber=2.5)
    clean = adjust(session, truth)
    assert plain.chi2 / plain.dof > 100
    sigma = np.sqrt(np.diagonal(clean.covariance.matrix))
    shifted = np.abs(errors(robust, truth) - errors(clean, truth)) / sigma
    assert shifted.max() < 1.5
    assert (np.abs(errors(plain, truth) - errors(clean, truth)) / sigma).max() > 10
    assert np.linalg.norm(robust.residuals[0, 5, 1]) > 9


def test_weights_follow_the_covariance():
    # A marker with a covariance of (1 px)^2 may lie anywhere.
    session, truth = observe(scene(count=2), sigma_px=0.0, robot=None)
    pixels, covariance = session.pixels.copy(), session.pixel_covariance * 1e-4
    pixels[0, 5, 1] += (0.5, -0.2)
    covariance[0, 5, 1] = [[1e6, 2e5], [2e5, 1e6]]
    result = adjust(session, truth, pixels=pixels, covariance=covariance)
    np.testing.assert_allclose(errors(result, truth), 0, atol=1e-6)
    np.testing.assert_allclose(result.residuals[0, 5, 1], (0.5, -0.2), atol=1e-6)


@pytest.fixture(scope="module")
def seen():
    return observe(scene(count=3, half_turns=4))


class TestRefusals:
    def test_one_camera_without_half_turns(self):
        session, truth = observe(scene(count=1))
        with pytest.raises(DegenerateMotionError, match="too few"):
            adjust(session, truth)

    def test_camera_that_shares_nothing(self, seen):
        session, truth = seen
        pixels = session.pixels.copy()
        pixels[:2, 4:] = np.nan
        pixels[2, :4] = np.nan
        with pytest.raises(DegenerateMotionError, match="c2 share no usable station"):
            adjust(session, truth, pixels=pixels)

    def test_blind_reference(self, seen):
        session, truth = seen
        pixels = session.pixels.copy()
        pixels[0] = np.nan
        with pytest.raises(DegenerateMotionError, match="share no usable station"):
            adjust(session, truth, pixels=pixels)

    def test_one_plane_only(self):
        # All stations parallel: Proposition 1 leaves the focal lengths open.
        geometry = scene(count=2)
        first = geometry.stations[0].base_from_flange
        flat = geometry.flange_from_triangle
        stations = []
        for j, station in enumerate(geometry.stations):
            shift = SE3.exp([0.01 * (j % 4), 0.008 * (j // 4), 0, 0, 0, 0.4 * j])
            pose = first @ flat @ shift @ flat.inverse()
            stations.append(replace(station, base_from_flange=pose))
        session, truth = observe(replace(geometry, stations=tuple(stations)))
        with pytest.raises(DegenerateMotionError, match="planes|determine"):
            adjust(session, truth, size=0.0)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"pixels": np.zeros((3, 8, 2, 2))}, "pixels must have shape"),
            ({"covariance": np.zeros((3, 8, 3, 2))}, "covariance must have shape"),
            ({"covariance": np.zeros((3, 8, 3, 2, 2))}, "positive definite"),
            ({"skew": [True]}, "skew and lenses"),
            ({"lenses": [("k9",), (), ()]}, "among k1"),
            ({"lenses": [("k1", "k1"), (), ()]}, "distinct"),
            (
                {"half_turns": [HalfTurn(0, 1, "normal"), HalfTurn(1, 2, "normal")]},
                "several half_turns",
            ),
            ({"half_turns": [HalfTurn(0, 99, "normal")]}, "beyond the 8"),
            ({"half_turns": ()}, "turn_noise needs half_turns"),
        ],
    )
    def test_bad_argument(self, seen, change, message):
        session, truth = seen
        with pytest.raises(InputError, match=message):
            adjust(session, truth, turn_noise=NOISE, **change)

    def test_bad_start(self, seen):
        session, truth = seen
        cameras, places, poses = near(truth)
        rest = (session.pixels, session.pixel_covariance, session.triangle)
        with pytest.raises(InputError, match="one motion for each"):
            bundle_cameras(cameras, places[:2], poses, *rest)
        with pytest.raises(InputError, match="shape \\(8, 4, 4\\)"):
            bundle_cameras(cameras, places, poses[1:], *rest)
        with pytest.raises(InputError, match="cameras is empty"):
            bundle_cameras([], [], poses, *rest)
        lost = poses.copy()
        lost[3] = np.nan
        with pytest.raises(InputError, match="stations \\[3\\]"):
            bundle_cameras(cameras, places, lost, *rest)
        behind = poses @ se3_exp([0, 0, 0, 0, 0, 0.0])
        behind[2, 2, 3] = -1.0
        with pytest.raises(InputError, match="behind its camera"):
            bundle_cameras(cameras, places, behind, *rest)
        twice = [cameras[0], cameras[0], cameras[2]]
        with pytest.raises(InputError, match="names must differ"):
            bundle_cameras(twice, places, poses, *rest)

    @pytest.mark.parametrize(
        ("matrix", "correlation"),
        [
            (np.eye(5), 0.0),
            (np.full((6, 6), np.nan), 0.0),
            (-np.eye(6), 0.0),
            (np.eye(6) + np.diag(np.ones(5), 1), 0.0),
            (np.eye(6), 1.0),
            (np.eye(6), -0.1),
        ],
    )
    def test_bad_turn_noise(self, matrix, correlation):
        with pytest.raises(InputError, match="covariance|correlation"):
            TurnNoise(matrix, correlation)
