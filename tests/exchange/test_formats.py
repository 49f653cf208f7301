"""Every text format, read back by a reader that is not ours."""

from __future__ import annotations

import argparse
import json
import shlex
from dataclasses import replace

import cv2
import numpy as np
import pinocchio as pin
import pytest
import yaml
from drawn_session import drawn_session, with_outcome
from exported import call, exported
from hypothesis import given
from hypothesis import strategies as st

from handeye_tri.camera import Lens
from handeye_tri.errors import InputError
from handeye_tri.exchange import FrameNames, camera_info_yaml, kalibr_yaml
from handeye_tri.exchange.urdf import MOUNTING_FROM_OPTICAL, roll_pitch_yaw
from handeye_tri.pipeline.export import read_results
from handeye_tri.se3 import SE3, so3_exp


def changed(results, **changes):
    return replace(results, calibration=replace(results.calibration, **changes))


def matrix(node):
    return np.reshape(node["data"], (node["rows"], node["cols"]))


def from_quaternion(x, y, z, w):
    """By Pinocchio, so that the order of components is not ours."""
    return pin.Quaternion(float(w), float(x), float(y), float(z)).toRotationMatrix()


# -- camera_info ------------------------------------------------------------------


def test_camera_info_gives_opencv_the_same_cameras(capsys, tmp_path):
    run, path, out = exported(capsys, tmp_path, "camera_info", "info.yaml")
    cell = run.hand_eye()
    for camera in cell.cameras:
        file = path.with_name(f"info_{camera.name}.yaml")
        assert str(file) in out
        info = yaml.safe_load(file.read_text())
        assert (info["image_width"], info["image_height"]) == camera.image_size
        assert info["camera_name"] == camera.name
        assert info["distortion_model"] == "plumb_bob"
        assert (matrix(info["camera_matrix"]) == camera.intrinsics.matrix).all()
        assert (
            matrix(info["distortion_coefficients"])[0] == camera.lens.coefficients
        ).all()


def test_camera_info_rectifies_so_that_depth_follows_from_disparity(capsys, tmp_path):
    """By cv2: rows agree, and Z = f b / d with b from the calibration."""
    run, path, _ = exported(capsys, tmp_path, "camera_info", "info.yaml")
    cell = run.hand_eye()
    skewless = [
        replace(c, intrinsics=replace(c.intrinsics, skew=0.0)) for c in cell.cameras
    ]
    rng = np.random.default_rng(1)
    centre = cell.base_from_camera[0].apply([0, 0, 0.9])
    points = centre + rng.uniform(-0.1, 0.1, (50, 3))
    rectified, infos = [], []
    for camera, motion in zip(skewless, cell.base_from_camera, strict=True):
        info = yaml.safe_load(path.with_name(f"info_{camera.name}.yaml").read_text())
        pixels = camera.project(motion.inverse().apply(points))
        rectified.append(
            cv2.undistortPoints(
                pixels[:, None],
                matrix(info["camera_matrix"]),
                matrix(info["distortion_coefficients"]),
                R=matrix(info["rectification_matrix"]),
                P=matrix(info["projection_matrix"]),
            )[:, 0]
        )
        infos.append(info)
    # In this cell the camera called "left" stands at the right, as the pair looks.
    right, left = rectified
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-6)
    p_right, p_left = (matrix(info["projection_matrix"]) for info in infos)
    assert p_left[0, 3] == 0
    baseline = np.linalg.norm(
        cell.base_from_camera[0].translation - cell.base_from_camera[1].translation
    )
    assert p_right[0, 3] == pytest.approx(-p_right[0, 0] * baseline, rel=1e-12)
    depth = p_left[0, 0] * baseline / (left[:, 0] - right[:, 0])
    into_rectified = matrix(infos[1]["rectification_matrix"])
    seen = cell.base_from_camera[1].inverse().apply(points) @ into_rectified.T
    np.testing.assert_allclose(depth, seen[:, 2], rtol=1e-8)


def test_a_right_camera_listed_first_still_has_the_baseline_in_its_file(tmp_path):
    results = read_results(drawn_session(tmp_path), FrameNames())
    cell = results.calibration
    swapped = changed(
        results,
        cameras=cell.cameras[::-1],
        base_from_camera=cell.base_from_camera[::-1],
    )
    for given_results in (results, swapped):
        files = camera_info_yaml(given_results)
        shift = {
            name: matrix(yaml.safe_load(text)["projection_matrix"])[0, 3]
            for name, text in files.items()
        }
        assert shift["right"] == 0
        assert shift["left"] < -100
        assert "the right camera of the pair, as the pair itself" in files["left"]


def test_cameras_above_each_other_are_not_called_a_pair(tmp_path):
    results = read_results(drawn_session(tmp_path), FrameNames())
    first, second = results.calibration.base_from_camera
    above = first @ SE3.from_parts(np.eye(3), [0.02, -0.3, 0.0])
    files = camera_info_yaml(changed(results, base_from_camera=(first, above)))
    for text in files.values():
        assert "no horizontal pair" in text
        info = yaml.safe_load(text)
        assert matrix(info["rectification_matrix"]).tolist() == np.eye(3).tolist()
        assert matrix(info["projection_matrix"])[0, 3] == 0


# -- OpenCV -----------------------------------------------------------------------


def test_opencv_reads_every_matrix_back(capsys, tmp_path):
    run, path, _ = exported(capsys, tmp_path, "opencv", "cell.yml")
    cell = run.hand_eye()
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.getNode("verdict").string() == "PASS"
    names = storage.getNode("cameras")
    assert [names.at(i).string() for i in range(names.size())] == ["left", "right"]
    first = cell.base_from_camera[0]
    for i, camera in enumerate(cell.cameras):
        node = storage.getNode(camera.name)
        size = tuple(
            int(node.getNode(f"image_{key}").real()) for key in ("width", "height")
        )
        assert size == camera.image_size
        k = node.getNode("camera_matrix").mat()
        assert (k == camera.intrinsics.matrix).all()
        lens = node.getNode("distortion_coefficients").mat()
        assert (lens[:, 0] == camera.lens.coefficients).all()
        place = node.getNode("base_from_camera_m").mat()
        assert (place == cell.base_from_camera[i].matrix).all()
    node = storage.getNode("right")
    point = np.array([0.1, -0.05, 0.9])
    moved = node.getNode("R").mat() @ point + node.getNode("T_m").mat()[:, 0]
    in_base = cell.base_from_camera[1].apply(moved)
    np.testing.assert_allclose(in_base, first.apply(point), atol=1e-12)
    rig = storage.getNode("flange_from_triangle_m").mat()
    assert (rig == cell.flange_from_triangle.matrix).all()
    assert (storage.getNode("markers_in_flange_m").mat() == cell.markers).all()
    storage.release()


# -- Kalibr -----------------------------------------------------------------------


def test_kalibr_chain_maps_the_first_camera_to_the_second(capsys, tmp_path):
    run, path, _ = exported(capsys, tmp_path, "kalibr", "camchain.yaml")
    cell, chain = run.hand_eye(), yaml.safe_load(path.read_text())
    assert sorted(chain) == ["cam0", "cam1"]
    for i, camera in enumerate(cell.cameras):
        entry, k = chain[f"cam{i}"], camera.intrinsics
        assert entry["camera_model"] == "pinhole"
        assert entry["distortion_model"] == "radtan"
        assert entry["intrinsics"] == [k.fx, k.fy, k.cx, k.cy]
        assert entry["distortion_coeffs"] == camera.lens.coefficients[:4].tolist()
        assert tuple(entry["resolution"]) == camera.image_size
        assert entry["cam_overlaps"] == [1 - i]
    assert "T_cn_cnm1" not in chain["cam0"]
    point = np.array([0.1, -0.05, 0.9, 1.0])
    moved = np.array(chain["cam1"]["T_cn_cnm1"]) @ point
    np.testing.assert_allclose(
        cell.base_from_camera[1].apply(moved[:3]),
        cell.base_from_camera[0].apply(point[:3]),
        atol=1e-12,
    )
    # What the format cannot hold is said.
    assert "no skew factor" in path.read_text()


@pytest.mark.parametrize(
    "lens", [Lens("radtan", [0, 0, 0, 0, 0.1]), Lens("rational", [0] * 5 + [0.2, 0, 0])]
)
def test_kalibr_refuses_a_lens_that_it_cannot_hold(tmp_path, lens):
    results = read_results(drawn_session(tmp_path), FrameNames())
    left, right = results.calibration.cameras
    with pytest.raises(InputError, match=r"left\.k[34] is 0\.[12].*export opencv"):
        kalibr_yaml(changed(results, cameras=(replace(left, lens=lens), right)))


# -- easy_handeye2, static transforms ----------------------------------------------


def test_easy_handeye2_has_the_keys_and_numbers_of_the_tool(capsys, tmp_path):
    run, path, _ = exported(
        capsys, tmp_path, "easy_handeye2", "cell.calib", "--base-frame", "panda_link0"
    )
    for camera, motion in zip(
        run.hand_eye().cameras, run.hand_eye().base_from_camera, strict=True
    ):
        data = yaml.safe_load(path.with_name(f"cell_{camera.name}.calib").read_text())
        assert set(data) == {"parameters", "transform"}
        assert data["parameters"]["calibration_type"] == "eye_on_base"
        assert data["parameters"]["robot_base_frame"] == "panda_link0"
        frame = f"{camera.name}_optical_frame"
        assert data["parameters"]["tracking_base_frame"] == frame
        shift = [data["transform"]["translation"][k] for k in "xyz"]
        assert shift == motion.translation.tolist()
        turn = from_quaternion(*(data["transform"]["rotation"][k] for k in "xyzw"))
        np.testing.assert_allclose(turn, motion.rotation, atol=1e-14)


def static_transform(text):
    """As tf2_ros's static_transform_publisher documents its flags."""
    parser = argparse.ArgumentParser()
    for flag in ("x", "y", "z", "qx", "qy", "qz", "qw"):
        parser.add_argument(f"--{flag}", type=float, default=0.0)
    parser.add_argument("--frame-id", required=True)
    parser.add_argument("--child-frame-id", required=True)
    return parser.parse_args(shlex.split(text))


def test_the_launch_file_and_the_commands_place_the_cameras(capsys, tmp_path):
    run, path, out = exported(capsys, tmp_path, "ros2_static_tf", "cams.launch.yaml")
    cell, launch = run.hand_eye(), yaml.safe_load(path.read_text())["launch"]
    commands = [line for line in out.splitlines() if line.startswith("ros2 run")]
    assert len(launch) == len(commands) == 2
    for i, camera in enumerate(cell.cameras):
        node = launch[i]["node"]
        assert (node["pkg"], node["exec"]) == ("tf2_ros", "static_transform_publisher")
        prefix = "ros2 run tf2_ros static_transform_publisher "
        assert commands[i] == prefix + node["args"]
        got = static_transform(node["args"])
        assert got.frame_id == "base"
        assert got.child_frame_id == f"{camera.name}_optical_frame"
        motion = cell.base_from_camera[i]
        assert [got.x, got.y, got.z] == motion.translation.tolist()
        turn = from_quaternion(got.qx, got.qy, got.qz, got.qw)
        np.testing.assert_allclose(turn, motion.rotation, atol=1e-14)


# -- URDF -------------------------------------------------------------------------


@pytest.mark.parametrize("frame", ["mounting", "optical"])
def test_pinocchio_reads_the_optical_frames_from_the_urdf(capsys, tmp_path, frame):
    run, path, _ = exported(
        capsys, tmp_path, "urdf", "cameras.urdf", "--camera-frame", frame
    )
    cell = run.hand_eye()
    model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.zeros(0))
    for camera, motion in zip(cell.cameras, cell.base_from_camera, strict=True):
        index = model.getFrameId(f"{camera.name}_optical_frame")
        np.testing.assert_allclose(
            data.oMf[index].homogeneous, motion.matrix, atol=1e-14
        )
        assert model.existFrame(f"{camera.name}_link") == (frame == "mounting")
        if frame == "mounting":
            link = data.oMf[model.getFrameId(f"{camera.name}_link")].rotation
            # x of the mounting frame looks where the camera looks.
            np.testing.assert_allclose(link[:, 0], motion.rotation[:, 2], atol=1e-14)
            np.testing.assert_allclose(link[:, 2], -motion.rotation[:, 1], atol=1e-14)


@given(
    st.lists(st.floats(-4, 4), min_size=3, max_size=3),
    st.sampled_from([0.0, 1e-12, 1e-9, 1e-7, 1e-3]),
    st.booleans(),
)
def test_roll_pitch_yaw_gives_any_rotation_back(vector, off, upright):
    rotation = so3_exp(vector)
    if upright:
        # Pitch next to 90 degrees, where roll and yaw fall together.
        rotation = so3_exp([0, 0, vector[0]]) @ so3_exp([0, np.pi / 2 - off, 0])
        rotation = rotation @ so3_exp([vector[1], 0, 0])
    again = pin.rpy.rpyToMatrix(*roll_pitch_yaw(rotation))
    np.testing.assert_allclose(again, rotation, atol=1e-14)


def test_the_mounting_frame_is_that_of_rep_103():
    forward, right, down = np.eye(3)[2], np.eye(3)[0], np.eye(3)[1]
    assert MOUNTING_FROM_OPTICAL.apply(forward).tolist() == [1, 0, 0]
    assert MOUNTING_FROM_OPTICAL.apply(right).tolist() == [0, -1, 0]
    assert MOUNTING_FROM_OPTICAL.apply(down).tolist() == [0, 0, -1]


# -- TUM --------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore")
def test_evo_compares_the_two_tracks(capsys, tmp_path):
    from evo.core import metrics, sync
    from evo.tools import file_interface

    run, path, _ = exported(capsys, tmp_path, "tum", "flange.tum")
    robot, observed = (
        file_interface.read_tum_trajectory_file(
            str(path.with_name(f"flange_{name}.tum"))
        )
        for name in ("robot", "observed")
    )
    session = run.session()
    assert robot.num_poses == len(session.stations)
    np.testing.assert_allclose(
        robot.poses_se3, session.base_from_flange, rtol=0, atol=1e-14
    )
    pair = sync.associate_trajectories(robot, observed)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(pair)
    # The robot repeats to 0.03 mm per axis and the cameras add as much.
    assert 1e-6 < ape.get_statistic(metrics.StatisticsType.rmse) < 3e-4


# -- JSON -------------------------------------------------------------------------


def test_the_json_follows_its_schema_and_holds_everything(capsys, tmp_path):
    import jsonschema

    run, path, _ = exported(capsys, tmp_path, "json", "all.json")
    data = json.loads(path.read_text())
    schema = json.loads(path.with_name("all_schema.json").read_text())
    validator = jsonschema.Draft202012Validator(schema)
    validator.check_schema(schema)
    validator.validate(data)
    for key, name in (("hand_eye", "hand_eye.json"), ("evaluation", "evaluation.json")):
        original = json.loads(run.folder.file(name).read_text())
        assert data[key] == original
    pixels = np.array(data["observations"]["pixels_px"], dtype=float)
    np.testing.assert_array_equal(pixels, run.session().pixels)
    # The schema notices what is missing or of another kind.
    for path_to, value in (
        (("hand_eye", "flange_from_triangle", "translation_m"), [0, 0]),
        (("evaluation", "verdict"), "FINE"),
        (("plan", "stations"), None),
    ):
        broken = json.loads(json.dumps(data))
        *parents, last = path_to
        place = broken
        for key in parents:
            place = place[key]
        place[last] = value
        assert not validator.is_valid(broken)


# -- the verdict ------------------------------------------------------------------


@pytest.mark.parametrize(("outcome", "code"), [("FAIL", 3), ("CANNOT TELL", 4)])
def test_without_pass_nothing_is_exported_unless_asked_and_then_stamped(
    capsys, tmp_path, outcome, code
):
    run = with_outcome(drawn_session(tmp_path), outcome)
    for layout in ("camera_info", "opencv", "kalibr", "easy_handeye2", "urdf", "tum"):
        target = tmp_path / layout / "file.txt"
        asked = ("export", run.folder.path, layout, "-o", target)
        got, out, err = call(capsys, *asked)
        assert (got, out) == (code, "")
        assert f"the verdict is {outcome}" in err
        assert "--even-if-failed" in err
        assert not target.parent.exists()
        got, out, err = call(capsys, *asked, "--even-if-failed")
        assert (got, err) == (0, "")
        for file in target.parent.iterdir():
            text = file.read_text()
            assert "NOT FIT FOR USE" in text
            assert f"VERDICT {outcome}" in text


def test_a_changed_session_is_not_exported(capsys, tmp_path):
    run = drawn_session(tmp_path)
    path = run.folder.file("hand_eye.json")
    path.write_text(path.read_text().replace('"dof": ', '"dof":  '))
    target = tmp_path / "x.yaml"
    code, _, err = call(capsys, "export", run.folder.path, "opencv", "-o", target)
    assert code == 2
    assert "hand_eye.json was changed or damaged" in err
    assert not target.exists()


@pytest.mark.parametrize("name", ["", "a b", "--x", "a\nb", 'a"/><evil', "1st"])
def test_a_frame_name_cannot_break_out_of_a_file(capsys, tmp_path, name):
    run = drawn_session(tmp_path)
    code, _, err = call(
        *(capsys, "export", run.folder.path, "urdf", "-o", tmp_path / "x.urdf"),
        f"--base-frame={name}",
    )
    assert code == 2
    assert "--base-frame must be letters" in err
    assert not (tmp_path / "x.urdf").exists()


def test_a_folder_is_no_file(capsys, tmp_path):
    run = drawn_session(tmp_path)
    code, _, err = call(capsys, "export", run.folder.path, "urdf", "-o", tmp_path)
    assert code == 2
    assert "this is a folder; name a file with -o" in err
