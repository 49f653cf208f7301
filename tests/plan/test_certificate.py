from __future__ import annotations

import re
from functools import cache

import numpy as np
import planning_scene as scene
import pytest
import simulated_calibrations as simulated

from handeye_tri.calibrate_cameras.session_camera import alone
from handeye_tri.plan.certificate import axis_spread, certify
from handeye_tri.plan.information import StationInformation
from handeye_tri.plan.poses import HALF_TURN
from handeye_tri.se3 import se3_exp, so3_exp


@cache
def model_of(name="hp3_stereo", sigma_px=0.03):
    cell = scene.cell_of(name)
    base = scene.arm_of(name).base_from_world.matrix
    return StationInformation(cell, base, cell.repeatability, sigma_px)


def both(poses):
    return np.ones((len(poses), 2), dtype=bool)


def first(poses):
    return np.zeros(len(poses), dtype=int)


def planned(name="hp3_stereo"):
    _, poses, turns = scene.calibration_of(scene.plan_of(name))
    # The two of a half-turn beside each other.
    return poses[turns.ravel()], np.arange(22).reshape(-1, 2)


def test_a_good_plan_passes_without_findings():
    poses, turns = planned()
    certificate = certify(
        scene.cell_of("hp3_stereo"), model_of(), poses, both(poses), first(poses), turns
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
        first(poses),
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
        first(poses),
        np.array([[0, 1], [2, 3]]),
    )
    assert certificate.outcome == "CANNOT TELL"
    assert "0.0 degrees apart, needs 20" in " ".join(certificate.findings)


def test_one_half_turn_says_how_many_are_needed():
    poses, turns = planned()
    certificate = certify(
        scene.cell_of("hp3_stereo"),
        model_of(),
        poses[:2],
        both(poses[:2]),
        first(poses[:2]),
        turns[:1],
    )
    assert certificate.outcome == "CANNOT TELL"
    text = "\n".join(certificate.findings)
    assert "1 half-turn: at least 2, in planes 20 degrees apart, are needed" in text
    assert "the rotations hardly leave a plane (spread 0.000, needs 0.1)" in text
    assert re.search(r"camera left: fx would be known to \d+\.\d px only", text)
    assert re.search(
        r"Do: add a half-turn with the triangle at \(.*\) m in the world, its plane "
        r"tilted \d+ degrees against camera left's image, about the image direction "
        r"\d+ degrees from its x axis; then the calibration's part of the track error "
        r"is \d\.\d{3} mm$",
        text,
    )


def test_the_half_turn_that_is_proposed_mends_parallel_planes():
    """It is made, where it is proposed, and the same stations are judged again."""
    pose = planned()[0][0]
    moves = np.array(
        [
            [0, 0, 0, 0, 0, 0],
            [0.03, 0.02, 0.04, 0, 0, 0.4],
            [-0.03, 0.05, 0.02, 0, 0, 1.0],
            [0.02, -0.05, -0.05, 0, 0, 2.0],
        ]
    )
    before = pose @ se3_exp(moves)
    poses = np.stack([before, before @ HALF_TURN], axis=1).reshape(-1, 4, 4)
    cell, model = scene.cell_of("hp3_stereo"), model_of()
    turns = np.arange(8).reshape(-1, 2)
    parallel = certify(cell, model, poses, both(poses), first(poses), turns)
    where = re.search(r"\((.*?)\).*tilted (\d+) degrees", parallel.findings[-1])
    place, tilt = np.array(where[1].split(","), dtype=float), float(where[2])
    # The proposal is one of these draws: find it by its own words.
    view = model.views[0]
    world = view.draw(np.random.default_rng(0), 1500)
    centres = view.marker_positions(world).mean(axis=1)
    near = np.flatnonzero(np.abs(centres - place).max(axis=1) < 0.006)
    camera = view.world_from_camera[0, :3, 2]
    leans = np.degrees(np.arccos(np.abs(view.normals(world[near]) @ camera)))
    best = near[np.argmin(np.abs(leans - tilt))]
    added = model.base_from_world @ world[best]
    poses = np.concatenate([poses, [added, added @ HALF_TURN]])
    turns = np.arange(10).reshape(-1, 2)
    mended = certify(cell, model, poses, both(poses), first(poses), turns)
    promised = float(parallel.findings[-1].split("error is ")[1].split(" mm")[0])
    assert mended.numbers["track_calibration_rms_mm"] == pytest.approx(
        promised, abs=6e-4
    )
    assert mended.numbers["rank"] == mended.numbers["unknowns"]


@pytest.mark.parametrize("side", [15, 8])
def test_a_tiny_triangle_fails_and_a_larger_one_passes(side):
    """Robot and markers would do, but no camera could begin by itself."""
    poses, turns = planned()

    def judged(side_mm):
        rig = {"side_ab_mm": side_mm, "side_ac_mm": 0.92 * side_mm}
        cell = scene.changed("hp3_stereo", rig={**rig, "marker_radii_mm": [1, 1, 1]})
        base = scene.arm_of("hp3_stereo").base_from_world.matrix
        model = StationInformation(cell, base, cell.repeatability, 0.03)
        return certify(cell, model, poses, both(poses), first(poses), turns)

    tiny = judged(side)
    assert tiny.outcome == "FAIL"
    assert re.match(
        r"camera left: its own half-turns leave fx open by \d+ px of 1720, too much to "
        r"begin a calibration with",
        tiny.findings[0],
    )
    assert "Do: make the triangle" in tiny.findings[-1]
    factor = float(re.search(r"(\S+) times larger", tiny.findings[-1])[1])
    assert 1 < factor < 4
    larger = judged(1.1 * factor * side)
    assert (larger.outcome, larger.findings) == ("PASS", ())


def test_the_sigma_to_begin_with_is_that_of_a_camera_alone():
    cell, model = scene.cell_of("hp3_stereo"), model_of()
    plan = scene.plan_of("hp3_stereo")
    session, _ = simulated.simulated(
        cell, model, *simulated.to_calibrate(plan), np.random.default_rng(1)
    )
    for i, camera in enumerate(cell.cameras):
        found = alone(session, i, np.zeros((22, 3, 2)))
        expected = plan.certificate[f"alone.{camera.name}.fx_px"]
        # The step itself takes a rougher covariance of the half-turn's miss.
        assert found.covariance.std(f"{camera.name}.fx") == pytest.approx(
            expected, rel=0.1
        )


def test_a_tight_limit_fails_and_says_by_how_much():
    poses, turns = planned()
    cell = scene.changed("hp3_stereo", track_limit_mm=0.05)
    certificate = certify(cell, model_of(), poses, both(poses), first(poses), turns)
    assert certificate.outcome == "FAIL"
    assert "limit 0.05 mm" in certificate.findings[0]


def test_the_half_turn_that_is_proposed_helps_as_promised():
    poses, turns = planned()
    cell = scene.changed("hp3_stereo", track_limit_mm=0.05)
    few = certify(
        cell, model_of(), poses[:8], both(poses[:8]), first(poses[:8]), turns[:4]
    )
    promised = float(few.findings[-1].split("error is ")[1].split(" mm")[0])
    assert promised < few.numbers["track_calibration_rms_mm"]


def test_predicted_track_error_is_that_of_a_simulated_test():
    """Errors of cameras, rig, pixels and robot, drawn; triangulated, compared."""
    from handeye_tri.camera import triangulate
    from handeye_tri.se3 import SE3

    cell, model = scene.cell_of("hp3_stereo"), model_of()
    view, rng = model.views[0], np.random.default_rng(4)
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
    covariance = model.covariance(
        model.of_stations(poses, both(poses), first(poses)).sum(axis=0)
    )
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
    bases = model.base_from_world @ model.views[0].world_from_camera
    moved = [
        base @ se3_exp(drawn[:, place])
        for base, place in zip(bases, places, strict=True)
    ]
    lengths = np.linalg.norm(moved[0][:, :3, 3] - moved[1][:, :3, 3], axis=1)
    assert model.baseline_sigma(covariance) == pytest.approx(lengths.std(), rel=0.05)


@pytest.mark.parametrize("name", ["hp3_stereo", "hp3_stereo_both"])
def test_predicted_covariance_is_that_of_the_joint_adjustment(name):
    """One calibration, its noise small beside the curvature of the model.

    Predictions take detection errors for independent; so does this adjustment.
    """
    cell, model, plan = scene.cell_of(name), model_of(name), scene.plan_of(name)
    stations, half_turns = simulated.to_calibrate(plan)
    rng = np.random.default_rng(8)
    session, truth = simulated.simulated(cell, model, stations, half_turns, rng)
    stated = simulated.from_truth(session, truth, 0.0).covariance
    predicted = model.covariance(
        model.of_stations(
            np.array([s.base_from_flange.matrix for s in stations]),
            np.ones((len(stations), 2), dtype=bool),
            np.array([s.mount for s in stations]),
        ).sum(axis=0)
    )
    found = stated.block(model.labels)
    scale = np.sqrt(np.diag(predicted.matrix))
    np.testing.assert_allclose(
        found / np.outer(scale, scale),
        predicted.matrix / np.outer(scale, scale),
        atol=0.01,
    )


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
    certificate = certify(
        scene.cell_of("hp3_stereo"), model_of(), poses, seen, first(poses), turns
    )
    assert certificate.outcome == "FAIL"
    assert "no chain of common views joins left with right" in certificate.findings[0]


def test_what_a_camera_does_not_see_tells_nothing_of_it():
    poses, _ = planned()
    model, seen = model_of(), both(poses)
    seen[:, 1] = False
    information = model.of_stations(poses, seen, first(poses)).sum(axis=0)
    other = [k for k, name in enumerate(model.labels) if "right" in name]
    assert np.abs(information[other]).max() == 0
    assert np.abs(information).max() > 0


def drawn_with_both(counts):
    """Half-turns that both cameras see, so many with each mount."""
    cell = scene.cell_of("hp3_stereo_both")
    model = StationInformation(cell, np.eye(4), cell.repeatability, 0.03)
    rng = np.random.default_rng(3)
    poses = []
    for view, count in zip(model.views, counts, strict=True):
        world = view.draw(rng, 400)
        both_see = (view.seen(world) & view.seen(world @ HALF_TURN)).all(axis=1)
        chosen = world[both_see][:count]
        poses += list(np.stack([chosen, chosen @ HALF_TURN], axis=1).reshape(-1, 4, 4))
    mounts = np.repeat([0, 1], 2 * np.array(counts))
    turns = np.arange(len(poses)).reshape(-1, 2)
    return cell, model, np.array(poses), mounts, turns


def test_both_mounts_are_certified_together():
    cell, model, poses, mounts, turns = drawn_with_both((6, 5))
    certificate = certify(cell, model, poses, both(poses), mounts, turns)
    assert certificate.outcome == "PASS", certificate.findings
    numbers = certificate.numbers
    for name in ("flange_from_triangle", "flange_from_triangle_2"):
        assert 0 < numbers[f"sigma.{name}.translation_mm"] < 0.2
    assert (numbers["mount_1.stations"], numbers["mount_2.stations"]) == (12, 10)
    assert (numbers["mount_1.half_turns"], numbers["mount_2.half_turns"]) == (6, 5)
    assert numbers["rank"] == numbers["unknowns"] == len(model.labels)
    # The mounts share the cameras: each gains by the other's half-turns.
    alone = certify(
        cell.mounted[0],
        StationInformation(cell.mounted[0], np.eye(4), cell.repeatability, 0.03),
        poses[:12],
        both(poses[:12]),
        mounts[:12],
        turns[:6],
    ).numbers
    assert "mount_1.stations" not in alone
    assert numbers["sigma.left.fx_px"] < alone["sigma.left.fx_px"]


def test_a_mount_that_no_station_has_is_named():
    cell, model, poses, mounts, turns = drawn_with_both((6, 0))
    certificate = certify(cell, model, poses, both(poses), mounts, turns)
    assert certificate.outcome == "CANNOT TELL"
    text = "\n".join(certificate.findings)
    assert re.search(r"do not determine marker_._2\..*\(rank \d+ of 40\)", text)
    assert "no station has mount 2 (about its edge BC)" in text
    assert "Do: add a half-turn of mount 2 (about its edge BC), with the tri" in text
