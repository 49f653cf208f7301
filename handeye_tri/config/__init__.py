"""The cell description that ``scenes/*.yaml`` are read into; units in the keys."""

from handeye_tri.config.cell import (
    Cell,
    CellToCalibrate,
    ImagingConfig,
    MeasuredCell,
    RigConfig,
    TriangleConfig,
)
from handeye_tri.config.parse import parse_any_cell, parse_cell

__all__ = [
    "Cell",
    "CellToCalibrate",
    "ImagingConfig",
    "MeasuredCell",
    "RigConfig",
    "TriangleConfig",
    "parse_any_cell",
    "parse_cell",
]
