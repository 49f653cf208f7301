"""Views of a chessboard: its corners, Zhang's calibration of them, its half-turns."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera, StereoRig
from handeye_tri.errors import InputError
from handeye_tri.se3 import SE3
from handeye_tri.storage import read_image
from handeye_tri.triangle import TriangleRig

Floats = NDArray[np.float64]

# Half width of the window in which a corner is refined, pixels. A larger one reaches
# the next corner where the board is small in the image.
_CORNER_WINDOW = 5
_NO_LENS = (
    cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
)
_NAMES = re.compile(r"(left|right)_?(\d+)\.(?:png|jpe?g)")


@dataclass(frozen=True, slots=True, eq=False)
class Board:
    """A chessboard's inner corners.

    Attributes:
        columns: Corners in a row.
        rows: Of corners.
        square: Their distance, metres.
    """

    columns: int = 9
    rows: int = 6
    square: float = 0.03

    @property
    def points(self) -> Floats:
        """Corners in the order of detection, shape (rows * columns, 3), metres."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        return self.square * np.column_stack([column, row, np.zeros(len(row))])


@dataclass(frozen=True, slots=True, eq=False)
class BoardViews:
    """Corners of one board in the pairs of views of two cameras.

    Attributes:
        board: The chessboard.
        names: Of the views.
        image_size: (width, height), pixels.
        corners: Shape (2, views, corners, 2), pixels: left, then right.
    """

    board: Board
    names: tuple[str, ...]
    image_size: tuple[int, int]
    corners: Floats


def read_board_views(folder: Path, board: Board) -> BoardViews:
    """Detect the board in all pairs left<number> and right<number> of a folder.

    Pairs in which it is not seen whole are left out. Where the folder has one named
    "images", that is looked into.

    Raises:
        InputError: fewer than three whole pairs, or images of unequal size.
        StorageError: an image cannot be read.
    """
    found: dict[str, dict[str, Path]] = {}
    inner = folder / "images"
    source = inner if inner.is_dir() else folder
    for path in sorted(source.iterdir()) if source.is_dir() else []:
        match = _NAMES.fullmatch(path.name.lower())
        if match:
            found.setdefault(match[2], {})[match[1]] = path
    names, corners, sizes = [], [], set()
    for number, pair in found.items():
        if len(pair) < 2:
            continue
        both = []
        for side in ("left", "right"):
            image = read_image(pair[side])
            sizes.add((image.shape[1], image.shape[0]))
            both.append(find_board(image, board))
        if all(seen is not None for seen in both):
            names.append(number)
            corners.append(both)
    if len(names) < 3:
        raise InputError(
            f"{folder}: {len(names)} pairs of views show the whole {board.columns} x "
            f"{board.rows} board, at least 3 are needed; give --images a folder of "
            "left01.jpg, right01.jpg, left02.jpg and so on"
        )
    if len(sizes) > 1:
        raise InputError(f"{folder}: the images differ in size: {sorted(sizes)}")
    pixels = np.array(corners, dtype=float).swapaxes(0, 1)
    return BoardViews(board, tuple(names), sizes.pop(), pixels)


def find_board(image: NDArray[np.uint8], board: Board) -> Floats | None:
    """Inner corners of a board that is seen whole, (rows * columns, 2), else None.

    Args:
        image: RGB, shape (h, w, 3), or grey, shape (h, w).
        board: The chessboard.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    whole, corners = cv2.findChessboardCorners(grey, (board.columns, board.rows))
    if not whole:
        return None
    until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    window = (_CORNER_WINDOW, _CORNER_WINDOW)
    refined = cv2.cornerSubPix(grey, corners, window, (-1, -1), until)
    return np.asarray(refined, dtype=float).reshape(-1, 2)


def zhang(views: BoardViews, side: int, *, lens: bool = True) -> PinholeCamera:
    """One camera by Zhang's method as OpenCV has it, with k1 k2 p1 p2 k3 or no lens.

    Zhang 2000, doi:10.1109/34.888718: every corner of every view, one pose a view.

    Args:
        views: The corners.
        side: 0 left, 1 right.
        lens: Whether the lens is estimated; else there is none.
    """
    points, seen = _for_opencv(views, side)
    _, k, bent, _, _ = cv2.calibrateCamera(
        points, seen, views.image_size, None, None, flags=0 if lens else _NO_LENS
    )
    return PinholeCamera(
        ("left", "right")[side],
        Intrinsics.from_matrix(k),
        views.image_size,
        Lens("radtan", np.asarray(bent, dtype=float).ravel()[:5]),
    )


def zhang_pair(views: BoardViews, *, lens: bool = True) -> StereoRig:
    """Both cameras by :func:`zhang`, placed by OpenCV's stereo calibration."""
    pair = zhang(views, 0, lens=lens), zhang(views, 1, lens=lens)
    points, left = _for_opencv(views, 0)
    (k_left, d_left), (k_right, d_right) = (
        (camera.intrinsics.matrix, camera.lens.coefficients.copy()) for camera in pair
    )
    found = cv2.stereoCalibrate(
        points,
        left,
        _for_opencv(views, 1)[1],
        k_left,
        d_left,
        k_right,
        d_right,
        views.image_size,
        flags=cv2.CALIB_FIX_INTRINSIC,
    )
    right_from_left = SE3.from_parts(found[5], np.asarray(found[6]).ravel())
    return StereoRig(*pair, right_from_left.inverse())


def _for_opencv(views: BoardViews, side: int) -> tuple[list[Any], list[Any]]:
    points = [views.board.points.astype(np.float32)] * len(views.names)
    return points, [corners.astype(np.float32) for corners in views.corners[side]]


def board_half_turns(
    board: Board, width: int, height: int
) -> tuple[TriangleRig, NDArray[np.intp], NDArray[np.intp]]:
    """All half-turns of one triangle that the corners of a board hold (Sec. III-A).

    A, B and C are corners (0, 0), (width, 0) and (0, height) of a place on the board;
    turned by 180 degrees about a normal they come to lie on corners again. Each two
    places make a half-turn, the axis half-way between.

    Args:
        board: The chessboard.
        width: Of the triangle, squares.
        height: Of the triangle, squares.

    Returns:
        The triangle; indices of the corners of A, B, C before and after each
        half-turn, both of shape (n, 3).
    """
    corner = np.array([[0, 0], [width, 0], [0, height]])
    places = np.array(
        [
            (column, row)
            for row in range(board.rows - height)
            for column in range(board.columns - width)
        ]
    )
    pairs = np.array([(p, q) for p in places for q in places])
    before = pairs[:, :1] + corner
    after = pairs[:, 1:] + (width, height) - corner
    flat = np.array([1, board.columns])
    legs = board.square * np.column_stack([corner, np.zeros(3)])
    return TriangleRig.from_points(legs), before @ flat, after @ flat
