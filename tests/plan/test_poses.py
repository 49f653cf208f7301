from __future__ import annotations

import numpy as np
import planning_scene as scene
import pytest

from handeye_tri.plan.poses import HALF_TURN, View, plane_angles
from handeye_tri.se3 import so3_exp


@pytest.fixture(params=scene.CELLS)
def view(request):
    return View(scene.cell_of(request.param))


def sphere_pixels(view, camera, poses, points=400):
    """Pixels of points all over every marker, shape (n, 3, points, 2)."""
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(points, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    centres = view.marker_positions(poses)
    solid = centres[:, :, None] + view.radii[:, None, None] * ball
    pose = view.world_from_camera[camera]
    return view.cameras[camera].project((solid - pose[:3, 3]) @ pose[:3, :3])


def test_draws_are_rigid_poses_in_the_box(view):
    poses = view.draw(np.random.default_rng(1), 300)
    r = poses[:, :3, :3]
    np.testing.assert_allclose(r.swapaxes(1, 2) @ r, np.tile(np.eye(3), (300, 1, 1)),
                               atol=1e-14)  # fmt: skip
    np.testing.assert_allclose(np.linalg.det(r), 1.0)
    # The middle of the markers' positions before and after the turn is in the box.
    centre = 0.5 * sum(
        view.marker_positions(p).mean(axis=1) for p in (poses, poses @ HALF_TURN)
    )
    plan = view.cell.plan
    assert (centre >= np.array(plan.workspace_min_m) - 1e-12).all()
    assert (centre <= np.array(plan.workspace_max_m) + 1e-12).all()
    assert np.ptp(centre, axis=0) == pytest.approx(
        np.subtract(plan.workspace_max_m, plan.workspace_min_m), rel=0.1
    )


def test_draws_tilt_to_every_side(view):
    poses = view.draw(np.random.default_rng(1), 400)
    normals = view.normals(poses)
    if view.cell.rig.axis != "normal":
        normals *= np.sign(normals[:, :1])
    # Cameras look along -x: the normals lean to all four sides of +x.
    for axis in (1, 2):
        assert (normals[:, axis] > 0.3).mean() > 0.1
        assert (normals[:, axis] < -0.3).mean() > 0.1


def test_in_image_means_that_whole_markers_are_inside(view):
    poses = view.draw(np.random.default_rng(2), 300)
    accepted = view.in_image(poses).all(axis=1)
    margin = view.cell.plan.image_margin_px
    for camera in range(len(view.cameras)):
        size = np.array(view.cameras[camera].image_size)
        pixels = sphere_pixels(view, camera, poses[accepted])
        assert (pixels >= margin - 0.05).all()
        assert (pixels <= size - 1 - margin + 0.05).all()
    # And it refuses nothing that is clearly inside.
    clear = np.ones(len(poses), dtype=bool)
    for camera in range(len(view.cameras)):
        size = np.array(view.cameras[camera].image_size)
        pixels = sphere_pixels(view, camera, poses)
        inside = (pixels >= margin + 1) & (pixels <= size - 2 - margin)
        clear &= inside.all(axis=(1, 2, 3))
    assert 0.2 < accepted.mean() < 1.0
    assert (accepted | ~clear).all()


def test_what_is_behind_a_camera_is_not_in_its_image():
    view = View(scene.cell_of("hp3_stereo"))
    pose = view.draw(np.random.default_rng(0), 50)
    assert view.in_image(pose).all(axis=1).any()
    mirrored = pose.copy()
    mirrored[:, 0, 3] += 2.5
    assert not view.in_image(mirrored).any()


def test_a_lens_that_folds_the_image_does_not_fool_the_check():
    """Points far outside, which k1 < 0 maps back into the image, are refused."""
    folding = {"model": "radtan", "coefficients": {"k1": -3.0}}
    data = scene.cell_of("hp3_stereo").model_dump(by_alias=True)["cameras"]
    view = View(
        scene.changed("hp3_stereo", cameras=[{**c, "lens": folding} for c in data])
    )
    pose = np.eye(4)[None].copy()
    pose[:, :3, 3] = view.world_from_camera[0][:3] @ (0.55, 0.0, 1.0, 1.0)
    fold = view.cameras[0].project([[0.55, 0.0, 1.0]])[0]
    assert 100 < fold[0] < 900
    assert not view.in_image(pose)[0, 0]


def test_tilts_are_the_angles_to_the_lines_of_sight(view):
    """A rig that faces a camera, then leans by a known angle."""
    camera = view.world_from_camera[0]
    own = view.flange_from_triangle.rotation[:, 2]
    for lean in np.radians([0.0, 25.0, 70.0]):
        # Rotate the normal onto the camera's backward axis, then lean about its x.
        back = -camera[:3, 2]
        axis = np.cross(own, back)
        sine = np.linalg.norm(axis)
        turn = so3_exp(axis / sine * np.arctan2(sine, own @ back))
        turn = so3_exp(lean * camera[:3, 0]) @ turn
        pose = np.eye(4)[None].copy()
        pose[0, :3, :3] = turn
        on_axis = camera[:3, 3] + 0.9 * camera[:3, 2]
        pose[0, :3, 3] = on_axis - turn @ view.markers.mean(axis=0)
        assert view.tilts(pose)[0, 0] == pytest.approx(lean, abs=1e-7)
        turned = np.pi - lean if view.cell.rig.axis == "normal" else lean
        pose[0, :3, :3] = so3_exp(np.pi * camera[:3, 0]) @ turn
        pose[0, :3, 3] = on_axis - pose[0, :3, :3] @ view.markers.mean(axis=0)
        assert view.tilts(pose)[0, 0] == pytest.approx(turned, abs=1e-7)


def test_plane_angles_are_acute_and_exact_near_zero():
    x, y, z = np.eye(3)
    assert plane_angles(x, -x) == 0
    assert plane_angles(x, y) == pytest.approx(np.pi / 2)
    tiny = 1e-9
    assert plane_angles(x, np.cos(tiny) * x + np.sin(tiny) * z) == pytest.approx(tiny)
    steep = np.cos(2.0) * x + np.sin(2.0) * y
    assert plane_angles(x, steep) == pytest.approx(np.pi - 2.0)
