"""Compiling any arm, and rendering where the analytic projection says."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from handeye_tri.arm import Arm
from handeye_tri.camera import PinholeCamera
from handeye_tri.config import Cell, parse_cell
from handeye_tri.errors import InputError, MissingDependencyError
from handeye_tri.imaging import Image
from handeye_tri.records import Plan, Repeatability, Station
from handeye_tri.se3 import SE3, se3_inverse, se3_log
from handeye_tri.simulate import (
    check_rendering,
    compile_mechanism,
    execute,
    ground_truth,
    render_views,
)
from handeye_tri.storage.cells import read_cell

REPO = Path(__file__).resolve().parent.parent
DATA = Path(__file__).resolve().parent / "data"
HP3 = REPO / "robot_models" / "hp3_like.xml"


def shipped(name: str) -> Cell:
    return read_cell(REPO / "scenes" / f"{name}.yaml")


def small_cell(**changes: object) -> Cell:
    """A gantry that carries a small triangle before two unlike small cameras.

    Off-centre principal points and fx != fy: a wrong sign or a half pixel shows.
    """
    eye = {
        "image_size_px": [360, 280],
        "focal_px": [700.0, 660.0],
        "principal_point_px": [205.3, 118.6],
        "position_m": [0.0, 0.0, 0.0],
        "look_at_m": [1.0, 0.0, 0.0],
    }
    data: dict[str, object] = {
        "schema": "handeye_tri.cell/1",
        "name": "small",
        "arm": {"model": "gantry.xml", "flange": "flange"},
        "rig": {
            "axis": "normal",
            "side_ab_mm": 90,
            "side_ac_mm": 85,
            "angle_deg": 62,
            "ahead_mm": 80,
            "marker_radii_mm": [8, 8, 8],
            "marker_colours": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
            "identity": "colour",
        },
        "cameras": [
            {"name": "one", **eye},
            {
                **eye,
                "name": "two",
                "focal_px": [690.0, 720.0],
                "principal_point_px": [150.2, 171.9],
                "position_m": [0.05, 0.2, 0.1],
                "roll_deg": 100,
            },
        ],
        "plan": {"workspace_min_m": [0, 0, 0], "workspace_max_m": [1, 1, 1]},
    }
    return parse_cell({**data, **changes}, "small cell")


def facing(cell: Cell, count: int) -> np.ndarray:
    """Gantry joints, shape (count, 6), that show all markers to every camera."""
    arm = Arm(compile_mechanism(cell, DATA / "gantry.xml"))
    rng = np.random.default_rng(3)
    found: list[np.ndarray] = []
    while len(found) < count:
        place = rng.uniform((0.6, -0.3, -0.3), (1.1, 0.3, 0.3))
        # The flange looks back at the cameras, tilted.
        turn = rng.uniform(-0.5, 0.5, 3) + (0.0, -np.pi / 2, 0.0)
        joints = np.concatenate([place, turn])
        markers = arm.base_from_world.inverse().apply(arm.marker_positions(joints))
        if all(
            (
                np.abs(
                    config.camera.project(
                        config.world_from_camera.inverse().apply(markers)
                    )
                    - 0.5 * np.array(config.image_size_px)
                )
                < 0.5 * np.array(config.image_size_px) - 14
            ).all()
            for config in cell.cameras
        ):
            found.append(joints)
    return np.array(found)


def outline_centre(
    camera: PinholeCamera, centre: np.ndarray, radius: float
) -> np.ndarray:
    """Centroid of the area that a sphere covers in the image, exactly.

    The cone of tangents touches the sphere in a circle; its image is a polygon of
    2000 corners here, whose centroid is that of the shoelace formula.
    """
    distance = np.linalg.norm(centre)
    sine = radius / distance
    axes = np.linalg.svd(centre[None])[2][1:]
    angle = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    circle = centre * (1 - sine**2) + radius * np.sqrt(1 - sine**2) * (
        np.cos(angle)[:, None] * axes[0] + np.sin(angle)[:, None] * axes[1]
    )
    p = camera.project(circle)
    middle = p.mean(axis=0)
    p = p - middle
    q = np.roll(p, -1, axis=0)
    cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    return np.asarray(
        middle + ((p + q) * cross[:, None]).sum(axis=0) / (3 * cross.sum())
    )


def own_colour_centroid(image: Image, channel: int, near: np.ndarray) -> np.ndarray:
    """Centroid of how much one channel exceeds the others: grey counts nothing."""
    u, v = (int(round(x)) for x in near)
    top, left = max(v - 16, 0), max(u - 16, 0)
    part = image[top : v + 17, left : u + 17].astype(float)
    others = np.delete(part, channel, axis=2).max(axis=2)
    weight = np.clip(part[..., channel] - others, 0, None)
    rows, columns = np.indices(weight.shape)
    return np.array(
        [
            left + (weight * columns).sum() / weight.sum(),
            top + (weight * rows).sum() / weight.sum(),
        ]
    )


LENS = {"model": "radtan", "coefficients": {"k1": -0.2, "k2": 0.1, "p1": 8e-4}}


@pytest.mark.parametrize("distorted", [False, True], ids=["pinhole", "lens and skew"])
def test_pixels_are_where_the_projection_says(distorted: bool) -> None:
    """Bias far below 0.02 px, with off-centre principal points and fx != fy."""
    cell = small_cell()
    if distorted:
        cameras = [
            {**c.model_dump(), "lens": LENS, "skew_px": 2.5} for c in cell.cameras
        ]
        cell = small_cell(cameras=cameras)
    joints = facing(cell, 14)
    model = DATA / "gantry.xml"
    arm = Arm(compile_mechanism(cell, model))
    world = arm.base_from_world.inverse().apply(arm.marker_positions(joints))
    errors, shifts = [], []
    views = [(i, j) for j in range(len(joints)) for i in range(2)]
    for i, j, image in render_views(cell, model, joints, 0, views):
        config = cell.cameras[i]
        points = config.world_from_camera.inverse().apply(world[j])
        for k, point in enumerate(points):
            expected = outline_centre(config.camera, point, 0.008)
            found = own_colour_centroid(image, k, expected)
            errors.append(found - expected)
            shifts.append(config.camera.project(point) - expected)
            if not distorted:
                # The ellipse's centre in closed form, (X, Y) Z / (Z^2 - r^2); the
                # polygon of 2000 corners differs by 1e-6 of the radius.
                factor = point[2] / (point[2] ** 2 - 0.008**2)
                ellipse = config.camera.pixels(point[:2] * factor)
                np.testing.assert_allclose(ellipse, expected, atol=1e-5)
    error = np.array(errors)
    assert len(error) == 84
    # One 2x supersampled sphere of 5 px radius misses by 0.02-0.03 px at random.
    assert np.abs(error.mean(axis=0)).max() < 0.01
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.03
    assert np.abs(error).max() < 0.1
    assert np.abs(shifts).max() > 0.001


def test_views_do_not_depend_on_order_or_company() -> None:
    imaging = {"noise_percent": 2, "blur_px": 0.8}
    cell = small_cell(imaging=imaging)
    model = DATA / "gantry.xml"
    joints = facing(cell, 3)
    views = [(1, 2), (0, 0), (1, 0)]
    all_views = {
        (i, j): image for i, j, image in render_views(cell, model, joints, 4, views)
    }
    assert list(all_views) == views
    ((i, j, alone),) = render_views(cell, model, joints, 4, [(1, 0)])
    assert (i, j) == (1, 0)
    np.testing.assert_array_equal(alone, all_views[1, 0])
    ((_, _, other),) = render_views(cell, model, joints, 5, [(1, 0)])
    difference = other.astype(float) - alone
    # Same picture, other noise: sqrt(2) of 2 % of full scale.
    assert abs(difference.mean()) < 0.1
    assert difference.std() == pytest.approx(np.sqrt(2) * 5.1, rel=0.05)


def test_two_renderings_at_once_do_not_mix() -> None:
    cell = small_cell()
    model = DATA / "gantry.xml"
    joints = facing(cell, 2)
    views = [(0, 0), (1, 1)]
    apart = [image for _, _, image in render_views(cell, model, joints, 0, views)]
    first = render_views(cell, model, joints, 0, views)
    second = render_views(cell, model, joints, 0, views[::-1])
    together = [next(first)[2], next(second)[2], next(first)[2], next(second)[2]]
    for image, k in zip(together, (0, 1, 1, 0), strict=True):
        np.testing.assert_array_equal(image, apart[k])
    first.close()
    second.close()


@pytest.mark.parametrize(
    "name", ["hp3_stereo", "hp3_stereo_edge", "hp3_stereo_lens", "hp3_stereo_mono"]
)
def test_the_shipped_cells_show_three_markers_and_a_grey_cell(name: str) -> None:
    cell = shipped(name)
    arm = Arm(compile_mechanism(cell, HP3))
    # The triangle faces the middle of the cameras.
    toward = np.mean([c.position_m for c in cell.cameras], axis=0) - (0.45, 0.0, 0.42)
    toward /= np.linalg.norm(toward)
    side = np.cross((0.0, 0.0, 1.0), toward)
    side /= np.linalg.norm(side)
    up = np.cross(toward, side)
    rotation = np.stack([side, up, toward], axis=1)
    if cell.rig.axis != "normal":
        # Flange down, markers' plane towards the cameras.
        rotation = np.stack([side, toward, -up], axis=1)
    markers = cell.rig.flange_from_triangle.apply(cell.rig.triangle.points)
    centre = np.array([0.45, 0.0, 0.42]) - rotation @ markers.mean(axis=0)
    target = SE3.from_parts(rotation, centre).matrix
    solutions = arm.inverse(target[None], np.random.default_rng(0)).joints[0]
    joints = next(q for q in solutions if arm.collision(q) is None)
    for i, _, image in render_views(cell, HP3, joints[None], 1, [(0, 0), (1, 0)]):
        assert image.shape == (768, 1024) + (() if cell.imaging.grey else (3,))
        config = cell.cameras[i]
        seen = config.camera.project(
            config.world_from_camera.inverse().apply(
                arm.base_from_world.inverse().apply(arm.marker_positions(joints))
            )
        )
        colours = np.array(cell.rig.marker_colours)
        whole = np.ones(image.shape[:2], dtype=bool)
        for (u, v), colour in zip(np.round(seen).astype(int), colours, strict=True):
            expected = 255 * (colour.mean() if cell.imaging.grey else colour)
            patch = image[v - 3 : v + 4, u - 3 : u + 4].astype(float)
            noise = 2.55 * cell.imaging.noise_percent
            assert np.abs(patch.mean(axis=(0, 1)) - expected).max() < 1 + noise
            whole[v - 26 : v + 27, u - 26 : u + 27] = False
        rest = image[whole].astype(float)
        # Neutral grey, and darker than any marker.
        if not cell.imaging.grey:
            assert np.abs(rest.mean(axis=0) - rest.mean()).max() < 0.5
            assert np.ptp(rest, axis=1).mean() <= 10 * cell.imaging.noise_percent
        assert rest.max() < 225
        assert rest.std() > 15


def test_the_hp3_keeps_its_published_reach() -> None:
    arm = Arm(compile_mechanism(shipped("hp3_stereo"), HP3))
    home = np.zeros(6)
    flange = arm.forward(home)
    np.testing.assert_allclose(flange[:3, 3], (0.49, 0.0, 0.675), atol=1e-12)
    np.testing.assert_allclose(flange[:3, 2], (1, 0, 0), atol=1e-12)
    # Stretched out to the wrist: lower arm and the elbow's offset in one line.
    stretched = np.array([0, np.pi / 2, np.arctan2(0.3, 0.085), 0, 0, 0])
    wrist = arm.body_poses(stretched)[arm.mechanism.flange_body - 1]
    reach = 0.1 + 0.29 + np.hypot(0.3, 0.085)
    assert reach == pytest.approx(0.7018, abs=5e-5)
    np.testing.assert_allclose(wrist[:3, 3], (reach, 0, 0.3), atol=1e-12)
    speeds = [joint.speed for joint in arm.mechanism.joints]
    np.testing.assert_allclose(np.degrees(speeds), (200, 150, 190, 300, 300, 420))


def test_the_base_stands_where_the_cell_says() -> None:
    cell = shipped("hp3_stereo")
    moved = cell.model_copy(
        update={"arm": cell.arm.model_copy(update={"position_m": (0.1, 0.2, 0.3)})}
    )
    arm = Arm(compile_mechanism(moved, HP3))
    np.testing.assert_allclose(
        arm.base_from_world.matrix, SE3.exp((-0.1, -0.2, -0.3, 0, 0, 0)).matrix
    )


def test_what_the_cell_adds_is_in_the_mechanism() -> None:
    cell = shipped("hp3_stereo")
    mechanism = compile_mechanism(cell, HP3)
    solids = {solid.name: solid for solid in mechanism.geometries}
    table = solids["cell/table"]
    np.testing.assert_allclose(table.size, (0.9, 0.6, 0.02))
    assert table.collides
    for k, letter in enumerate("ABC"):
        ball = solids[f"rig/marker {letter}"]
        assert ball.body == mechanism.marker_body
        np.testing.assert_allclose(
            ball.body_from_geometry.translation, mechanism.markers[k], atol=1e-15
        )
        np.testing.assert_allclose(ball.rgba[:3], cell.rig.marker_colours[k])
    sides = mechanism.markers[[1, 2]] - mechanism.markers[0]
    np.testing.assert_allclose(np.linalg.norm(sides, axis=1), (0.13, 0.12))
    for config in cell.cameras:
        # Behind the optical centre: never in its own view.
        for part in ("lens", "body"):
            housing = solids[f"cell/camera {config.name} {part}"]
            depth = (
                config.world_from_camera.inverse() @ housing.body_from_geometry
            ).translation[2]
            reach = housing.size[-1]
            assert depth + reach < 0
    touching = {
        frozenset(mechanism.bodies[k].name for k in pair) for pair in mechanism.touching
    }
    assert frozenset({"link_s", "link_l"}) in touching


def with_arm(**arm: object) -> Cell:
    cell = shipped("hp3_stereo")
    return cell.model_copy(update={"arm": cell.arm.model_copy(update=arm)})


def test_unknown_frames_are_listed() -> None:
    with pytest.raises(InputError, match=r"arm\.flange.*'tool9'.*link_t.*sites flange"):
        compile_mechanism(with_arm(flange="tool9"), HP3)
    with pytest.raises(InputError, match=r"arm\.base.*'floor'.*base, link_s"):
        compile_mechanism(with_arm(base="floor"), HP3)


def test_a_base_must_stand_still_and_carry_the_flange() -> None:
    with pytest.raises(InputError, match="'link_l' moves.*link_s, link_l"):
        compile_mechanism(with_arm(base="link_l"), HP3)
    cell = with_arm(base="shelf", flange="tool")
    with pytest.raises(InputError, match="'shelf' does not carry the flange 'tool'"):
        compile_mechanism(cell, DATA / "seven_joints.xml")


MODEL = "<mujoco><worldbody><body name='b'>{}</body></worldbody></mujoco>"
BAD_FILES = {
    "free": (
        MODEL.format("<freejoint name='fly'/><geom size='1'/>"),
        "'fly' is a free",
    ),
    "ball": (
        MODEL.format("<joint name='hip' type='ball'/><geom size='1'/>"),
        "'hip' is a ball",
    ),
    "field": (
        "<mujoco><asset><hfield name='h' nrow='2' ncol='2' size='1 1 1 1'/></asset>"
        "<worldbody><geom type='hfield' hfield='h'/><body name='b'>"
        "<joint/><geom size='1'/></body></worldbody></mujoco>",
        "height field",
    ),
    "mesh": (
        "<mujoco><asset><mesh name='m' file='gone.stl'/></asset>"
        "<worldbody><body name='b'><geom type='mesh' mesh='m'/></body></worldbody>"
        "</mujoco>",
        "gone.stl",
    ),
    "syntax": ("<mujoco><worldbody>", "cannot read"),
    "text": ("a robot", "cannot read"),
    "empty": ("", "cannot read"),
    "world only": ("<mujoco/>", "no body or site 'b'"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_model_is_one_sentence(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text, message = BAD_FILES[name]
    path = tmp_path / "arm.xml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        compile_mechanism(with_arm(flange="b"), path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    # MuJoCo leaves no log behind.
    assert [p.name for p in tmp_path.iterdir()] == ["arm.xml"]


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere.xml"):
        compile_mechanism(with_arm(), tmp_path / "nowhere.xml")


def test_joints_must_fit_the_arm() -> None:
    with pytest.raises(InputError, match=r"\(stations, 6\).*\(2, 5\)"):
        next(render_views(shipped("hp3_stereo"), HP3, np.zeros((2, 5)), 0, [(0, 0)]))


def test_no_opengl_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(width: int, height: int) -> None:
        raise ImportError("Cannot initialize a EGL device display")

    check_rendering()
    monkeypatch.setattr(mujoco, "GLContext", broken)
    with pytest.raises(MissingDependencyError, match="apt-get install libegl1"):
        check_rendering()


def test_no_opengl_library_at_all_names_the_packages() -> None:
    """PyOpenGL fails while mujoco is imported, in ways that are no ImportError."""
    code = (
        "import ctypes, ctypes.util\n"
        "ctypes.util.find_library = lambda name: None\n"
        "real = ctypes.CDLL.__init__\n"
        "def fake(self, name=None, *a, **k):\n"
        "    if name and ('EGL' in str(name) or 'libGL' in str(name)\n"
        "                 or 'libOpenGL' in str(name)):\n"
        "        raise OSError(f'{name}: cannot open shared object file')\n"
        "    real(self, name, *a, **k)\n"
        "ctypes.CDLL.__init__ = fake\n"
        "from handeye_tri.errors import MissingDependencyError\n"
        "from handeye_tri.simulate import check_rendering\n"
        "try:\n"
        "    check_rendering()\n"
        "except MissingDependencyError as error:\n"
        "    print(error)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert "apt-get install libegl1" in result.stdout


def plan_of(arm: Arm, joints: np.ndarray) -> Plan:
    stations = tuple(
        Station(k, "calibration", q, SE3(arm.forward(q))) for k, q in enumerate(joints)
    )
    return Plan(stations, (), {}, {}, 0)


def test_the_robot_misses_by_its_repeatability() -> None:
    arm = Arm(compile_mechanism(shipped("hp3_stereo"), HP3))
    rng = np.random.default_rng(2)
    home = np.array([0.1, 0.2, -0.5, 0.4, 0.9, -0.3])
    joints = home + rng.uniform(-0.2, 0.2, (150, 6))
    plan = plan_of(arm, joints)
    repeatability = Repeatability(3e-5, 1e-4)
    executed = execute(arm, plan, repeatability, 1)
    tangents = se3_log(se3_inverse(arm.forward(joints)) @ arm.forward(executed))
    scaled = tangents / np.repeat([3e-5, 1e-4], 3)
    # Four standard errors of a mean and of a standard deviation of 150 draws.
    assert np.abs(scaled.mean(axis=0)).max() < 4 / np.sqrt(150)
    assert np.abs(scaled.std(axis=0) - 1).max() < 4 / np.sqrt(300)
    np.testing.assert_array_equal(executed, execute(arm, plan, repeatability, 1))
    assert (executed != execute(arm, plan, repeatability, 2)).any()
    # A station's draw does not depend on the stations before it.
    few = execute(arm, plan_of(arm, joints[:3]), repeatability, 1)
    np.testing.assert_allclose(few, executed[:3], atol=1e-12)


def test_an_exact_robot_goes_where_it_is_told() -> None:
    arm = Arm(compile_mechanism(shipped("hp3_stereo"), HP3))
    joints = np.array([[0.1, 0.2, -0.5, 0.4, 0.9, -0.3]])
    executed = execute(arm, plan_of(arm, joints), Repeatability(0.0, 0.0), 1)
    np.testing.assert_allclose(executed, joints, atol=1e-12)


def test_a_plan_of_another_arm_is_refused() -> None:
    arm = Arm(compile_mechanism(shipped("hp3_stereo"), HP3))
    station = Station(0, "calibration", np.zeros(7), SE3.identity())
    plan = Plan((station,), (), {}, {}, 0)
    with pytest.raises(InputError, match="7 joints, the arm has 6"):
        execute(arm, plan, Repeatability(0.0, 0.0), 1)


def test_the_truth_is_in_the_base_frame() -> None:
    cell = with_arm(position_m=(0.1, 0.2, 0.3))
    arm = Arm(compile_mechanism(cell, HP3))
    joints = np.array([[0.1, 0.2, -0.5, 0.4, 0.9, -0.3]])
    truth = ground_truth(cell, arm, joints)
    np.testing.assert_allclose(truth.base_from_flange, arm.forward(joints))
    for config, camera, pose in zip(
        cell.cameras, truth.cameras, truth.base_from_camera, strict=True
    ):
        assert camera.name == config.name
        np.testing.assert_allclose(
            pose.translation, np.subtract(config.position_m, (0.1, 0.2, 0.3))
        )
    markers = truth.flange_from_triangle.apply(cell.rig.triangle.points)
    np.testing.assert_allclose(
        SE3(truth.base_from_flange[0]).apply(markers), arm.marker_positions(joints)[0]
    )
