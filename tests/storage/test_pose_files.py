"""Files of pose pairs: formats, units, and everything that is refused by name."""

import copy
import json

import numpy as np
import pytest

from handeye_tri.errors import InputError, StorageError
from handeye_tri.se3 import quaternion_wxyz, se3_exp, so3_exp, so3_log
from handeye_tri.storage import POSES_SCHEMA, read_moveit_samples, read_pose_pairs

RNG = np.random.default_rng(0)
ROBOT, OBSERVED = se3_exp(RNG.standard_normal((2, 5, 6)))


def quaternion(matrix):
    return dict(zip("wxyz", quaternion_wxyz(matrix[:3, :3]).tolist(), strict=True))


def pose(matrix):
    return {"translation_m": matrix[:3, 3].tolist(), "quaternion": quaternion(matrix)}


def content():
    return {
        "schema": POSES_SCHEMA,
        "mounting": "eye_in_hand",
        "robot_poses": "flange_in_base",
        "observed_poses": "target_in_camera",
        "target_size": "known",
        "pairs": [
            {"name": f"p{i}", "robot": pose(a), "observed": pose(b)}
            for i, (a, b) in enumerate(zip(ROBOT, OBSERVED, strict=True))
        ],
    }


def write(folder, data, name="poses.json"):
    path = folder / name
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def test_pairs_come_back(tmp_path):
    pairs = read_pose_pairs(write(tmp_path, content()))
    np.testing.assert_allclose(pairs.robot, ROBOT, atol=1e-12)
    np.testing.assert_allclose(pairs.observed, OBSERVED, atol=1e-12)
    assert pairs.names == ("p0", "p1", "p2", "p3", "p4")
    assert pairs.metric
    assert not pairs.timed
    assert pairs.noise is None


def other_ways(matrix):
    """The same pose as each format writes it."""
    rotation, place = matrix[:3, :3], matrix[:3, 3]
    vector = so3_log(rotation)
    millimetres = {"translation_mm": (1e3 * place).tolist()}
    in_mm = np.array(matrix)
    in_mm[:3, 3] *= 1e3
    # R = Rx(a) Ry(b) Rz(c), about moving axes; about fixed ones in reverse order.
    b = np.arcsin(rotation[0, 2])
    a = np.arctan2(-rotation[1, 2], rotation[2, 2])
    c = np.arctan2(-rotation[0, 1], rotation[0, 0])
    angles = np.degrees([a, b, c]).tolist()
    return [
        {**millimetres, "rotation_matrix": rotation.tolist()},
        {**millimetres, "rotation_vector_rad": vector.tolist()},
        {**millimetres, "rotation_vector_deg": np.degrees(vector).tolist()},
        {
            **millimetres,
            "euler": {"order": "xyz", "about": "moving", "angles_deg": angles},
        },
        {
            **millimetres,
            "euler": {"order": "zyx", "about": "fixed", "angles_deg": angles[::-1]},
        },
        {"matrix_m": matrix.tolist()},
        {"matrix_mm": in_mm.tolist()},
    ]


@pytest.mark.parametrize("way", range(7))
def test_every_format_says_the_same(tmp_path, way):
    data = content()
    for pair, matrix in zip(data["pairs"], ROBOT, strict=True):
        pair["robot"] = other_ways(matrix)[way]
    pairs = read_pose_pairs(write(tmp_path, data))
    np.testing.assert_allclose(pairs.robot, ROBOT, atol=1e-9)


def test_streams_with_clocks_scale_and_noise(tmp_path):
    data = content()
    del data["pairs"]
    data["target_size"] = "unknown"
    data["robot"] = [{"time_s": i / 10, **pose(a)} for i, a in enumerate(ROBOT)]
    data["observed"] = [
        {"time_s": i / 7, "name": f"n{i}", **pose(b)}
        for i, b in enumerate(OBSERVED[:4])
    ]
    data["noise"] = {
        "robot_translation_mm": 0.1,
        "robot_rotation_deg": 0.02,
        "lateral_mm": 0.2,
        "depth_mm": 0.8,
        "rotation_deg": 0.1,
    }
    pairs = read_pose_pairs(write(tmp_path, data))
    assert pairs.timed
    assert not pairs.metric
    assert pairs.names == ("n0", "n1", "n2", "n3")
    np.testing.assert_allclose(pairs.robot_times, np.arange(5) / 10)
    assert pairs.noise.depth == pytest.approx(8e-4)
    assert pairs.noise.rotation == pytest.approx(np.radians(0.1))


def drop(key):
    return lambda data: data.pop(key)


def put(path, value):
    def change(data):
        *parents, last = path
        for key in parents:
            data = data[key]
        data[last] = value

    return change


BAD_ROTATION = (so3_exp((0.1, 0.2, 0.3)) * 1.004).tolist()
MIRROR = np.diag([1.0, 1.0, -1.0]).tolist()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (drop("schema"), '"schema" must be "handeye-tri poses 1", got None'),
        (drop("mounting"), 'lacks "mounting"; write "eye_in_hand" or "eye_to_hand"'),
        (drop("robot_poses"), 'lacks "robot_poses".*nothing is guessed'),
        (drop("observed_poses"), 'lacks "observed_poses"'),
        (drop("target_size"), 'lacks "target_size"; write "known" or "unknown"'),
        (put(["mounting"], "wrist"), "\"mounting\" must be .*got 'wrist'"),
        (put(["units"], "m"), "unknown key 'units'"),
        (drop("pairs"), 'give either "pairs" or both'),
        (put(["robot"], []), 'give either "pairs" or both'),
        (put(["pairs"], []), "at least one item"),
        (put(["pairs", 3, "name"], "p1"), "names must differ, and 'p1' is that of"),
        (lambda d: d["pairs"][2].pop("observed"), r"pairs\[2\] lacks 'observed'"),
        (
            lambda d: d["pairs"][1]["robot"].pop("translation_m"),
            r"robot\[1\] must have one translation \(translation_m or translation_mm\)",
        ),
        (put(["pairs", 1, "robot", "translation"], [0, 0, 0]), "unknown key 'transl"),
        (
            put(["pairs", 1, "robot", "translation_mm"], [0, 0, 0]),
            r"one translation.*it has quaternion, translation_m, translation_mm",
        ),
        (put(["pairs", 0, "robot", "quaternion"], [1, 0, 0, 0]), "by name"),
        (
            put(["pairs", 0, "robot", "quaternion", "w"], 3.0),
            "length differs from 1 by .*too far for rounding",
        ),
        (
            put(
                ["pairs", 3, "observed"],
                {"translation_m": [0, 0, 1], "rotation_matrix": BAD_ROTATION},
            ),
            r"observed\[3\].*differs from I by 0\.008.*\+1\.01.*--orthonormalise",
        ),
        (
            put(
                ["pairs", 3, "observed"],
                {"translation_m": [0, 0, 1], "rotation_matrix": MIRROR},
            ),
            "mirror image.*-1.0",
        ),
        (
            put(["pairs", 0, "robot", "translation_m", 1], None),
            "robot.0..translation_m",
        ),
        (
            put(["pairs", 0, "robot", "translation_m"], [1, 2]),
            r"shape \(3,\), got \(2,\)",
        ),
        (put(["pairs", 0, "robot", "translation_m", 1], float("nan")), "NaN or inf"),
        (
            put(["pairs", 0, "robot"], {"matrix_m": np.eye(4).T.tolist()[:3]}),
            r"shape \(4, 4\), got \(3, 4\)",
        ),
        (
            put(["pairs", 0, "robot"], {"matrix_m": ROBOT[0].T.tolist()}),
            "last row must be 0 0 0 1.*row by row",
        ),
        (
            put(
                ["pairs", 0, "robot"],
                {
                    "translation_m": [0, 0, 1],
                    "euler": {
                        "order": "abc",
                        "about": "fixed",
                        "angles_deg": [0, 0, 0],
                    },
                },
            ),
            "three letters",
        ),
        (
            put(
                ["pairs", 0, "robot"],
                {"translation_m": [0, 0, 1], "rotation_vector_rad": [0, 0, 90.0]},
            ),
            "turn by 90 rad.*rotation_vector_deg",
        ),
        (
            put(["pairs", 0, "robot", "translation_m", 1], 1e200),
            r"translation_m is 1e\+200 m away",
        ),
        (
            put(
                ["noise"],
                dict.fromkeys(
                    ["robot_translation_mm", "robot_rotation_deg", "lateral_mm"]
                    + ["depth_mm", "rotation_deg"],
                    -1.0,
                ),
            ),
            "noise.robot_translation must not be negative",
        ),
        (put(["noise"], {"lateral_mm": 1}), "\"noise\" lacks 'robot_translation_mm'"),
        (put(["pairs", 1], 7), r"pairs\[1\] must be an object, got 7"),
    ],
)
def test_what_is_wrong_is_named_with_the_file(tmp_path, change, message):
    data = copy.deepcopy(content())
    change(data)
    path = write(tmp_path, data)
    with pytest.raises(InputError, match=message) as refused:
        read_pose_pairs(path)
    assert str(refused.value).startswith(str(path))


def test_unequal_counts_and_missing_times_are_named(tmp_path):
    data = content()
    del data["pairs"]
    data["robot"] = [pose(a) for a in ROBOT]
    data["observed"] = [pose(b) for b in OBSERVED[:3]]
    with pytest.raises(InputError, match="5 robot poses and 3 observed"):
        read_pose_pairs(write(tmp_path, data))
    data["robot"][0]["time_s"] = 0.0
    with pytest.raises(InputError, match=r"robot\[1\] lacks time_s, which others"):
        read_pose_pairs(write(tmp_path, data))


def test_rounded_rotations_are_taken_on_request(tmp_path):
    data = content()
    for pair, matrix in zip(data["pairs"], ROBOT, strict=True):
        pair["robot"] = {"matrix_m": np.round(matrix, 4).tolist()}
    path = write(tmp_path, data)
    with pytest.raises(InputError, match="--orthonormalise"):
        read_pose_pairs(path)
    pairs = read_pose_pairs(path, orthonormalise=True)
    product = np.swapaxes(pairs.robot[:, :3, :3], 1, 2) @ pairs.robot[:, :3, :3]
    np.testing.assert_allclose(product, np.tile(np.eye(3), (5, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(pairs.robot, ROBOT, atol=1e-4)


@pytest.mark.parametrize("text", ["", " \n", "\ufeff"])
def test_an_empty_file_is_said(tmp_path, text):
    with pytest.raises(StorageError, match="this file is empty"):
        read_pose_pairs(write(tmp_path, text))


def test_a_byte_order_mark_does_no_harm(tmp_path):
    pairs = read_pose_pairs(write(tmp_path, "\ufeff" + json.dumps(content())))
    assert len(pairs.names) == 5


@pytest.mark.parametrize("text", ["{", "\x00\x01", "[" * 100000])
def test_what_is_no_json_is_said(tmp_path, text):
    with pytest.raises(StorageError, match="not readable JSON"):
        read_pose_pairs(write(tmp_path, text))


def test_a_list_and_a_missing_file_are_said(tmp_path):
    for data in ([], 3, None):
        with pytest.raises(InputError, match=r"no object.*--format moveit"):
            read_pose_pairs(write(tmp_path, data))
    with pytest.raises(StorageError, match="missing"):
        read_pose_pairs(tmp_path / "absent.json")


def test_moveit_samples_as_yaml_and_as_lists(tmp_path):
    text = "".join(
        f"- effector_wrt_world: {a.ravel().tolist()}\n"
        f"  object_wrt_sensor: {b.ravel().tolist()}\n"
        for a, b in zip(ROBOT, OBSERVED, strict=True)
    )
    lists = [[a.tolist(), b.tolist()] for a, b in zip(ROBOT, OBSERVED, strict=True)]
    for path in (
        write(tmp_path, text, "samples.yaml"),
        write(tmp_path, lists, "samples.json"),
    ):
        pairs = read_moveit_samples(path, "eye_to_hand")
        np.testing.assert_allclose(pairs.base_from_flange, ROBOT)
        np.testing.assert_allclose(pairs.camera_from_target, OBSERVED)
        assert pairs.mounting == "eye_to_hand"
        with pytest.raises(InputError, match="--mounting eye_in_hand"):
            read_moveit_samples(path, None)


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        ({}, "are a list"),
        ([[np.eye(4).tolist()]], "sample 0 is no pair"),
        ([{"effector_wrt_world": [0] * 16}], "sample 0 lacks 'object_wrt_sensor'"),
        ([[np.eye(4).tolist(), [0] * 16]], "sample 0, observed: the last row"),
    ],
)
def test_malformed_moveit_samples_are_named(tmp_path, samples, message):
    with pytest.raises(InputError, match=message):
        read_moveit_samples(write(tmp_path, samples), "eye_to_hand")
