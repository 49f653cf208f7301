import json

import numpy as np
import pytest

from handeye_tri.calibrate_cameras import calibrate_cameras_general
from handeye_tri.errors import ConvergenceError
from handeye_tri.experiments import fig13
from handeye_tri.experiments.half_turn_views import IMAGE_SIZE, TRUE_CAMERA
from handeye_tri.experiments.outcome import Options


@pytest.fixture
def one_noise(monkeypatch):
    monkeypatch.setattr(fig13, "NOISES", (0.2,))


def test_views_are_exact_and_in_every_image():
    pixels = fig13.draw_views(np.random.default_rng(1))
    assert pixels.shape == (6, 22, 3, 2)
    assert (pixels > 0).all()
    assert (pixels < np.array(IMAGE_SIZE) - 1).all()
    found = calibrate_cameras_general(pixels, fig13.TRIANGLE, image_sizes=IMAGE_SIZE)
    for camera in found.cameras:
        error = camera.intrinsics.vector - TRUE_CAMERA.intrinsics.vector
        assert np.abs(error).max() < 1e-5


def test_a_trial_depends_on_its_seed_only_and_json_holds_it():
    task = fig13.Trial((0.2,))
    first = task(3)
    assert first == task(3)
    assert json.loads(json.dumps(first, allow_nan=False)) == first
    (run,) = first["runs"]
    ratio = np.array(run["error"]) / run["sigma"]
    assert np.abs(ratio).max() < 6
    # Of 30 quantities: 1 +- 0.26 if the stated covariance is true.
    assert 0.2 < run["nees"] < 1.8


def test_it_writes_and_judges(tmp_path, one_noise):
    outcome = fig13.run(Options(tmp_path, trials=3))
    assert outcome.verdict == "PASS"
    assert "3 of 3 runs converged" in outcome.sentence
    lines = outcome.files[0].read_text().splitlines()
    assert len(lines) == 1 + 5


def test_runs_that_do_not_converge_count(tmp_path, one_noise, monkeypatch):
    real, calls = fig13.calibrate_cameras_general, []

    def second_fails(*arguments, **options):
        calls.append(1)
        if len(calls) == 2:
            raise ConvergenceError("no")
        return real(*arguments, **options)

    monkeypatch.setattr(fig13, "calibrate_cameras_general", second_fails)
    outcome = fig13.run(Options(tmp_path, trials=3))
    assert outcome.verdict == "FAIL"
    assert "2 of 3 runs converged" in outcome.sentence
