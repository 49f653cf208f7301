"""What is put into a cell is seen where it is, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
from small_cell import GANTRY, small_cell

from handeye_tri.errors import InputError
from handeye_tri.mechanism import Geometry
from handeye_tri.se3 import SE3, so3_exp
from handeye_tri.simulate import Prop, render_views


def sheet(half: float = 0.03) -> Geometry:
    """A bright square in the plane z = 0, seen from both sides."""
    vertices = half * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    faces = [(0, 1, 2), (0, 2, 3), (0, 2, 1), (0, 3, 2)]
    white = np.array([1.0, 1.0, 1.0, 1.0])
    return Geometry(
        *("sheet", 0, "mesh", np.empty(0), SE3.identity()),
        *(vertices, np.array(faces), white, False),
    )


def test_a_prop_is_seen_where_it_is_and_only_at_its_stations() -> None:
    cell = small_cell()
    pose = np.tile(np.eye(4), (3, 1, 1))
    pose[:, :3, :3] = so3_exp([0.3, -1.2, 0.2])
    pose[:, :3, 3] = [0.8, 0.02, 0.03], [0.85, -0.04, 0.0], [np.nan] * 3
    prop = Prop("sheet", (sheet(),), pose)
    # The gantry waits behind the cameras.
    joints = np.tile([-3.0, 0.0, 0.0, 0.0, 0.0, 0.0], (3, 1))
    images = {
        (i, j): image.astype(float).mean(axis=2)
        for i, j, image in render_views(
            cell,
            GANTRY,
            joints,
            1,
            [(i, j) for j in range(3) for i in range(2)],
            [prop],
        )
    }
    for i, config in enumerate(cell.cameras):
        for j in range(2):
            # The sheet has one level, what is behind it a gradient.
            level = images[i, j].max()
            covered = (images[i, j] - images[i, 2]) / (level - images[i, 2])
            rows, columns = np.indices(covered.shape)
            seen = np.array([columns, rows]) * covered
            # The centroid of the projected quadrilateral, by many points of it.
            grid = np.linspace(-0.03, 0.03, 201)
            grid = 0.5 * (grid[1:] + grid[:-1])
            points = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
            points = np.column_stack([points, np.zeros(len(points))])
            world = points @ pose[j, :3, :3].T + pose[j, :3, 3]
            local = config.world_from_camera.inverse().apply(world)
            # Each point stands for its part of the image: depth^-3 of the sheet's.
            weight = local[:, 2] ** -3
            true = (config.camera.project(local) * weight[:, None]).sum(axis=0)
            found = seen.sum(axis=(1, 2)) / covered.sum()
            np.testing.assert_allclose(found, true / weight.sum(), atol=0.03)


def test_a_prop_is_made_of_meshes() -> None:
    ball = Geometry(
        *("ball", 0, "sphere", np.array([0.1]), SE3.identity()),
        *(np.empty((0, 3)), np.empty((0, 3), dtype=int), np.ones(4), False),
    )
    with pytest.raises(InputError, match="prop 'toy': ball must be given as meshes"):
        Prop("toy", (ball,), np.eye(4)[None])
    with pytest.raises(InputError, match="prop 'toy': world_from_prop"):
        Prop("toy", (sheet(),), np.eye(4))
