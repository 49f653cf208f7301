"""A calibrated session without rendering, and a mechanism with every shape."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.diagnose import assess
from handeye_tri.evaluate import evaluate_track, track_budget
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.mechanism import Body, Geometry, Joint, Mechanism, Shape
from handeye_tri.records import (
    CameraCalibration,
    GroundTruth,
    HandEyeCalibration,
    Repeatability,
    Session,
    TrackEvaluation,
)
from handeye_tri.se3 import SE3
from handeye_tri.summary import result_rows
from handeye_tri.synthesize import Geometry as Driven
from handeye_tri.synthesize import reference_geometry, synthesize, two_mount_geometry
from handeye_tri.triangle import Axis

RNG = np.random.default_rng
BASE_FROM_WORLD = SE3.from_parts(np.eye(3), [0.0, 0.0, -0.3])


@dataclass(frozen=True)
class Finished:
    session: Session
    cameras: CameraCalibration
    calibration: HandEyeCalibration
    track: TrackEvaluation
    truth: GroundTruth


@cache
def finished(seed: int = 1, axis: Axis = "normal") -> Finished:
    """A session of 5 half-turns and 3 held-out stations, calibrated."""
    return _calibrated(
        reference_geometry(
            RNG([seed, 0]), half_turns=5, evaluation_stations=3, axis=axis
        ),
        seed,
    )


@cache
def finished_on_two_mounts(seed: int = 1) -> Finished:
    """3 half-turns and 2 held-out stations about a normal, then about the edge BC."""
    geometry = two_mount_geometry(RNG([seed, 0]), half_turns=3, evaluation_stations=2)
    return _calibrated(geometry, seed)


def _calibrated(geometry: Driven, seed: int) -> Finished:
    session, truth = synthesize(
        geometry,
        RNG([seed, 1]),
        sigma_px=0.02,
        repeatability=Repeatability(3e-5, np.radians(0.005)),
        marker_radii=(0.008, 0.008, 0.008),
    )
    cameras = calibrate_session_cameras(session)
    calibration = calibrate_hand_eye(session, cameras)
    track = evaluate_track(calibration, session)
    return Finished(session, cameras, calibration, track, truth)


def _geometry(name: str, body: int, shape: Shape, size: list[float]) -> Geometry:
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], dtype=float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    is_mesh = shape == "mesh"
    return Geometry(
        name=name,
        body=body,
        shape=shape,
        size=np.array(size),
        body_from_geometry=SE3.identity(),
        vertices=corners if is_mesh else np.empty((0, 3)),
        faces=faces if is_mesh else np.empty((0, 3), dtype=np.int64),
        rgba=np.array([0.6, 0.6, 0.6, 1.0]),
        collides=True,
    )


def mechanism() -> Mechanism:
    """Two bodies on the world, with one solid of each shape."""
    shapes: list[tuple[int, Shape, list[float]]] = [
        (0, "plane", []),
        (0, "box", [0.4, 0.4, 0.02]),
        (1, "cylinder", [0.1, 0.05]),
        (1, "capsule", [0.05, 0.15]),
        (2, "sphere", [0.03]),
        (2, "ellipsoid", [0.05, 0.03, 0.02]),
        (2, "mesh", []),
    ]
    return Mechanism(
        bodies=(
            Body("world", 0, SE3.identity()),
            Body("base", 0, BASE_FROM_WORLD.inverse()),
            # A name that needs escaping in a path.
            Body("link/1 t", 1, SE3.identity()),
        ),
        joints=(
            Joint(
                *("t", 2, "hinge", np.zeros(3), np.array([0.0, 0.0, 1.0])),
                *(-3.0, 3.0, 0.0, 1.0),
            ),
        ),
        geometries=tuple(
            _geometry(f"{shape} of {body}", body, shape, size)
            for body, shape, size in shapes
        ),
        base="base",
        flange="flange",
        base_body=1,
        flange_body=2,
        body_from_flange=SE3.identity(),
        marker_body=2,
        markers=np.zeros((3, 3)),
        touching=frozenset(),
    )


def world_from_body(session: Session) -> NDArray[np.float64]:
    """The last body is at the flange; shape (n, 3, 4, 4)."""
    world_from_base = BASE_FROM_WORLD.inverse().matrix
    poses = np.tile(np.eye(4), (len(session.stations), 3, 1, 1))
    poses[:, 1] = world_from_base
    poses[:, 2] = world_from_base @ session.base_from_flange
    return poses


def photograph(camera: str, station: int) -> NDArray[np.uint8]:
    """A grey ramp that is another in every view."""
    ramp = np.linspace(60, 200, 1024, dtype=np.uint8)
    row = np.roll(ramp, 40 * station + len(camera))
    return np.repeat(np.tile(row, (768, 1))[..., None], 3, axis=2)


def evaluation(done: Finished) -> dict[str, Any]:
    """What evaluation.json holds."""
    track, budget = done.track, track_budget(done.calibration, done.session)
    verdict = assess(
        *(done.session, done.cameras, done.calibration, track),
        track_limit=1e-3,
        min_plane_spread=float(np.radians(20)),
    )
    worst = int(np.argmax(track.distances))
    return {
        "verdict": verdict.outcome,
        "sentence": verdict.sentence,
        "nearest": verdict.nearest,
        "simulated": True,
        "gates": [asdict(gate) for gate in verdict.gates],
        "findings": [asdict(finding) for finding in verdict.findings],
        "track": {
            "source": "held-out stations",
            "stations": len(set(track.stations.tolist())),
            "mean_mm": 1e3 * track.mean,
            "rms_mm": 1e3 * track.rms,
            "max_mm": 1e3 * track.max,
            "worst_station": int(track.stations[worst]),
            "worst_marker": "ABC"[track.markers[worst]],
            "predicted_rms_mm": 1e3 * track.predicted_rms,
            "against_prediction": {
                "outcome": "consistent",
                "low_mm": 0.05,
                "high_mm": 0.15,
            },
            "predicted_parts_mm": {
                name: 1e3 * value for name, value in budget.parts().items()
            },
            "positions": [
                {
                    "station": int(track.stations[r]),
                    "marker": "ABC"[track.markers[r]],
                    "reported_m": track.reported[r].tolist(),
                    "observed_m": track.observed[r].tolist(),
                    "error_mm": 1e3 * float(track.distances[r]),
                }
                for r in range(len(track.stations))
            ],
        },
        "robot": {"asked": [], "estimated": [], "undetermined": []},
        "cross_checks": _cross_checks(done),
        "result": result_rows(done.calibration, done.truth),
    }


def _cross_checks(done: Finished) -> dict[str, Any]:
    covariance = done.calibration.covariance
    sigma = {label: covariance.std(label) for label in covariance.labels}
    return {
        "cross_validation": {
            **{"folds": 5, "groups": 5, "stations": 10, "undetermined": [[2, 3]]},
            **{"mean_mm": 0.0712, "rms_mm": 0.0823, "max_mm": 0.1934},
            "predicted_rms_mm": 0.0845,
        },
        "bootstrap": {
            **{"replicates": 60, "failed": 0, "drawn_from": 5, "relative_error": 0.37},
            **{"track_calibration_mm": 0.0456, "rms_ratio_to_covariance": 1.25},
            "track_calibration_by_covariance_mm": 0.0365,
            "sigma": {label: 1.25 * value for label, value in sigma.items()},
            "sigma_by_covariance": sigma,
        },
        "parametric_bootstrap": {"not_run": "there was <no> time"},
    }
