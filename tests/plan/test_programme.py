from __future__ import annotations

import time
from itertools import pairwise

import mujoco
import numpy as np
import planning_scene as scene
import pytest

from handeye_tri.arm import Arm
from handeye_tri.errors import InputError, NoPlanError
from handeye_tri.plan import Visited, plan_motions, plan_next
from handeye_tri.plan.certificate import certify
from handeye_tri.plan.information import StationInformation
from handeye_tri.plan.poses import View
from handeye_tri.simulate import compile_mechanism
from handeye_tri.simulate.compile import compile_cell
from handeye_tri.simulate.truth import execute

HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])


@pytest.fixture(params=scene.CELLS)
def name(request):
    return request.param


def markers_of(cell, plan):
    """Markers in the base from the reported poses and the rig as built, (n, 3, 3)."""
    rig = cell.rig.flange_from_triangle.matrix
    points = cell.rig.triangle.points @ rig[:3, :3].T + rig[:3, 3]
    poses = np.array([s.base_from_flange.matrix for s in plan.stations])
    turned = points @ poses[:, :3, :3].swapaxes(1, 2)
    return turned + poses[:, None, :3, 3]


def planes_of(points):
    """Unit normals through three points, shape (n, 3)."""
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def test_every_station_belongs_to_one_half_turn_or_is_held_out(name):
    cell, plan = scene.cell_of(name), scene.plan_of(name)
    assert [s.index for s in plan.stations] == list(range(28))
    held_out = [s.index for s in plan.stations if s.kind == "evaluation"]
    pairs = [(t.before, t.after) for t in plan.half_turns]
    assert len(held_out) == 6
    assert len(pairs) == 11
    assert sorted([*held_out, *np.ravel(pairs)]) == list(range(28))
    assert all(before < after for before, after in pairs)
    assert pairs == sorted(pairs)
    assert {t.axis for t in plan.half_turns} == {cell.rig.axis}


def test_one_solution_serves_both_stations_of_a_half_turn(name):
    """What is wrong with all other joints is wrong alike in both."""
    plan = scene.plan_of(name)
    for turn in plan.half_turns:
        before, after = plan.stations[turn.before], plan.stations[turn.after]
        np.testing.assert_array_equal(before.joints[:-1], after.joints[:-1])


def test_stations_are_within_limits_and_where_they_say(name):
    plan, arm = scene.plan_of(name), scene.arm_of(name)
    joints = np.array([s.joints for s in plan.stations])
    assert (joints >= arm.lower).all()
    assert (joints <= arm.upper).all()
    poses = np.array([s.base_from_flange.matrix for s in plan.stations])
    np.testing.assert_allclose(arm.forward(joints), poses, atol=1e-9)


def test_half_turns_are_exact(name):
    plan = scene.plan_of(name)
    for turn in plan.half_turns:
        before = plan.stations[turn.before].base_from_flange
        after = plan.stations[turn.after].base_from_flange
        np.testing.assert_allclose(
            (before.inverse() @ after).matrix, HALF_TURN, atol=1e-9
        )


def test_planes_are_spread(name):
    cell, plan = scene.cell_of(name), scene.plan_of(name)
    planes = planes_of(markers_of(cell, plan))
    before, after = np.array([(t.before, t.after) for t in plan.half_turns]).T
    # A half-turn keeps the plane.
    np.testing.assert_allclose(np.abs((planes[before] * planes[after]).sum(axis=1)), 1)
    cosine = np.abs(planes[before] @ planes[before].T)
    spread = np.degrees(np.arccos(cosine.min()))
    assert spread > 2 * cell.plan.min_plane_spread_deg
    assert spread == pytest.approx(plan.certificate["plane_spread_deg"])


def test_the_rotations_span_all_directions(name):
    assert scene.plan_of(name).certificate["axis_spread"] > 0.3


def test_no_view_is_too_steep_and_not_all_are_frontal(name):
    cell, plan = scene.cell_of(name), scene.plan_of(name)
    points = markers_of(cell, plan)
    tilts = []
    for camera in cell.cameras:
        toward = np.array(camera.position_m) - points.mean(axis=1)
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        cosine = np.abs((toward * planes_of(points)).sum(axis=1))
        tilts.append(np.degrees(np.arccos(cosine)))
    assert np.max(tilts) <= cell.plan.max_tilt_deg + 1e-9
    assert np.mean(tilts) > 25


@pytest.mark.parametrize("name", ["hp3_stereo", "hp3_stereo_edge"])
def test_mujoco_sees_every_marker_and_no_contact(name):
    """Another engine: rays from each camera to the markers, contacts on the way."""
    cell, plan = scene.cell_of(name), scene.plan_of(name)
    model, _ = compile_cell(cell, scene.MODEL)
    data = mujoco.MjData(model)
    points = markers_of(cell, plan)
    radii = 1e-3 * np.array(cell.rig.marker_radii_mm)
    balls = [model.geom(f"rig/marker {k}").id for k in "ABC"]
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    geom = np.zeros(1, dtype=np.int32)
    for station, centres in zip(plan.stations, points, strict=True):
        data.qpos[:] = station.joints
        mujoco.mj_forward(model, data)
        for camera in cell.cameras:
            apex = np.array(camera.position_m)
            for ball, centre, radius in zip(balls, centres, radii, strict=True):
                sight = centre - apex
                across = np.linalg.svd(sight[None])[2][1:]
                for part in (0.0, 0.5, 0.95):
                    for a in angle:
                        aim = sight + part * radius * (
                            np.cos(a) * across[0] + np.sin(a) * across[1]
                        )
                        mujoco.mj_ray(model, data, apex, aim, None, 1, -1, geom)
                        assert geom[0] == ball
    for start, end in zip(plan.stations[:-1], plan.stations[1:], strict=True):
        for fraction in np.linspace(0, 1, 25):
            data.qpos[:] = start.joints + fraction * (end.joints - start.joints)
            mujoco.mj_forward(model, data)
            assert data.ncon == 0 or data.contact.dist.min() > 0


def test_whole_markers_are_in_every_image(name):
    cell, plan = scene.cell_of(name), scene.plan_of(name)
    margin = cell.plan.image_margin_px
    ball = np.random.default_rng(0).normal(size=(300, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    radii = 1e-3 * np.array(cell.rig.marker_radii_mm)
    solid = markers_of(cell, plan)[:, :, None] + radii[:, None, None] * ball
    for config in cell.cameras:
        local = config.world_from_camera.inverse().apply(solid)
        pixels = config.camera.project(local)
        assert (pixels >= margin - 0.05).all()
        assert (pixels <= np.array(config.image_size_px) - 1 - margin + 0.05).all()


def test_evaluation_stations_are_elsewhere(name):
    plan = scene.plan_of(name)
    poses = np.array([s.base_from_flange.matrix for s in plan.stations])
    held_out = np.array([s.kind == "evaluation" for s in plan.stations])
    place = poses[:, :3, 3]
    gap = np.linalg.norm(place[held_out, None] - place[~held_out], axis=-1)
    assert gap.min() > 1e-3


def test_the_chosen_half_turns_tell_more_than_random_ones():
    """Against the first eleven candidates of the same search."""
    from handeye_tri.plan.candidates import CandidateSearch

    cell, arm = scene.cell_of("hp3_stereo"), scene.arm_of("hp3_stereo")
    plan, view = scene.plan_of("hp3_stereo"), View(cell)
    search = CandidateSearch(view, arm, np.random.default_rng([1, 0]))
    first = search.find(11, turns=True)
    sigma = plan.certificate["sigma_px"]
    model = StationInformation(
        cell, arm.base_from_world.matrix, cell.repeatability, sigma
    )
    poses = np.concatenate([c.base_from_flange for (c,) in first])
    random = model.covariance(
        model.of_stations(poses, np.ones((22, 2), bool), np.zeros(22, int)).sum(axis=0)
    )
    assert plan.certificate["sigma.left.fx_px"] < 0.8 * random.std("left.fx")


def test_the_certificate_names_every_estimated_quantity(name):
    cell, certificate = scene.cell_of(name), scene.plan_of(name).certificate
    for camera in cell.cameras:
        for quantity in ("fx_px", "fy_px", "skew_px", "cx_px", "cy_px"):
            assert 0 < certificate[f"sigma.{camera.name}.{quantity}"] < 20
        for coefficient in camera.estimate.lens:
            assert certificate[f"sigma.{camera.name}.{coefficient}"] > 0
        key = f"sigma.base_from_{camera.name}"
        assert 0 < certificate[f"{key}.translation_mm"] < 1
        assert 0 < certificate[f"{key}.rotation_deg"] < 0.1
    assert 0.01 < certificate["track_calibration_rms_mm"] < 0.1


def test_same_seed_same_plan_and_another_seed_another():
    cell = scene.cell_of("hp3_stereo")
    # Fresh arms, so that nothing an arm remembers can matter.
    first, again, other = (
        plan_motions(cell, Arm(scene.compiled(cell)), seed, half_turns=3)
        for seed in (1, 1, 2)
    )
    for a, b in zip(first.stations, again.stations, strict=True):
        np.testing.assert_array_equal(a.joints, b.joints)
    assert dict(first.certificate) == dict(again.certificate)
    assert dict(first.rejected) == dict(again.rejected)
    assert np.abs(first.stations[0].joints - other.stations[0].joints).max() > 1e-3


def test_fewer_half_turns_and_progress():
    seen = []
    plan = plan_motions(
        scene.cell_of("hp3_stereo"),
        scene.arm_of("hp3_stereo"),
        3,
        half_turns=3,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert len(plan.half_turns) == 3
    assert len(plan.stations) == 12
    done, totals = np.array(seen).T
    assert (np.diff(done) > 0).all()
    assert set(totals) == {done[-1]}


def test_one_half_turn_is_refused():
    with pytest.raises(InputError, match="half_turns must be at least 2, got 1"):
        plan_motions(scene.cell_of("hp3_stereo"), scene.arm_of("hp3_stereo"), 0, 1)


def looking(direction):
    cameras = scene.cell_of("hp3_stereo").model_dump()["cameras"]
    return [{**c, "look_at_m": direction} for c in cameras]


def moved(metres):
    """Workspace and cameras moved along x."""
    plan = scene.cell_of("hp3_stereo").model_dump()["plan"]
    cameras = scene.cell_of("hp3_stereo").model_dump()["cameras"]

    def shift(p):
        return (p[0] + metres, *p[1:])

    return {
        "plan": {k: shift(plan[k]) for k in ("workspace_min_m", "workspace_max_m")},
        "cameras": [
            {
                **c,
                "position_m": shift(c["position_m"]),
                "look_at_m": shift(c["look_at_m"]),
            }
            for c in cameras
        ],
    }


WALL = {"name": "wall", "size_mm": (10, 1000, 1000), "position_m": (0.9, 0, 0.5)}
IMPOSSIBLE = {
    "image": ({"cameras": looking((3.0, 0.0, 0.4))}, "turn the cameras"),
    "reach": (moved(1.0), "nearer to the robot"),
    "tilt": ({"plan": {"max_tilt_deg": 4}}, "raise plan.max_tilt_deg"),
    "occlusion": ({"surroundings": [WALL]}, "uncover the markers"),
    "plane_spread": (
        {"plan": {"max_tilt_deg": 20, "min_plane_spread_deg": 60}},
        "lower plan.min_plane_spread_deg",
    ),
}


@pytest.mark.parametrize("check", IMPOSSIBLE)
def test_an_impossible_cell_names_the_check_and_what_to_do(check):
    sections, remedy = IMPOSSIBLE[check]
    cell = scene.changed("hp3_stereo", **sections)
    arm = Arm(scene.compiled(cell))
    start = time.process_time()
    with pytest.raises(NoPlanError, match=remedy) as caught:
        plan_motions(cell, arm, 1)
    assert time.process_time() - start < 20
    assert caught.value.rejected[check] > 0
    assert f"Most in the way is {check}" in str(caught.value)
    assert f" {caught.value.rejected[check]}" in str(caught.value)


def test_a_seven_joint_arm_whose_flange_leans_is_planned_for(tmp_path):
    """A roll in the lower arm, and a flange axis that is not the last joint's."""
    model = scene.seven_joints(tmp_path)
    cell = scene.cell_of("hp3_stereo")
    arm = Arm(compile_mechanism(cell, model))
    assert len(arm.joint_names) == 7
    plan = plan_motions(cell, arm, 1, half_turns=3)
    joints = np.array([s.joints for s in plan.stations])
    assert ((joints >= arm.lower) & (joints <= arm.upper)).all()
    poses = np.array([s.base_from_flange.matrix for s in plan.stations])
    np.testing.assert_allclose(arm.forward(joints), poses, atol=1e-9)
    for turn in plan.half_turns:
        before, after = turn.before, turn.after
        np.testing.assert_allclose(poses[before] @ HALF_TURN, poses[after], atol=1e-9)
        # The last joint alone cannot do it: the others move as well.
        assert np.abs(joints[after, :-1] - joints[before, :-1]).max() > 0.01
    executed = arm.forward(execute(arm, plan, cell.repeatability, 1))
    missed = np.linalg.norm(executed[:, :3, 3] - poses[:, :3, 3], axis=1)
    assert 0 < missed.max() < 6 * cell.repeatability.translation
    points = [arm.home]
    for station, via in zip(plan.stations, plan.via, strict=True):
        points += [*via, station.joints]
    for a, b in pairwise(points):
        assert arm.path_collision(a, b) is None


def test_what_is_planned_next_adds_most_to_what_was_seen():
    """Two more half-turns after three: better than two of the same plan."""
    cell, arm = scene.cell_of("hp3_stereo"), scene.arm_of("hp3_stereo")
    plan = scene.plan_of("hp3_stereo")
    joints, poses, turns = scene.calibration_of(plan)
    joints, poses = joints[turns.ravel()], poses[turns.ravel()]
    visited = Visited(
        poses[:6],
        np.ones((6, 2), dtype=bool),
        np.zeros(6, dtype=int),
        np.arange(6).reshape(-1, 2),
        joints[5],
    )
    more = plan_next(cell, arm, visited, 1, 2)
    assert [s.kind for s in more.stations] == ["calibration"] * 4
    pairs = [(t.before, t.after) for t in more.half_turns]
    assert sorted(np.ravel(pairs)) == [0, 1, 2, 3]
    assert more.outcome == "PASS", more.findings
    least = cell.plan.min_plane_spread_deg
    assert more.certificate["plane_spread_deg"] >= least
    model = StationInformation(
        cell, arm.base_from_world.matrix, cell.repeatability, 0.03
    )
    both, turns = np.ones((10, 2), dtype=bool), np.arange(10).reshape(-1, 2)
    usual = certify(cell, model, poses[:10], both, np.zeros(10, int), turns).numbers
    name = "track_calibration_rms_mm"
    assert more.certificate[name] < usual[name]
    assert more.certificate[name] > scene.plan_of("hp3_stereo").certificate[name]
    before = joints[5]
    for station, via in zip(more.stations, more.via, strict=True):
        for a, b in pairwise([before, *via, station.joints]):
            assert arm.path_collision(a, b) is None
        before = station.joints


def test_no_half_turn_more_is_refused():
    cell, arm = scene.cell_of("hp3_stereo"), scene.arm_of("hp3_stereo")
    visited = Visited(
        np.eye(4)[None],
        np.ones((1, 2), bool),
        np.zeros(1, dtype=int),
        np.zeros((0, 2), dtype=int),
        arm.home,
    )
    with pytest.raises(InputError, match="half_turns must be at least 1, got 0"):
        plan_next(cell, arm, visited, 1, 0)


def ring(count):
    """Cameras on an arc about the workspace, copies of the left one."""
    data = scene.cell_of("hp3_stereo").model_dump(by_alias=True)["cameras"][0]
    cameras = []
    for k, angle in enumerate(np.radians(np.linspace(-75, 75, count))):
        place = (0.45 + 0.9 * np.cos(angle), 0.9 * np.sin(angle), 0.45)
        cameras.append({**data, "name": f"c{k}", "position_m": place})
    return scene.changed("hp3_stereo", cameras=cameras)


def test_many_cameras_round_the_arm_are_all_determined_and_joined():
    """No station is seen by all of seven cameras, yet each is tied to each."""
    cell = ring(7)
    arm = Arm(scene.compiled(cell))
    plan = plan_motions(cell, arm, 1)
    assert plan.outcome == "PASS", plan.findings
    assert plan.certificate["rank"] == plan.certificate["unknowns"]
    view = View(cell)
    world = arm.base_from_world.inverse().matrix @ np.array(
        [s.base_from_flange.matrix for s in plan.stations]
    )
    seen = view.seen(world)
    assert (seen.sum(axis=1) >= 2).all()
    assert not seen.all(axis=1).any()
    used = [s.index for s in plan.stations if s.kind == "calibration"]
    assert (seen[used].sum(axis=0) >= 4).all()
    for camera in cell.cameras:
        assert plan.certificate[f"sigma.{camera.name}.fx_px"] < 10
