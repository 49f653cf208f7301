"""Sessions with as many cameras as wanted, and starts near the truth."""

from dataclasses import replace

import numpy as np

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.records import Repeatability
from handeye_tri.se3 import SE3, se3_exp
from handeye_tri.synthesize import (
    look_at,
    reference_geometry,
    synthesize,
    two_mount_geometry,
)

LENS = Lens("radtan", np.array([-0.15, 0.05, 5e-4, -3e-4, 0.0]))
ROBOT = Repeatability(3e-5, float(np.radians(0.005)))
SIGMA_PX = 0.015


def scene(seed=0, count=2, *, half_turns=8, **options):
    """A geometry with `count` cameras on an arc; the pair of the reference first."""
    geometry = reference_geometry(
        np.random.default_rng(seed),
        half_turns=half_turns,
        evaluation_stations=0,
        **options,
    )
    cameras = list(geometry.cameras)
    places = list(geometry.base_from_camera)
    target = np.array([0.45, 0.0, 0.42])
    rng = np.random.default_rng([seed, 7])
    for i in range(2, count):
        angle = 0.5 * np.sin(2.4 * i)
        position = target + 0.95 * np.array(
            [np.cos(angle), np.sin(angle), 0.25 * np.cos(1.7 * i)]
        )
        k = Intrinsics.from_vector(
            cameras[0].intrinsics.vector * rng.uniform(0.99, 1.01, 5)
        )
        cameras.append(
            PinholeCamera(f"c{i}", k, cameras[0].image_size, cameras[0].lens)
        )
        places.append(look_at(position, target + rng.normal(0, 0.01, 3)))
    return replace(
        geometry,
        cameras=tuple(cameras[:count]),
        base_from_camera=tuple(places[:count]),
    )


def observe(geometry, seed=0, sigma_px=SIGMA_PX, robot=ROBOT, **options):
    return synthesize(
        geometry,
        np.random.default_rng([seed, 99]),
        sigma_px=sigma_px,
        repeatability=robot,
        **options,
    )


def two_feet(seed=0, count=2, *, half_turns=8, axes=("normal", "normal"), **options):
    """Two mounts; about normals through feet 15 mm apart in the triangle."""
    geometry = two_mount_geometry(
        np.random.default_rng(seed),
        half_turns=half_turns // 2,
        evaluation_stations=0,
        axes=axes,
        **options,
    )
    stations = list(geometry.stations)
    (flange_from_triangle,) = geometry.other_mounts
    foot = geometry.triangle.circumcentre + (0.012, -0.009)
    for turn in geometry.half_turns[half_turns // 2 :]:
        if turn.axis == "normal":
            motion = geometry.triangle.half_turn("normal", foot)
            moved = flange_from_triangle @ motion @ flange_from_triangle.inverse()
            pose = stations[turn.before].base_from_flange @ moved
            stations[turn.after] = replace(stations[turn.after], base_from_flange=pose)
    return replace(
        geometry,
        cameras=geometry.cameras[:count],
        base_from_camera=geometry.base_from_camera[:count],
        stations=tuple(stations),
    )


def true_motions(truth, mounts=None):
    """reference_from_camera of all cameras and reference_from_triangle, (n, 4, 4).

    With several mounts of the triangle, ``mounts`` is that of each station.
    """
    base = truth.base_from_camera[0].inverse()
    rigs = [truth.flange_from_triangle.matrix]
    rigs += [mount.flange_from_triangle.matrix for mount in truth.other_mounts]
    poses = truth.base_from_flange @ np.array(rigs)[0 if mounts is None else mounts]
    return [base @ place for place in truth.base_from_camera], base.matrix @ poses


def near(truth, seed=0, size=1.0, mounts=None):
    """Cameras 1 % and motions about 1 mm and 1 mrad beside the truth."""
    rng = np.random.default_rng([seed, 3])
    places, poses = true_motions(truth, mounts)
    cameras = []
    for camera in truth.cameras:
        factor = 1 + 0.01 * size * rng.standard_normal(5)
        vector = camera.intrinsics.vector * factor
        lens = Lens(camera.lens.model, camera.lens.coefficients * (1 - 0.2 * size))
        cameras.append(
            replace(camera, intrinsics=Intrinsics.from_vector(vector), lens=lens)
        )
    moved = [places[0]] + [
        place @ SE3.exp(1e-3 * size * rng.standard_normal(6)) for place in places[1:]
    ]
    poses = poses @ se3_exp(1e-3 * size * rng.standard_normal((len(poses), 6)))
    return cameras, moved, poses


def errors(result, truth):
    """Truth less estimate, in the order and units of the covariance labels."""
    places, _ = true_motions(truth)
    values = {}
    for i, (camera, true) in enumerate(zip(result.cameras, truth.cameras, strict=True)):
        for name in ("fx", "fy", "skew", "cx", "cy"):
            values[f"{camera.name}.{name}"] = getattr(true.intrinsics, name) - getattr(
                camera.intrinsics, name
            )
        for j, name in enumerate(camera.lens.names):
            values[f"{camera.name}.{name}"] = (
                true.lens.coefficients[j] - camera.lens.coefficients[j]
            )
        tangent = (result.reference_from_camera[i].inverse() @ places[i]).log()
        for j, name in enumerate(("x", "y", "z", "rx", "ry", "rz")):
            values[f"reference_from_{camera.name}.{name}"] = tangent[j]
    return np.array([values[label] for label in result.covariance.labels])


def nees(result, truth):
    """Normalised estimation error squared per unknown; 1 in the mean."""
    error = errors(result, truth)
    return error @ np.linalg.solve(result.covariance.matrix, error) / len(error)
