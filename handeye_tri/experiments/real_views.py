"""The first real experiment's cameras: from half-turns that a chessboard holds.

The paper turned a clock's hands. Corners of a chessboard are the same data: three of
them, and three where a half-turn takes them, with nobody turning anything.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras import calibrate_camera
from handeye_tri.camera import PinholeCamera, StereoRig
from handeye_tri.experiments.chessboard import (
    Board,
    BoardViews,
    board_half_turns,
    read_board_views,
)
from handeye_tri.records import CameraCalibration
from handeye_tri.se3 import SE3, se3_inverse

Floats = NDArray[np.float64]

SIDES = ("left", "right")
BOARD = Board()
# Of the triangle, in squares: large enough to be well seen, small enough to be turned
# all over the board.
_WIDTH, _HEIGHT = 5, 3


@dataclass(frozen=True, slots=True, eq=False)
class RealStereo:
    """Two real cameras, calibrated by three points.

    Attributes:
        views: What they saw.
        calibrations: Left, right.
        half_turns: Number that the views hold.
    """

    views: BoardViews
    calibrations: tuple[CameraCalibration, CameraCalibration]
    half_turns: int

    @property
    def cameras(self) -> tuple[PinholeCamera, PinholeCamera]:
        """Left and right."""
        return self.calibrations[0].camera, self.calibrations[1].camera

    @property
    def rig(self) -> StereoRig:
        """The pair, placed by the poses of the triangle that both saw."""
        poses = [found.details["camera_from_triangle"] for found in self.calibrations]
        relative = poses[0] @ se3_inverse(poses[1])
        return StereoRig(*self.cameras, SE3.mean([SE3(m) for m in relative]))


def calibrate_views(images: Path) -> RealStereo:
    """Calibrate both cameras of a folder of chessboard views.

    Raises:
        InputError: there are too few views in the folder.
    """
    views = read_board_views(images, BOARD)
    left, right = (calibrate_side(views, side) for side in range(2))
    return RealStereo(views, (left, right), len(left.residuals[0]) // 2)


def calibrate_side(
    views: BoardViews, side: int, left_out: int | None = None
) -> CameraCalibration:
    """One camera, with lens, zero skew, and O wherever it is in each half-turn.

    Corners take part in many half-turns, so that the stated covariance, which counts
    these as independent, is too small: see the jackknife of Table I.

    Args:
        views: The corners.
        side: 0 left, 1 right.
        left_out: Index of a view not to use.
    """
    triangle, before, after = board_half_turns(views.board, _WIDTH, _HEIGHT)
    corners = views.corners[side]
    if left_out is not None:
        corners = np.delete(corners, left_out, axis=0)
    return calibrate_camera(
        corners[:, before].reshape(-1, 3, 2),
        corners[:, after].reshape(-1, 3, 2),
        triangle,
        image_size=views.image_size,
        skew=False,
        distortion="radtan",
        o="free",
        name=SIDES[side],
    )
