"""The cells of scenes/, changed where a test asks for it."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from handeye_tri.arm import Arm
from handeye_tri.config import Cell, parse_cell
from handeye_tri.mechanism import Mechanism
from handeye_tri.plan import plan_motions
from handeye_tri.records import Plan
from handeye_tri.simulate import compile_mechanism
from handeye_tri.storage.cells import read_cell

REPO = Path(__file__).resolve().parents[2]
CELLS = ("hp3_stereo", "hp3_stereo_edge", "hp3_stereo_lens", "hp3_stereo_mono")
MODEL = REPO / "robot_models" / "hp3_like.xml"


@cache
def cell_of(name: str) -> Cell:
    return read_cell(REPO / "scenes" / f"{name}.yaml")


@cache
def arm_of(name: str) -> Arm:
    return Arm(compiled(cell_of(name)))


@cache
def plan_of(name: str, seed: int = 1) -> Plan:
    return plan_motions(cell_of(name), arm_of(name), seed)


def compiled(cell: Cell) -> Mechanism:
    return compile_mechanism(cell, MODEL)


def changed(name: str, **sections: object) -> Cell:
    """A cell with top-level sections merged (mappings) or replaced (others)."""
    data = cell_of(name).model_dump(by_alias=True)
    for key, value in sections.items():
        data[key] = {**data[key], **value} if isinstance(value, dict) else value
    return parse_cell(data, name)
