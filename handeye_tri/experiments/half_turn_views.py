"""Half-turns before the simulated camera of Sec. IV-A, and the bound on any estimate.

The paper's own numbers for camera and triangle are 1024 x 768 pixels, O at the middle
of the edge that faces theta, 22 images; focal length and sides are chosen here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import Intrinsics, PinholeCamera
from handeye_tri.errors import NoPlanError
from handeye_tri.se3 import se3_exp, so3_exp
from handeye_tri.triangle import EDGES, Axis, TriangleRig

Floats = NDArray[np.float64]

IMAGE_SIZE = (1024, 768)
TRUE_CAMERA = PinholeCamera(
    "camera", Intrinsics(1720.0, 1715.0, 0.0, 519.3, 377.8), IMAGE_SIZE
)
SIDE_AB, SIDE_AC = 0.13, 0.12
# Tilt of the triangle's plane against the image plane, and where its middle is.
_TILT_DEG = (20.0, 55.0)
_SIDEWAYS_M = 0.08
_DISTANCE_M = (0.8, 1.0)
_MARGIN_PX = 5.0
# Steps of the numerical derivatives: pixels, then metres and radians.
_STEPS = np.concatenate([np.full(5, 1e-2), np.full(8, 1e-6)])


@dataclass(frozen=True, slots=True, eq=False)
class HalfTurnViews:
    """Exact views of n half-turns.

    Attributes:
        triangle: The rig.
        axis: The axis of all half-turns.
        foot: Where a normal axis meets the triangle's plane, shape (2,), metres.
        poses: camera_from_triangle before each half-turn, (n, 4, 4), metres.
        pixels: Shape (n, 2, 3, 2): half-turn, before and after, marker.
    """

    triangle: TriangleRig
    axis: Axis
    foot: Floats
    poses: Floats
    pixels: Floats

    def bound(self, sigma_px: float, *, skew: bool) -> Floats:
        """Cramer-Rao bound on the sigmas of fx, fy, skew, cx, cy, shape (5,), px.

        The two images of a half-turn share a pose; O is unknown, and the same in all
        half-turns. Derivatives by central differences of the projection, all
        unknowns in one matrix. Without ``skew`` its own bound is zero.
        """
        n = len(self.poses)
        steps = np.concatenate([np.diag(_STEPS), -np.diag(_STEPS)])
        both = np.array([self._moved(step) for step in steps])
        slope = (both[:13] - both[13:]) / (2 * _STEPS[:, None, None, None, None])
        slope = np.moveaxis(slope, 0, -1).reshape(n, 12, 13)
        quantities = [0, 1, 2, 3, 4] if skew else [0, 1, 3, 4]
        shared = [*quantities, *((5, 6) if self.axis == "normal" else ())]
        jacobian = np.zeros((n, 12, len(shared) + 6 * n))
        jacobian[:, :, : len(shared)] = slope[:, :, shared]
        for i in range(n):
            at = len(shared) + 6 * i
            jacobian[i, :, at : at + 6] = slope[i, :, 7:]
        matrix = jacobian.reshape(12 * n, -1)
        scale = np.linalg.norm(matrix, axis=0)
        root = np.linalg.inv(np.linalg.qr(matrix / scale, mode="r"))
        result = np.zeros(5)
        length = np.linalg.norm(root, axis=1) / scale
        result[quantities] = sigma_px * length[: len(quantities)]
        return result

    def _moved(self, step: Floats) -> Floats:
        """Pixels (n, 2, 3, 2) after a step of K (5), O (2) and every pose (6)."""
        camera = PinholeCamera(
            "moved",
            Intrinsics.from_vector(TRUE_CAMERA.intrinsics.vector + step[:5]),
            IMAGE_SIZE,
        )
        motion = se3_exp(step[7:])
        return _views(
            camera, self.triangle, self.axis, self.foot + step[5:7], self.poses @ motion
        )


def longest_edge(triangle: TriangleRig) -> Axis:
    """The edge whose ends hold no right angle, the best axis of Sec. III-B."""
    points = triangle.points
    edges: tuple[Axis, ...] = ("AB", "BC", "CA")
    return max(
        edges,
        key=lambda edge: float(np.linalg.norm(np.subtract(*points[list(EDGES[edge])]))),
    )


def draw_half_turns(
    rng: np.random.Generator, count: int, *, cos_theta: float, normal: bool
) -> HalfTurnViews:
    """Random half-turns, every marker inside the image before and after.

    Args:
        rng: Source of the poses.
        count: Half-turns; each makes two images.
        cos_theta: Cosine of the angle at A.
        normal: Axis along a normal (Sec. III-A), else the longest edge (III-B).

    Raises:
        NoPlanError: almost no pose has all markers inside the image.
    """
    triangle = TriangleRig(SIDE_AB, SIDE_AC, float(np.arccos(cos_theta)))
    foot = triangle.points[1:, :2].mean(axis=0)
    axis: Axis = "normal" if normal else longest_edge(triangle)
    poses, pixels = np.empty((0, 4, 4)), np.empty((0, 2, 3, 2))
    drawn = 0
    while len(poses) < count:
        if drawn > 1000 * count:
            raise NoPlanError(
                f"of {drawn} poses only {len(poses)} have every marker in the image, "
                f"{count} are needed",
                {"outside the image": drawn - len(poses)},
            )
        more = _random_poses(rng, 2 * count, foot)
        seen = _views(TRUE_CAMERA, triangle, axis, foot, more)
        inside = (seen > _MARGIN_PX) & (seen < np.array(IMAGE_SIZE) - 1 - _MARGIN_PX)
        good = inside.all(axis=(1, 2, 3))
        poses = np.concatenate([poses, more[good]])
        pixels = np.concatenate([pixels, seen[good]])
        drawn += len(more)
    return HalfTurnViews(triangle, axis, foot, poses[:count], pixels[:count])


def _random_poses(rng: np.random.Generator, count: int, foot: Floats) -> Floats:
    azimuth, turn = rng.uniform(0, 2 * np.pi, (2, count))
    tilt = np.radians(rng.uniform(*_TILT_DEG, count))
    zero = np.zeros(count)
    lean = np.stack([tilt * np.cos(azimuth), tilt * np.sin(azimuth), zero], axis=-1)
    rotation = so3_exp(lean) @ so3_exp(np.stack([zero, zero, turn], axis=-1))
    sideways = rng.uniform(-_SIDEWAYS_M, _SIDEWAYS_M, (count, 2))
    centre = np.column_stack([sideways, rng.uniform(*_DISTANCE_M, count)])
    poses = np.zeros((count, 4, 4))
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = centre - rotation @ np.append(foot, 0.0)
    poses[:, 3, 3] = 1.0
    return poses


def _views(
    camera: PinholeCamera,
    triangle: TriangleRig,
    axis: Axis,
    foot: Floats,
    poses: Floats,
) -> Floats:
    turn = triangle.half_turn(axis, foot if axis == "normal" else None)
    both = np.array([triangle.points, turn.apply(triangle.points)])
    rotation = np.swapaxes(poses[:, None, :3, :3], -1, -2)
    return camera.project(both @ rotation + poses[:, None, None, :3, 3])
