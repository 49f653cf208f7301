"""Budget by part, and the predicted track error anywhere in the workspace."""

import dataclasses

import numpy as np
import pytest

from handeye_tri.adjustment import adjust, joint_offsets
from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.camera import Intrinsics, PinholeCamera, triangulate
from handeye_tri.errors import InputError
from handeye_tri.evaluate import (
    compare_with_truth,
    evaluate_track,
    predicted_track_error,
    track_budget,
    track_map,
)
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.records import (
    MARKER_LABELS,
    Covariance,
    Repeatability,
    motion_labels,
)
from handeye_tri.se3 import SE3, se3_exp
from handeye_tri.synthesize import reference_geometry, synthesize

ROBOT = Repeatability(3e-5, np.radians(0.005))


@pytest.fixture(scope="module")
def cell():
    geometry = reference_geometry(np.random.default_rng(0))
    session, truth = synthesize(
        geometry, np.random.default_rng(1), sigma_px=0.1, repeatability=ROBOT
    )
    separate = calibrate_hand_eye(session, calibrate_session_cameras(session))
    return session, truth, separate, adjust(session, separate)


@pytest.mark.parametrize("which", [2, 3])
def test_the_budget_adds_up_and_names_every_part(cell, which):
    budget = track_budget(cell[which], cell[0])
    parts = budget.calibration_parts
    assert set(parts) == {
        "left camera", "right camera", "stereo", "hand-eye", "rig"
    }  # fmt: skip
    assert min(parts.values()) >= 0
    total = np.sqrt(sum(value**2 for value in parts.values()))
    assert total == pytest.approx(budget.calibration, rel=1e-9)
    total = np.sqrt(sum(value**2 for value in budget.parts().values()))
    assert total == pytest.approx(budget.total, rel=1e-9)


def keep(calibration, owner):
    """The cell with nothing uncertain but what an owner's labels say."""
    labels = calibration.covariance.labels
    kept = np.array([label.split(".")[0].startswith(owner) for label in labels])
    matrix = calibration.covariance.matrix * np.outer(kept, kept)
    return dataclasses.replace(calibration, covariance=Covariance(labels, matrix))


@pytest.mark.parametrize(
    ("owner", "part"), [("left", "left camera"), ("marker", "rig")]
)
def test_a_part_that_alone_is_uncertain_has_all_of_the_budget(cell, owner, part):
    alone = keep(cell[3], owner)
    budget = track_budget(alone, cell[0])
    assert budget.calibration > 1e-6
    assert budget.calibration_parts[part] == pytest.approx(budget.calibration, rel=1e-6)


def test_independent_parts_keep_their_own_variance(cell):
    labels = cell[3].covariance.labels
    std = np.array([cell[3].covariance.std(label) for label in labels])
    # Both places move with the first camera's, or the stereo motion were uncertain.
    calibration = dataclasses.replace(
        cell[3], covariance=Covariance(labels, np.diag(std**2))
    )
    whole = track_budget(calibration, cell[0])
    for owner, part in (("left", "left camera"), ("right", "right camera"),
                        ("marker", "rig")):  # fmt: skip
        alone = track_budget(keep(calibration, owner), cell[0]).calibration
        assert whole.calibration_parts[part] == pytest.approx(alone, rel=1e-6)


def test_many_cameras_are_one_part():
    geometry = reference_geometry(np.random.default_rng(0), half_turns=5)
    cameras, places = [], []
    for i in range(6):
        base = geometry.cameras[i % 2]
        name = f"camera_{i}"
        cameras.append(PinholeCamera(name, base.intrinsics, base.image_size))
        side = SE3.exp((0.01 * i, 0.02, 0, 0, 0, 0))
        places.append(geometry.base_from_camera[i % 2] @ side)
    session, _ = synthesize(
        dataclasses.replace(
            geometry, cameras=tuple(cameras), base_from_camera=tuple(places)
        ),
        np.random.default_rng(1),
        sigma_px=0.1,
        repeatability=ROBOT,
    )
    start = calibrate_hand_eye(session, calibrate_session_cameras(session))
    parts = track_budget(adjust(session, start), session).calibration_parts
    assert set(parts) == {"cameras", "stereo", "hand-eye", "rig"}


def test_marker_errors_are_predicted_by_the_markers(cell):
    """Markers that calibrate themselves move alone, not with the triangle."""
    session, _, _, found = cell
    labels = found.covariance.labels
    for k, label in enumerate(MARKER_LABELS):
        spike = np.zeros((len(labels), len(labels)))
        column = labels.index(label)
        spike[column, column] = 1.0
        one = dataclasses.replace(found, covariance=Covariance(labels, spike))
        # The reported marker moves by as much; the observed does not.
        third = track_budget(one, session).calibration
        assert third == pytest.approx(np.sqrt(1 / 3), rel=1e-12)
        moved = found.markers + 1e-3 * np.eye(9)[k].reshape(3, 3)
        shifted = evaluate_track(dataclasses.replace(found, markers=moved), session)
        difference = shifted.reported - evaluate_track(found, session).reported
        assert np.sqrt((difference**2).sum(1).mean()) == pytest.approx(1e-3 * third)


def test_truth_has_the_markers(cell):
    rows = {row.quantity: row for row in compare_with_truth(cell[3], cell[1])}
    assert set(MARKER_LABELS) <= set(rows)
    row = rows["marker_B.y"]
    assert row.truth == cell[1].markers[1, 1]
    assert row.error == pytest.approx(cell[3].markers[1, 1] - row.truth)
    assert 0 < row.sigma < 1e-3
    unknown = dataclasses.replace(cell[1], markers=None)
    rows = {row.quantity for row in compare_with_truth(cell[3], unknown)}
    assert not set(MARKER_LABELS) & rows
    assert {*motion_labels("flange_from_triangle"), "baseline.right"} <= rows


def test_the_map_agrees_with_the_held_out_stations(cell):
    session, _, _, found = cell
    track = evaluate_track(found, session)
    for r in range(0, len(track.stations), 5):
        pose = session.stations[track.stations[r]].base_from_flange
        # One marker and one orientation: the other two markers may not count.
        single = keep(found, ("left", "right", "base"))
        covariance = predicted_track_error(
            single,
            track.observed[r],
            pose.rotation[None],
            sigma_px=0.1,
        )
        at_station = evaluate_track(
            single, dataclasses.replace(session, repeatability=Repeatability(0, 0))
        ).predicted_covariance[r]
        assert np.abs(covariance - at_station).max() < 1e-6 * at_station.max()


def test_the_map_is_the_spread_of_redrawn_cells(cell):
    """Monte-Carlo of the definition: perturb the cell, look where a marker then is."""
    session, _, _, found = cell
    labels = found.covariance.labels
    point = np.array([0.5, 0.05, 0.35])
    turns = session.base_from_flange[:3, :3, :3]
    predicted = predicted_track_error(
        found, point, turns, sigma_px=0.05, repeatability=ROBOT
    )
    rng = np.random.default_rng(7)
    names = [label for label in labels if label.split(".")[0] in ("left", "right")
             or label.startswith(("base", "marker"))]  # fmt: skip
    block = found.covariance.block(names)
    std = np.sqrt(np.diagonal(block))
    values, vectors = np.linalg.eigh(block / np.outer(std, std))
    root = std[:, None] * vectors * np.sqrt(np.maximum(values, 0))
    pixels = np.array([
        camera.project(motion.inverse().apply(point))
        for camera, motion in zip(found.cameras, found.base_from_camera, strict=True)
    ])  # fmt: skip
    draws = []
    sigma = np.repeat([ROBOT.translation, ROBOT.rotation], 3)
    for _ in range(400):
        change = dict(zip(names, root @ rng.normal(size=len(names)), strict=True))
        cameras, places = [], []
        for camera, motion in zip(found.cameras, found.base_from_camera, strict=True):
            vector = camera.intrinsics.vector + [
                change[f"{camera.name}.{q}"] for q in ("fx", "fy", "skew", "cx", "cy")
            ]
            intrinsics = Intrinsics.from_vector(vector)
            cameras.append(PinholeCamera(camera.name, intrinsics, camera.image_size))
            owner = motion_labels(f"base_from_{camera.name}")
            places.append(motion @ SE3.exp([change[label] for label in owner]))
        noisy = pixels + 0.05 * rng.normal(size=pixels.shape)
        noise = np.broadcast_to(0.05**2 * np.eye(2), (2, 1, 2, 2))
        observed, _ = triangulate(cameras, places, noisy[:, None], noise)
        k, turn = rng.integers(3), turns[rng.integers(3)]
        marker = found.markers[k]
        shift = np.array([change[f"marker_{'ABC'[k]}.{axis}"] for axis in "xyz"])
        flange = SE3.from_parts(turn, point - turn @ marker)
        executed = se3_exp(sigma * rng.normal(size=6))
        missed = executed[:3, :3] @ marker + executed[:3, 3] - marker
        reported = flange.apply(marker + shift)
        draws.append(observed[0] + turn @ missed - reported)
    measured = np.mean([np.outer(d, d) for d in draws], axis=0)
    # 400 draws know a variance to 7 %, and there are six entries.
    scale = np.sqrt(np.outer(np.diagonal(predicted), np.diagonal(predicted)))
    assert np.abs((measured - predicted) / scale).max() < 0.25


def test_a_map_covers_the_workspace_and_is_blank_where_unseen(cell):
    session, _, _, found = cell
    grid = track_map(found, session, (4, 5, 3))
    assert grid.points.shape == (4, 5, 3, 3)
    assert grid.rms.shape == (4, 5, 3)
    seen = grid.rms[np.isfinite(grid.rms)]
    assert len(seen) > 20
    track = evaluate_track(found, session)
    assert 0.5 * track.predicted_rms < np.median(seen) < 2 * track.predicted_rms
    away = predicted_track_error(found, [[5.0, 5.0, 5.0]], np.eye(3)[None])
    assert np.isnan(away).all()
    with pytest.raises(InputError, match="at least 2"):
        track_map(found, session, (1, 5, 3))
    with pytest.raises(InputError, match="orientations"):
        predicted_track_error(found, [0.5, 0, 0.4], np.eye(3))
    with pytest.raises(InputError, match="points"):
        predicted_track_error(found, [0.5, 0], np.eye(3)[None])


def test_a_corrected_robot_needs_its_parameters(cell):
    session, _, separate, _ = cell
    n = len(session.stations)
    jacobian = np.random.default_rng(0).normal(size=(n, 6, 2))
    parameters = joint_offsets(("a", "b"), jacobian)
    found = adjust(session, separate, robot_parameters=parameters)
    assert set(found.robot) == {"a.offset", "b.offset"}
    with pytest.raises(InputError, match=r"a\.offset, b\.offset.*28 stations"):
        evaluate_track(found, session)
    track = evaluate_track(found, session, parameters)
    assert track.rms < 3 * track.predicted_rms
    budget = track_budget(found, session, parameters)
    assert budget.calibration_parts["robot parameters"] > 0
    assert budget.total == pytest.approx(track.predicted_rms, rel=1e-12)
