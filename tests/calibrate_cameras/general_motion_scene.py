"""Cameras of unequal focal lengths on a dome around a triangle that moves at will."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.se3 import SE3, so3_exp
from handeye_tri.triangle import TriangleRig

Floats = NDArray[np.float64]

TRIANGLE = TriangleRig(0.22, 0.20, np.radians(65.0))
IMAGE_SIZE = (1024, 768)


@dataclass(frozen=True)
class Scene:
    cameras: tuple[PinholeCamera, ...]
    places: tuple[SE3, ...]
    poses: Floats
    pixels: Floats

    def noisy(self, rng: np.random.Generator, sigma: float) -> Floats:
        return self.pixels + sigma * rng.standard_normal(self.pixels.shape)

    @property
    def places_from_first(self) -> list[SE3]:
        first = self.places[0].inverse()
        return [first @ place for place in self.places]

    @property
    def poses_from_first(self) -> Floats:
        return self.places[0].inverse().matrix @ self.poses


def look_at(position: Floats, target: Floats, roll: float) -> SE3:
    forward = (target - position) / np.linalg.norm(target - position)
    side = np.cross(forward, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    rotation = np.stack([side, np.cross(forward, side), forward], axis=1)
    return SE3.from_parts(rotation @ so3_exp([0.0, 0.0, roll]), position)


def make_scene(
    rng: np.random.Generator,
    m: int,
    n: int = 22,
    *,
    around: float = np.pi,
    skew: float = 1.0,
    lens: Lens | None = None,
    steepest_deg: float = 90.0,
) -> Scene:
    """Cameras at azimuths up to `around` apart; every marker inside every image.

    A camera that sees the triangle's plane steeper than `steepest_deg` off its normal
    sees nothing of it (NaN): markers hide each other there.
    """
    cameras, places = [], []
    azimuth = rng.uniform(0, 2 * np.pi)
    step = around / m
    for i in range(m):
        focal = rng.uniform(800.0, 1600.0)
        cameras.append(
            PinholeCamera(
                f"camera{i}",
                Intrinsics(
                    focal,
                    focal * rng.uniform(0.98, 1.02),
                    skew * rng.uniform(-1, 1),
                    511.5 + rng.uniform(-25, 25),
                    383.5 + rng.uniform(-25, 25),
                ),
                IMAGE_SIZE,
                Lens() if lens is None else lens,
            )
        )
        angle = azimuth + step * (i + rng.uniform(-0.2, 0.2))
        height = rng.uniform(0.1, 0.7)
        direction = np.array([np.cos(angle), np.sin(angle), height])
        direction /= np.linalg.norm(direction)
        position = direction * focal / 1024 * rng.uniform(1.0, 1.25)
        target = rng.uniform(-0.02, 0.02, 3)
        places.append(look_at(position, target, rng.uniform(-0.2, 0.2)))
    corners = TRIANGLE.points - TRIANGLE.points.mean(axis=0)
    offset = SE3.from_parts(np.eye(3), -TRIANGLE.points.mean(axis=0)).matrix
    poses, views = [], []
    for _ in range(1000 * n):
        if len(poses) == n:
            break
        axis = rng.standard_normal(3)
        turn = so3_exp(axis / np.linalg.norm(axis) * rng.uniform(0, np.pi))
        where = rng.uniform(-0.2, 0.2, 3)
        world = corners @ turn.T + where
        seen = []
        for camera, place in zip(cameras, places, strict=True):
            local = place.inverse().apply(world)
            if local[:, 2].min() < 0.1:
                break
            pixels = camera.project(local)
            if (pixels < 5).any() or (pixels > np.array(IMAGE_SIZE) - 6).any():
                break
            ray = place.translation - where
            off = abs(float(ray @ turn[:, 2])) / np.linalg.norm(ray)
            if off < np.cos(np.radians(steepest_deg)):
                pixels = np.full((3, 2), np.nan)
            seen.append(pixels)
        if len(seen) == m:
            poses.append(SE3.from_parts(turn, where).matrix @ offset)
            views.append(seen)
    assert len(poses) == n, "the scene has no room for these views"
    return Scene(
        tuple(cameras), tuple(places), np.array(poses), np.array(views).swapaxes(0, 1)
    )


def errors(result, scene: Scene) -> Floats:
    """Truth less estimate in the order of the covariance labels."""
    values = {}
    for i, (camera, true) in enumerate(zip(result.cameras, scene.cameras, strict=True)):
        difference = true.intrinsics.vector - camera.intrinsics.vector
        for name, value in zip(
            ("fx", "fy", "skew", "cx", "cy"), difference, strict=True
        ):
            values[f"{camera.name}.{name}"] = value
        if len(true.lens.coefficients) == len(camera.lens.coefficients):
            bent = true.lens.coefficients - camera.lens.coefficients
            for name, value in zip(camera.lens.names, bent, strict=True):
                values[f"{camera.name}.{name}"] = value
        place = scene.places_from_first[i]
        tangent = (result.reference_from_camera[i].inverse() @ place).log()
        for name, value in zip(("x", "y", "z", "rx", "ry", "rz"), tangent, strict=True):
            values[f"reference_from_{camera.name}.{name}"] = value
    return np.array([values[label] for label in result.covariance.labels])


def nees(result, scene: Scene) -> float:
    """Normalised estimation error squared of the intrinsics, per unknown."""
    return _nees(result, scene, places=False)


def nees_of_places(result, scene: Scene) -> float:
    """The same of where the cameras stand.

    Apart from the intrinsics: a principal point that is uncertain by 50 px goes with a
    rotation that is uncertain by degrees, and together the curvature of that pair
    would be scored, not the estimate.
    """
    return _nees(result, scene, places=True)


def _nees(result, scene: Scene, places: bool) -> float:
    labels = result.covariance.labels
    kept = [
        i for i, label in enumerate(labels) if label.startswith("reference") == places
    ]
    error = errors(result, scene)[kept]
    matrix = result.covariance.matrix[np.ix_(kept, kept)]
    return float(error @ np.linalg.solve(matrix, error) / len(error))
