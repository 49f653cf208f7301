"""Why there is no plan, and what to change."""

from __future__ import annotations

from collections import Counter

from handeye_tri.counting import counted
from handeye_tri.errors import NoPlanError

_REMEDY = {
    "tilt": "raise plan.max_tilt_deg or bring the cameras closer together",
    "image": "turn the cameras to the workspace box, or move plan.workspace_min_m "
    "and workspace_max_m to where all cameras see the rig",
    "reach": "move the workspace box or the cameras nearer to the robot",
    "limits": "move the workspace box to where the joint limits leave room",
    "half_turn": "the wrist cannot turn by 180 degrees: widen the limits of the last "
    "joint if they are narrower than the robot's, or mount the rig on a joint that can",
    "collision": "give the arm room: move what stands in the cell or the workspace box",
    "occlusion": "uncover the markers: move the cameras, what stands between, or the "
    "rig farther ahead of the flange",
    "plane_spread": "lower plan.min_plane_spread_deg or raise plan.max_tilt_deg",
    "path": "give the arm room between stations: move what stands in the cell",
    "axis_spread": "raise plan.max_tilt_deg: the stations hardly turn against another",
}


# What counts are called in a message.
_WORDS = {
    "tilt": "seen at too steep an angle by a camera",
    "image": "not wholly in the images",
    "reach": "out of reach",
    "limits": "beyond the joint limits",
    "half_turn": "without a turn by 180 degrees",
    "collision": "in collision",
    "occlusion": "hidden from a camera",
    "plane_spread": "in planes too much alike",
    "path": "moves blocked",
    "axis_spread": "turned about axes too much alike",
}
# Checks in the order that candidates go through them.
_IN_TURN = (
    ("tilt",),
    ("image",),
    ("limits", "reach"),
    ("half_turn",),
    ("collision", "occlusion"),
)


def no_plan(
    cell: str,
    rejected: Counter[str],
    drawn: int,
    what: str,
    check: str | None = None,
    solids: Counter[str] | None = None,
) -> NoPlanError:
    """The error that names the checks that failed and what to do.

    Args:
        cell: Name of the cell.
        rejected: Candidates by the check that rejected them.
        drawn: Candidates in all.
        what: What was not found.
        check: What stands most in the way; None: the check that let the smallest
            part pass of what came to it.
        solids: What solids do, in words, such as "wall hides a marker"; how often.
    """
    counts = {name: n for name, n in rejected.most_common() if n}
    most = check or _narrowest(rejected, drawn)
    listed = ", ".join(f"{_WORDS[name]} {n}" for name, n in counts.items()) or "none"
    often = ""
    if solids and most in ("collision", "occlusion", "path"):
        often = f" (most often: {solids.most_common(1)[0][0]})"
    return NoPlanError(
        f"no plan for cell {cell!r}: {what} among "
        f"{counted(drawn, 'candidate')}; rejected: "
        f"{listed}. Most in the way is {most}{often}. Do: {_REMEDY[most]}",
        counts,
    )


def _narrowest(rejected: Counter[str], drawn: int) -> str:
    """The check that let the smallest part pass."""
    narrowest, worst = "reach", -1.0
    for checks in _IN_TURN:
        failed = sum(rejected[check] for check in checks)
        if failed / max(drawn, 1) > worst:
            narrowest = max(checks, key=lambda check: rejected[check])
            worst = failed / max(drawn, 1)
        drawn -= failed
    return narrowest
