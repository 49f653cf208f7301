"""How good a calibrated cell is: held-out track, budget, map, truth where known."""

from handeye_tri.evaluate.budget import TrackBudget
from handeye_tri.evaluate.change import (
    PartChange,
    PlacementChange,
    as_reference,
    part_changes,
    placement_change,
)
from handeye_tri.evaluate.cross_validation import CrossValidation, cross_validate
from handeye_tri.evaluate.repeatability import (
    Spread,
    bootstrap,
    parametric_bootstrap,
    track_part,
)
from handeye_tri.evaluate.track import (
    AgainstPrediction,
    LoopResiduals,
    against_prediction,
    evaluate_track,
    loop_residuals,
    track_budget,
)
from handeye_tri.evaluate.track_poses import TrackPoses, track_poses
from handeye_tri.evaluate.truth import Comparison, compare_with_truth
from handeye_tri.evaluate.workspace import (
    TrackMap,
    predicted_track_error,
    track_map,
)

__all__ = [
    "AgainstPrediction",
    "Comparison",
    "CrossValidation",
    "LoopResiduals",
    "PartChange",
    "PlacementChange",
    "against_prediction",
    "as_reference",
    "Spread",
    "TrackBudget",
    "TrackMap",
    "TrackPoses",
    "bootstrap",
    "compare_with_truth",
    "cross_validate",
    "evaluate_track",
    "loop_residuals",
    "part_changes",
    "placement_change",
    "parametric_bootstrap",
    "predicted_track_error",
    "track_budget",
    "track_map",
    "track_part",
    "track_poses",
]
