"""Stations for a calibration: half-turns joined by general motions."""

from handeye_tri.plan.programme import Visited, plan_motions, plan_next
from handeye_tri.plan.stations import certify_stations

__all__ = ["Visited", "certify_stations", "plan_motions", "plan_next"]
