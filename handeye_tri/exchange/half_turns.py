"""Half-turns found in the robot's poses themselves."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import InputError
from handeye_tri.records import Floats
from handeye_tri.se3 import se3_inverse, so3_log

_MAX_PAIRS = 1000
# Farther apart than this no two stations are taken for a half-turn.
_MOST_APART = 100


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """A rotation by about 180 degrees between two stations.

    Attributes:
        before: Index of the station before.
        after: Index of the station after.
        miss: How far from 180 degrees it is, radians.
        axis: Unit axis in the flange's frame, shape (3,); its sign has no meaning.
        foot: Point of the axis next to the flange's origin, shape (3,), metres.
        pitch: How far the flange moved along the axis, metres.
    """

    before: int
    after: int
    miss: float
    axis: Floats
    foot: Floats
    pitch: float


@dataclass(frozen=True, slots=True, eq=False)
class FoundTurns:
    """What was found among the stations.

    Attributes:
        turns: The half-turns by their first stations, each station in one at most.
        others: Turns by 180 degrees between successive stations that are none of the
            rig: why, in words.
        axis: Their common axis in the flange's frame, shape (3,).
        foot: Point of the common axis next to the flange's origin, (3,), metres.
    """

    turns: tuple[Turn, ...]
    others: tuple[str, ...]
    axis: Floats
    foot: Floats


@dataclass(frozen=True, slots=True)
class TurnTolerance:
    """What counts as a half-turn of the rig.

    Attributes:
        angle: From 180 degrees, and between axes, radians.
        length: Along the axis, and between parallel axes, metres.
    """

    angle: float
    length: float


def turn_between(base_from_flange: Floats, before: int, after: int) -> Turn:
    """The turn from one station to another, of poses of shape (n, 4, 4), metres."""
    motion = se3_inverse(base_from_flange[before]) @ base_from_flange[after]
    vector = so3_log(motion[:3, :3])
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle else np.array([0.0, 0.0, 1.0])
    shift = motion[:3, 3]
    pitch = float(shift @ axis)
    # (I - R) p = shift - pitch axis; a half-turn's I - R is 2 across the axis.
    foot = np.linalg.pinv(np.eye(3) - motion[:3, :3]) @ (shift - pitch * axis)
    foot = foot - (foot @ axis) * axis
    return Turn(before, after, np.pi - angle, axis, foot, pitch)


def find_half_turns(
    base_from_flange: Floats, tolerance: TurnTolerance, within: range | None = None
) -> FoundTurns:
    """Pair the stations that a half-turn of the rig joins.

    The rig is rigid on the flange, so that all its half-turns have one axis there, and
    nothing moves along it. The axis that most turns by 180 degrees share is taken for
    the rig's; which of the triangle's axes it is, the poses cannot tell. The two
    stations may be up to 100 apart, as in a programme that is ordered for speed; by
    chance one pair in a hundred turns by 180 degrees to within a degree, so that such
    a turn alone counts for none.

    Args:
        base_from_flange: Reported poses, shape (n, 4, 4), metres.
        tolerance: What counts as a half-turn.
        within: Stations with one mount, in a row; None: all.
    """
    within = within or range(len(base_from_flange))
    alike = base_from_flange[within.start : within.stop]
    candidates = [
        turn
        for before, after in _nearly_opposite(alike, tolerance.angle)
        for turn in [turn_between(base_from_flange, within[before], within[after])]
        if abs(turn.miss) <= tolerance.angle
    ]
    support = _support(candidates, tolerance)
    # Stations that follow each other first: a leader that nothing else agrees with
    # is one of them, or there is none.
    least = [1 if turn.after == turn.before + 1 else 2 for turn in candidates]
    empty = np.zeros(3)
    if not (support >= least).any():
        return FoundTurns((), _others(candidates, None, (), tolerance), empty, empty)
    leader = candidates[int(np.argmax(np.where(support >= least, support, 0)))]
    used = set[int]()
    turns: list[Turn] = []
    for turn in candidates:
        stations = {turn.before, turn.after}
        if not used & stations and not _difference(leader, turn, tolerance):
            turns.append(turn)
            used |= stations
    turns.sort(key=lambda turn: turn.before)
    signs = [1.0 if turn.axis @ leader.axis > 0 else -1.0 for turn in turns]
    axis = np.mean([s * t.axis for s, t in zip(signs, turns, strict=True)], axis=0)
    foot = np.mean([turn.foot for turn in turns], axis=0)
    others = _others(candidates, leader, turns, tolerance)
    return FoundTurns(
        tuple(turns), others, axis / np.linalg.norm(axis), np.asarray(foot)
    )


def _nearly_opposite(
    base_from_flange: Floats, tolerance: float
) -> list[tuple[int, int]]:
    """Pairs of stations that a turn by about 180 degrees joins, the nearest first."""
    rotations = base_from_flange[:, :3, :3].reshape(-1, 9)
    # The trace of the turn between two stations is 1 + 2 cos(angle).
    most = 1 + 2 * np.cos(np.pi - tolerance) + 1e-9
    pairs = []
    for apart in range(1, min(_MOST_APART, len(rotations) - 1) + 1):
        traces = (rotations[:-apart] * rotations[apart:]).sum(axis=1)
        pairs += [(int(j), int(j) + apart) for j in np.flatnonzero(traces <= most)]
    return pairs


def _support(turns: Sequence[Turn], tolerance: TurnTolerance) -> NDArray[np.intp]:
    """How many turns agree with each, itself among them, shape (n,)."""
    axes = np.array([turn.axis for turn in turns]).reshape(-1, 3)
    feet = np.array([turn.foot for turn in turns]).reshape(-1, 3)
    moved = np.array([abs(turn.pitch) for turn in turns]) > tolerance.length
    support = np.zeros(len(turns), dtype=np.intp)
    for k in np.flatnonzero(~moved):
        near = np.abs(axes @ axes[k]) >= np.cos(tolerance.angle)
        near &= np.linalg.norm(feet - feet[k], axis=1) <= tolerance.length
        support[k] = (near & ~moved).sum()
    return support


def _others(
    candidates: Sequence[Turn],
    leader: Turn | None,
    turns: Sequence[Turn],
    tolerance: TurnTolerance,
) -> tuple[str, ...]:
    """Why turns of successive stations are none of those taken."""
    of = {station: turn for turn in turns for station in (turn.before, turn.after)}
    others = []
    for turn in candidates:
        if turn.after > turn.before + 1 or turn in turns:
            continue
        why = _difference(leader or turn, turn, tolerance)
        if not why:
            station = turn.before if turn.before in of else turn.after
            other = of[station]
            why = f"station {station} already belongs to {other.before}-{other.after}"
        others.append(f"{turn.before}-{turn.after}: {why}")
    return tuple(others)


def _difference(rig: Turn, turn: Turn, tolerance: TurnTolerance) -> str:
    """Why a turn is none about the rig's axis; "" where it is one."""
    off = float(np.arccos(min(1.0, abs(float(rig.axis @ turn.axis)))))
    if off > tolerance.angle:
        return f"its axis is {np.degrees(off):.1f} deg off the others' in the flange"
    if abs(turn.pitch) > tolerance.length:
        return f"the flange moved {1e3 * turn.pitch:.2f} mm along the axis"
    apart = float(np.linalg.norm(rig.foot - turn.foot))
    if apart > tolerance.length:
        return f"its axis is {1e3 * apart:.2f} mm beside the others' in the flange"
    return ""


def parse_pairs(text: str, option: str) -> list[tuple[int, int]]:
    """Pairs of stations as a user writes them: "0-1, 4-5".

    Raises:
        InputError: it is written otherwise.
    """
    pairs: list[tuple[int, int]] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,6})\s*-\s*(\d{1,6})\s*", part)
        if match is None or len(pairs) >= _MAX_PAIRS:
            raise InputError(
                f'{option} must be pairs of stations such as "0-1,2-3", got {part!r}'
            )
        pairs.append((int(match[1]), int(match[2])))
    return pairs


def parse_stations(text: str, count: int, option: str) -> list[int]:
    """Stations as a user writes them: "12-17,20", or "none".

    Raises:
        InputError: it is written otherwise, or names a station that is not there.
    """
    if text.strip() == "none":
        return []
    found: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,6})(?:\s*-\s*(\d{1,6}))?\s*", part)
        if match is None:
            raise InputError(
                f'{option} must be stations such as "12-17,20", or "none", got {part!r}'
            )
        last = int(match[2] or match[1])
        if last >= count:
            raise InputError(
                f"{option} names station {last}, but there are {count}, from 0 to "
                f"{count - 1}"
            )
        found.update(range(int(match[1]), last + 1))
    return sorted(found)


def named_turns(
    base_from_flange: Floats, pairs: Sequence[tuple[int, int]], option: str
) -> tuple[Turn, ...]:
    """The turns between stations that a user named, of poses (n, 4, 4), metres.

    Raises:
        InputError: a station is not there or named twice, or what lies between two is
            far from half a turn.
    """
    count, used = len(base_from_flange), set[int]()
    turns = []
    for before, after in pairs:
        for station in (before, after):
            if station >= count or station in used:
                what = "named twice" if station in used else f"beyond the {count}"
                raise InputError(f"{option}: station {station} is {what}")
            used.add(station)
        turn = turn_between(base_from_flange, before, after)
        if abs(turn.miss) > np.radians(10):
            raise InputError(
                f"{option}: from station {before} to {after} the flange turned by "
                f"{180 - np.degrees(turn.miss):.2f} deg; a half-turn is 180"
            )
        turns.append(turn)
    return tuple(turns)
