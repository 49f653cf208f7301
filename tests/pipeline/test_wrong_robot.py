"""A robot whose joints and links are not as its controller thinks, by commands."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from handeye_tri import storage
from handeye_tri.pipeline import STAGES, NullProgress, Run, execute, start
from handeye_tri.pipeline.execution import inputs_of
from handeye_tri.pipeline.run import TRUTH_SCHEMA
from handeye_tri.se3 import SE3, se3_exp, se3_inverse
from handeye_tri.storage import codec
from handeye_tri.synthesize import Geometry, synthesize

OFFSET = np.radians(0.05)
LINK = 2e-4


def command(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "handeye_tri.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )


def executed(arm, joints, rng):
    """Where a flange is whose joints are 0.05 deg off and whose links 0.2 mm."""
    off = joints + OFFSET * rng.choice([-1, 1], joints.shape[1])
    bodies = [arm.mechanism.joints[k].body for k in arm.mechanism.arm_joints]
    links = arm.base_from_world.matrix @ arm.body_poses(off)[:, bodies]
    pose = arm.forward(off)
    # From the last link back: each error moves everything beyond its link.
    for k in reversed(range(joints.shape[1])):
        tangent = np.r_[LINK / np.sqrt(3) * rng.normal(size=3), 0, 0, 0]
        frame = links[:, k]
        pose = frame @ se3_exp(tangent) @ se3_inverse(frame) @ pose
    return pose


@pytest.fixture(scope="module")
def observed(tmp_path_factory):
    """A planned session with observations of what a wrong robot does, no images."""
    folder = tmp_path_factory.mktemp("wrong") / "session"
    run = Run(start("hp3_stereo", folder, 5, None), NullProgress())
    execute(run, STAGES, ("plan",), again=False)
    plan, cell, arm = run.plan(), run.cell, run.arm
    joints = np.array([station.joints for station in plan.stations])
    geometry = Geometry(
        cell.rig.triangle,
        cell.rig.flange_from_triangle,
        tuple(camera.camera for camera in cell.cameras),
        tuple(arm.base_from_world @ c.world_from_camera for c in cell.cameras),
        tuple(
            replace(station, base_from_flange=SE3(pose))
            for station, pose in zip(
                plan.stations,
                executed(arm, joints, np.random.default_rng(6)),
                strict=True,
            )
        ),
        plan.half_turns,
    )
    session, truth = synthesize(
        geometry,
        np.random.default_rng(7),
        sigma_px=0.03,
        repeatability=cell.repeatability,
        marker_radii=tuple(1e-3 * np.array(cell.rig.marker_radii_mm)),
    )
    storage.write_json(
        run.folder.file("truth.json"),
        {"schema": TRUTH_SCHEMA, **codec.truth_to_json(truth, joints)},
    )
    storage.write_arrays(
        run.folder.file("observations.npz"),
        {"pixels": session.pixels, "pixel_covariance": session.pixel_covariance},
    )
    for stage, output in (("simulate", "truth.json"), ("detect", "observations.npz")):
        inputs = inputs_of(run, STAGES[stage])
        run.folder.record(stage, inputs, [output], "synthesised")
    return folder


def test_without_the_switch_the_verdict_is_not_pass_and_names_it(observed, tmp_path):
    folder = tmp_path / "without"
    shutil.copytree(observed, folder)
    done = command("calibrate", folder)
    assert done.returncode == 0, done.stderr
    hand_eye = json.loads((folder / "hand_eye.json").read_text())
    assert hand_eye["chi2"] / hand_eye["dof"] > 5
    done = command("check", folder, "--json")
    assert done.returncode == 3, done.stderr
    result = json.loads(done.stdout)
    assert result["verdict"] == "FAIL"
    remedies = {finding["code"]: finding["remedy"] for finding in result["findings"]}
    assert "--robot joint-offsets,link-corrections" in remedies["LOOP"]


def test_with_it_the_robot_is_corrected_everywhere(observed, tmp_path):
    folder = tmp_path / "with"
    shutil.copytree(observed, folder)
    done = command("calibrate", folder, "--robot", "joint-offsets,link-corrections")
    assert done.returncode == 0, done.stderr
    done = command("evaluate", folder)
    assert done.returncode == 0, done.stdout
    result = json.loads((folder / "evaluation.json").read_text())
    assert result["verdict"] == "PASS"
    assert result["hand_eye_chi2_per_dof"] == pytest.approx(1.0, abs=0.35)
    assert result["track"]["rms_mm"] < 1.5 * result["track"]["predicted_rms_mm"]
    robot = result["robot"]
    assert len(robot["estimated"]) + len(robot["undetermined"]) == 6 + 18
    assert len(robot["estimated"]) >= 6
    rows = {row["name"]: row for row in result["result"]}
    for label in robot["estimated"]:
        assert label in rows
        assert label in done.stdout
    # A base that is shifted as a whole is no error of the robot that anything tells.
    assert robot["undetermined"]
    assert "left at zero" in done.stdout
    for name in ("cross_validation", "bootstrap"):
        assert "not_run" not in result["cross_checks"][name]
    # Report, recording and check take the corrected robot too.
    done = command("report", folder)
    assert done.returncode == 0, done.stderr
    done = command("check", folder)
    assert done.returncode == 0, done.stderr


def test_errors_of_the_robot_need_the_joint_method(observed, tmp_path):
    folder = tmp_path / "separate"
    shutil.copytree(observed, folder)
    done = command(
        "calibrate", folder, "--method", "separate", "--robot", "joint-offsets"
    )
    assert done.returncode == 2
    assert "--method joint" in done.stderr
    done = command("calibrate", folder, "--robot", "elbow")
    assert done.returncode == 2
    assert "joint-offsets or link-corrections" in done.stderr
    before = {path: path.read_bytes() for path in folder.glob("*.json")}
    done = command("calibrate", folder, "--robot", "joint-offsets,clock-offset")
    assert done.returncode == 2
    assert "stands still" in done.stderr
    assert "handeye-tri solve" in done.stderr
    assert before == {path: path.read_bytes() for path in folder.glob("*.json")}
