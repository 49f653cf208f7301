"""Where things are drawn and seen from; numpy only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.records import HandEyeCalibration
from handeye_tri.replay.story import Story
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]

Colour = tuple[int, int, int]

# One colour each, in every view: what was estimated, what was held out, the truth.
ESTIMATE: Colour = (64, 156, 255)
HELD_OUT: Colour = (255, 149, 0)
TRUTH: Colour = (165, 165, 165)
WHITE: Colour = (255, 255, 255)

_RING_PX = 24.0
_TURN = np.linspace(0.0, 2.0 * np.pi, 33)
_RING = _RING_PX * np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1)
_CROSS = 0.55 * _RING_PX * np.array([[[-1, 0], [1, 0]], [[0, -1], [0, 1]]])


@dataclass(frozen=True, slots=True, eq=False)
class Eye:
    """From where a 3-D view is seen.

    Attributes:
        position: Of the eye, shape (3,), metres.
        target: What it looks at, shape (3,), metres.
    """

    position: Floats
    target: Floats


def rings(centres: Floats) -> Floats:
    """A ring about each of k points, (k, 2) -> (k, 33, 2), pixels."""
    return centres[:, None] + _RING


def crosses(centres: Floats) -> Floats:
    """A cross on each of k points, (k, 2) -> (2 k, 2, 2), pixels."""
    return np.asarray((centres[:, None, None] + _CROSS).reshape(-1, 2, 2))


def vertex_normals(vertices: Floats, faces: NDArray[np.int64]) -> Floats:
    """Mean normals of the faces about each vertex, weighted by area.

    Args:
        vertices: Shape (v, 3), metres.
        faces: Shape (f, 3).

    Returns:
        Shape (v, 3), unit length; zero where a vertex has no face.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], face_normals)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(lengths > 0, lengths, 1.0))


def eye_on_cell(
    base_from_camera: Sequence[SE3], markers: Floats, base_from_world: SE3
) -> Eye:
    """Robot and cameras in view, in the world: over the cameras' shoulder.

    Args:
        base_from_camera: Where the cameras are.
        markers: Where they were, in the base, shape (n, 3, 3), metres.
        base_from_world: Where the world is.
    """
    world_from_base = base_from_world.inverse()
    centres = world_from_base.apply([motion.translation for motion in base_from_camera])
    rig = world_from_base.apply(markers.mean(axis=(0, 1)))
    points = np.vstack([centres, rig, world_from_base.translation])
    target = 0.5 * (points.min(axis=0) + points.max(axis=0))
    target[2] = 0.75 * rig[2] + 0.25 * world_from_base.translation[2]
    towards = _level(centres.mean(axis=0) - rig)
    side = np.cross([0.0, 0.0, 1.0], towards)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    return Eye(target + size * (0.8 * towards - 0.42 * side + [0, 0, 0.42]), target)


def eye_on_track(calibration: HandEyeCalibration, story: Story) -> Eye:
    """The held-out track as the first camera sees it, in the base."""
    target = story.reported[story.held_out].mean(axis=(0, 1))
    reach = float(
        np.linalg.norm(story.reported[story.held_out] - target, axis=-1).max()
    )
    towards = calibration.base_from_camera[0].translation - target
    return Eye(target + 1.6 * reach * towards / np.linalg.norm(towards), target)


def eye_on_cameras(calibration: HandEyeCalibration, base_from_world: SE3) -> Eye:
    """All cameras in view, in the world: from behind and above."""
    world_from_base = base_from_world.inverse()
    motions = [world_from_base @ motion for motion in calibration.base_from_camera]
    centres = np.array([motion.translation for motion in motions])
    looks = np.mean([motion.rotation[:, 2] for motion in motions], axis=0)
    target = 0.5 * (centres.min(axis=0) + centres.max(axis=0)) + 0.1 * looks
    size = max(float(np.linalg.norm(np.ptp(centres, axis=0))), 0.25)
    towards = _level(looks)
    side = np.cross([0.0, 0.0, 1.0], towards)
    away = -1.15 * towards + 0.5 * side + [0.0, 0.0, 0.9]
    return Eye(target + (size + 0.12) * away, target)


def _level(direction: Floats) -> Floats:
    """The horizontal part of a direction, unit length; x where there is none."""
    flat = direction * [1.0, 1.0, 0.0]
    length = float(np.linalg.norm(flat))
    return flat / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
