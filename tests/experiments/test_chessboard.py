import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import block_diag

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera, StereoRig
from handeye_tri.errors import InputError
from handeye_tri.experiments import fig09, table1
from handeye_tri.experiments.chessboard import (
    Board,
    BoardViews,
    board_half_turns,
    read_board_views,
    zhang,
    zhang_pair,
)
from handeye_tri.experiments.outcome import Options
from handeye_tri.experiments.real_views import (
    RealStereo,
    calibrate_side,
    calibrate_views,
)
from handeye_tri.experiments.rendered import RenderedStereo
from handeye_tri.records import Covariance
from handeye_tri.se3 import SE3, so3_exp
from handeye_tri.storage import write_image

BOARD = Board()
REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "opencv_stereo13"
needs_real = pytest.mark.skipif(
    not REAL.is_dir(), reason="the real chessboard views are not on this machine"
)
SIZE = (640, 480)
LENS = Lens("radtan", np.array([-0.28, 0.1, 0.001, -0.0005, 0.0]))
PAIR = (
    PinholeCamera("left", Intrinsics(533.0, 532.0, 0.0, 341.0, 234.0), SIZE, LENS),
    PinholeCamera("right", Intrinsics(537.0, 536.0, 0.0, 327.0, 248.0), SIZE, LENS),
)
LEFT_FROM_RIGHT = SE3.from_parts(so3_exp([0.01, -0.03, 0.005]), [0.1, 0.002, 0.001])


def poses(count, seed=1):
    """left_from_board: tilted every way, in view of both cameras."""
    rng = np.random.default_rng(seed)
    middle = BOARD.points.mean(axis=0)
    result = []
    for i in range(count):
        lean = 0.5 * np.array([np.cos(2.4 * i), np.sin(2.4 * i), 0.0])
        rotation = so3_exp(lean) @ so3_exp([0, 0, rng.uniform(-0.3, 0.3)])
        place = np.array([*rng.uniform(-0.03, 0.03, 2), rng.uniform(0.4, 0.5)])
        place[0] += 0.05
        result.append(SE3.from_parts(rotation, place - rotation @ middle))
    return result


def simulated(count=8, noise=0.0, pair=PAIR):
    rng = np.random.default_rng(2)
    corners = np.array(
        [
            [
                camera.project(reference.inverse().apply(pose.apply(BOARD.points)))
                for pose in poses(count)
            ]
            for camera, reference in zip(
                pair, (SE3.identity(), LEFT_FROM_RIGHT), strict=True
            )
        ]
    )
    corners += noise * rng.standard_normal(corners.shape)
    return BoardViews(BOARD, tuple(map(str, range(count))), SIZE, corners)


def picture(camera, camera_from_board, samples=2):
    """A chessboard as the camera sees it, each pixel the mean of samples^2."""
    width, height = camera.image_size
    offset = (np.arange(samples) + 0.5) / samples - 0.5
    u = (np.arange(width)[:, None] + offset).ravel()
    v = (np.arange(height)[:, None] + offset).ravel()
    rays = camera.normalised(np.stack(np.meshgrid(u, v), axis=-1))
    rays = np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], axis=-1)
    rotation, origin = camera_from_board.rotation, camera_from_board.translation
    depth = (rotation[:, 2] @ origin) / (rays @ rotation[:, 2])
    squares = (depth[..., None] * rays - origin) @ rotation[:, :2] / BOARD.square
    index = np.floor(squares).astype(int) + 1
    inside = ((index >= 0) & (index <= (BOARD.columns, BOARD.rows))).all(axis=-1)
    black = inside & (index.sum(axis=-1) % 2 == 0)
    fine = np.where(black, 30.0, 220.0)
    coarse = fine.reshape(height, samples, width, samples).mean(axis=(1, 3))
    return coarse.round().astype(np.uint8)


def test_half_turns_of_the_board_are_half_turns():
    triangle, before, after = board_half_turns(BOARD, 5, 3)
    places = (BOARD.columns - 5) * (BOARD.rows - 3)
    assert before.shape == after.shape == (places**2, 3)
    assert len({tuple(row) for row in np.hstack([before, after])}) == places**2
    p, q = BOARD.points[before], BOARD.points[after]
    # One midpoint for A, B and C: the axis. And p is the triangle, not its mirror.
    middle = 0.5 * (p + q)
    assert np.abs(middle - middle[:, :1]).max() < 1e-15
    assert np.abs(p - p[:, :1] - triangle.points).max() < 1e-15


def test_exact_corners_give_the_exact_cameras():
    views = simulated()
    found = [calibrate_side(views, side) for side in range(2)]
    for calibration, camera in zip(found, PAIR, strict=True):
        error = calibration.camera.intrinsics.vector - camera.intrinsics.vector
        assert np.abs(error).max() < 1e-5
        lens = calibration.camera.lens.coefficients
        assert lens == pytest.approx(LENS.coefficients, abs=1e-6)
    rig = RealStereo(views, tuple(found), 144).rig
    assert np.abs(rig.left_from_right.matrix - LEFT_FROM_RIGHT.matrix).max() < 1e-8
    points = fig09.reconstruct(rig, views)
    for view, pose in zip(points, poses(8), strict=True):
        assert np.abs(view - pose.apply(BOARD.points)).max() < 1e-7
        assert fig09.off_plane(view) < 1e-7
        assert fig09.adjacent(view, BOARD) == pytest.approx(0.03, abs=1e-8)


def test_zhang_is_the_same_on_exact_corners():
    """OpenCV takes corners as float32, good to 3e-5 px."""
    views = simulated()
    rig = zhang_pair(views)
    for found, camera in zip((rig.left, rig.right), PAIR, strict=True):
        error = found.intrinsics.vector - camera.intrinsics.vector
        assert np.abs(error).max() < 1e-2
    error = rig.left_from_right.matrix - LEFT_FROM_RIGHT.matrix
    assert np.abs(error).max() < 1e-5


def test_a_view_left_out_is_not_used():
    views = simulated()
    spoilt = views.corners.copy()
    spoilt[:, 3] = np.nan
    without = calibrate_side(views, 0, 3).camera.intrinsics.vector
    nan = BoardViews(BOARD, views.names, SIZE, spoilt)
    assert calibrate_side(nan, 0).camera.intrinsics.vector == pytest.approx(without)


def test_leaving_out_counts_left_then_right():
    task = table1.LeaveOut(simulated(4, noise=0.1))
    left, right = (task(seed)["values"] for seed in (1, 5))
    assert left == table1._values(calibrate_side(task.views, 0, 1).camera)
    assert right == table1._values(calibrate_side(task.views, 1, 1).camera)


def test_corners_of_drawn_boards_are_found(tmp_path):
    inner = tmp_path / "images"
    count = 3
    pair = [replace(camera, lens=Lens()) for camera in PAIR]
    for i, pose in enumerate(poses(count)):
        for side, (camera, reference) in enumerate(
            zip(pair, (SE3.identity(), LEFT_FROM_RIGHT), strict=True)
        ):
            name = f"{('left', 'right')[side]}{i:02d}.png"
            write_image(inner / name, picture(camera, reference.inverse() @ pose))
    # No pair; no name of ours.
    shutil.copy(inner / "left00.png", inner / "left77.png")
    (inner / "notes.txt").write_text("nothing")
    views = read_board_views(tmp_path, BOARD)
    assert views.names == ("00", "01", "02")
    assert views.image_size == SIZE
    exact = simulated(count, pair=pair).corners
    # The detector may count from either end of the board; four samples a pixel leave
    # stairs on the edges of the squares.
    for found, true in zip(
        views.corners.reshape(-1, 54, 2), exact.reshape(-1, 54, 2), strict=True
    ):
        off = min(found - true, found[::-1] - true, key=lambda d: np.abs(d).max())
        assert np.sqrt((off**2).mean()) < 0.2
        assert np.abs(off).max() < 0.5


@pytest.mark.parametrize("make", [False, True])
def test_a_folder_without_views_is_named(tmp_path, make):
    folder = tmp_path / "absent"
    if make:
        folder.mkdir()
    with pytest.raises(InputError, match=r"absent: 0 pairs .* at least 3"):
        read_board_views(folder, BOARD)


@pytest.fixture
def no_rendering(monkeypatch):
    """Table I and Fig. 9 of a pair that was not rendered but projected."""
    views = simulated(noise=0.002)
    found = [calibrate_side(views, side) for side in range(2)]
    cameras = tuple(one.camera for one in found)
    both = replace(
        found[0],
        cameras=cameras,
        reference_from_camera=(SE3.identity(), LEFT_FROM_RIGHT),
        residuals=np.concatenate([one.residuals for one in found]),
        covariance=Covariance(
            tuple(label for one in found for label in one.covariance.labels),
            # Corners take part in many half-turns, which are not independent.
            100 * block_diag(*(one.covariance.matrix for one in found)),
        ),
    )
    rendered = RenderedStereo(both, 144, StereoRig(*PAIR, LEFT_FROM_RIGHT))
    for module in (table1, fig09):
        monkeypatch.setattr(module, "calibrate_rendered", lambda *_: rendered)
        monkeypatch.setattr(module, "rendered_board_views", lambda *_: views)
    monkeypatch.setattr(table1, "zhang", lambda views, side, **_: zhang(views, side))
    monkeypatch.setattr(fig09, "zhang_pair", lambda views, **_: zhang_pair(views))
    return rendered


def test_without_real_views_the_clock_is_judged(tmp_path, no_rendering):
    outcome = table1.run(Options(tmp_path))
    assert outcome.verdict == "PASS"
    assert "no real views" in outcome.sentence
    lines = outcome.files[0].read_text().splitlines()
    assert len(lines) == 1 + 2 * 5
    assert lines[1].startswith("clock,left,fu,533.0,")
    outcome = fig09.run(Options(tmp_path))
    assert outcome.verdict == "PASS"
    assert "rendered clock: 744 adjacent corners" in outcome.sentence


@pytest.mark.parametrize(("factor", "passed"), [(1.002, False), (1.0, True)])
def test_the_clock_fails_where_its_camera_is_off(
    tmp_path, no_rendering, monkeypatch, factor, passed
):
    """0.2 % is within the tolerance, and far outside the stated sigmas."""
    true = no_rendering.true
    k = true.left.intrinsics
    left = replace(true.left, intrinsics=replace(k, fx=factor * k.fx))
    wrong = replace(no_rendering, true=replace(true, left=left))
    monkeypatch.setattr(table1, "calibrate_rendered", lambda *_: wrong)
    assert (table1.run(Options(tmp_path)).verdict == "PASS") == passed


@pytest.fixture(scope="module")
def real():
    return calibrate_views(REAL)


@needs_real
def test_real_views_give_zhangs_cameras(real):
    assert len(real.views.names) == 13
    for side, camera in enumerate(real.cameras):
        other = zhang(real.views, side).intrinsics
        ours = camera.intrinsics
        assert ours.fx == pytest.approx(other.fx, rel=3e-3)
        assert ours.fy == pytest.approx(other.fy, rel=3e-3)
        assert ours.cx == pytest.approx(other.cx, abs=3)
        assert ours.cy == pytest.approx(other.cy, abs=3)


@needs_real
def test_real_corners_are_where_they_belong(real, tmp_path, monkeypatch, no_rendering):
    monkeypatch.setattr(fig09, "calibrate_views", lambda images: real)
    outcome = fig09.run(Options(tmp_path, images=REAL))
    assert outcome.verdict == "PASS"
    assert all(path.stat().st_size > 0 for path in outcome.files)
    points = fig09.reconstruct(real.rig, real.views)
    distance = 1e3 * np.array([fig09.adjacent(view, BOARD) for view in points])
    assert distance.size == 13 * 93
    assert distance.mean() == pytest.approx(30, abs=0.05)


@needs_real
def test_table_1_of_a_few_real_views(tmp_path, no_rendering):
    folder = tmp_path / "views"
    folder.mkdir()
    for number in ("01", "04", "05", "06", "08"):
        for side in ("left", "right"):
            shutil.copy(REAL / "images" / f"{side}{number}.jpg", folder)
    outcome = table1.run(Options(tmp_path / "out", images=folder))
    assert "720 half-turns in 5 pairs" in outcome.sentence
    lines = outcome.files[0].read_text().splitlines()
    assert len(lines) == 1 + 2 * 5 + 2 * 10
    assert lines[0].startswith("views,camera,quantity,truth,three_points,sigma,zhang")
    assert lines[-1].startswith("boards,right,k3,,")
    assert len((tmp_path / "out" / "table1.jsonl").read_text().splitlines()) == 1 + 10
