"""The cells of scenes/, changed where a test asks for it."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handeye_tri.arm import Arm
from handeye_tri.config import Cell, parse_cell
from handeye_tri.mechanism import Mechanism
from handeye_tri.plan import plan_motions
from handeye_tri.records import Plan
from handeye_tri.simulate import compile_mechanism
from handeye_tri.storage.cells import read_cell

Floats = NDArray[np.float64]
REPO = Path(__file__).resolve().parents[2]
CELLS = ("hp3_stereo", "hp3_stereo_edge", "hp3_stereo_lens", "hp3_stereo_mono")
MODEL = REPO / "robot_models" / "hp3_like.xml"


@cache
def cell_of(name: str) -> Cell:
    return read_cell(REPO / "scenes" / f"{name}.yaml")


def arm_of(name: str) -> Arm:
    """The arm with the first mount."""
    return arms_of(name)[0]


@cache
def arms_of(name: str) -> tuple[Arm, ...]:
    """The arm with each mount of a cell."""
    return tuple(Arm(compiled(cell)) for cell in cell_of(name).mounted)


@cache
def plan_of(name: str, seed: int = 1) -> Plan:
    return plan_motions(cell_of(name), arms_of(name), seed)


def calibration_of(plan: Plan) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Joints (n, q) and poses (n, 4, 4) to calibrate from; half-turns among them."""
    used = [s for s in plan.stations if s.kind == "calibration"]
    turns = np.searchsorted(
        [s.index for s in used], [(t.before, t.after) for t in plan.half_turns]
    )
    poses = np.array([s.base_from_flange.matrix for s in used])
    return np.array([s.joints for s in used]), poses, turns


def compiled(cell: Cell) -> Mechanism:
    return compile_mechanism(cell, MODEL)


def seven_joints(directory: Path) -> Path:
    """A model of seven joints: the HP3-like arm with a roll in its lower arm.

    Its flange leans, so that the last joint's axis is not that of the half-turns.
    """
    text = MODEL.read_text()
    lower_arm = '<joint name="l" axis="0 1 0" range="-85 90"/>'
    flange = 'quat="0.7071067811865476 0 0.7071067811865476 0"'
    assert text.count(lower_arm) == text.count(flange) == 1
    text = text.replace(
        lower_arm, lower_arm + '<joint name="roll" axis="0 0 1" range="-120 120"/>'
    ).replace(flange, 'euler="0 105 0"')
    model = directory / "seven.xml"
    model.write_text(text)
    return model


def changed(name: str, **sections: object) -> Cell:
    """A cell with top-level sections merged (mappings) or replaced (others)."""
    data = cell_of(name).model_dump(by_alias=True)
    for key, value in sections.items():
        data[key] = {**data[key], **value} if isinstance(value, dict) else value
    return parse_cell(data, name)
