"""Row 4 of `bench.py`: the joint adjustment, two cameras and three points a view.

A view is one camera's picture of one station. The gate: at 100 stations the same answer
as a dense solver that knows nothing of this project's derivatives or elimination (it
takes central differences of the cameras' own projections).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from bench_rows import Gate, Measured, Row, here

from handeye_tri.adjustment import adjust
from handeye_tri.camera import Intrinsics, PinholeCamera
from handeye_tri.records import (
    Covariance,
    HandEyeCalibration,
    Repeatability,
    Session,
    Station,
)
from handeye_tri.se3 import SE3, se3_exp, se3_inverse, se3_log
from handeye_tri.synthesize import Geometry, reference_geometry, synthesize

ROBOT = Repeatability(3e-5, float(np.radians(0.005)))
SIGMA_PX = 0.1
FEW, MANY, VERY_MANY = 100, 10_000, 100_000
CAMERAS = 2
MOST_BYTES = 2000
SAME = 1e-9
# Of a camera: fx, fy, cx, cy among its five intrinsics, then its place.
FREE = [0, 1, 3, 4]
OF_A_CAMERA = len(FREE) + 6
SHARED = CAMERAS * OF_A_CAMERA + 9


def crowd(n: int) -> tuple[Session, HandEyeCalibration]:
    """A stereo cell with n stations in view, and a cell near the true one."""
    rng = np.random.default_rng([4, n])
    base = reference_geometry(rng, half_turns=3, evaluation_stations=0)
    nominal = np.array([one.base_from_flange.matrix for one in base.stations])
    away = rng.uniform(-1, 1, (n, 6)) * np.repeat([0.02, 0.3], 3)
    poses = nominal[rng.integers(0, len(nominal), n)] @ se3_exp(away)
    stations = tuple(
        Station(j, "calibration", np.empty(0), SE3(pose))
        for j, pose in enumerate(poses)
    )
    geometry = Geometry(
        base.triangle,
        base.flange_from_triangle,
        base.cameras,
        base.base_from_camera,
        stations,
        (),
    )
    session, truth = synthesize(
        geometry,
        rng,
        sigma_px=SIGMA_PX,
        repeatability=ROBOT,
        estimate_skew=False,
    )
    near = np.r_[np.full(4, 3.0), np.full(3, 1e-3), np.full(3, 2e-3)]
    change = np.r_[np.tile(near, CAMERAS), np.full(9, 1e-3)]
    unknown = Unknown(
        truth.cameras,
        np.array([place.matrix for place in truth.base_from_camera]),
        truth.markers,
        session.base_from_flange,
    ).moved(change * rng.standard_normal(SHARED), np.zeros((n, 6)))
    frame = truth.flange_from_triangle
    return session, HandEyeCalibration(
        unknown.cameras,
        tuple(SE3(place) for place in unknown.places),
        frame,
        unknown.markers,
        Covariance(("none.x",), np.eye(1)),
        0.0,
        1,
        np.zeros((1, 6)),
        "drawn",
    )


@dataclass(frozen=True)
class Unknown:
    """One value of what the dense solver looks for."""

    cameras: tuple[PinholeCamera, ...]
    places: Any
    markers: Any
    poses: Any

    def moved(self, shared: Any, own: Any) -> Unknown:
        """Moved by (SHARED,) and (n, 6) numbers."""
        cameras, places = [], []
        for i, camera in enumerate(self.cameras):
            step = shared[i * OF_A_CAMERA : (i + 1) * OF_A_CAMERA]
            vector = np.array(camera.intrinsics.vector)
            vector[FREE] += step[:4]
            cameras.append(replace(camera, intrinsics=Intrinsics.from_vector(vector)))
            places.append(self.places[i] @ se3_exp(step[4:]))
        markers = self.markers + shared[-9:].reshape(3, 3)
        poses = self.poses @ se3_exp(own)
        return Unknown(tuple(cameras), np.array(places), markers, poses)

    def pixels(self) -> Any:
        """Shape (cameras, n, 3, 2)."""
        points = np.einsum("nab,kb->nka", self.poses[:, :3, :3], self.markers)
        points += self.poses[:, None, :3, 3]
        return np.array(
            [
                camera.project(SE3(place).inverse().apply(points))
                for camera, place in zip(self.cameras, self.places, strict=True)
            ]
        )

    def slopes(self) -> tuple[Any, Any]:
        """Of pixels, by shared (..., SHARED) and own unknowns (..., 6)."""
        size = np.r_[
            np.tile(np.r_[np.full(4, 1e-1), np.full(6, 1e-5)], CAMERAS),
            np.full(9, 1e-5),
        ]
        still, zero = np.zeros((len(self.poses), 6)), np.zeros(SHARED)
        shared = [
            (self.moved(d, still).pixels() - self.moved(-d, still).pixels()) / (2 * h)
            for d, h in zip(np.diag(size), size, strict=True)
        ]
        own = []
        for turn in 1e-5 * np.eye(6):
            plus, minus = (self.moved(zero, still + d) for d in (turn, -turn))
            own.append((plus.pixels() - minus.pixels()) / 2e-5)
        return np.stack(shared, -1), np.stack(own, -1)


def dense(session: Session, start: HandEyeCalibration) -> tuple[Unknown, float]:
    """Gauss-Newton on one dense matrix; the optimum and its chi2."""
    n = len(session.stations)
    seen = np.isfinite(session.pixels)
    sigma = np.repeat([ROBOT.translation, ROBOT.rotation], 3)
    at = Unknown(
        start.cameras,
        np.array([place.matrix for place in start.base_from_camera]),
        np.array(start.markers),
        session.base_from_flange,
    )
    for _ in range(8):
        by_shared, by_own = at.slopes()
        wide = np.zeros((*by_own.shape[:-1], n, 6))
        wide[:, np.arange(n), :, :, np.arange(n)] = np.moveaxis(by_own, 1, 0)
        by_pixels = np.concatenate(
            [by_shared, wide.reshape(*by_own.shape[:-1], 6 * n)], axis=-1
        )
        back = se3_inverse(session.base_from_flange)
        error = se3_log(back @ at.poses)
        robot = np.zeros((n, 6, n, 6))
        for k, turn in enumerate(1e-5 * np.eye(6)):
            plus, minus = (se3_log(back @ at.poses @ se3_exp(d)) for d in (turn, -turn))
            robot[np.arange(n), :, np.arange(n), k] = (plus - minus) / 2e-5
        robot = np.hstack([np.zeros((6 * n, SHARED)), robot.reshape(6 * n, 6 * n)])
        weights = np.tile(1 / sigma, n)
        matrix = np.vstack([by_pixels[seen] / SIGMA_PX, weights[:, None] * robot])
        missed = (at.pixels() - session.pixels)[seen] / SIGMA_PX
        missed = np.append(missed, weights * error.ravel())
        scale = 1 / np.linalg.norm(matrix, axis=0)
        orthogonal, upper = np.linalg.qr(matrix * scale)
        step = -scale * np.linalg.solve(upper, orthogonal.T @ missed)
        at = at.moved(step[:SHARED], step[SHARED:].reshape(n, 6))
    return at, float(missed @ missed)


@cache
def same_as_dense() -> Gate:
    """Largest difference of what both solvers find at 100 stations."""
    session, start = crowd(FEW)
    found = adjust(session, start)
    expected, chi2 = dense(session, start)
    differences = [abs(found.chi2 / chi2 - 1)]
    for i, camera in enumerate(found.cameras):
        mine, other = (c.intrinsics.vector[FREE] for c in (camera, expected.cameras[i]))
        differences.append(np.abs(mine / other - 1).max())
        place = found.base_from_camera[i].matrix
        differences.append(np.abs(place - expected.places[i]).max())
    differences.append(np.abs(found.markers - expected.markers).max())
    worst = float(max(differences))
    return Gate(
        worst <= SAME, f"dense solver, {FEW} stations: within {worst:.1e} <= {SAME:g}"
    )


@cache
def adjusting(n: int) -> Callable[[], Any]:
    return partial(adjust, *crowd(n))


def promised_bytes(_least: float) -> tuple[float, Any]:
    return float(MOST_BYTES * CAMERAS * VERY_MANY), None


def theirs(_peers: Any) -> Measured:
    return here(adjusting(MANY))


def rows() -> list[Row]:
    return [
        Row(
            number=4,
            work=f"joint adjustment, a view of {VERY_MANY} stations",
            peer=f"itself, {MANY} stations",
            bar=1.2,
            at_most=True,
            ours=partial(adjusting, VERY_MANY),
            theirs=theirs,
            units=(CAMERAS * VERY_MANY, CAMERAS * MANY),
            gate=lambda _ours, _theirs: same_as_dense(),
            threads=False,
        ),
        Row(
            number=4,
            work="joint adjustment, memory of a view",
            peer=f"{MOST_BYTES} bytes",
            bar=1.0,
            at_most=True,
            ours=partial(adjusting, VERY_MANY),
            theirs=lambda _peers: promised_bytes,
            units=(CAMERAS * VERY_MANY, CAMERAS * VERY_MANY),
            measure="bytes",
            threads=False,
        ),
    ]
