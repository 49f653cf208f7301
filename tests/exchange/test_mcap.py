"""The session as a bag, read by rosbags and by mcap's own reader with CRCs."""

from __future__ import annotations

import io
import json
import sys
from collections import Counter

import numpy as np
import pinocchio as pin
import pytest
import yaml
from drawn_session import drawn_session
from exported import call, exported
from finished_session import mechanism as every_shape
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from handeye_tri.exchange import link_names, robot_urdf
from handeye_tri.se3 import SE3
from handeye_tri.storage import read_bytes


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """The session, the file, and its messages by topic: (time in ns, message)."""
    import contextlib

    run = drawn_session(tmp_path_factory.mktemp("bag"))
    path = run.folder.path.parent / "session.mcap"
    from handeye_tri import cli

    with contextlib.redirect_stdout(io.StringIO()), pytest.raises(SystemExit) as left:
        cli.main(["export", str(run.folder.path), "mcap", "-o", str(path)])
    assert not left.value.code
    topics: dict[str, list[tuple[int, object]]] = {}
    with AnyReader([path]) as reader:
        for connection, time, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            topics.setdefault(connection.topic, []).append((time, message))
    return run, path, topics


def motion(transform):
    t, q = transform.translation, transform.rotation
    turn = pin.Quaternion(q.w, q.x, q.y, q.z).toRotationMatrix()
    return SE3.from_parts(turn, [t.x, t.y, t.z])


def test_rosbags_finds_every_image_byte_for_byte(bag):
    run, _, topics = bag
    stations = len(run.plan().stations)
    for camera in ("left", "right"):
        views = topics[f"/{camera}/image/compressed"]
        assert [time for time, _ in views] == [
            (j + 1) * 10**10 for j in range(stations)
        ]
        for j, (time, message) in enumerate(views):
            stamp = message.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == time
            assert message.header.frame_id == f"{camera}_optical_frame"
            assert message.format == "png"
            file = run.folder.file(run.image_name(camera, j))
            assert message.data.tobytes() == read_bytes(file)


def test_rosbags_finds_cameras_joints_and_frames(bag):
    run, _, topics = bag
    cell, session = run.hand_eye(), run.session()
    for camera in cell.cameras:
        for _, info in topics[f"/{camera.name}/camera_info"]:
            assert (info.width, info.height) == camera.image_size
            assert info.k.tolist() == camera.intrinsics.matrix.ravel().tolist()
            assert info.d.tolist() == camera.lens.coefficients.tolist()
            assert info.distortion_model == "plumb_bob"
    ((_, fixed),) = topics["/tf_static"]
    found = {
        (t.header.frame_id, t.child_frame_id): motion(t.transform)
        for t in fixed.transforms
    }
    for camera, place in zip(cell.cameras, cell.base_from_camera, strict=True):
        frames = ("base", f"{camera.name}_optical_frame")
        np.testing.assert_allclose(found[frames].matrix, place.matrix, atol=1e-14)
    np.testing.assert_allclose(
        found["flange", "triangle"].matrix,
        cell.flange_from_triangle.matrix,
        atol=1e-14,
    )
    assert len(topics["/tf"]) == len(topics["/joint_states"])
    for time, message in topics["/joint_states"]:
        station = session.stations[round(time / 1e10) - 1]
        assert tuple(message.name) == run.arm.joint_names
        assert message.position.tolist() == station.joints.tolist()


def test_frames_are_one_tree_that_leads_from_base_to_the_reported_flange(bag):
    run, _, topics = bag
    poses = run.session().base_from_flange
    for time, message in topics["/tf"]:
        parents = {t.child_frame_id: t for t in message.transforms}
        assert len(parents) == len(message.transforms)
        reported = motion(parents["flange"].transform)
        expected = poses[round(time / 1e10) - 1]
        np.testing.assert_allclose(reported.matrix, expected, atol=1e-14)
        # The last link's body carries the flange; the links say the same of it.
        chain, frame = SE3.identity(), "rig"
        while frame != "base":
            chain = motion(parents[frame].transform) @ chain
            frame = parents[frame].header.frame_id
        np.testing.assert_allclose(chain.matrix, expected, atol=1e-12)


def test_pinocchio_moves_the_description_as_our_arm_moves(bag):
    run, _, topics = bag
    ((_, text),) = topics["/robot_description"]
    model = pin.buildModelFromXML(text.data)
    assert tuple(model.names)[1:] == run.arm.joint_names
    data, rng = model.createData(), np.random.default_rng(1)
    base, rig = model.getFrameId("base"), model.getFrameId("rig")
    for _ in range(20):
        q = rng.uniform(run.arm.lower, run.arm.upper)
        pin.framesForwardKinematics(model, data, q)
        found = data.oMf[base].inverse() * data.oMf[rig]
        np.testing.assert_allclose(found.homogeneous, run.arm.forward(q), atol=1e-12)


def test_a_joint_off_its_bodys_origin_and_away_from_zero_keeps_its_place(tmp_path):
    from dataclasses import replace

    from handeye_tri.arm import Arm

    plain = every_shape()
    joint = replace(plain.joints[0], anchor=np.array([0.1, -0.2, 0.05]), reference=0.4)
    skewed = replace(plain, joints=(joint,), flange="rig")
    names = link_names(skewed, "base", "flange")
    model = pin.buildModelFromXML(robot_urdf(skewed, names))
    data, arm = model.createData(), Arm(skewed)
    for q in ([0.0], [0.4], [-1.3]):
        pin.framesForwardKinematics(model, data, np.array(q))
        base, last = (data.oMf[model.getFrameId(names[i])] for i in (1, 2))
        found = (base.inverse() * last).homogeneous
        np.testing.assert_allclose(found, arm.forward(q), atol=1e-12)


def test_links_never_take_the_name_of_the_reported_flange():
    names = link_names(every_shape(), "world", "link_1_t")
    assert len(set(names)) == 3
    assert names[1] == "world"
    assert "link_1_t" not in names


def test_the_bag_says_what_it_is(bag):
    run, _, topics = bag
    ((_, message),) = topics["/handeye_tri/session"]
    about = json.loads(message.data)
    assert about["notice"][0].startswith("VERDICT PASS")
    assert about["session"]["cell"] == run.folder.header["cell"]


def test_mcaps_reader_accepts_every_crc(bag):
    _, path, topics = bag
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        count = sum(1 for _ in reader.iter_messages())
        assert reader.get_summary().statistics.message_count == count
    assert count == sum(map(len, topics.values()))


@settings(max_examples=25)
@given(st.floats(0, 1, exclude_max=True), st.integers(0, 7))
def test_a_flipped_bit_in_the_data_is_noticed(bag, place, bit):
    _, path, _ = bag
    data = bytearray(path.read_bytes())
    # Behind the magic and the header, before the summary: what chunk CRCs cover.
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    chunk = chunks[int(place * len(chunks))]
    # A chunk's own head is 53 bytes long; what it holds follows.
    offset = 53 + int(place * (chunk.chunk_length - 53))
    data[chunk.chunk_start_offset + offset] ^= 1 << bit
    with pytest.raises(Exception):  # noqa: B017, PT011, PT012
        reader = make_reader(io.BytesIO(bytes(data)), validate_crcs=True)
        for _ in reader.iter_messages():
            pass


def test_without_the_extra_one_sentence_says_how_to_get_it(
    capsys, tmp_path, monkeypatch
):
    run = drawn_session(tmp_path)
    monkeypatch.setitem(sys.modules, "mcap_ros2", None)
    target = tmp_path / "x.mcap"
    code, _, err = call(capsys, "export", run.folder.path, "mcap", "-o", target)
    assert code == 2
    assert 'install them with: pip install "handeye-tri[ros]"' in err
    assert len(err.splitlines()) == 1
    assert not target.exists()


def test_frames_of_ones_own(capsys, tmp_path):
    _, path, _ = exported(
        *(capsys, tmp_path, "mcap", "x.mcap", "--base-frame", "base_link"),
        *("--flange-frame", "tool0"),
    )
    with AnyReader([path]) as reader:
        pairs = set()
        for connection, _, raw in reader.messages():
            if connection.topic == "/tf":
                message = reader.deserialize(raw, connection.msgtype)
                pairs |= {
                    (t.header.frame_id, t.child_frame_id) for t in message.transforms
                }
    assert ("base_link", "tool0") in pairs


def test_a_rosbag2_folder_holds_the_same_messages(bag, capsys, tmp_path):
    run, _, topics = bag
    folder = tmp_path / "session"
    code, out, _ = call(capsys, "export", run.folder.path, "mcap", "-o", folder)
    assert code == 0
    assert f"wrote {folder / 'metadata.yaml'}" in out
    with AnyReader([folder]) as reader:
        found = {c.topic: c.msgcount for c in reader.connections}
        assert found == {topic: len(rows) for topic, rows in topics.items()}
        assert reader.message_count == sum(found.values())
        # Not only counted: a folder's connections must be those of its file.
        read = Counter(connection.topic for connection, _, _ in reader.messages())
        assert read == found
    information = yaml.safe_load((folder / "metadata.yaml").read_text())
    metadata = information["rosbag2_bagfile_information"]
    for row in metadata["topics_with_message_count"]:
        (qos,) = yaml.safe_load(row["topic_metadata"]["offered_qos_profiles"])
        late = row["topic_metadata"]["name"] in ("/tf_static", "/robot_description")
        if late:
            assert (qos["durability"], qos["depth"]) == (1, 1)
