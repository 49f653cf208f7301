import json

import numpy as np
import pytest

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.errors import HandEyeError, StorageError
from handeye_tri.records import (
    CameraCalibration,
    Covariance,
    DroppedHalfTurn,
    GroundTruth,
    HalfTurn,
    HandEyeCalibration,
    Mount,
    Plan,
    Station,
    ToolChange,
)
from handeye_tri.se3 import SE3
from handeye_tri.storage import codec

RNG = np.random.default_rng(5)
CAMERA = PinholeCamera(
    "left",
    Intrinsics(1720.25, 1715.5, 0.125, 519.3, 377.8),
    (1024, 768),
    Lens("rational", RNG.normal(size=8)),
)
MOTION = SE3.exp(RNG.normal(size=6))
HALF_TURN = SE3.exp([0.1, 0.2, 0.3, np.pi, 0, 0])
COVARIANCE = Covariance(("left.fx", "left.fy"), np.array([[2.0, 0.5], [0.5, 1.0]]))


def through_text(data):
    return json.loads(json.dumps(data, allow_nan=False))


def close(a: SE3, b: SE3) -> bool:
    return bool(np.abs(a.matrix - b.matrix).max() < 1e-15)


@pytest.mark.parametrize("motion", [SE3.identity(), MOTION, HALF_TURN])
def test_motion(motion):
    back = codec.motion_from_json(through_text(codec.motion_to_json(motion)))
    assert close(back, motion)


def test_a_quaternion_that_is_none_is_refused():
    data = codec.motion_to_json(MOTION)
    data["quaternion"]["w"] = 3.0
    with pytest.raises(HandEyeError, match="length 1"):
        codec.motion_from_json(data)


def test_camera():
    back = codec.camera_from_json(through_text(codec.camera_to_json(CAMERA)))
    assert back.name == "left"
    assert back.intrinsics == CAMERA.intrinsics
    assert back.image_size == (1024, 768)
    assert back.lens.model == "rational"
    assert np.array_equal(back.lens.coefficients, CAMERA.lens.coefficients)


def test_plan():
    stations = tuple(
        Station(i, kind, RNG.normal(size=6), SE3.exp(RNG.normal(size=6)))
        for i, kind in enumerate(("calibration", "calibration", "evaluation"))
    )
    plan = Plan(
        stations,
        (HalfTurn(0, 1, "CA"),),
        {"limits": 3},
        {"a_mm": 0.5},
        7,
        "FAIL",
        ("a",),
    )
    back = codec.plan_from_json(through_text(codec.plan_to_json(plan)))
    assert back.half_turns == plan.half_turns
    assert (back.rejected, back.certificate, back.seed) == (
        {"limits": 3},
        {"a_mm": 0.5},
        7,
    )
    assert [via.shape for via in back.via] == [via.shape for via in plan.via]
    for ours, theirs in zip(back.stations, stations, strict=True):
        assert (ours.index, ours.kind) == (theirs.index, theirs.kind)
        assert np.array_equal(ours.joints, theirs.joints)
        assert close(ours.base_from_flange, theirs.base_from_flange)


def test_a_plan_with_a_tool_change():
    stations = tuple(
        Station(i, "calibration", RNG.normal(size=6), MOTION, mount)
        for i, mount in enumerate((0, 1))
    )
    change = ToolChange(1, RNG.normal(size=6), RNG.normal(size=(0, 6)))
    plan = Plan(stations, (), {}, {}, 7, "PASS", (), tool_change=change)
    back = codec.plan_from_json(through_text(codec.plan_to_json(plan)))
    assert [s.mount for s in back.stations] == [0, 1]
    assert back.tool_change.before == 1
    assert np.array_equal(back.tool_change.joints, change.joints)
    assert back.tool_change.via.shape == (0, 6)


def test_a_truth_with_a_second_mount():
    second = Mount(HALF_TURN, RNG.normal(size=(3, 3)))
    poses = MOTION.matrix[None]
    truth = GroundTruth((CAMERA,), (MOTION,), MOTION, poses, None, (second,))
    data = through_text(codec.truth_to_json(truth, np.zeros((1, 6))))
    (back,) = codec.truth_from_json(data)[0].other_mounts
    assert np.array_equal(back.markers, second.markers)
    assert close(back.flange_from_triangle, HALF_TURN)


def test_truth():
    poses = np.array([MOTION.matrix, HALF_TURN.matrix])
    markers = RNG.normal(size=(3, 3))
    truth = GroundTruth((CAMERA,), (MOTION,), HALF_TURN, poses, markers)
    joints = RNG.normal(size=(2, 6))
    data = through_text(codec.truth_to_json(truth, joints))
    back, executed = codec.truth_from_json(data)
    assert np.array_equal(back.markers, markers)
    del data["markers_in_flange_m"]
    assert codec.truth_from_json(data)[0].markers is None
    assert np.array_equal(executed, joints)
    assert np.abs(back.base_from_flange - poses).max() < 1e-15
    assert close(back.flange_from_triangle, HALF_TURN)


def test_camera_calibration_keeps_unseen_residuals():
    residuals = RNG.normal(size=(1, 2, 3, 2))
    residuals[0, 1, 2] = np.nan
    result = CameraCalibration(
        (CAMERA,), (SE3.identity(),), COVARIANCE, 3.0, 4, residuals, 1e5, 9.0, "way",
        {"dropped": (DroppedHalfTurn("left", 5, 10, 11, "the same image"),)},
    )  # fmt: skip
    back = codec.camera_calibration_from_json(
        through_text(codec.camera_calibration_to_json(result))
    )
    assert np.array_equal(back.residuals, residuals, equal_nan=True)
    assert back.details == result.details
    assert back.covariance.labels == COVARIANCE.labels
    assert np.array_equal(back.covariance.matrix, COVARIANCE.matrix)
    assert (back.chi2, back.dof, back.condition, back.cost_start, back.method) == (
        3.0,
        4,
        1e5,
        9.0,
        "way",
    )


def test_hand_eye():
    result = HandEyeCalibration(
        (CAMERA,), (MOTION,), HALF_TURN, RNG.normal(size=(3, 3)), COVARIANCE, 3.0, 4,
        RNG.normal(size=(5, 6)), "way", {"shah": MOTION}, {"elbow.offset": 1e-3},
    )  # fmt: skip
    back = codec.hand_eye_from_json(through_text(codec.hand_eye_to_json(result)))
    assert close(back.base_from_camera[0], MOTION)
    assert close(back.flange_from_triangle, HALF_TURN)
    assert np.array_equal(back.markers, result.markers)
    assert np.array_equal(back.residuals, result.residuals)
    assert close(back.alternatives["shah"], MOTION)
    assert back.robot == {"elbow.offset": 1e-3}


def test_ragged_numbers_are_refused():
    with pytest.raises(StorageError, match="these are not numbers"):
        codec.array([[1.0], "x"], "residuals_px")
