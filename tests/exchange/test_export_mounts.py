"""What is exported of a cell whose triangle was put on another mount on the way."""

from __future__ import annotations

import cv2
import numpy as np
import pinocchio as pin
import pytest
from rosbags.highlevel import AnyReader

from handeye_tri import exchange
from handeye_tri.records import Covariance, HandEyeCalibration
from handeye_tri.se3 import SE3
from handeye_tri.synthesize import synthesize, two_mount_geometry


@pytest.fixture(scope="module")
def results():
    """The truth of a cell as if it were a result, over two stations with each mount."""
    rng = np.random.default_rng(3)
    geometry = two_mount_geometry(rng, half_turns=1, evaluation_stations=0)
    session, truth = synthesize(geometry, rng, sigma_px=0.0)
    calibration = HandEyeCalibration(
        cameras=truth.cameras,
        base_from_camera=truth.base_from_camera,
        flange_from_triangle=truth.flange_from_triangle,
        markers=truth.markers,
        covariance=Covariance((), np.zeros((0, 0))),
        chi2=1.0,
        dof=1,
        residuals=np.zeros((4, 6)),
        method="truth",
        other_mounts=truth.other_mounts,
    )
    return exchange.Results(
        cell="both",
        calibration=calibration,
        verdict="PASS",
        sentence="It is the truth",
        simulated=True,
        base_from_flange=session.base_from_flange,
        mounts=session.mounts,
        stations=(0, 1, 2, 3),
        observed_base_from_flange=truth.base_from_flange,
    )


def test_opencv_reads_each_mount_once(results, tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text(exchange.opencv_yaml(results))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    for mount, suffix in zip(results.calibration.mounts, ("", "_2"), strict=True):
        motion = storage.getNode(f"flange_from_triangle{suffix}_m").mat()
        assert (motion == mount.flange_from_triangle.matrix).all()
        markers = storage.getNode(f"markers_in_flange{suffix}_m").mat()
        assert (markers == mount.markers).all()


def test_the_triangle_moves_on_the_flange_at_the_tool_change(results, tmp_path):
    path = tmp_path / "session.mcap"
    bag = exchange.Bag(results, "{}", lambda camera, station: None)
    path.write_bytes(exchange.session_mcap(bag))
    held = [mount.flange_from_triangle.matrix for mount in results.calibration.mounts]
    seen = []
    with AnyReader([path]) as reader:
        for connection, time, raw in reader.messages():
            if connection.topic not in ("/tf", "/tf_static"):
                continue
            for link in reader.deserialize(raw, connection.msgtype).transforms:
                if link.child_frame_id != "triangle":
                    continue
                assert connection.topic == "/tf"
                assert link.header.frame_id == "flange"
                t, q = link.transform.translation, link.transform.rotation
                turn = pin.Quaternion(q.w, q.x, q.y, q.z).toRotationMatrix()
                motion = SE3.from_parts(turn, [t.x, t.y, t.z])
                station = round(time / 1e10) - 1
                expected = held[station // 2]
                np.testing.assert_allclose(motion.matrix, expected, atol=1e-14)
                seen.append(station)
    assert seen == sorted(seen)
    assert set(seen) == {0, 1, 2, 3}
