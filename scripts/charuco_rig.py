"""A ChArUco board on the arm of a cell, photographed in the same simulation.

The board's black modules are quadrilaterals, not a texture: their edges are as sharp
as the renderer's geometry, whatever the distance and tilt.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from handeye_tri.arm import Arm
from handeye_tri.config import Cell, parse_cell
from handeye_tri.errors import NoPlanError
from handeye_tri.plan.poses import View
from handeye_tri.records import Plan, Station
from handeye_tri.se3 import SE3
from handeye_tri.simulate import compile_mechanism, execute, render_views

# A board of the size of a sheet of A4; a module is an eighth of a square.
COLUMNS, ROWS = 10, 7
MODULE = 3.5e-3
SQUARE = 8 * MODULE
_AHEAD = 0.06
_PLATE, _BORDER, _RAISED = 4e-3, 8e-3, 5e-5
# Board frame as OpenCV has it: origin at a corner, x right, y down, z into the board.
FLANGE_FROM_BOARD = SE3.from_parts(
    np.diag([1.0, -1.0, -1.0]), [-0.5 * COLUMNS * SQUARE, 0.5 * ROWS * SQUARE, _AHEAD]
)
# Of all corners, so many must be well inside both images.
_SEEN = 0.6
_MARGIN = 12.0
_BATCH, _MOST = 60, 60
_STREAM = 301


def board() -> cv2.aruco.CharucoBoard:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return cv2.aruco.CharucoBoard((COLUMNS, ROWS), SQUARE, 6 * MODULE, dictionary)


def board_cell(cell: Cell, model: Path, folder: Path) -> tuple[Cell, Path]:
    """The cell with a board instead of the three balls, and its arm's model.

    A cell cannot do without a triangle: a tiny one hides behind the board.
    """
    data = cell.model_dump(mode="json", by_alias=True)
    data["rig"].update(
        axis="normal", side_ab_mm=3.0, side_ac_mm=3.0, angle_deg=60.0,
        ahead_mm=0.5e3 * _AHEAD, turn_deg=0.0,
        marker_radii_mm=[0.2, 0.2, 0.2], identity="colour",
        marker_colours=[[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    )  # fmt: skip
    path = folder / "arm_with_board.xml"
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(_with_board(model.read_text(), printed=True))
    # Collisions are of the plate; nobody needs the hull of what is printed on it.
    _blank(path).write_text(_with_board(model.read_text(), printed=False))
    data["arm"]["model"] = str(path)
    return parse_cell(data, "the cell with a board"), path


def _blank(path: Path) -> Path:
    return path.with_name("arm_with_blank_board.xml")


def _with_board(text: str, *, printed: bool) -> str:
    """MJCF of the HP3-like arm with the board welded to its flange."""
    across, down = COLUMNS * 8, ROWS * 8
    bits = board().generateImage((across, down), marginSize=0, borderBits=1) < 128
    grid = np.zeros((down + 1, across + 1, 3))
    grid[..., 0] = MODULE * np.arange(across + 1)
    grid[..., 1] = MODULE * np.arange(down + 1)[:, None]
    rows, columns = np.nonzero(bits)
    corner = rows * (across + 1) + columns
    # Seen from -z, where the cameras are, these turn anticlockwise.
    quads = np.stack([corner, corner + across + 1, corner + across + 2, corner + 1])
    faces = np.concatenate([quads[[0, 1, 2]].T, quads[[0, 2, 3]].T])

    def listed(values: np.ndarray) -> str:
        return " ".join(f"{v:.9g}" for v in values.ravel())

    assets = (
        '<asset><mesh name="modules" inertia="shell" '
        f'vertex="{listed(FLANGE_FROM_BOARD.apply(grid))}" '
        f'face="{listed(faces)}"/>'
        '<material name="paper" rgba="0.85 0.85 0.85 1" emission="1" specular="0"/>'
        '<material name="ink" rgba="0.04 0.04 0.04 1" emission="1" specular="0"/>'
        "</asset>"
    )
    half = [
        0.5 * COLUMNS * SQUARE + _BORDER, 0.5 * ROWS * SQUARE + _BORDER, 0.5 * _PLATE,
    ]  # fmt: skip
    site = '<site name="flange" quat="0.7071067811865476 0 0.7071067811865476 0"'
    assert text.count(site) == 1, "the arm's model has another flange"
    body = (
        '<body name="board" quat="0.7071067811865476 0 0.7071067811865476 0">'
        f'<geom name="plate" type="box" size="{listed(np.array(half))}" '
        f'pos="0 0 {_AHEAD - _RAISED - 0.5 * _PLATE}" material="paper"/>'
    )
    if printed:
        body += (
            '<geom name="modules" type="mesh" mesh="modules" material="ink" '
            'contype="0" conaffinity="0"/>'
        )
    body += "</body>"
    text = text.replace(site, body + site)
    return text.replace("</mujoco>", assets + "</mujoco>")


def plan_board(cell: Cell, arm: Arm, stations: int, seed: int) -> Plan:
    """General motions with large rotations, as OpenCV's hand-eye solvers want them.

    The board's centre is uniform in the cell's workspace, its normal 8 to 55 degrees
    off the line of sight in any direction, and it is spun by any angle about that
    normal: rotations between stations reach 180 degrees about axes of all directions.
    """
    view = View(cell)
    rng = np.random.default_rng([seed, _STREAM])
    corners = FLANGE_FROM_BOARD.apply(np.asarray(board().getChessboardCorners(), float))
    found: list[Station] = []
    for _ in range(_MOST):
        poses = view.draw(rng, _BATCH)
        keep = view.tilt_allowed(poses).all(axis=1)
        for camera, pose in zip(view.cameras, view.world_from_camera, strict=True):
            world = corners @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
            local = (world - pose[:3, 3]) @ pose[:3, :3]
            pixels = camera.project(local)
            size = np.array(camera.image_size)
            inside = (pixels > _MARGIN) & (pixels < size - 1 - _MARGIN)
            keep &= inside.all(axis=-1).mean(axis=1) >= _SEEN
        targets = arm.base_from_world.matrix @ poses[keep]
        if len(targets) == 0:
            continue
        for solutions in arm.inverse(targets, rng, starts=9).joints:
            free = [q for q in solutions if arm.collision(q) is None]
            if free:
                pose = SE3(arm.forward(free[0][None])[0])
                found.append(Station(len(found), "calibration", free[0], pose))
            if len(found) == stations:
                return Plan(tuple(found), (), {}, {}, seed, "PASS", ())
    raise NoPlanError(f"only {len(found)} of {stations} board poses are reachable", {})


def photograph(
    cell: Cell, model: Path, stations: int, seed: int
) -> tuple[Plan, np.ndarray, Iterator[tuple[int, int, np.ndarray]]]:
    """Plan, executed flange poses (n, 4, 4), and the views as they are rendered."""
    arm = Arm(compile_mechanism(cell, _blank(model)))
    plan = plan_board(cell, arm, stations, seed)
    joints = execute(arm, plan, cell.repeatability, seed)
    wanted = [(i, j) for j in range(stations) for i in range(len(cell.cameras))]
    views = render_views(cell, model, joints, seed, wanted)
    return plan, arm.forward(joints), views
