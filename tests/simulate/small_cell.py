"""Cells for the tests: the shipped ones, and a small one with a gantry."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from handeye_tri.arm import Arm
from handeye_tri.config import Cell, parse_cell
from handeye_tri.simulate import compile_mechanism
from handeye_tri.storage.cells import read_cell

REPO = Path(__file__).resolve().parents[2]
DATA = REPO / "tests" / "data"
HP3 = REPO / "robot_models" / "hp3_like.xml"
GANTRY = DATA / "gantry.xml"


def shipped(name: str) -> Cell:
    return read_cell(REPO / "scenes" / f"{name}.yaml")


def small_cell(**changes: object) -> Cell:
    """A gantry that carries a small triangle before two unlike small cameras.

    Off-centre principal points and fx != fy: a wrong sign or a half pixel shows.
    """
    eye = {
        "image_size_px": [360, 280],
        "focal_px": [700.0, 660.0],
        "principal_point_px": [205.3, 118.6],
        "position_m": [0.0, 0.0, 0.0],
        "look_at_m": [1.0, 0.0, 0.0],
    }
    data: dict[str, object] = {
        "schema": "handeye_tri.cell/1",
        "name": "small",
        "arm": {"model": "gantry.xml", "flange": "flange"},
        "rig": {
            "axis": "normal",
            "side_ab_mm": 90,
            "side_ac_mm": 85,
            "angle_deg": 62,
            "ahead_mm": 80,
            "marker_radii_mm": [8, 8, 8],
            "marker_colours": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
            "identity": "colour",
        },
        "cameras": [
            {"name": "one", **eye},
            {
                **eye,
                "name": "two",
                "focal_px": [690.0, 720.0],
                "principal_point_px": [150.2, 171.9],
                "position_m": [0.05, 0.2, 0.1],
                "roll_deg": 100,
            },
        ],
        "plan": {"workspace_min_m": [0, 0, 0], "workspace_max_m": [1, 1, 1]},
    }
    return parse_cell({**data, **changes}, "small cell")


def facing(cell: Cell, count: int) -> np.ndarray:
    """Gantry joints, shape (count, 6), that show all markers to every camera."""
    arm = Arm(compile_mechanism(cell, GANTRY))
    rng = np.random.default_rng(3)
    found: list[np.ndarray] = []
    while len(found) < count:
        place = rng.uniform((0.6, -0.3, -0.3), (1.1, 0.3, 0.3))
        # The flange looks back at the cameras, tilted.
        turn = rng.uniform(-0.5, 0.5, 3) + (0.0, -np.pi / 2, 0.0)
        joints = np.concatenate([place, turn])
        markers = arm.base_from_world.inverse().apply(arm.marker_positions(joints))
        if all(
            (
                np.abs(
                    config.camera.project(
                        config.world_from_camera.inverse().apply(markers)
                    )
                    - 0.5 * np.array(config.image_size_px)
                )
                < 0.5 * np.array(config.image_size_px) - 14
            ).all()
            for config in cell.cameras
        ):
            found.append(joints)
    return np.array(found)


def with_arm(**arm: object) -> Cell:
    cell = shipped("hp3_stereo")
    return cell.model_copy(update={"arm": cell.arm.model_copy(update=arm)})
