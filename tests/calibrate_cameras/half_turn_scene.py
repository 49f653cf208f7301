"""Half-turns before a known camera: exact pixels, and the bound on any estimator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.se3 import se3_exp, so3_exp
from handeye_tri.triangle import Axis, TriangleRig

Floats = NDArray[np.float64]

TRIANGLE = TriangleRig(0.13, 0.12, np.radians(65.0))
FOOT = (0.05, 0.035)
IMAGE_SIZE = (1024, 768)


@dataclass(frozen=True)
class Scene:
    camera: PinholeCamera
    triangle: TriangleRig
    axes: tuple[Axis, ...]
    foot: tuple[float, float]
    poses: Floats
    before: Floats
    after: Floats

    def noisy(self, rng: np.random.Generator, sigma: float) -> tuple[Floats, Floats]:
        shape = self.before.shape
        return (
            self.before + sigma * rng.standard_normal(shape),
            self.after + sigma * rng.standard_normal(shape),
        )


def camera(
    skew: float = 1.5, lens: Lens | None = None, name: str = "camera"
) -> PinholeCamera:
    return PinholeCamera(
        name,
        Intrinsics(1720.0, 1715.0, skew, 519.3, 377.8),
        IMAGE_SIZE,
        Lens() if lens is None else lens,
    )


def project(view: PinholeCamera, triangle: TriangleRig, pose: Floats) -> Floats:
    return view.project(triangle.points @ pose[:3, :3].T + pose[:3, 3])


def make_scene(
    rng: np.random.Generator,
    n: int,
    axes: Axis | Sequence[Axis] = "normal",
    *,
    triangle: TriangleRig = TRIANGLE,
    foot: tuple[float, float] = FOOT,
    view: PinholeCamera | None = None,
    tilt_deg: tuple[float, float] = (20.0, 55.0),
    sideways: float = 0.08,
    azimuths: Sequence[float] | None = None,
    angle_deg: float = 180.0,
    turn_root: Floats | None = None,
) -> Scene:
    """Random poses about 0.9 m away, every marker at least 5 px inside the image."""
    view = camera() if view is None else view
    names = (axes,) * n if isinstance(axes, str) else tuple(axes)
    poses, before, after = [], [], []
    for _ in range(1000 * n):
        i = len(poses)
        if i == n:
            break
        azimuth = rng.uniform(0, 2 * np.pi) if azimuths is None else azimuths[i]
        lean = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        rotation = so3_exp(lean * np.radians(rng.uniform(*tilt_deg)))
        rotation = rotation @ so3_exp([0.0, 0.0, rng.uniform(0, 2 * np.pi)])
        centre = np.array([*rng.uniform(-sideways, sideways, 2), rng.uniform(0.8, 1.0)])
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = centre - rotation @ np.append(foot, 0.0)
        motion = half_turn(triangle, names[i], foot, angle_deg)
        if turn_root is not None:
            motion = motion @ se3_exp(turn_root @ rng.standard_normal(6))
        pixels = [project(view, triangle, p) for p in (pose, pose @ motion)]
        inside = (np.array(pixels) > 5) & (np.array(pixels) < np.array(IMAGE_SIZE) - 6)
        if inside.all():
            poses.append(pose)
            before.append(pixels[0])
            after.append(pixels[1])
    assert len(poses) == n, "the scene has no room for these views"
    return Scene(
        view, triangle, names, foot, *(np.array(x) for x in (poses, before, after))
    )


def half_turn(
    triangle: TriangleRig, axis: Axis, foot: tuple[float, float], angle_deg: float
) -> Floats:
    """A turn by any angle, written apart from TriangleRig.half_turn."""
    if axis == "normal":
        through, direction = np.append(foot, 0.0), np.array([0.0, 0.0, 1.0])
    else:
        ends = {"A": 0, "B": 1, "C": 2}
        through = triangle.points[ends[axis[0]]]
        direction = triangle.points[ends[axis[1]]] - through
        direction = direction / np.linalg.norm(direction)
    motion = np.eye(4)
    motion[:3, :3] = so3_exp(direction * np.radians(angle_deg))
    motion[:3, 3] = through - motion[:3, :3] @ through
    return motion


def cramer_rao(scene: Scene, sigma: float) -> Floats:
    """Bound on (fx, fy, skew, cx, cy), O shared and unknown where an axis is normal.

    From a Jacobian by central differences of the projection, all unknowns in one dense
    matrix: nothing in common with the estimator but the model.
    """
    n = len(scene.poses)
    free_foot = "normal" in scene.axes

    def predict(unknowns: Floats) -> Floats:
        foot = np.array(scene.foot) + (unknowns[5:7] if free_foot else 0.0)
        view = PinholeCamera(
            "bound",
            Intrinsics.from_vector(scene.camera.intrinsics.vector + unknowns[:5]),
            IMAGE_SIZE,
        )
        steps = unknowns[-6 * n :].reshape(n, 6)
        pixels = []
        for pose, step, axis in zip(scene.poses, steps, scene.axes, strict=True):
            moved = pose @ se3_exp(step)
            turn = half_turn(scene.triangle, axis, tuple(foot), 180.0)
            pixels.append(project(view, scene.triangle, moved))
            pixels.append(project(view, scene.triangle, moved @ turn))
        return np.array(pixels).ravel()

    shared = 7 if free_foot else 5
    size = np.concatenate([np.full(5, 1e-2), np.full(shared - 5 + 6 * n, 1e-6)])
    jacobian = np.column_stack(
        [
            (predict(size[i] * unit) - predict(-size[i] * unit)) / (2 * size[i])
            for i, unit in enumerate(np.eye(shared + 6 * n))
        ]
    )
    scale = np.linalg.norm(jacobian, axis=0)
    _, upper = np.linalg.qr(jacobian / scale)
    root = np.linalg.inv(upper) / scale[:, None]
    return sigma**2 * (root @ root.T)[:5, :5]
