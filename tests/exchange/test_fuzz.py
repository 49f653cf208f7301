"""Whatever a file holds: a clear error or the same numbers, never a traceback.

``HANDEYE_FUZZ=1000`` sets the number of cases of each reader (default 100);
``python scripts/check_readers.py`` does that.
"""

from __future__ import annotations

import io
import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap_ros2.writer import Writer
from PIL import Image
from rosbags.typesys import Stores, get_typestore

from handeye_tri.config import parse_any_cell
from handeye_tri.errors import HandEyeError
from handeye_tri.exchange.bags import BagFile
from handeye_tri.exchange.half_turns import (
    TurnTolerance,
    find_half_turns,
    parse_pairs,
    parse_stations,
)
from handeye_tri.exchange.image_folders import euroc_images, find_images, timed_images
from handeye_tri.exchange.pose_tables import PoseFormat, read_pose_table
from handeye_tri.se3 import se3_exp
from handeye_tri.storage import decode_image, read_moveit_samples, read_pose_pairs

CASES = int(os.environ.get("HANDEYE_FUZZ", "100"))
fuzz = settings(
    max_examples=CASES,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
FORMATS = (
    *("matrix:m", "quaternion-wxyz:mm", "quaternion-xyzw:m", "rotation-vector:mm,rad"),
    *("axis-angle:m,deg", "euler-zyx-moving:mm,deg", "euler-xyx-fixed:m,rad"),
)
NUMBERS = st.one_of(
    st.floats(-1e3, 1e3).map(repr),
    st.sampled_from(["nan", "inf", "-1e400", "1_0", "0x10", "", " ", "٣", "1e-320"]),
    st.integers(-(10**30), 10**30).map(str),
)
LINES = st.lists(
    st.one_of(
        st.lists(NUMBERS, min_size=6, max_size=17).map(",".join),
        st.lists(NUMBERS, min_size=6, max_size=9).map(" ".join),
        st.text(max_size=40),
        st.sampled_from(
            ["#timestamp [ns],x [m]", "time_s,x_mm", "station;x_m", '"', "a,b"]
        ),
    ),
    max_size=6,
).map("\n".join)
PLAIN = st.recursive(
    st.one_of(
        *(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8)),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=5),
        st.dictionaries(
            st.sampled_from(
                [
                    *("poses", "robot_poses", "translation_m", "translation_mm"),
                    *("quaternion", "rotation_vector_deg", "euler", "matrix_m"),
                    *("w", "x", "y", "z", "order", "about", "angles_deg", "time_s"),
                    *("name", "schema", "pairs", "robot", "observed", "mounting"),
                    *("effector_wrt_world", "object_wrt_sensor"),
                ]
            ),
            inner,
            max_size=6,
        ),
    ),
    max_leaves=30,
)


def only_clear_errors(read):
    """Run a reader; what it raises must be one of ours and say something."""
    try:
        return read()
    except HandEyeError as error:
        message = str(error)
    assert len(message) > 20
    assert "\n" not in message
    return None


@fuzz
@given(LINES, st.sampled_from(FORMATS), st.booleans())
def test_csv_poses(tmp_path, text, layout, inverse):
    path = tmp_path / "poses.csv"
    path.write_text(text)
    table = only_clear_errors(
        lambda: read_pose_table(
            path,
            "csv",
            pose_format=PoseFormat.parse(layout),
            direction="base_in_flange" if inverse else "flange_in_base",
        )
    )
    if table is not None:
        assert np.isfinite(table.base_from_flange).all()
        turn = table.base_from_flange[:, :3, :3]
        assert np.abs(turn @ turn.mT - np.eye(3)).max() < 1e-5


@fuzz
@given(st.one_of(LINES.map(str.encode), st.binary(max_size=200)))
def test_tum_and_euroc_poses(tmp_path, data):
    path = tmp_path / "poses.txt"
    path.write_bytes(data)
    for kind in ("tum", "euroc"):
        only_clear_errors(
            lambda kind=kind: read_pose_table(
                path, kind, pose_format=None, direction="flange_in_base"
            )
        )


BOMB = "a0: &a0 [1,1,1,1,1,1,1,1,1,1]\n" + "\n".join(
    f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 10)
)


@fuzz
@given(st.one_of(PLAIN.map(json.dumps), st.text(max_size=80)))
@example(BOMB + "\nposes: *a9\nrobot_poses: flange_in_base")
@example("[" * 300)
@example("{" * 300)
@example("!!python/object/apply:os.system ['true']")
@example("2001-99-99")
@example("? [a]\n: b")
@example("&a [*a]")
def test_yaml_and_json_poses(tmp_path, text):
    for name in ("poses.yaml", "poses.json"):
        path = tmp_path / name
        path.write_text(text)
        only_clear_errors(
            lambda path=path: read_pose_table(
                path, "yaml", pose_format=None, direction=None
            )
        )
    # Of JSON from here on, which is a hundred times as fast to read.
    only_clear_errors(lambda: read_pose_pairs(path))
    only_clear_errors(lambda: read_moveit_samples(path, "eye_to_hand"))


@fuzz
@given(PLAIN)
def test_cells_from_recordings(data):
    if isinstance(data, dict):
        only_clear_errors(lambda: parse_any_cell(data, "bag"))
        only_clear_errors(
            lambda: parse_any_cell({**data, "schema": "handeye_tri.cell/1"}, "bag")
        )


@fuzz
@given(st.text(max_size=30))
@example("euler-zyx-moving:mm")
@example("0-1,2-3")
@example("0-" + "9" * 400)
@example("**")
@example("a/../b")
@example("/etc/*")
@example("/\n")
def test_words_of_the_command_line(tmp_path, text):
    only_clear_errors(lambda: PoseFormat.parse(text))
    only_clear_errors(lambda: parse_pairs(text, "--half-turns"))
    only_clear_errors(lambda: parse_stations(text, 18, "--held-out"))
    only_clear_errors(lambda: find_images(tmp_path, {"left": text}))
    only_clear_errors(lambda: timed_images([Path(f"{text}.png")], "ns"))


@fuzz
@given(st.one_of(st.text(max_size=120).map(str.encode), st.binary(max_size=120)))
@example(b"1,a.png\n1,b.png")
@example(b"5,../a.png")
@example(b"5,\0.png")
def test_euroc_listings(tmp_path, data):
    (tmp_path / "data.csv").write_bytes(data)
    only_clear_errors(lambda: euroc_images(tmp_path))


def encoded(kind):
    buffer = io.BytesIO()
    ramp = np.arange(40 * 30 * 3, dtype=np.uint8).reshape(30, 40, 3)
    Image.fromarray(ramp).save(buffer, format=kind)
    return buffer.getvalue()


PICTURES = {kind: encoded(kind) for kind in ("PNG", "JPEG", "BMP", "TIFF", "PPM")}


@fuzz
@given(
    st.sampled_from(sorted(PICTURES)),
    st.lists(st.tuples(st.floats(0, 1), st.integers(0, 7)), min_size=1, max_size=3),
    st.booleans(),
)
# A bit of the pixels that Pillow alone lets pass.
@example(kind="PNG", flips=[(0.87109375, 0)], cut=False)
@pytest.mark.filterwarnings("ignore")
def test_damaged_images(kind, flips, cut):
    data = bytearray(PICTURES[kind])
    for place, bit in flips:
        data[min(int(place * len(data)), len(data) - 1)] ^= 1 << bit
    if cut:
        data = data[: int(flips[0][0] * len(data))]
    image = only_clear_errors(lambda: decode_image(bytes(data), "shot.png"))
    if image is not None:
        assert image.dtype == np.uint8
        if kind == "PNG":
            # PNG has checksums: what still reads is what was written.
            original = np.asarray(Image.open(io.BytesIO(PICTURES["PNG"])))
            assert image.shape == original.shape
            assert (image == original).all()


def small_bag():
    """Three stands of a robot with a picture each, with checksums."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    buffer = io.BytesIO()
    writer = Writer(buffer, chunk_size=2000)
    kinds = {
        name: writer.register_msgdef(
            name, types.generate_msgdef(name, ros_version=2)[0]
        )
        for name in (
            "geometry_msgs/msg/PoseStamped",
            "sensor_msgs/msg/CompressedImage",
        )
    }
    for j in range(3):
        for k in range(6):
            time = (1 + j) * 10**10 + k * 10**8
            stamp = {"sec": time // 10**9, "nanosec": time % 10**9}
            header = {"stamp": stamp, "frame_id": "base"}
            pose = {
                "position": {"x": 0.1 * j, "y": 0.0, "z": 0.5},
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            }
            writer.write_message(
                "/pose",
                kinds["geometry_msgs/msg/PoseStamped"],
                {"header": header, "pose": pose},
                log_time=time,
            )
            if k == 3:
                content = {"header": header, "format": "png", "data": PICTURES["PNG"]}
                kind = kinds["sensor_msgs/msg/CompressedImage"]
                writer.write_message("/left/image", kind, content, log_time=time)
    writer.finish()
    return buffer.getvalue()


BAG = small_bag()


def contents(path):
    """Times, poses and images of the small recording."""
    bag = BagFile(path)
    stream = bag.robot("pose:/pose", None, "flange_in_base")
    images = bag.images({"left": "/left/image"})["left"]
    pictures = [images.read(i) for i in range(len(images.times))]
    return stream.times, stream.base_from_flange, np.array(images.times), pictures


@fuzz
@given(st.floats(0, 1), st.integers(0, 7), st.booleans())
def test_flipped_bits_of_a_recording(tmp_path, place, bit, cut):
    data = bytearray(BAG)
    at = min(int(place * len(data)), len(data) - 1)
    data[at] ^= 1 << bit
    path = tmp_path / "x.mcap"
    path.write_bytes(bytes(data[:at] if cut else data))
    found = only_clear_errors(lambda: contents(path))
    if found is not None:
        path.write_bytes(BAG)
        for one, other in zip(found, contents(path), strict=True):
            np.testing.assert_array_equal(one, other)


@fuzz
@given(st.binary(max_size=300), st.sampled_from(["x.mcap", "x.bag", "x.db3"]))
def test_anything_called_a_recording(tmp_path, data, name):
    path = tmp_path / name
    path.write_bytes(
        {"x.mcap": b"\x89MCAP0\r\n", "x.bag": b"#ROSBAG V2.0\n"}.get(
            name, b"SQLite format 3\0"
        )
        + data
    )
    only_clear_errors(lambda: BagFile(path))


@fuzz
@given(st.integers(0, 2**32 - 1), st.integers(1, 12))
def test_half_turns_of_any_poses(seed, count):
    rng = np.random.default_rng(seed)
    poses = se3_exp(rng.choice([0, 1, np.pi / 2, np.pi], (count, 6)))
    found = find_half_turns(poses, TurnTolerance(0.02, 1e-3))
    used = [j for turn in found.turns for j in (turn.before, turn.after)]
    assert len(used) == len(set(used))
    for turn in found.turns:
        assert abs(turn.miss) <= 0.02
        assert abs(turn.pitch) <= 1e-3
