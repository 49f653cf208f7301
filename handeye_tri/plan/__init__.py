"""Stations for a calibration: half-turns joined by general motions."""

from handeye_tri.plan.programme import plan_motions
from handeye_tri.plan.stations import certify_stations

__all__ = ["certify_stations", "plan_motions"]
