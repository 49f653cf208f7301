"""How good a calibrated cell is: held-out track, budget, map, truth where known."""

from handeye_tri.evaluate.budget import TrackBudget
from handeye_tri.evaluate.track import (
    LoopResiduals,
    evaluate_track,
    loop_residuals,
    track_budget,
)
from handeye_tri.evaluate.truth import Comparison, compare_with_truth
from handeye_tri.evaluate.workspace import (
    TrackMap,
    predicted_track_error,
    track_map,
)

__all__ = [
    "Comparison",
    "LoopResiduals",
    "TrackBudget",
    "TrackMap",
    "compare_with_truth",
    "evaluate_track",
    "loop_residuals",
    "predicted_track_error",
    "track_budget",
    "track_map",
]
