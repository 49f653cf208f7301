"""The stages in order, from a cell's description to its report.

A stage whose inputs and outputs are unchanged is not done again.
"""

from handeye_tri.pipeline.execution import Stage, execute
from handeye_tri.pipeline.run import PLAN_SCHEMA, NullProgress, Progress, Run, start
from handeye_tri.pipeline.stages import STAGES, VERBS, stages_of

__all__ = [
    "PLAN_SCHEMA",
    "STAGES",
    "VERBS",
    "NullProgress",
    "Progress",
    "Run",
    "Stage",
    "execute",
    "stages_of",
    "start",
]
