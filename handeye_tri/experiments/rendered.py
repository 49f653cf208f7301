"""Cells that are rendered, calibrated by their half-turns, and used to look at things.

The truth of a rendered cell is known: it judges, and the estimators never see it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.camera import StereoRig
from handeye_tri.experiments.chessboard import Board, BoardViews, find_board
from handeye_tri.experiments.outcome import Options
from handeye_tri.experiments.props import board_solids
from handeye_tri.pipeline import STAGES, NullProgress, Run, execute, start
from handeye_tri.records import CameraCalibration
from handeye_tri.se3 import SE3, so3_exp
from handeye_tri.storage import find_cell, find_model, read_cell
from handeye_tri.sweep import Result

if TYPE_CHECKING:
    from handeye_tri.simulate import Prop

Floats = NDArray[np.float64]

SEED = 1
# The clock waits beside what the cameras see while they look at the model plane.
_CLOCK_ASIDE = (-1.0, -1.4, 0.0, 0.0, 0.0, 0.0)
BOARD_POSES = 9
_BOARD = Board()


@dataclass(frozen=True, slots=True, eq=False)
class RenderedStereo:
    """A rendered pair of cameras, as calibrated and as it is.

    Attributes:
        calibration: From the half-turns.
        half_turns: Their number.
        true: The pair as it was built.
    """

    calibration: CameraCalibration
    half_turns: int
    true: StereoRig

    @property
    def rig(self) -> StereoRig:
        """The calibrated pair."""
        left, right = self.calibration.cameras
        return StereoRig(left, right, self.calibration.reference_from_camera[1])


def calibrate_rendered(options: Options, cell_name: str) -> RenderedStereo:
    """Plan, render, detect and calibrate a shipped cell of two cameras.

    What the folder holds of it is not done again.

    Raises:
        InputError: a stage's input cannot be used.
        MissingDependencyError: there is no OpenGL.
    """
    folder = start(cell_name, options.folder / f"{cell_name}_session", SEED, None)
    run = Run(folder, NullProgress())
    with folder.locked():
        execute(run, STAGES, ("plan", "simulate", "detect"), again=False)
        session = run.session()
    left, right = run.designed_cell.cameras
    return RenderedStereo(
        calibrate_session_cameras(session),
        len(session.half_turns),
        StereoRig(
            left.camera,
            right.camera,
            left.world_from_camera.inverse() @ right.world_from_camera,
        ),
    )


def photograph(
    cell_name: str, joints: Sequence[float], stations: int, props: Sequence[Prop]
) -> list[list[NDArray[np.uint8]]]:
    """Images of props in a shipped cell, by camera and station.

    Args:
        cell_name: The cell.
        joints: Where its arm waits meanwhile, rad or m.
        stations: How many.
        props: What stands there.
    """
    from handeye_tri.simulate import render_views

    path = find_cell(cell_name)
    cell = read_cell(path)
    images: list[list[NDArray[np.uint8]]] = [[] for _ in cell.cameras]
    wanted = [(i, j) for j in range(stations) for i in range(len(cell.cameras))]
    for i, _, image in render_views(
        cell,
        find_model(cell, path),
        np.tile(np.asarray(joints, dtype=float), (stations, 1)),
        SEED,
        wanted,
        props,
    ):
        images[i].append(image)
    return images


@dataclass(frozen=True, slots=True)
class BoardView:
    """Photographs the model plane in one of its poses, and finds its corners."""

    cell_name: str

    def __call__(self, seed: int) -> Result:
        """Corners by camera; the seed counts poses."""
        from handeye_tri.simulate import Prop

        cell = read_cell(find_cell(self.cell_name))
        place = board_pose(cell.cameras[0].world_from_camera, seed)
        board = Prop("board", board_solids(_BOARD), place.matrix[None])
        corners = []
        for (image,) in photograph(self.cell_name, _CLOCK_ASIDE, 1, [board]):
            found = find_board(image, _BOARD)
            corners.append(None if found is None else found.tolist())
        return {"corners": corners}


def board_pose(world_from_camera: SE3, number: int) -> SE3:
    """Where the model plane is held: tilted in turn to every side, 0.85 m away."""
    azimuth = 2 * np.pi * number / BOARD_POSES
    tilt = np.radians(25.0 + 10.0 * (number % 3))
    lean = tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    turn = so3_exp(lean) @ so3_exp([0.0, 0.0, 0.25 * np.sin(3.0 * azimuth)])
    shift = np.array([0.03 * np.cos(2 * azimuth), 0.02 * np.sin(2 * azimuth), 0.85])
    middle = _BOARD.points.mean(axis=0)
    return world_from_camera @ SE3.from_parts(turn, shift - turn @ middle)


def rendered_board_views(options: Options, cell_name: str) -> BoardViews:
    """The model plane in all its poses before a shipped cell's cameras."""
    found = options.sweep(
        f"{cell_name}_boards", BoardView(cell_name), {"cell": cell_name}, BOARD_POSES
    )
    whole = [j for j, view in enumerate(found) if None not in view["corners"]]
    corners = np.array([found[j]["corners"] for j in whole]).swapaxes(0, 1)
    size = read_cell(find_cell(cell_name)).cameras[0].image_size_px
    return BoardViews(_BOARD, tuple(f"{j + 1}" for j in whole), size, corners)
