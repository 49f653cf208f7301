"""Stations for a calibration: half-turns joined by general motions."""

from handeye_tri.plan.programme import plan_motions

__all__ = ["plan_motions"]
