"""Two sessions of one cell, before against after: what changed, and how surely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from handeye_tri import storage
from handeye_tri.errors import InputError
from handeye_tri.pipeline.export import verdict_of
from handeye_tri.pipeline.run import Run

if TYPE_CHECKING:
    from handeye_tri.evaluate import PartChange, PlacementChange
    from handeye_tri.records import HandEyeCalibration

# What of a part's test is reported as it is.
_TEST = ("chi2", "dof", "p_value", "changed")
# How many sigmas of noise a change must exceed to be seen nearly always: 3 to be
# told from noise, 2 more since it has noise itself.
_SEEN_SIGMAS = 5.0


def compare_sessions(before: Run, after: Run) -> dict[str, Any]:
    """Set a newer calibration of a cell against an older one.

    Args:
        before: The older session, evaluated.
        after: The newer session, evaluated.

    Returns:
        "verdict": PASS where nothing changed beyond noise, FAIL where something did,
        CANNOT TELL where the two do not decide it; "sentence", in words; "why", the
        reasons of CANNOT TELL; "before" and "after" with path and verdict each;
        "changes" by part of the cell; "placement", how far off the older calibration
        places what the newer one sees; "quantities", both values and sigmas,
        difference and its sigmas.

    Raises:
        StorageError: a session is not evaluated, or something changed since.
        InputError: they are not of the same cell, or not calibrated alike.
    """
    from handeye_tri.evaluate import part_changes, placement_change

    differences = _differences(before, after)
    if differences:
        raise InputError(
            f"{before.folder.path} and {after.folder.path} cannot be compared: "
            f"{'; '.join(differences)}; name two sessions of one cell, calibrated alike"
        )
    verdicts = [verdict_of(run) for run in (before, after)]
    old, new = before.hand_eye(), after.hand_eye()
    changes = part_changes(old, new)
    rows = after.evaluation()["track"]["positions"]
    placement = placement_change(old, new, np.array([r["observed_m"] for r in rows]))
    limit = 1e-3 * after.cell.track_limit_mm
    why = _undecided(before, after, verdicts, placement, limit)
    changed = [change for change in changes if change.changed]
    verdict = "CANNOT TELL" if why else "FAIL" if changed else "PASS"
    return {
        "schema": "handeye_tri.comparison/1",
        "verdict": verdict,
        "sentence": _sentence(verdict, changed, why),
        "why": why,
        "before": {"session": str(before.folder.path), "verdict": verdicts[0]},
        "after": {"session": str(after.folder.path), "verdict": verdicts[1]},
        "cell": after.cell.name,
        "simulated": bool(after.folder.header["simulated"]),
        "changes": [
            {
                "part": part_name(change),
                "moved_mm": 1e3 * change.moved,
                "turned_deg": float(np.degrees(change.turned)),
                **{key: asdict(change)[key] for key in _TEST},
            }
            for change in changes
        ],
        "placement": {
            "points": placement.points,
            "rms_mm": 1e3 * placement.rms,
            "max_mm": 1e3 * placement.max,
            "expected_rms_mm": 1e3 * placement.expected_rms,
            "limit_mm": 1e3 * limit,
        },
        "quantities": _quantities(old, new),
    }


def part_name(change: PartChange) -> str:
    """A part of the cell in words."""
    return {
        "intrinsics": f"{change.camera} intrinsics",
        "place": f"{change.camera} in base",
        "between": f"{change.camera} to first camera",
        "rig": f"rig on flange{_on_mount(change)}",
    }[change.part]


def _on_mount(change: PartChange) -> str:
    """Which mount, where there are several; "" where there is one."""
    return f", mount {change.mount + 1}" if change.mount >= 0 else ""


def _differences(before: Run, after: Run) -> list[str]:
    """What makes two sessions ones of different cells, or of different methods."""
    found = []
    if before.cell.name != after.cell.name:
        found.append(f"cell {before.cell.name} against {after.cell.name}")
    cameras = [
        ", ".join(
            f"{c.name} {c.image_size_px[0]} x {c.image_size_px[1]}"
            for c in run.cell.cameras
        )
        for run in (before, after)
    ]
    if cameras[0] != cameras[1]:
        found.append(f"cameras {cameras[0]} against {cameras[1]}")
    cells = [run.cell.model_dump(mode="json") for run in (before, after)]
    for name in ("rig", "second_mount"):
        held = [cell[name] for cell in cells]
        if (held[0] is None) != (held[1] is None):
            which = [run for run, one in zip((before, after), held, strict=True) if one]
            found.append(
                f"only {which[0].folder.path} has a second mount of its rig (about "
                f"{which[0].cell.axes[1]})"
            )
        elif held[0] is not None:
            odd = [key for key in held[0] if held[0][key] != held[1].get(key)]
            found += [
                f"{name}.{key} {held[0][key]} against {held[1].get(key)}"
                for key in odd[:1]
            ]
    if before.robot_errors != after.robot_errors:
        asked = [", ".join(run.robot_errors) or "none" for run in (before, after)]
        found.append(f"errors of the robot estimated: {asked[0]} against {asked[1]}")
    return found


def _undecided(
    before: Run,
    after: Run,
    verdicts: Sequence[str],
    placement: PlacementChange,
    limit: float,
) -> list[str]:
    """Why the two cannot tell whether the cell changed."""
    why = []
    seen = [storage.sha256(r.folder.file("observations.npz")) for r in (before, after)]
    if seen[0] == seen[1]:
        why.append(
            "both rest on the same observations, so that their errors are not "
            "independent: this compares two methods, not two states of the cell"
        )
    for run, verdict in zip((before, after), verdicts, strict=True):
        if verdict != "PASS":
            why.append(f"{run.folder.path} has the verdict {verdict}")
    needed = _SEEN_SIGMAS * placement.expected_rms
    if needed > limit:
        why.append(
            f"a change under {1e3 * needed:.2g} mm would hide in the noise, and the "
            f"cell allows {1e3 * limit:.2g} mm"
        )
    return why


def _sentence(verdict: str, changed: Sequence[PartChange], why: Sequence[str]) -> str:
    if verdict == "CANNOT TELL":
        return f"Whether the cell changed cannot be told: {'; '.join(why)}"
    if verdict == "PASS":
        return "Nothing changed beyond the noise of both calibrations"
    moved = [change for change in changed if change.part == "place"]
    places = {change.camera for change in moved}
    between = any(change.part == "between" for change in changed)
    said = []
    if len(moved) > 1 and not between:
        said.append(
            f"all of {', '.join(sorted(places))} moved alike in the robot's base, not "
            "against each other: their common mount, or the base itself, moved"
        )
    else:
        said += [f"camera {_how_far(change)}" for change in moved]
    for change in changed:
        if change.part == "intrinsics":
            said.append(f"the intrinsics of camera {change.camera} changed")
        elif change.part == "rig":
            said.append(_rig_moved(change))
        elif change.part == "between" and not moved:
            said.append(f"against the first camera, {_how_far(change)}")
    text = "; ".join(said)
    return text[0].upper() + text[1:]


def _rig_moved(change: PartChange) -> str:
    distance = f"{1e3 * change.moved:.2g} mm"
    if change.mount < 0:
        return f"the rig moved on the flange by {distance}"
    return f"the rig has slipped on mount {change.mount + 1} by {distance}"


def _how_far(change: PartChange) -> str:
    return (
        f"{change.camera} moved {1e3 * change.moved:.2g} mm and turned "
        f"{np.degrees(change.turned):.2g} deg"
    )


def _quantities(
    before: HandEyeCalibration, after: HandEyeCalibration
) -> list[dict[str, Any]]:
    """Everything estimated, side by side."""
    from handeye_tri.evaluate import as_reference
    from handeye_tri.summary import result_rows

    rows = []
    old_rows = result_rows(before, None)
    for old, new in zip(
        old_rows, result_rows(after, as_reference(before)), strict=True
    ):
        sigma = float(np.hypot(old["sigma"], new["sigma"]))
        # Of the robot's own errors nothing is known but the two values.
        change = new["value"] - old["value"] if new["error"] is None else new["error"]
        rows.append(
            {
                "name": new["name"],
                "unit": new["unit"],
                "before": old["value"],
                "after": new["value"],
                "difference": change,
                "sigma": sigma,
                "sigmas": change / sigma if sigma > 0 else None,
            }
        )
    return rows
