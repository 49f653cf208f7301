"""Recordings and pose streams: stands, frames, topics, EuRoC folders."""

from __future__ import annotations

import shutil
from dataclasses import dataclass

import numpy as np
import pytest
from exported import call
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from handeye_tri.errors import InputError
from handeye_tri.exchange.bags import BagFile, Forward
from handeye_tri.exchange.capture import ImageStream, PoseStream, Stillness
from handeye_tri.exchange.standstill import standstills, stations_from_streams
from handeye_tri.exchange.tf_tree import Frames
from handeye_tri.pipeline import NullProgress, Run
from handeye_tri.se3 import quaternion_wxyz, se3_exp, se3_inverse, se3_log, so3_exp
from handeye_tri.storage import SessionFolder

SIZE = (40, 34)


def path_of_poses(rng, stations=6, hold=20, move=15, jitter=1e-6):
    """A robot that stops at half-turns; 50 Hz; times, poses, middles and targets."""
    targets = []
    for _ in range(stations // 2):
        pose = se3_exp(rng.uniform(-0.6, 0.6, 6))
        turned = pose.copy()
        turned[:3, :3] = pose[:3, :3] @ so3_exp([0, 0, np.pi])
        targets += [pose, turned]
    poses, middles = [], []
    for j, target in enumerate(targets):
        middles.append(len(poses) + 0.5 * (hold - 1))
        poses += [
            target @ se3_exp(jitter * rng.standard_normal(6)) for _ in range(hold)
        ]
        if j + 1 < len(targets):
            between = se3_inverse(target) @ targets[j + 1]
            step = se3_log(between)
            poses += [
                target @ se3_exp(step * k / (move + 1)) for k in range(1, move + 1)
            ]
    times = 100.0 + 0.02 * np.arange(len(poses))
    return times, np.array(poses), 100 + 0.02 * np.array(middles), np.array(targets)


# -- stands -----------------------------------------------------------------------


def test_every_stand_is_found_once_and_its_pose_is_the_mean():
    times, poses, middles, targets = path_of_poses(np.random.default_rng(1))
    stream = PoseStream(times, poses, np.zeros((len(times), 0)))
    still = Stillness(seconds=0.2)
    found = standstills(stream, still)
    assert len(found) == len(targets)
    for (first, last), middle in zip(found, middles, strict=True):
        assert times[first] <= middle <= times[last]
    # A camera at 25 Hz that runs all the time: the image nearest to the middle.
    clock = tuple(np.arange(100.0, times[-1], 0.04).tolist())
    taken = []
    camera = ImageStream(clock, lambda i: taken.append(clock[i]))
    capture = stations_from_streams(stream, {"left": camera}, still)
    for shot, target, middle in zip(capture.shots, targets, middles, strict=True):
        # The mean of ten samples that scatter by a micrometre.
        off = shot.base_from_flange.matrix - target
        assert np.abs(off).max() < 2e-6
        shot.pictures["left"]()
        assert abs(taken[-1] - middle) < 0.05


def test_a_creeping_robot_does_not_stand():
    times = np.arange(0, 20, 0.02)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = 1e-3 * times
    stream = PoseStream(times, poses, np.zeros((len(times), 0)))
    # 0.1 mm take 0.1 s.
    assert standstills(stream, Stillness()) == []
    assert len(standstills(stream, Stillness(translation=1e-3, seconds=0.9))) >= 18


def test_a_silence_ends_a_stand_even_at_the_same_place():
    times = np.concatenate([np.arange(0, 1, 0.1), np.arange(5, 6, 0.1)])
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    stream = PoseStream(times, poses, np.zeros((len(times), 0)))
    assert standstills(stream, Stillness()) == [(0, 9), (10, 19)]


def test_clocks_that_do_not_meet_are_told():
    times, poses, _, _ = path_of_poses(np.random.default_rng(1))
    stream = PoseStream(times, poses, np.zeros((len(times), 0)))
    camera = ImageStream((1.0, 2.0), lambda i: None)
    with pytest.raises(InputError, match="do robot and cameras share a clock"):
        stations_from_streams(stream, {"left": camera}, Stillness(seconds=0.2))


# -- frames -----------------------------------------------------------------------


def test_frames_chain_over_any_tree():
    rng = np.random.default_rng(2)
    links = {name: se3_exp(rng.uniform(-1, 1, 6)) for name in "abcd"}
    frames = Frames("/base", "tool")
    assert frames.update([("world", "base", links["a"]), ("world", "l1", links["b"])])
    assert frames.pose() is None
    assert frames.update([("l1", "/l2", links["c"]), ("l2", "tool", links["d"])])
    expected = se3_inverse(links["a"]) @ links["b"] @ links["c"] @ links["d"]
    np.testing.assert_allclose(frames.pose(), expected, atol=1e-12)
    assert not frames.update([("world", "camera", np.eye(4))])
    # From below the flange up, too.
    upward = Frames("tool", "base")
    upward.update(
        [
            ("world", "base", links["a"]),
            ("world", "l1", links["b"]),
            ("l1", "l2", links["c"]),
            ("l2", "tool", links["d"]),
        ]
    )
    np.testing.assert_allclose(upward.pose(), se3_inverse(expected), atol=1e-12)


def test_a_circle_of_frames_ends():
    frames = Frames("a", "b")
    frames.update([("c", "b", np.eye(4)), ("b", "c", np.eye(4))])
    assert frames.pose() is None


# -- recordings -------------------------------------------------------------------


@dataclass
class Recording:
    """What was written, to compare with."""

    path: object
    middles: np.ndarray
    targets: np.ndarray
    images: dict


def record(folder, kind, rng, encoding="rgb8"):
    """A recording of two cameras at 25 Hz, joint states and poses at 50 Hz."""
    ros1 = kind == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    message = store.types
    times, poses, middles, targets = path_of_poses(rng)
    path = folder / ("cell.bag" if ros1 else "cell")
    made = Writer1(path) if ros1 else Writer2(path, version=9)
    encode = store.serialize_ros1 if ros1 else store.serialize_cdr

    def header(time, frame=""):
        stamp = message["builtin_interfaces/msg/Time"](int(time), round(time % 1 * 1e9))
        arguments = (0, stamp, frame) if ros1 else (stamp, frame)
        return message["std_msgs/msg/Header"](*arguments)

    events, images = [], {}
    for time, pose in zip(times, poses, strict=True):
        w, x, y, z = quaternion_wxyz(pose[:3, :3])
        body = message["geometry_msgs/msg/Pose"](
            message["geometry_msgs/msg/Point"](*pose[:3, 3]),
            message["geometry_msgs/msg/Quaternion"](x, y, z, w),
        )
        events.append(
            (
                *(time, "/tool_pose", "geometry_msgs/msg/PoseStamped"),
                message["geometry_msgs/msg/PoseStamped"](header(time, "base"), body),
            )
        )
        joints = np.array([7.0, *pose[:3, 3]])
        state = message["sensor_msgs/msg/JointState"](
            header(time), ["finger", "z1", "z2", "z3"], joints, np.zeros(0), np.zeros(0)
        )
        events.append((time, "/joint_states", "sensor_msgs/msg/JointState", state))
    width, height = SIZE
    for camera in ("left", "right"):
        for number, time in enumerate(np.arange(100.0, times[-1], 0.04)):
            picture = rng.integers(0, 255, (height, width, 3), dtype=np.uint8)
            images[camera, number] = (time, picture)
            stored = picture[..., ::-1] if encoding == "bgr8" else picture
            # Rows are padded, as drivers do.
            rows = np.zeros((height, 3 * width + 8), dtype=np.uint8)
            rows[:, : 3 * width] = stored.reshape(height, -1)
            content = message["sensor_msgs/msg/Image"](
                *(header(time), height, width, encoding, 0, rows.shape[1]),
                rows.ravel(),
            )
            events.append(
                (time, f"/{camera}/image_raw", "sensor_msgs/msg/Image", content)
            )
    events.sort(key=lambda event: event[0])
    with made as writer:
        connections = {}
        for time, topic, name, content in events:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(connections[topic], round(1e9 * time), encode(content, name))
    return Recording(path, middles, targets, images)


@pytest.mark.parametrize("kind", ["ros1", "ros2"])
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8"])
def test_a_recording_gives_the_stands_and_the_right_images(
    capsys, tmp_path, kind, encoding
):
    made = record(tmp_path, kind, np.random.default_rng(5), encoding)
    cell = tmp_path / "cell.yaml"
    with cell.open("w") as stream:
        YAML(typ="safe").dump(measured_cell(), stream)
    out = tmp_path / "session"
    arguments = ("import", "bag", made.path, "-o", out, "--cell", cell)
    code, _, err = call(capsys, *arguments)
    assert code == 2
    assert "say where the robot's poses are: --robot" in err
    assert "/tool_pose (PoseStamped" in err
    code, printed, err = call(
        *(capsys, *arguments, "--robot", "pose:/tool_pose"),
        *("--direction", "flange_in_base", "--still", "0.1,0.02,0.2"),
    )
    assert (code, err.strip()) == (0, "")
    assert "--image left=/left/image_raw" in printed
    assert "3 half-turns about normal found" in printed
    run = Run(SessionFolder.open(out), NullProgress())
    stations = run.plan().stations
    assert len(stations) == len(made.targets)
    for station, target, middle in zip(
        stations, made.targets, made.middles, strict=True
    ):
        assert np.abs(station.base_from_flange.matrix - target).max() < 2e-6
        for camera in ("left", "right"):
            taken = [v for (name, _), v in made.images.items() if name == camera]
            picture = min(taken, key=lambda v: abs(v[0] - middle))[1]
            found = run.image(camera, station.index)
            near = [v[1] for v in taken if abs(v[0] - middle) < 0.05]
            assert any((found == one).all() for one in (picture, *near))


def measured_cell():
    return {
        "schema": "handeye_tri.measured_cell/1",
        "name": "bench",
        "arm": {"repeatability_mm": 0.03, "repeatability_deg": 0.005},
        "rig": {
            "axis": "normal",
            "side_ab_mm": 130.0,
            "side_ac_mm": 120.0,
            "angle_deg": 65.0,
            "marker_radii_mm": [8.0, 8.0, 8.0],
            "marker_colours": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
            "identity": "colour",
        },
        "cameras": [
            {"name": name, "image_size_px": list(SIZE)} for name in ("left", "right")
        ],
    }


def test_joints_are_taken_by_name_whatever_else_reports(tmp_path):
    made = record(tmp_path, "ros2", np.random.default_rng(6))

    def forward(joints):
        poses = np.tile(np.eye(4), (len(joints), 1, 1))
        poses[:, :3, 3] = joints[:, ::-1]
        return poses

    bag = BagFile(made.path)
    stream = bag.robot(
        "joints:/joint_states", Forward(("z3", "z2", "z1"), forward), None
    )
    poses = bag.robot("pose:/tool_pose", None, "flange_in_base").base_from_flange
    np.testing.assert_allclose(
        stream.base_from_flange[:, :3, 3], poses[:, :3, 3], atol=1e-15
    )
    inverse = bag.robot("pose:/tool_pose", None, "base_in_flange").base_from_flange
    np.testing.assert_allclose(se3_inverse(inverse), poses, atol=1e-12)
    with pytest.raises(InputError, match="never reports the joints z9"):
        bag.robot("joints:/joint_states", Forward(("z9", "z1"), forward), None)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("x.mcap", b"", "damaged or cut off"),
        ("x.bag", b"#ROSBAG V2.0\n rest", "no readable recording"),
        ("x.db3", b"abc", "no readable recording"),
        ("x.zip", b"abc", "no readable recording"),
        ("absent.mcap", None, "there is no such recording"),
    ],
)
def test_what_is_no_recording_is_one_sentence(capsys, tmp_path, name, content, message):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    out = tmp_path / "s"
    code, _, err = call(capsys, "import", "bag", path, "-o", out)
    assert code == 2
    assert message in err
    assert len(err.splitlines()) == 1


# -- EuRoC ------------------------------------------------------------------------


def test_a_euroc_folder_is_matched_by_time(capsys, tmp_path):
    rng = np.random.default_rng(7)
    times, poses, middles, targets = path_of_poses(rng)
    source = tmp_path / "mav0"
    shots = np.arange(100.0, times[-1], 0.04)
    for camera in ("cam0", "cam1"):
        (source / camera / "data").mkdir(parents=True)
        lines = ["#timestamp [ns],filename"]
        for time in shots:
            name = f"{round(1e9 * time)}.png"
            level = round(1e3 * (time - 100)) % 251
            Image.new("L", SIZE, level).save(source / camera / "data" / name)
            lines.append(f"{round(1e9 * time)},{name}")
        (source / camera / "data.csv").write_text("\n".join(lines))
    rows = [
        "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], "
        "q_RS_x [], q_RS_y [], q_RS_z [], v_x [m s^-1]"
    ]
    for time, pose in zip(times, poses, strict=True):
        row = [*pose[:3, 3], *quaternion_wxyz(pose[:3, :3]), 0.0]
        numbers = ",".join(map(repr, map(float, row)))
        rows.append(f"{round(1e9 * time)},{numbers}")
    truth = source / "state.csv"
    truth.write_text("\n".join(rows))
    cell = tmp_path / "cell.yaml"
    with cell.open("w") as stream:
        YAML(typ="safe").dump(measured_cell(), stream)
    arguments = (
        *("import", "euroc", source, "-o", tmp_path / "s", "--cell", cell),
        *("--poses", truth, "--direction", "flange_in_base"),
        *("--still", "0.1,0.02,0.2"),
    )
    code, _, err = call(capsys, *arguments)
    assert code == 2
    assert "--image left=cam0" in err
    assert "has cam0, cam1" in err
    code, _, err = call(
        capsys, *arguments, "--image", "left=cam0", "--image", "right=cam1"
    )
    assert (code, err.strip()) == (0, "")
    run = Run(SessionFolder.open(tmp_path / "s"), NullProgress())
    for station, target, middle in zip(
        run.plan().stations, targets, middles, strict=True
    ):
        assert np.abs(station.base_from_flange.matrix - target).max() < 2e-6
        level = int(run.image("left", station.index)[0, 0])
        wanted = round(1e3 * (shots[np.abs(shots - middle).argmin()] - 100)) % 251
        assert min((level - wanted) % 251, (wanted - level) % 251) <= 40
    # A list cannot point out of its folder.
    listing = source / "cam0" / "data.csv"
    listing.write_text(listing.read_text() + "\n9,../../secret.png")
    shutil.rmtree(tmp_path / "s")
    code, _, err = call(
        capsys, *arguments, "--image", "left=cam0", "--image", "right=cam1"
    )
    assert code == 2
    assert "is no file in data" in err
