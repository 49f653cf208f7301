"""The joint adjustment: exact on exact data, honest on noisy data, typed errors."""

import tracemalloc
from dataclasses import replace

import adjust_scene
import numpy as np
import pytest

from handeye_tri.adjustment import Loss, adjust
from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.evaluate import evaluate_track
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.records import MARKER_LABELS, HalfTurn
from handeye_tri.se3 import SE3
from handeye_tri.triangle import TriangleRig

EXACT_CASES = {
    "points": ({}, {}),
    "exact robot": ({"repeatability": adjust_scene.EXACT}, {}),
    "exact sides": ({}, {"side_sigma": 0.0}),
    "sides with a sigma": ({}, {"side_sigma": 1e-4}),
    "spheres": ({"marker_radii": (0.008, 0.0065, 0.01)}, {}),
    "lens": ({"lens": adjust_scene.LENS, "skew": 1.5}, {}),
    "edge": ({"axis": "CA"}, {}),
    "edge, correlated": ({"axis": "CA"}, {"on_axis_correlation": 0.5}),
    "robust": ({}, {"loss": Loss("cauchy", 2.0)}),
    "two mounts": ({"axes": ("normal", "BC"), "half_turns": 6}, {}),
    "two mounts, exact sides": (
        {"axes": ("normal", "normal"), "half_turns": 6},
        {"side_sigma": 0.0},
    ),
    "two mounts, correlated": (
        {"axes": ("CA", "normal"), "half_turns": 6},
        {"on_axis_correlation": 0.5},
    ),
}


@pytest.mark.parametrize("name", EXACT_CASES)
def test_exact_data_give_the_exact_cell(name):
    options, chosen = EXACT_CASES[name]
    # The robot is exact, and said to repeat to 0.03 mm unless it is said to be exact.
    stated = options.get("repeatability", adjust_scene.ROBOT)
    options = {**options, "repeatability": adjust_scene.EXACT}
    session, truth, start = adjust_scene.cell(1, sigma_px=0.0, **options)
    session = replace(session, repeatability=stated)
    found = adjust(session, start, **chosen)
    assert found.chi2 < 1e-12
    off = adjust_scene.errors(found, truth)
    for label, error in off.items():
        assert abs(error) < (1e-6 if label.split(".")[0] in ("left", "right") else 1e-9)
    assert np.abs(found.residuals).max() < 1e-9
    assert found.residuals.shape == (2 * len(session.half_turns), 6)
    assert evaluate_track(found, session).max < 1e-9


def test_spheres_behind_a_lens_are_seen_where_their_outline_is():
    session, truth, start = adjust_scene.cell(
        1, sigma_px=0.0, lens=adjust_scene.LENS, marker_radii=(0.008,) * 3
    )
    found = adjust(session, start)
    # The centroid is integrated to 1e-4 px, and the sessions' weight is 1 px.
    assert np.sqrt(found.chi2 / (2 * found.residuals.shape[0] * 6)) < 2e-4
    assert evaluate_track(found, session).max < 1e-6


@pytest.mark.parametrize("m", [1, 2, 64])
def test_any_number_of_cameras(m):
    rng = np.random.default_rng(m)
    session, truth = adjust_scene.ring(m, 30, rng, 0.0, adjust_scene.EXACT)
    found = adjust(session, adjust_scene.rough(truth, rng))
    off = adjust_scene.errors(found, truth)
    assert max(abs(v) for k, v in off.items() if k.startswith("base_from")) < 1e-9
    assert max(abs(v) for k, v in off.items() if k.startswith("marker")) < 1e-9
    assert len(found.covariance.labels) == 4 * m + 6 * (m - 1) + 6 * m + 6 + 9


def test_memory_grows_by_less_than_2_kb_a_view():
    peaks = []
    for n in (1000, 3000):
        rng = np.random.default_rng(n)
        session, truth = adjust_scene.ring(2, n, rng)
        start = adjust_scene.rough(truth, rng, 0.1)
        tracemalloc.start()
        adjust(session, start)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert (peaks[1] - peaks[0]) / (2 * 2000) < 2000


def test_any_subset_of_markers():
    rng = np.random.default_rng(3)
    session, truth = adjust_scene.ring(3, 40, rng, 0.0, adjust_scene.EXACT)
    hidden = rng.random((3, 40, 3)) < 0.5
    hidden[:, 0] = True
    hidden[0, 0, 1] = False
    session = adjust_scene.hide(session, hidden)
    found = adjust(session, adjust_scene.rough(truth, rng))
    assert max(map(abs, adjust_scene.errors(found, truth).values())) < 1e-6
    # One marker in one view does not fix the flange, but it counts.
    assert 0 not in found.details["stations"]
    assert len(found.residuals) == len(found.details["stations"])
    seen = np.isfinite(found.details["pixel_residuals"]).all(axis=-1)
    np.testing.assert_array_equal(seen, np.isfinite(session.pixels).all(axis=-1))
    assert found.dof == 2 * seen.sum() - (3 * 10 + 9)


def test_held_out_stations_are_not_read():
    session, _, start = adjust_scene.cell(
        2, sigma_px=0.1, repeatability=adjust_scene.ROBOT
    )
    hidden = np.zeros((2, 28, 3), dtype=bool)
    hidden[:, 22:] = True
    one, other = (
        adjust(session, start),
        adjust(adjust_scene.hide(session, hidden), start),
    )
    assert one.chi2 == other.chi2
    np.testing.assert_array_equal(one.markers, other.markers)


def test_wrong_sides_matter_only_where_they_are_believed():
    session, truth, start = adjust_scene.cell(
        4, sigma_px=0.03, repeatability=adjust_scene.ROBOT
    )
    true = session.triangle
    wrong = TriangleRig(true.side_ab + 3e-4, true.side_ac, true.angle)
    mistaken = replace(session, triangle=wrong)
    free = adjust(mistaken, start)
    assert free.chi2 == pytest.approx(adjust(session, start).chi2, rel=1e-9)
    side = np.linalg.norm(free.markers[1] - free.markers[0])
    assert side == pytest.approx(true.side_ab, abs=6e-5)
    believed = adjust(mistaken, start, side_sigma=0.0)
    assert believed.chi2 / believed.dof > 1.3
    side = np.linalg.norm(believed.markers[1] - believed.markers[0])
    assert side == pytest.approx(wrong.side_ab, abs=1e-12)
    doubted = adjust(mistaken, start, side_sigma=3e-4)
    assert doubted.chi2 / doubted.dof < 1.2
    assert doubted.details["chi2_sides"] > 0.3


def test_the_covariance_is_consistent_among_its_labels():
    session, _, start = adjust_scene.cell(
        5, sigma_px=0.1, repeatability=adjust_scene.ROBOT
    )
    step = 1e-6
    for sigma in (np.inf, 0.0):
        found = adjust(session, start, side_sigma=sigma)
        labels = found.covariance.labels
        markers = [label for label in labels if label.startswith("marker")]
        frame = [label for label in labels if label.startswith("flange_from")]
        block = found.covariance.block([*frame, *markers])
        # The triangle's frame is built from the markers: the same by differences.
        slope = np.zeros((6, 9))
        for k in range(9):
            moved = found.markers + step * np.eye(9)[k].reshape(3, 3)
            along, toward = moved[1] - moved[0], moved[2] - moved[0]
            x = along / np.linalg.norm(along)
            z = np.cross(x, toward) / np.linalg.norm(np.cross(x, toward))
            built = SE3.from_parts(np.stack([x, np.cross(z, x), z], axis=1), moved[0])
            slope[:, k] = (found.flange_from_triangle.inverse() @ built).log() / step
        expected = slope @ block[6:, 6:] @ slope.T
        std = np.sqrt(np.diagonal(expected))
        scaled = (block[:6, :6] - expected) / np.outer(std, std)
        assert np.abs(scaled).max() < 1e-4
        # Adj(right_from_left) carries the first camera's tangent to the second.
        names = [f"{o}.{q}" for o in ("base_from_left", "base_from_right",
                                      "reference_from_right")
                 for q in ("x", "y", "z", "rx", "ry", "rz")]  # fmt: skip
        right_from_left = (
            found.base_from_camera[1].inverse() @ found.base_from_camera[0]
        )
        change = np.hstack([right_from_left.adjoint(), -np.eye(6), np.eye(6)])
        block = found.covariance.block(names)
        size = np.abs(change) @ np.sqrt(np.diagonal(block))
        left_over = change @ block @ change.T / np.outer(size, size)
        assert np.abs(left_over).max() < 1e-9


def test_wrong_detections_lose_their_weight():
    session, truth, start = adjust_scene.cell(
        6, sigma_px=0.05, repeatability=adjust_scene.ROBOT
    )
    clean = adjust(session, start)
    rng = np.random.default_rng(0)
    pixels = session.pixels.copy()
    wrong = rng.random((2, 28, 3)) < 0.05
    wrong[:, 22:] = False
    pixels[wrong] += rng.uniform(3, 8, size=(wrong.sum(), 2))
    spoiled = replace(session, pixels=pixels)
    plain = adjust(spoiled, start)
    assert plain.chi2 / plain.dof > 20
    for loss in (Loss("huber", 2.5), Loss("cauchy", 2.5)):
        robust = adjust(spoiled, start, loss=loss)
        track = evaluate_track(robust, session)
        assert track.rms < 1.3 * evaluate_track(clean, session).rms
        assert track.rms < 0.5 * evaluate_track(plain, session).rms
        assert loss.name in robust.method


def test_an_exact_robot_has_no_corrections_and_no_such_cost():
    session, _, start = adjust_scene.cell(7, sigma_px=0.1)
    found = adjust(session, start)
    assert found.details["chi2_robot"] == 0.0
    assert not found.details["corrections"][:22].any()
    assert np.isnan(found.details["corrections"][22:]).all()
    assert found.dof == 2 * 2 * 3 * 22 - (2 * 11 + 9)


def test_start_does_not_matter():
    session, _, start = adjust_scene.cell(
        8, sigma_px=0.1, repeatability=adjust_scene.ROBOT
    )
    separate = calibrate_hand_eye(session, calibrate_session_cameras(session))
    one, other = adjust(session, start), adjust(session, separate)
    assert one.chi2 == pytest.approx(other.chi2, rel=1e-9)
    for a, b in zip(one.cameras, other.cameras, strict=True):
        np.testing.assert_allclose(a.intrinsics.vector, b.intrinsics.vector, atol=1e-4)
    assert set(other.alternatives) == {*separate.alternatives, "separate"}


def test_correlated_errors_on_the_axis_are_found():
    rng = np.random.default_rng(1)
    session, _, start = adjust_scene.cell(9, sigma_px=1e-6, axis="CA", half_turns=20)
    noise = 0.05 * rng.normal(size=session.pixels.shape)
    for turn in session.half_turns:
        common = 0.05 * rng.normal(size=(2, 2, 2))
        # C and A are on the axis.
        for j in (turn.before, turn.after):
            noise[:, j, [0, 2]] = (
                np.sqrt(0.4) * noise[:, j, [0, 2]] + np.sqrt(0.6) * common
            )
    session = replace(
        session,
        pixels=session.pixels + noise,
        pixel_covariance=np.broadcast_to(0.05**2 * np.eye(2), (*noise.shape, 2)),
        repeatability=adjust_scene.ROBOT,
    )
    found = adjust(session, start)
    assert 0.4 < found.details["on_axis_correlation"] < 0.8
    assert adjust(session, start, on_axis_correlation=0.0).details[
        "on_axis_correlation"
    ] == pytest.approx(0.0)


def test_motion_about_one_axis_names_what_it_leaves_open():
    session, truth = adjust_scene.ring(2, 20, np.random.default_rng(0), 0.0)
    about = [SE3.exp((0, 0, 0, 0, 0, angle)) for angle in np.linspace(-0.6, 0.6, 20)]
    first = session.stations[0].base_from_flange
    pixels = np.full(session.pixels.shape, np.nan)
    poses = [first @ motion for motion in about]
    for i, camera in enumerate(truth.cameras):
        for j, pose in enumerate(poses):
            local = truth.base_from_camera[i].inverse() @ pose
            pixels[i, j] = camera.project(local.apply(truth.markers))
    stations = tuple(
        replace(s, base_from_flange=pose)
        for s, pose in zip(session.stations, poses, strict=True)
    )
    session = replace(
        session,
        stations=stations,
        pixels=pixels,
        pixel_covariance=np.broadcast_to(0.01 * np.eye(2), (*pixels.shape, 2)),
    )
    with pytest.raises(
        DegenerateMotionError, match="open: base_from_camera_0, .*marker_A, .*trade"
    ):
        adjust(session, adjust_scene.rough(truth, np.random.default_rng(1), 0.0))


def test_too_few_observations_are_counted():
    session, truth = adjust_scene.ring(2, 2, np.random.default_rng(0), 0.0)
    start = adjust_scene.rough(truth, np.random.default_rng(1), 0.0)
    with pytest.raises(DegenerateMotionError, match=r"36 observations .* 41 unknowns"):
        adjust(session, start)


def test_what_does_not_fit_is_named():
    session, _, start = adjust_scene.cell(0, sigma_px=0.1, half_turns=3)
    swapped = replace(start, cameras=start.cameras[::-1])
    with pytest.raises(InputError, match="right, left"):
        adjust(session, swapped)
    with pytest.raises(InputError, match="side_sigma must be 0 or more"):
        adjust(session, start, side_sigma=-1.0)
    with pytest.raises(InputError, match="on_axis_correlation"):
        adjust(session, start, on_axis_correlation=1.0)
    hidden = np.zeros(session.pixels.shape[:3], dtype=bool)
    hidden[1] = True
    with pytest.raises(InputError, match="'right' sees no marker"):
        adjust(adjust_scene.hide(session, hidden), start)
    turned = start.base_from_camera[1] @ SE3.exp((0, 0, 0, 0, np.pi, 0))
    behind = replace(start, base_from_camera=(start.base_from_camera[0], turned))
    with pytest.raises(InputError, match="behind its camera"):
        adjust(session, behind)
    turns = (*session.half_turns, HalfTurn(0, 2, "CA"), HalfTurn(2, 4, "CA"))
    with pytest.raises(InputError, match="several half_turns"):
        adjust(replace(session, half_turns=turns), start)


@pytest.mark.parametrize(
    ("options", "chosen"),
    [
        ({"sigma_px": 0.1, "repeatability": adjust_scene.ROBOT}, {}),
        ({"sigma_px": 0.03}, {"side_sigma": 0.0}),
        (
            {
                "sigma_px": 0.1,
                "repeatability": adjust_scene.ROBOT,
                "axes": ("normal", "BC"),
                "half_turns": 6,
            },
            {"on_axis_correlation": 0.0},
        ),
    ],
)
def test_errors_are_as_large_as_predicted(options, chosen):
    """30 draws; one NEES per unknown is then known to 4 to 6 %, a ratio to 10 %."""
    trials = 30
    nees, tracks, predicted, chi2 = [], [], [], []
    blocks = ["left", "right", "base_from_left", "base_from_right",
              "flange_from_triangle", "marker"]  # fmt: skip
    if "axes" in options:
        blocks += ["flange_from_triangle_2", "marker_A_2", "marker_B_2", "marker_C_2"]
    for trial in range(trials):
        session, truth, start = adjust_scene.cell(
            trial % 5, noise=100 + trial, estimate_skew=False, **options
        )
        found = adjust(session, start, **chosen)
        off = adjust_scene.errors(found, truth)
        row = []
        for block in blocks:
            labels = [
                x
                for x in found.covariance.labels
                if x.split(".")[0] == block
                or (block == "marker" and x in MARKER_LABELS)
            ]
            if block == "marker" and "side_sigma" in chosen:
                # A rigid triangle: nine coordinates, six unknowns.
                labels = labels[:3]
            error = np.array([off[label] for label in labels])
            row.append(
                error @ np.linalg.solve(found.covariance.block(labels), error)
                / len(labels)
            )  # fmt: skip
        nees.append(row)
        track = evaluate_track(found, session)
        tracks.append(track.rms**2)
        predicted.append(track.predicted_rms**2)
        chi2.append(found.chi2 / found.dof)
    # 30 x 4 to 9 squares of normal errors: standard deviation 0.08 to 0.13.
    assert np.abs(np.mean(nees, axis=0) - 1).max() < 0.4, np.mean(nees, axis=0)
    assert np.sqrt(np.mean(tracks) / np.mean(predicted)) == pytest.approx(1, abs=0.15)
    # dof of 235: 0.092 for one, 0.017 for the mean of 30.
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("session", None),
        ("start", "cell"),
        ("side_sigma", "0.1"),
        ("side_sigma", True),
        ("side_sigma", -1.0),
        ("loss", "huber"),
        ("robot_parameters", ["elbow.offset"]),
        ("on_axis_correlation", "0.5"),
        ("on_axis_correlation", 1.0),
    ],
)
def test_an_argument_of_the_wrong_kind_is_named(argument, value):
    session, _, start = adjust_scene.cell(1, half_turns=3, sigma_px=0.1)
    with pytest.raises(InputError, match=f"^{argument} must be "):
        adjust(**{"session": session, "start": start, argument: value})
