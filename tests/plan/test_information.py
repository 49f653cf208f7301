from __future__ import annotations

import numpy as np
import planning_scene as scene
import pytest

from handeye_tri.camera import Intrinsics, Lens, PinholeCamera, triangulate
from handeye_tri.plan.information import StationInformation
from handeye_tri.records import marker_labels
from handeye_tri.se3 import SE3, se3_exp, se3_inverse

SIGMA = 0.05
NO_ERROR = np.zeros(6)


@pytest.fixture(
    params=["hp3_stereo", "hp3_stereo_lens", "hp3_stereo_edge", "hp3_stereo_both"]
)
def cell(request):
    return scene.cell_of(request.param)


class Predicted:
    """Pixels of a cell as a function of the unknowns' deviations, by projection."""

    def __init__(self, cell):
        self.cell = cell
        self.base_from_world = se3_exp([0.1, 0.2, 0.3, 0.2, -0.1, 0.4])
        self.model = StationInformation(
            cell, self.base_from_world, cell.repeatability, SIGMA
        )
        self.view = self.model.views[0]
        drawn, mounts = [], []
        for mount, view in enumerate(self.model.views):
            poses = view.draw(np.random.default_rng(5), 60)
            drawn.append(poses[view.in_image(poses).all(axis=1)][:12])
            mounts += [mount] * len(drawn[-1])
        self.mounts = np.array(mounts)
        self.poses = self.base_from_world @ np.concatenate(drawn)
        self.seen = np.ones((len(self.poses), len(self.view.cameras)), dtype=bool)
        self.there = self.poses, self.seen, self.mounts

    def deviated(self, delta):
        """Cameras, base_from_camera and markers (n, 3, 3), off by delta (p,)."""
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
        markers = np.array(
            [
                view.markers
                + np.reshape([value[label] for label in marker_labels(mount)], (3, 3))
                for mount, view in enumerate(self.model.views)
            ]
        )
        return cameras, motions, markers[self.mounts]

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
    found = scenario.model.of_stations(*scenario.there)
    # Both sides in units where every diagonal is 1: differences cost 1e-7 relative.
    # A station tells nothing of the other mount's markers.
    diagonal = np.diagonal(expected, axis1=1, axis2=2)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    unit = scale[:, :, None] * scale[:, None, :]
    np.testing.assert_allclose(found * unit, expected * unit, atol=1e-5)


def test_an_exact_robot_is_the_limit_of_a_good_one(cell):
    scenario = Predicted(cell)
    exact = StationInformation(
        cell,
        scenario.base_from_world,
        type(cell.repeatability)(0.0, 0.0),
        SIGMA,
    ).of_stations(*scenario.there)
    # Information only grows as the robot gets better.
    gained = exact - scenario.model.of_stations(*scenario.there)
    diagonal = np.diagonal(exact, axis1=1, axis2=2)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
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

    found = scenario.model.track_derivatives(*scenario.there)
    # A step of 1e-4 keeps differences of points near 1 m at 1e-11, the truncation
    # at 1e-8 of derivatives up to 10.
    expected = numeric(track, p, step=1e-4)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_covariance_is_the_inverse_and_names_what_is_estimated(cell):
    scenario = Predicted(cell)
    information = scenario.model.of_stations(*scenario.there).sum(axis=0)
    covariance = scenario.model.covariance(information)
    product = covariance.matrix @ (information + scenario.model.prior)
    np.testing.assert_allclose(product, np.eye(len(product)), atol=1e-5)
    for config in cell.cameras:
        asked = {"fx", "fy", "cx", "cy", *config.estimate.lens}
        asked |= {"skew"} if config.estimate.skew else set()
        own = {x.split(".")[1] for x in covariance.labels if x.startswith(config.name)}
        assert own == asked


def test_a_station_tells_of_its_own_mount_only():
    scenario = Predicted(scene.cell_of("hp3_stereo_both"))
    labels = scenario.model.labels
    assert labels[-18:] == (*marker_labels(0), *marker_labels(1))
    information = scenario.model.of_stations(*scenario.there)
    of = np.array([labels.index("marker_A.x"), labels.index("marker_A_2.x")])
    for mount in (0, 1):
        own, other = of[mount] + np.arange(9), of[1 - mount] + np.arange(9)
        there = information[scenario.mounts == mount]
        assert not there[:, other].any()
        assert (np.diagonal(there[:, own][:, :, own], axis1=1, axis2=2) > 0).all()


def test_either_mount_counts_alike_in_the_workspace():
    """The joint cost is the mean of those of cells with one mount each."""
    both = scene.cell_of("hp3_stereo_both")
    base = np.eye(4)
    joint = StationInformation(both, base, both.repeatability, SIGMA)
    alone = [
        StationInformation(cell, base, cell.repeatability, SIGMA)
        for cell in both.mounted
    ]
    assert joint.workspace_noise == pytest.approx(
        np.mean([one.workspace_noise for one in alone])
    )
    cameras = len(joint.labels) - 18
    costs = np.array([one.workspace_cost for one in alone])
    expected = costs[:, :cameras, :cameras].mean(axis=0)
    np.testing.assert_allclose(joint.workspace_cost[:cameras, :cameras], expected)
    for mount, cost in enumerate(costs):
        own = slice(cameras + 9 * mount, cameras + 9 * mount + 9)
        np.testing.assert_allclose(
            joint.workspace_cost[own, own], 0.5 * cost[cameras:, cameras:], atol=1e-12
        )
