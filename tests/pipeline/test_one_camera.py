"""A cell of one camera, from its plan to files for other tools."""

import numpy as np
import pytest

from handeye_tri import storage
from handeye_tri.exchange import FrameNames
from handeye_tri.pipeline import VERBS, NullProgress, Run, execute, stages_of, start
from handeye_tri.pipeline.export import FORMATS, export
from handeye_tri.replay import screenshot


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("one_camera") / "out"
    session = Run(start("hp3_single", folder, 2, 6), NullProgress())
    with session.folder.locked():
        execute(session, stages_of(session), VERBS, again=False)
    return Run(storage.SessionFolder.open(folder), NullProgress())


def test_it_passes_with_honest_sigmas(run):
    evaluation = run.evaluation()
    assert evaluation["verdict"] == "PASS"
    assert evaluation["track"]["stations"] == 6
    ratio = evaluation["track"]["rms_mm"] / evaluation["track"]["predicted_rms_mm"]
    assert 0.5 < ratio < 1.6
    assert 0.5 < evaluation["hand_eye_chi2_per_dof"] < 1.5
    for name, row in evaluation["truth"].items():
        assert abs(row["error"]) < 4.5 * row["sigma"], name
    assert "sigma.baseline_mm" not in run.plan().certificate


def test_separate_steps_start_from_what_was_written(run):
    from handeye_tri.evaluate import evaluate_track
    from handeye_tri.hand_eye import calibrate_hand_eye

    session = run.session()
    separate = calibrate_hand_eye(session, run.cameras())
    assert evaluate_track(separate, session).rms < 5e-4


def test_its_files_can_be_written(run, tmp_path):
    for name in FORMATS:
        files, results = export(run, name, tmp_path / name, frames=FrameNames())
        assert all(path.exists() for path in files), name
    # The only camera sees the flange at every station.
    assert results.stations == tuple(range(18))
    off = (
        results.observed_base_from_flange[:, :3, 3] - results.base_from_flange[:, :3, 3]
    )
    assert np.linalg.norm(off, axis=1).max() < 1e-3


def test_the_report_maps_the_workspace(run):
    from handeye_tri.evaluate import track_map

    radii = track_map(run.hand_eye(), run.session(), (4, 4, 3)).rms
    # Near the camera the triangle is not whole in the image.
    assert np.isfinite(radii).mean() > 0.5
    assert 0.03e-3 < np.nanmedian(radii) < 0.5e-3


def test_its_recording_has_no_view_error(run, tmp_path):
    assert screenshot(run.folder.file("replay.rrd"), tmp_path / "picture.png") == []
