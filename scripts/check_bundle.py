"""Monte-Carlo of the cameras' calibration, and what it costs: prints two tables.

    python scripts/check_bundle.py --trials 100

Projected points with noise, the sphere outlines and the robot's repeatability of the
shipped cells. NEES is the normalised estimation error squared per unknown: 1 where the
stated covariance is right.
"""

import argparse
import time
from dataclasses import replace

import numpy as np

from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.calibrate_cameras.bundle import TurnNoise, bundle_cameras
from handeye_tri.calibrate_cameras.session_camera import turn_covariance
from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.records import Repeatability
from handeye_tri.se3 import SE3, se3_exp
from handeye_tri.synthesize import look_at, reference_geometry, synthesize

ROBOT = Repeatability(3e-5, float(np.radians(0.005)))
RADII = (0.008, 0.008, 0.008)
LENS = Lens("radtan", np.array([-0.12, 0.04, 5e-4, -3e-4, 0.0]))
CELLS = {
    "normal": {},
    "edge": {"axis": "CA"},
    "lens": {"lens": LENS, "skew": 1.5},
}


def errors(result, truth):
    """Truth less estimate in the order of the labels."""
    values = {}
    origin = truth.base_from_camera[0].inverse()
    for i, (mine, true) in enumerate(zip(result.cameras, truth.cameras, strict=True)):
        difference = true.intrinsics.vector - mine.intrinsics.vector
        names = [*("fx", "fy", "skew", "cx", "cy"), *mine.lens.names]
        bent = true.lens.coefficients - mine.lens.coefficients
        for name, value in zip(names, [*difference, *bent], strict=True):
            values[f"{mine.name}.{name}"] = value
        place = origin @ truth.base_from_camera[i]
        tangent = (result.reference_from_camera[i].inverse() @ place).log()
        for name, value in zip(("x", "y", "z", "rx", "ry", "rz"), tangent, strict=True):
            values[f"reference_from_{mine.name}.{name}"] = value
    return np.array([values[label] for label in result.covariance.labels])


def tie(session, result):
    """Adjust again from a result, half-turns tied by the robot's repeatability."""
    return bundle_cameras(
        result.cameras,
        result.reference_from_camera,
        result.details["reference_from_triangle"],
        session.pixels - result.details["sphere_shift"],
        session.pixel_covariance,
        session.triangle,
        lenses=[info.lens for info in session.cameras],
        half_turns=session.half_turns,
        turn_noise=TurnNoise(turn_covariance(session.repeatability)),
    )


def monte_carlo(name, options, trials, sigma_px):
    rows = {"alone": [], "together": [], "tied": []}
    for seed in range(trials):
        geometry = reference_geometry(
            np.random.default_rng([seed, 0]), evaluation_stations=0, **options
        )
        session, truth = synthesize(
            geometry,
            np.random.default_rng([seed, 1]),
            sigma_px=sigma_px,
            repeatability=ROBOT,
            marker_radii=RADII,
        )
        result = calibrate_session_cameras(session)
        alone = result.details["separate"][0]
        one = replace(
            truth,
            cameras=truth.cameras[:1],
            base_from_camera=truth.base_from_camera[:1],
        )
        for kind, found, true in (
            ("alone", alone, one),
            ("together", result, truth),
            ("tied", tie(session, result), truth),
        ):
            error = errors(found, true)
            score = error @ np.linalg.solve(found.covariance.matrix, error) / len(error)
            rows[kind].append(
                (
                    score,
                    found.chi2 / found.dof,
                    error[0],
                    found.covariance.std("left.fx"),
                )
            )
    for kind, values in rows.items():
        score, chi2, error, sigma = np.array(values).T
        print(
            f"{name:8}{kind:10}{np.mean(score):7.3f}"
            f" +-{score.std() / len(score) ** 0.5:5.3f}{np.mean(chi2):10.3f}"
            f"{np.sqrt(np.mean(error**2)):11.3f}"
            f"{np.sqrt(np.mean(sigma**2)):10.3f}{np.abs(error / sigma).max():12.2f}"
        )


def crowd(cameras, stations):
    """Geometry of many cameras around a rig at many stations; pixels of all."""
    rng = np.random.default_rng(0)
    target = np.array([0.45, 0.0, 0.42])
    first = reference_geometry(rng, half_turns=3, evaluation_stations=0)
    mine, places = [], []
    for i in range(cameras):
        angle = rng.uniform(-0.5, 0.5)
        position = target + 0.95 * np.array([np.cos(angle), np.sin(angle), 0.2])
        k = Intrinsics.from_vector(
            first.cameras[0].intrinsics.vector * rng.uniform(0.99, 1.01, 5)
        )
        mine.append(PinholeCamera(f"c{i}", k, (1024, 768)))
        places.append(look_at(position, target))
    facing = look_at(target, target + (1.0, 0.0, 0.2)).matrix
    tangent = rng.uniform(-1, 1, (stations, 6)) * ([0.08] * 3 + [0.6] * 3)
    poses = facing @ se3_exp(tangent)
    corners = first.triangle.points - first.triangle.points.mean(axis=0)
    base = np.einsum("nab,kb->nka", poses[:, :3, :3], corners) + poses[:, None, :3, 3]
    pixels = np.array(
        [c.project(p.inverse().apply(base)) for c, p in zip(mine, places, strict=True)]
    )
    pixels += 0.015 * rng.standard_normal(pixels.shape)
    origin = places[0].inverse()
    offset = np.eye(4)
    offset[:3, 3] = -first.triangle.points.mean(axis=0)
    start = (
        origin.matrix
        @ poses
        @ offset
        @ se3_exp(1e-4 * rng.standard_normal((stations, 6)))
    )
    return mine, [origin @ p for p in places], start, pixels, first.triangle


def cost(cameras, stations):
    mine, places, start, pixels, triangle = crowd(cameras, stations)
    covariance = np.broadcast_to(0.015**2 * np.eye(2), (*pixels.shape, 2))
    started = time.process_time()
    result = bundle_cameras(
        mine, [SE3(p.matrix) for p in places], start, pixels, covariance, triangle
    )
    seconds = time.process_time() - started
    passes = result.details["iterations"] + 1
    print(
        f"{cameras:7}{stations:10}{seconds:10.2f}{passes:8}"
        f"{1e6 * seconds / passes / stations / cameras:16.2f}"
        f"{result.chi2 / result.dof:12.3f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--sigma-px", type=float, default=0.015)
    options = parser.parse_args()
    print(
        f"{options.trials} trials, {options.sigma_px} px       NEES     chi2/dof   "
        "fx rms px  sigma px  worst sigmas"
    )
    for name, cell in CELLS.items():
        monte_carlo(name, cell, options.trials, options.sigma_px)
    print("\ncameras  stations     cpu s  passes  us/view/pass    chi2/dof")
    for cameras, stations in ((2, 22), (2, 1000), (2, 10000), (64, 1000)):
        cost(cameras, stations)


if __name__ == "__main__":
    main()
