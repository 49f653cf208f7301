"""The cell description that ``scenes/*.yaml`` are read into; units in the keys."""

from handeye_tri.config.cell import (
    Cell,
    CellToCalibrate,
    ImagingConfig,
    MeasuredCell,
)
from handeye_tri.config.parse import parse_any_cell, parse_cell
from handeye_tri.config.rig import MountConfig, RigConfig, TriangleConfig

__all__ = [
    "Cell",
    "CellToCalibrate",
    "ImagingConfig",
    "MeasuredCell",
    "MountConfig",
    "RigConfig",
    "TriangleConfig",
    "parse_any_cell",
    "parse_cell",
]
