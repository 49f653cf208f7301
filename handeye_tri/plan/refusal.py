"""Why there is no plan, and what to change."""

from __future__ import annotations

from collections import Counter

from handeye_tri.errors import NoPlanError

_REMEDY = {
    "tilt": "raise plan.max_tilt_deg or bring the cameras closer together",
    "image": "turn the cameras to the workspace box, or move plan.workspace_min_m "
    "and workspace_max_m to where all cameras see the rig",
    "reach": "move the workspace box or the cameras nearer to the robot",
    "limits": "move the workspace box to where the joint limits leave room",
    "half_turn": "the wrist cannot turn by 180 degrees there: use an arm or an edge "
    "rig whose last joint can",
    "collision": "give the arm room: move what stands in the cell or the workspace box",
    "occlusion": "uncover the markers: move the cameras, what stands between, or the "
    "rig farther ahead of the flange",
    "plane_spread": "lower plan.min_plane_spread_deg or raise plan.max_tilt_deg",
    "path": "give the arm room between stations: move what stands in the cell",
    "axis_spread": "raise plan.max_tilt_deg: the stations hardly turn against another",
}


def no_plan(
    cell: str, rejected: Counter[str], drawn: int, what: str, check: str | None = None
) -> NoPlanError:
    """The error that names the checks that failed and what to do.

    Args:
        cell: Name of the cell.
        rejected: Candidates by the check that rejected them.
        drawn: Candidates in all.
        what: What was not found.
        check: What stands most in the way; None: what rejected most.
    """
    counts = {name: n for name, n in rejected.most_common() if n}
    most = check or next(iter(counts), "reach")
    listed = ", ".join(f"{name} {n}" for name, n in counts.items()) or "none"
    return NoPlanError(
        f"no plan for cell {cell!r}: {what} among {drawn} candidates; "
        f"rejected by check: {listed}. Do: {_REMEDY[most]}",
        counts,
    )
