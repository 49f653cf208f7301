"""A mislabelled view of one camera, from the files of a session to its verdict."""

import numpy as np
from drawn_session import drawn_session

from handeye_tri import storage
from handeye_tri.pipeline import STAGES, evaluation


def test_a_mislabelled_view_is_left_out_everywhere_and_named(tmp_path):
    run = drawn_session(tmp_path)
    whole = run.observed()
    np.testing.assert_array_equal(run.session().pixels, whole.pixels)
    assert run.cameras().details["dropped"] == ()

    turn = whole.half_turns[3]
    pixels = whole.pixels.copy()
    pixels[1, turn.after] = pixels[1, turn.after, [1, 0, 2]]
    storage.write_arrays(
        run.folder.file("observations.npz"),
        {"pixels": pixels, "pixel_covariance": whole.pixel_covariance},
    )
    _, line = STAGES["cameras"].run(run)
    name = whole.cameras[1].name
    said = f"{name}, half-turn 3 (stations {turn.before} and {turn.after}): labels exch"
    assert f"dropped {said}" in line

    unseen = np.isnan(run.session().pixels[..., 0]).all(axis=2)
    lost = np.zeros(unseen.shape, dtype=bool)
    lost[1, [turn.before, turn.after]] = True
    np.testing.assert_array_equal(unseen, lost | np.isnan(pixels[..., 0]).all(axis=2))
    STAGES["hand_eye"].run(run)
    judged = evaluation.judged_track(run, run.session(), run.hand_eye())
    verdict = evaluation.judge_session(run, judged)
    assert verdict.outcome == "PASS"
    named, dropped = verdict.findings
    assert (named.code, dropped.code) == ("LABELS", "DROPPED")
    assert (named.stations, named.camera) == ((turn.after,), name)
    assert said in dropped.evidence
