"""A calibration that gives up says what is likely wrong with the session."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from handeye_tri.errors import (
    ConvergenceError,
    DegenerateMotionError,
    HandEyeError,
    InputError,
)
from handeye_tri.pipeline.run import Run

if TYPE_CHECKING:
    from handeye_tri.diagnose import Finding

# Findings that are told; the first names the cause.
_TOLD = 2


def findings_of(run: Run) -> tuple[Finding, ...]:
    """What other readings of a session say that does not calibrate."""
    from handeye_tri.diagnose import why_uncalibrated
    from handeye_tri.pipeline.robot import turning_offsets

    return why_uncalibrated(
        run.observed(),
        min_plane_spread=float(np.radians(run.cell.plan.min_plane_spread_deg)),
        joints=turning_offsets(run) if run.has_robot else None,
        edges=run.edges(),
    )


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
        lines = [str(error)]
        for one in findings_of(run)[:_TOLD]:
            lines += [
                f"  {one.code}: {one.cause}; {one.evidence}",
                f"    Do: {one.remedy}.",
            ]
        raise type(error)("\n".join(lines)) from error


def why_calibration_fails(run: Run) -> HandEyeError | None:
    """Calibrate as the stages do, writing nothing; None where that succeeds."""
    from handeye_tri.calibrate_cameras import calibrate_session_cameras
    from handeye_tri.pipeline.robot import calibrated_cell

    session = run.observed()
    try:
        cameras = calibrate_session_cameras(session)
        calibrated_cell(run, session.without(cameras.details["dropped"]), cameras)
    except HandEyeError as error:
        return error
    return None
