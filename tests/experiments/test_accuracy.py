import csv
import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from handeye_tri.calibrate_cameras import calibrate_camera
from handeye_tri.experiments import accuracy, fig05, fig06, fig07
from handeye_tri.experiments.accuracy import Setting, Trial, judge, summarise
from handeye_tri.experiments.half_turn_views import (
    IMAGE_SIZE,
    TRUE_CAMERA,
    draw_half_turns,
    longest_edge,
)
from handeye_tri.experiments.outcome import Options
from handeye_tri.triangle import TriangleRig

SETTINGS = (Setting(0.1, 0.1, 8, 0.5), Setting(0.2, 0.2, 8, 0.5))


def views_and_calibration(normal, *, skew=True, noise=0.0, turns=11, cos_theta=0.5):
    rng = np.random.default_rng([7, normal])
    views = draw_half_turns(rng, turns, cos_theta=cos_theta, normal=normal)
    pixels = views.pixels + noise * rng.standard_normal(views.pixels.shape)
    found = calibrate_camera(
        pixels[:, 0],
        pixels[:, 1],
        views.triangle,
        image_size=IMAGE_SIZE,
        axis=views.axis,
        skew=skew,
        sigma_px=0.2,
    )
    return views, found


@pytest.mark.parametrize("normal", [True, False])
@pytest.mark.parametrize("cos_theta", [0.0, 0.5, 0.9])
def test_views_are_exact_half_turns_of_the_true_camera(normal, cos_theta):
    views, found = views_and_calibration(normal, cos_theta=cos_theta)
    error = found.camera.intrinsics.vector - TRUE_CAMERA.intrinsics.vector
    assert np.abs(error).max() < 1e-6
    assert (views.pixels > 0).all()
    assert (views.pixels < np.array(IMAGE_SIZE) - 1).all()


@pytest.mark.parametrize("normal", [True, False])
@pytest.mark.parametrize("skew", [True, False])
def test_the_bound_is_the_covariance_at_the_truth(normal, skew):
    """Numerical derivatives here, analytic ones there: central differences of pixels
    at 1e-6 leave seven digits of the Jacobian, the inverse about five."""
    views, found = views_and_calibration(normal, skew=skew)
    sigma = np.sqrt(np.diagonal(found.covariance.matrix))
    bound = views.bound(0.2, skew=skew)
    assert bound[bound > 0] == pytest.approx(sigma, rel=1e-4)
    assert (bound[2] == 0) == (not skew)


def test_the_bound_is_proportional_to_the_noise():
    views, _ = views_and_calibration(True)
    assert views.bound(0.6, skew=True) == pytest.approx(3 * views.bound(0.2, skew=True))


@pytest.mark.parametrize(("degrees", "edge"), [(30, "AB"), (80, "BC"), (150, "BC")])
def test_the_axis_in_the_plane_is_the_longest_edge(degrees, edge):
    assert longest_edge(TriangleRig(0.13, 0.12, np.radians(degrees))) == edge


def test_a_trial_depends_on_its_seed_only_and_json_holds_it():
    task = Trial(SETTINGS)
    first, again, other = task(3), task(3), task(4)
    assert first == again
    assert first != other
    assert json.loads(json.dumps(first, allow_nan=False)) == first
    assert set(first) == {"III-A", "III-B"}
    for entries in first.values():
        for entry in entries:
            ratio = np.array(entry["refined"]["error"]) / entry["bound"]
            assert np.abs(ratio).max() < 6


def test_views_of_two_half_turns_do_without_skew():
    entry = Trial((Setting(4, 0.01, 2, 0.5),))(1)["III-A"][0]
    assert entry["bound"][2] == 0
    assert entry["refined"]["error"][2] == 0


def made_up(ratio, trials, seed=0):
    """Trials whose refined errors are Gaussian with ``ratio`` times the bound."""
    rng = np.random.default_rng(seed)
    bound = [2.0, 2.0, 1.0, 3.0, 3.0]

    def entry():
        errors = ratio * rng.standard_normal(5) * bound
        estimate = {"error": errors.tolist(), "nees": ratio**2}
        return {"bound": bound, "paper": estimate, "whitened": estimate} | {
            "refined": estimate
        }

    return [
        {section: [entry() for _ in SETTINGS] for section in accuracy.SECTIONS}
        for _ in range(trials)
    ]


def test_statistics_are_those_of_the_errors():
    rows = summarise(SETTINGS, made_up(1.5, 4000))
    assert len(rows) == 2 * 2 * 3 * 5
    row = next(r for r in rows if r.quantity == "u0" and r.estimate == "refined")
    assert row.trials == 4000
    # Root mean squares of 4000 Gaussians scatter by 1.1 %.
    assert row.rms_over_bound == pytest.approx(1.5, rel=0.05)
    assert row.median_over_bound == pytest.approx(1.5, rel=0.08)
    percent = 100 * 1.5 * 3 / TRUE_CAMERA.intrinsics.fx
    assert row.std_percent == pytest.approx(percent, rel=0.05)
    assert row.mean_percent == pytest.approx(percent * np.sqrt(2 / np.pi), rel=0.05)
    assert row.bound_percent == pytest.approx(percent / 1.5)


@pytest.mark.parametrize(
    ("ratio", "trials", "expected"),
    [(1.0, 2000, True), (1.2, 2000, False), (0.8, 2000, False), (1.0, 49, None)],
)
def test_the_refined_estimate_must_be_at_the_bound(ratio, trials, expected):
    passed, sentence = judge(
        SETTINGS, summarise(SETTINGS, made_up(ratio, trials)), trials
    )
    assert passed is expected
    assert f"{trials} trials" in sentence


def test_a_failure_with_many_half_turns_is_one():
    trials = made_up(1.0, 2000)
    trials[5]["III-B"][0]["refined"] = {"failed": "ConvergenceError"}
    passed, sentence = judge(SETTINGS, summarise(SETTINGS, trials), 2000)
    assert passed is False
    assert "1 failed" in sentence


def test_failures_with_few_half_turns_are_told_apart():
    few = (replace(SETTINGS[0], half_turns=2), SETTINGS[1])
    trials = made_up(1.0, 2000)
    trials[5]["III-B"][0]["refined"] = {"failed": "DegenerateMotionError"}
    passed, sentence = judge(few, summarise(few, trials), 2000)
    assert passed is True
    assert "1 undetermined" in sentence


def test_a_study_writes_table_plot_and_verdict_and_resumes(tmp_path):
    options = Options(tmp_path, trials=3)
    outcome = accuracy.run_study(options, "small", "Small", "noise, px", SETTINGS)
    names = [path.name for path in outcome.files]
    assert names == ["small.csv", "small.svg", "small.png", "small.txt"]
    assert outcome.verdict == "CANNOT TELL"
    assert (tmp_path / "small.txt").read_text() == f"{outcome.line}\n"
    with (tmp_path / "small.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert {row["section"] for row in rows} == {"III-A", "III-B"}
    assert {row["estimate"] for row in rows} == set(accuracy.ESTIMATES)
    assert {row["x"] for row in rows} == {"0.1", "0.2"}
    assert (tmp_path / "small.png").read_bytes().startswith(b"\x89PNG")
    assert "Cramer-Rao bound" in (tmp_path / "small.svg").read_text()

    def never(seed):
        raise AssertionError(seed)

    identity = {"settings": [asdict(setting) for setting in SETTINGS]}
    again = options.sweep("small", never, identity)
    assert again == [Trial(SETTINGS)(seed) for seed in range(3)]


def test_settings_are_the_papers():
    assert [s.sigma_px for s in fig05.SETTINGS] == pytest.approx(
        np.linspace(0.1, 1.0, 10)
    )
    assert {2 * s.half_turns for s in (*fig05.SETTINGS, *fig07.SETTINGS)} == {22}
    assert [2 * s.half_turns for s in fig06.SETTINGS] == list(range(4, 23, 2))
    assert {s.sigma_px for s in fig06.SETTINGS} == {0.2}
    assert [s.cos_theta for s in fig07.SETTINGS] == pytest.approx(
        np.linspace(0, 0.9, 10)
    )
    assert {s.sigma_px for s in fig07.SETTINGS} == {0.3}
