from __future__ import annotations

from functools import cache

import numpy as np
import planning_scene as scene
import pytest
import simulated_calibrations as simulated

from handeye_tri.plan.certificate import axis_spread, certify
from handeye_tri.plan.information import StationInformation
from handeye_tri.plan.poses import HALF_TURN, View
from handeye_tri.se3 import se3_exp, so3_exp


@cache
def model_of(name="hp3_stereo", sigma_px=0.03):
    cell = scene.cell_of(name)
    base = scene.arm_of(name).base_from_world.matrix
    return StationInformation(View(cell), base, cell.repeatability, sigma_px)


def both(poses):
    return np.ones((len(poses), 2), dtype=bool)


def planned(name="hp3_stereo"):
    _, poses, turns = scene.calibration_of(scene.plan_of(name))
    # The two of a half-turn beside each other.
    return poses[turns.ravel()], np.arange(22).reshape(-1, 2)


def test_a_good_plan_passes_without_findings():
    poses, turns = planned()
    certificate = certify(
        scene.cell_of("hp3_stereo"), model_of(), poses, both(poses), turns
    )
    assert certificate.outcome == "PASS"
    assert certificate.findings == ()
    numbers = certificate.numbers
    assert numbers["rank"] == numbers["unknowns"] == len(model_of().labels)
    assert numbers["condition"] > 1
    assert numbers["track_predicted_rms_mm"] > numbers["track_calibration_rms_mm"] > 0


def test_stations_that_only_shift_leave_most_unknown():
    pose = planned()[0][0]
    shifts = np.zeros((6, 6))
    shifts[:, :3] = np.random.default_rng(0).normal(size=(6, 3)) * 0.02
    poses = pose @ se3_exp(shifts)
    certificate = certify(
        scene.cell_of("hp3_stereo"),
        model_of(),
        poses,
        both(poses),
        np.zeros((0, 2), dtype=int),
    )
    assert certificate.outcome == "CANNOT TELL"
    text = " ".join(certificate.findings)
    assert "do not determine" in text
    assert "base_from_" in text
    assert "(rank 28 of 31)" in text
    assert "0 half-turns" in text
    assert "Do: add a half-turn" in certificate.findings[-1]


def test_two_half_turns_in_parallel_planes_are_named():
    pose = planned()[0][0]
    moved = pose @ se3_exp(np.array([0.03, 0.02, 0.04, 0, 0, 0.4]))
    poses = np.array([pose, pose @ HALF_TURN, moved, moved @ HALF_TURN])
    certificate = certify(
        scene.cell_of("hp3_stereo"),
        model_of(),
        poses,
        both(poses),
        np.array([[0, 1], [2, 3]]),
    )
    assert certificate.outcome == "CANNOT TELL"
    assert "0.0 degrees apart, needs 20" in " ".join(certificate.findings)


def test_a_tight_limit_fails_and_says_by_how_much():
    poses, turns = planned()
    cell = scene.changed("hp3_stereo", track_limit_mm=0.05)
    certificate = certify(cell, model_of(), poses, both(poses), turns)
    assert certificate.outcome == "FAIL"
    assert "limit 0.05 mm" in certificate.findings[0]


def test_the_half_turn_that_is_proposed_helps_as_promised():
    poses, turns = planned()
    cell = scene.changed("hp3_stereo", track_limit_mm=0.05)
    few = certify(cell, model_of(), poses[:8], both(poses[:8]), turns[:4])
    promised = float(few.findings[-1].split("error is ")[1].split(" mm")[0])
    assert promised < few.numbers["track_calibration_rms_mm"]


def test_predicted_track_error_is_that_of_a_simulated_test():
    """Errors of cameras, rig, pixels and robot, drawn; triangulated, compared."""
    from handeye_tri.camera import triangulate
    from handeye_tri.se3 import SE3

    cell, model = scene.cell_of("hp3_stereo"), model_of()
    view, rng = View(cell), np.random.default_rng(4)
    world = view.draw(rng, 4000)
    world = world[view.seen(world).all(axis=1)]
    base = model.base_from_world @ world
    n = len(base)
    sigma = np.repeat([cell.repeatability.translation, cell.repeatability.rotation], 3)
    truly = base @ se3_exp(rng.normal(size=(n, 6)) * sigma)
    places = view.markers @ truly[:, :3, :3].swapaxes(1, 2) + truly[:, None, :3, 3]
    reported = view.markers @ base[:, :3, :3].swapaxes(1, 2) + base[:, None, :3, 3]
    base_from_camera = [SE3(model.base_from_world @ w) for w in view.world_from_camera]
    pixels = np.array(
        [
            camera.project(pose.inverse().apply(places.reshape(-1, 3)))
            for camera, pose in zip(view.cameras, base_from_camera, strict=True)
        ]
    )
    pixels += rng.normal(size=pixels.shape) * model.sigma_px
    noise = np.broadcast_to(np.eye(2), (*pixels.shape, 2))
    observed, _ = triangulate(view.cameras, base_from_camera, pixels, noise)
    found = np.square(observed - reported.reshape(-1, 3)).sum(axis=1).mean()
    assert np.sqrt(model.workspace_noise) == pytest.approx(np.sqrt(found), rel=0.04)


def test_baseline_sigma_is_that_of_drawn_cameras():
    model = model_of()
    poses, _ = planned()
    covariance = model.covariance(model.of_stations(poses, both(poses)).sum(axis=0))
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(
        np.zeros(len(model.labels)), covariance.matrix, 4000
    )
    lengths = []
    places = [
        [model.labels.index(f"base_from_{c}.{q}") for q in ("x", "y", "z")]
        + [model.labels.index(f"base_from_{c}.r{q}") for q in "xyz"]
        for c in ("left", "right")
    ]
    bases = model.base_from_world @ model.view.world_from_camera
    moved = [
        base @ se3_exp(drawn[:, place])
        for base, place in zip(bases, places, strict=True)
    ]
    lengths = np.linalg.norm(moved[0][:, :3, 3] - moved[1][:, :3, 3], axis=1)
    assert model.baseline_sigma(covariance) == pytest.approx(lengths.std(), rel=0.05)


def test_predicted_sigmas_are_those_of_simulated_adjustments():
    """60 runs know a sigma to 9 %; a block's pool to 3 to 6 %."""
    cell, model = scene.cell_of("hp3_stereo"), model_of()
    plan = scene.plan_of("hp3_stereo")
    stations, half_turns = simulated.to_calibrate(plan)
    errors = []
    for run in range(60):
        rng = np.random.default_rng([6, run])
        session, truth = simulated.simulated(cell, model, stations, half_turns, rng)
        test = simulated.workspace_test(cell, model, rng)
        found = simulated.from_truth(session, truth)
        errors.append(simulated.squared_errors(found, truth, test))
    quantities = simulated.by_quantity(errors, plan.certificate)
    assert len(quantities) == 19
    for name, squares in quantities.items():
        ratio = simulated.ratio(squares)
        assert ratio.value == pytest.approx(1, abs=0.1 + 3 * ratio.error), name
    for name, squares in simulated.by_block(quantities).items():
        ratio = simulated.ratio(squares)
        assert ratio.value == pytest.approx(1, abs=0.02 + 3 * ratio.error), name


def test_axis_spread_of_known_rotations():
    turns = np.array([np.eye(3), so3_exp([0.5, 0, 0]), so3_exp([1.1, 0, 0])])
    assert axis_spread(turns) == pytest.approx(0, abs=1e-7)
    assert axis_spread(np.array([np.eye(3)] * 3)) == 0.0
    assert axis_spread(so3_exp(np.random.default_rng(0).normal(size=(40, 3)))) > 0.5


def test_cameras_without_a_common_view_are_named():
    poses, turns = planned()
    seen = both(poses)
    seen[::4, 0] = seen[1::4, 0] = False
    seen[2::4, 1] = seen[3::4, 1] = False
    assert not seen.all(axis=1).any()
    certificate = certify(scene.cell_of("hp3_stereo"), model_of(), poses, seen, turns)
    assert certificate.outcome == "FAIL"
    assert "no chain of common views joins left with right" in certificate.findings[0]


def test_what_a_camera_does_not_see_tells_nothing_of_it():
    poses, _ = planned()
    model, seen = model_of(), both(poses)
    seen[:, 1] = False
    information = model.of_stations(poses, seen).sum(axis=0)
    other = [k for k, name in enumerate(model.labels) if "right" in name]
    assert np.abs(information[other]).max() == 0
    assert np.abs(information).max() > 0
