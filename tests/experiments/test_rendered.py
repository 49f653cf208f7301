"""What is photographed: the model plane, the cup, and what is made of them."""

from dataclasses import replace

import numpy as np
import pytest
from rerun.chunk import RrdReader

from handeye_tri.camera import StereoRig
from handeye_tri.experiments import fig10
from handeye_tri.experiments.chessboard import Board
from handeye_tri.experiments.outcome import Options
from handeye_tri.experiments.props import Cup, block_solids, board_solids
from handeye_tri.experiments.rendered import (
    BOARD_POSES,
    BoardView,
    RenderedStereo,
    board_pose,
)
from handeye_tri.mechanism import Geometry
from handeye_tri.storage import find_cell, read_cell


def pair_of(name):
    left, right = read_cell(find_cell(name)).cameras
    return StereoRig(
        left.camera,
        right.camera,
        left.world_from_camera.inverse() @ right.world_from_camera,
    )


def normals(solid: Geometry):
    a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def test_the_inner_corners_of_a_board_lie_between_its_squares():
    board = Board()
    black, white = board_solids(board)
    assert len(black.faces) == 2 * 35
    assert len(black.faces) + len(white.faces) == 2 * 12 * 9
    for solid in (black, white):
        assert (normals(solid)[:, 2] < 0).all()
    # At each inner corner two black squares meet, and two white ones.
    for point in board.points:
        for solid in (black, white):
            assert (np.abs(solid.vertices - point).max(axis=1) < 1e-12).sum() == 2


def test_a_cups_print_changes_at_every_corner():
    cup = Cup()
    dark = cup.inks < 2
    assert (dark != np.roll(dark, 1, axis=1)).all()
    assert (dark[1:] != dark[:-1]).all()
    assert len(np.unique(cup.inks)) == 4
    radii = np.linalg.norm(cup.corners[..., :2], axis=-1)
    assert radii == pytest.approx(cup.radius)
    for solid in cup.solids[:4]:
        middle = solid.vertices[solid.faces].mean(axis=1)
        assert ((normals(solid) * middle)[:, :2].sum(axis=1) > 0).all()


def test_a_block_ends_where_it_should():
    (block,) = block_solids((0.1, 0.2, 0.3))
    assert np.ptp(block.vertices, axis=0) == pytest.approx([0.1, 0.2, 0.3])
    assert block.vertices[:, 2].max() == 0


def test_the_model_plane_is_held_in_view_and_tilted():
    cell = read_cell(find_cell("clock_dial"))
    points = Board().points
    tilts = []
    for number in range(BOARD_POSES):
        pose = board_pose(cell.cameras[0].world_from_camera, number)
        for config in cell.cameras:
            local = config.world_from_camera.inverse() @ pose
            seen = config.camera.project(local.apply(points))
            assert (seen > 20).all()
            assert (seen < np.array(config.image_size_px) - 21).all()
        tilts.append(np.degrees(np.arccos(local.rotation[2, 2])))
    assert max(tilts) > 35


def test_a_photographed_board_has_its_corners_where_it_is():
    found = BoardView("clock_dial")(4)["corners"]
    cell = read_cell(find_cell("clock_dial"))
    pose = board_pose(cell.cameras[0].world_from_camera, 4)
    for config, corners in zip(cell.cameras, found, strict=True):
        local = config.world_from_camera.inverse() @ pose
        exact = config.camera.project(local.apply(Board().points))
        off = np.array(corners) - exact
        assert np.sqrt((off**2).mean()) < 0.15
        assert np.abs(off.mean(axis=0)).max() < 0.05


@pytest.fixture(scope="module")
def pictures():
    return fig10.take_pictures()


def test_a_cup_is_reconstructed_and_recorded(pictures, tmp_path, monkeypatch):
    rig = pair_of(fig10.CELL)

    class Found:
        cameras = (rig.left, rig.right)
        reference_from_camera = (None, rig.left_from_right)

    rendered = RenderedStereo(Found(), 11, rig)
    monkeypatch.setattr(fig10, "calibrate_rendered", lambda *_: rendered)
    monkeypatch.setattr(fig10, "take_pictures", lambda: pictures)
    outcome = fig10.run(Options(tmp_path))
    assert outcome.verdict == "PASS"
    assert "0 wrong pairs" in outcome.sentence
    assert [path.name for path in outcome.files][-1] == "fig10.rrd"
    table = np.genfromtxt(outcome.files[0], delimiter=",", names=True)
    assert len(table) >= 30
    assert np.sqrt((table["error_mm"] ** 2).mean()) < 0.6
    paths = {
        chunk.entity_path for chunk in RrdReader(outcome.files[-1]).stream().to_chunks()
    }
    for path in (
        "cup/true/handle",
        "cup/reconstructed/surface",
        "images/right/corners",
    ):
        assert f"/{path}" in paths


def test_a_wrong_focal_length_shows_in_the_cup(pictures):
    rig = pair_of(fig10.CELL)
    k = rig.left.intrinsics
    left = replace(rig.left, intrinsics=replace(k, fx=1.01 * k.fx, fy=1.01 * k.fy))
    empty, images = pictures
    masks = [fig10.cup_mask(*pair) for pair in zip(empty, images, strict=True)]
    _, true = fig10.truth()
    wrong = StereoRig(left, rig.right, rig.left_from_right)
    found = [fig10.reconstruct(one, images, masks).points for one in (rig, wrong)]
    good, bad = (np.sqrt((fig10.errors_mm(p, true) ** 2).mean()) for p in found)
    assert good < fig10._RMS_MM
    assert bad > fig10._RMS_MM
