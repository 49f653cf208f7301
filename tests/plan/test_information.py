from __future__ import annotations

import numpy as np
import planning_scene as scene
import pytest

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera, triangulate
from handeye_tri.plan.information import StationInformation
from handeye_tri.plan.poses import View
from handeye_tri.records import MARKER_LABELS
from handeye_tri.se3 import SE3, se3_exp, se3_inverse

SIGMA = 0.05
NO_ERROR = np.zeros(6)


@pytest.fixture(params=["hp3_stereo", "hp3_stereo_lens", "hp3_stereo_edge"])
def cell(request):
    return scene.cell_of(request.param)


class Predicted:
    """Pixels of a cell as a function of the unknowns' deviations, by projection."""

    def __init__(self, cell):
        self.cell = cell
        self.view = View(cell)
        self.base_from_world = se3_exp([0.1, 0.2, 0.3, 0.2, -0.1, 0.4])
        self.model = StationInformation(
            self.view, self.base_from_world, cell.repeatability, SIGMA
        )
        poses = self.view.draw(np.random.default_rng(5), 60)
        poses = poses[self.view.in_image(poses).all(axis=1)][:12]
        self.poses = self.base_from_world @ poses
        self.seen = np.ones((len(poses), len(self.view.cameras)), dtype=bool)

    def deviated(self, delta):
        """Cameras, base_from_camera and markers (3, 3), off by delta (p,)."""
        value = dict(zip(self.model.labels, delta, strict=True))
        cameras, motions = [], []
        for i, camera in enumerate(self.view.cameras):
            n = camera.name
            k = camera.intrinsics
            names = ("fx", "fy", "skew", "cx", "cy")
            vector = [getattr(k, q) + value.get(f"{n}.{q}", 0.0) for q in names]
            lens = np.array(camera.lens.coefficients)
            for j, q in enumerate(camera.lens.names):
                lens[j] += value.get(f"{n}.{q}", 0.0)
            cameras.append(
                PinholeCamera(
                    n, Intrinsics.from_vector(vector), camera.image_size,
                    Lens(camera.lens.model, lens),
                )
            )  # fmt: skip
            nominal = self.base_from_world @ self.view.world_from_camera[i]
            motions.append(nominal @ se3_exp(self._tangent(value, f"base_from_{n}")))
        off = np.array([value[label] for label in MARKER_LABELS]).reshape(3, 3)
        return cameras, motions, self.view.markers + off

    @staticmethod
    def _tangent(value, name):
        return [value[f"{name}.{q}"] for q in ("x", "y", "z", "rx", "ry", "rz")]

    def markers(self, points, error=NO_ERROR):
        """In the base, shape (n, 3, 3)."""
        poses = self.poses @ se3_exp(error)
        turned = points @ poses[:, :3, :3].swapaxes(1, 2)
        return turned + poses[:, None, :3, 3]

    def pixels(self, delta, error=NO_ERROR):
        """Shape (n, cameras, 3, 2)."""
        cameras, motions, rig = self.deviated(delta)
        points = self.markers(rig, error)
        seen = []
        for camera, motion in zip(cameras, motions, strict=True):
            local = se3_inverse(motion)
            seen.append(camera.project(points @ local[:3, :3].T + local[:3, 3]))
        return np.stack(seen, axis=1)


def numeric(function, size, step=1e-6):
    """Central differences, last axis by unknowns; f ~ 1e3 px limits it to 1e-7."""
    columns = []
    for k in range(size):
        delta = np.zeros(size)
        delta[k] = step
        columns.append((function(delta) - function(-delta)) / (2 * step))
    return np.stack(columns, axis=-1)


def test_information_is_that_of_the_whole_least_squares_problem(cell):
    """Built densely from finite differences, with one error per station as unknown."""
    scenario = Predicted(cell)
    p, n = len(scenario.model.labels), len(scenario.poses)
    zero = np.zeros(p)
    by_unknowns = numeric(scenario.pixels, p).reshape(n, -1, p)
    by_error = numeric(lambda e: scenario.pixels(zero, e), 6).reshape(n, -1, 6)
    robot = np.linalg.inv(cell.repeatability.covariance)
    expected = np.empty((n, p, p))
    for j in range(n):
        both = np.concatenate([by_unknowns[j], by_error[j]], axis=1) / SIGMA
        normal = both.T @ both
        normal[p:, p:] += robot
        coupling = normal[:p, p:]
        expected[j] = normal[:p, :p] - coupling @ np.linalg.solve(
            normal[p:, p:], coupling.T
        )
    found = scenario.model.of_stations(scenario.poses, scenario.seen)
    # Both sides in units where every diagonal is 1: differences cost 1e-7 relative.
    scale = 1 / np.sqrt(np.diagonal(expected, axis1=1, axis2=2))
    unit = scale[:, :, None] * scale[:, None, :]
    np.testing.assert_allclose(found * unit, expected * unit, atol=1e-5)


def test_an_exact_robot_is_the_limit_of_a_good_one(cell):
    scenario = Predicted(cell)
    exact = StationInformation(
        scenario.view,
        scenario.base_from_world,
        type(cell.repeatability)(0.0, 0.0),
        SIGMA,
    ).of_stations(scenario.poses, scenario.seen)
    # Information only grows as the robot gets better.
    gained = exact - scenario.model.of_stations(scenario.poses, scenario.seen)
    scale = 1 / np.sqrt(np.diagonal(exact, axis1=1, axis2=2))
    eigenvalues = np.linalg.eigvalsh(gained * scale[:, :, None] * scale[:, None, :])
    assert eigenvalues.min() > -1e-9
    assert eigenvalues.max() > 0.1


def test_track_derivatives_meet_triangulation(cell):
    """Triangulate true pixels with cameras and a rig that are off."""
    scenario = Predicted(cell)
    p, n = len(scenario.model.labels), len(scenario.poses)
    pixels = scenario.pixels(np.zeros(p)).transpose(1, 0, 2, 3).reshape(-1, 3 * n, 2)
    covariance = np.broadcast_to(np.eye(2), (*pixels.shape, 2))

    def track(delta):
        cameras, motions, rig = scenario.deviated(delta)
        observed, _ = triangulate(
            cameras, [SE3(m) for m in motions], pixels, covariance
        )
        return observed.reshape(n, 3, 3) - scenario.markers(rig)

    found = scenario.model.track_derivatives(scenario.poses, scenario.seen)
    # A step of 1e-4 keeps differences of points near 1 m at 1e-11, the truncation
    # at 1e-8 of derivatives up to 10.
    expected = numeric(track, p, step=1e-4)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_covariance_is_the_inverse_and_names_what_is_estimated(cell):
    scenario = Predicted(cell)
    information = scenario.model.of_stations(scenario.poses, scenario.seen).sum(axis=0)
    covariance = scenario.model.covariance(information)
    product = covariance.matrix @ (information + scenario.model.prior)
    np.testing.assert_allclose(product, np.eye(len(product)), atol=1e-5)
    for config in cell.cameras:
        asked = {"fx", "fy", "cx", "cy", *config.estimate.lens}
        asked |= {"skew"} if config.estimate.skew else set()
        own = {x.split(".")[1] for x in covariance.labels if x.startswith(config.name)}
        assert own == asked
