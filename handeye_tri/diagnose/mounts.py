"""Stations at which the triangle was on another mount than is recorded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.diagnose.gates import Finding
from handeye_tri.diagnose.odd_views import OddView
from handeye_tri.records import HalfTurn, Session
from handeye_tri.triangle import AXES, EDGES, Axis

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

# In a half-turn about an edge its markers move less than this share of what the third
# moves; about a normal one of the three stands still at most.
_STANDS = 0.05


def seen_turns(session: Session) -> Session:
    """The session with the axes of those mounts that its half-turns show.

    Which edge a half-turn is about, or whether it is about a normal, is seen without
    any calibration: an edge's two markers stand still. The mounts stay as recorded;
    those that turn about the same axis are not told apart by it.

    Args:
        session: What was detected.
    """
    about = _mount_by_axis(session)
    turns = []
    for turn in session.half_turns:
        moved = session.pixels[:, turn.after] - session.pixels[:, turn.before]
        axis = _seen_axis(np.linalg.norm(moved, axis=-1), turn.axis)
        other = axis in about and about[axis] != session.stations[turn.before].mount
        turns.append(replace(turn, axis=axis) if other else turn)
    return replace(session, half_turns=tuple(turns))


def shown_mounts(session: Session, seen: Session) -> Indices:
    """Which mount each station has by what its half-turns turn about, shape (n,).

    Stations of no half-turn go with those before and after them, where both have
    another one than recorded.

    Args:
        session: As recorded.
        seen: As :func:`seen_turns` has it.
    """
    about, mounts = _mount_by_axis(session), session.mounts
    shown, turning = mounts.copy(), set()
    for turn, other in zip(session.half_turns, seen.half_turns, strict=True):
        turning |= {turn.before, turn.after}
        if turn.axis != other.axis:
            shown[[turn.before, turn.after]] = about[other.axis]
    result = shown.copy()
    for j in set(range(len(mounts))) - turning:
        alike = [k for k in turning if mounts[k] == mounts[j]]
        near = [
            *sorted(k for k in alike if k < j)[-1:],
            *sorted(k for k in alike if k > j)[:1],
        ]
        others = {int(shown[k]) for k in near}
        if len(others) == 1:
            result[j] = others.pop()
    return result


def other_changes(session: Session) -> Iterator[Session]:
    """The session with its tool change before other stations, where it has one.

    No half-turn goes on over it, and what half-turns turn about stays as it is.
    """
    mounts = session.mounts
    steps = np.flatnonzero(np.diff(mounts)) + 1
    if len(steps) != 1:
        return
    for station in range(1, len(mounts)):
        parts = any(
            min(turn.before, turn.after) < station <= max(turn.before, turn.after)
            for turn in session.half_turns
        )
        if station != steps[0] and not parts:
            later = np.arange(len(mounts)) >= station
            yield with_mounts(session, np.where(later, mounts[-1], mounts[0]))


def with_mounts(session: Session, mounts: Indices) -> Session:
    """The session with other mounts, shape (n,)."""
    stations = tuple(
        replace(station, mount=int(mount))
        for station, mount in zip(session.stations, mounts, strict=True)
    )
    return replace(session, stations=stations)


def _mount_by_axis(session: Session) -> dict[Axis, int]:
    return {t.axis: session.stations[t.before].mount for t in session.half_turns}


def _seen_axis(moved: Floats, recorded: Axis) -> Axis:
    """What a half-turn is about, by how far the markers moved, (m, 3), px."""
    moved = moved[np.isfinite(moved).all(axis=1)]
    if not len(moved):
        return recorded
    for axis in AXES:
        if axis != "normal":
            first, second = EDGES[axis]
            third = moved[:, [3 - first - second]]
            if (moved[:, [first, second]] < _STANDS * third).all():
                return axis
    return "normal"


def mount_findings(
    session: Session,
    mounts: Indices,
    half_turns: Sequence[HalfTurn],
    odd: Sequence[OddView],
) -> list[Finding]:
    """Stations at which the triangle was on another mount than is recorded.

    Args:
        session: As recorded.
        mounts: With which the views were judged, shape (n,).
        half_turns: The session's, about the axes that they show.
        odd: Views, of which those of the kind "mount" are told.
    """
    mine = [view for view in odd if view.kind == "mount"]
    shown, told = mounts.copy(), []
    for view in mine:
        shown[view.station] = int(view.reading) - 1
    wrong = shown != session.mounts
    if not wrong.any():
        return []
    turns = [
        f"{turn.before} and {turn.after} about {_axis_name(turn.axis)}"
        for turn, other in zip(half_turns, session.half_turns, strict=True)
        if turn.axis != other.axis
    ]
    if turns:
        told.append(f"the markers show half-turns between stations {', '.join(turns)}")
    elif (mounts != session.mounts).any():
        told.append("so read, robot and cameras fit; as recorded they do not")
    mine = [view for view in mine if wrong[view.station]]
    if mine:
        stations = sorted({view.station for view in mine})
        residual, left = (
            np.sqrt(np.mean(np.square([getattr(view, name) for view in mine])))
            for name in ("residual", "left")
        )
        told.append(
            f"station{'s' if len(stations) > 1 else ''} "
            f"{', '.join(map(str, stations))}: {residual:.1f} px off (rms), then "
            f"{left:.2f}"
        )
    return [_finding(session, shown, "; ".join(told))]


def _axis_name(axis: Axis) -> str:
    return "a normal" if axis == "normal" else f"the edge {axis}"


def _finding(session: Session, shown: Indices, evidence: str) -> Finding:
    recorded = session.mounts
    wrong = np.flatnonzero(shown != recorded)
    names = [session.mount_name(k) for k in range(int(recorded.max()) + 1)]
    told = "; ".join(
        f"{names[mine]} where {names[other]} is recorded"
        for mine, other in sorted({(int(shown[j]), int(recorded[j])) for j in wrong})
    )
    cause = "at single stations the triangle was on another mount than recorded"
    remedy = "correct which mount those stations have, and calibrate again"
    steps, stated = (np.flatnonzero(np.diff(rows)) + 1 for rows in (shown, recorded))
    if len(wrong) == len(recorded):
        cause = "the mounts were exchanged"
        remedy = "exchange rig and second_mount in the cell, and calibrate again"
    elif not len(steps):
        cause = f"the tool was not changed: always it was {names[int(shown[0])]}"
        remedy = (
            "change the tool where the programme says so, and record those stations "
            "again; or leave second_mount out of the cell"
        )
    elif len(steps) == len(stated) == 1:
        cause = (
            f"the tool was changed before station {steps[0]}, not before station "
            f"{stated[0]} as recorded"
        )
        remedy = (
            f"state the tool change before station {steps[0]} (of an import: "
            f"--tool-change {steps[0]}), and calibrate again"
        )
    return Finding(
        "MOUNT",
        cause,
        f"{told}: {evidence}",
        "warning",
        remedy,
        tuple(wrong.tolist()),
    )
