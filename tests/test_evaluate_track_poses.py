"""The track as trajectories, and what a peer computes from them."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from finished_session import finished

from handeye_tri.evaluate import track_poses
from handeye_tri.records import TrackEvaluation
from handeye_tri.se3 import so3_exp
from handeye_tri.storage import write_tum


def evo_ape(folder, relation):
    """Statistics that evo finds between both files in a folder, by name."""
    program = Path(sys.executable).with_name("evo_ape")
    if not program.is_file():
        pytest.skip("evo is not installed: pip install evo")
    result = folder / f"{relation}.zip"
    done = subprocess.run(
        [
            *(program, "tum", folder / "reported.tum", folder / "observed.tum"),
            *("-r", relation, "--save_results", result, "--no_warnings"),
        ],
        capture_output=True,
        text=True,
        check=False,
        # It writes settings into the home folder.
        env={**os.environ, "HOME": str(folder), "MPLCONFIGDIR": str(folder)},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    with zipfile.ZipFile(result) as archive:
        return json.loads(archive.read("stats.json"))


@pytest.mark.parametrize("axis", ["normal", "BC"])
def test_evo_finds_the_same_track_error(tmp_path, axis):
    done = finished(3, axis)
    poses = track_poses(done.calibration, done.track, done.session.mounts)
    assert poses.rows.tolist() == list(range(9))
    for name in ("reported", "observed"):
        motions = getattr(poses, name)
        write_tum(tmp_path / f"{name}.tum", poses.times, motions, name)
    moved = evo_ape(tmp_path, "trans_part")
    assert moved["rmse"] == pytest.approx(done.track.rms, rel=1e-9)
    assert moved["mean"] == pytest.approx(done.track.mean, rel=1e-9)
    assert moved["max"] == pytest.approx(done.track.max, rel=1e-9)
    turned = evo_ape(tmp_path, "angle_deg")
    angles = np.degrees(poses.rotation_errors)
    assert angles.shape == (3,)
    # It takes the angle from a cosine-like formula, which costs half of the digits.
    assert turned["rmse"] == pytest.approx(np.sqrt(np.mean(angles**2)), rel=1e-4)
    assert turned["max"] == pytest.approx(angles.max(), rel=1e-4)


def test_orientations_are_those_of_the_triangle():
    done = finished(3)
    poses = track_poses(done.calibration, done.track, done.session.mounts)
    session = done.session
    for row, station in enumerate(done.track.stations):
        expected = session.base_from_flange[station, :3, :3]
        np.testing.assert_allclose(poses.reported[row, :3, :3], expected, atol=1e-9)
    # A turn that is put into what was observed comes out again.
    turn = so3_exp([0.001, -0.002, 0.0005])
    reported = done.track.reported.reshape(3, 3, 3)
    centre = reported.mean(axis=1, keepdims=True)
    observed = (reported - centre) @ turn.T + centre
    moved = TrackEvaluation(
        *(done.track.stations, done.track.markers, done.track.reported),
        *(observed.reshape(-1, 3), done.track.predicted_covariance),
    )
    angles = track_poses(done.calibration, moved, done.session.mounts).rotation_errors
    np.testing.assert_allclose(angles, np.linalg.norm([0.001, -0.002, 0.0005]))


def test_a_station_that_lacks_a_marker_has_no_orientation():
    done = finished(3)
    track = done.track
    keep = np.arange(9) != 4
    partial = TrackEvaluation(
        *(track.stations[keep], track.markers[keep], track.reported[keep]),
        *(track.observed[keep], track.predicted_covariance[keep]),
    )
    poses = track_poses(done.calibration, partial, done.session.mounts)
    assert poses.rows.tolist() == [0, 1, 2, 5, 6, 7]
    assert len(poses.rotation_errors) == 2
    assert (np.diff(poses.times) > 0).all()


def test_files_read_back_to_the_same_bits(tmp_path):
    done = finished(3)
    poses = track_poses(done.calibration, done.track, done.session.mounts)
    path = tmp_path / "track.tum"
    write_tum(path, poses.times, poses.observed, "what it is")
    assert path.read_text().startswith("# what it is\n# t x y z qx qy qz qw\n")
    table = np.loadtxt(path)
    np.testing.assert_array_equal(table[:, 1:4], poses.observed[:, :3, 3])
    np.testing.assert_allclose(np.linalg.norm(table[:, 4:], axis=1), 1, atol=1e-12)
