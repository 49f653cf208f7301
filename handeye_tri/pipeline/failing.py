"""A calibration that gives up says what is likely wrong with the session."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from handeye_tri.errors import ConvergenceError, DegenerateMotionError, InputError
from handeye_tri.pipeline.run import Run

# Findings that are told; the first names the cause.
_TOLD = 2


@contextmanager
def explained(run: Run) -> Iterator[None]:
    """Add to an error of calibration what other readings of the session say.

    Raises:
        DegenerateMotionError: as raised inside, with the findings below.
        ConvergenceError: likewise.
        InputError: likewise.
    """
    try:
        yield
    except (DegenerateMotionError, ConvergenceError, InputError) as error:
        from handeye_tri.diagnose import why_uncalibrated
        from handeye_tri.pipeline.robot import turning_offsets

        findings = why_uncalibrated(
            run.observed(),
            min_plane_spread=float(np.radians(run.cell.plan.min_plane_spread_deg)),
            joints=turning_offsets(run) if run.has_robot else None,
            edges=run.edges(),
        )
        lines = [str(error)]
        for one in findings[:_TOLD]:
            lines += [
                f"  {one.code}: {one.cause}; {one.evidence}",
                f"    Do: {one.remedy}.",
            ]
        raise type(error)("\n".join(lines)) from error
