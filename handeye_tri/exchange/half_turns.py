"""Half-turns found in the robot's poses themselves."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from handeye_tri.errors import InputError
from handeye_tri.records import Floats
from handeye_tri.se3 import se3_inverse, so3_log

_MAX_PAIRS = 1000


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
    """What was found among successive stations.

    Attributes:
        turns: The half-turns, each station in one of them at most.
        others: Turns by 180 degrees that are none of the rig: why, in words.
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


def find_half_turns(base_from_flange: Floats, tolerance: TurnTolerance) -> FoundTurns:
    """Pair successive stations that a half-turn of the rig joins.

    The rig is rigid on the flange, so that all its half-turns have one axis there, and
    nothing moves along it. The axis that most turns by 180 degrees share is taken for
    the rig's; which of the triangle's axes it is, the poses cannot tell.

    Args:
        base_from_flange: Reported poses, shape (n, 4, 4), metres.
        tolerance: What counts as a half-turn.
    """
    candidates = [
        turn
        for j in range(len(base_from_flange) - 1)
        if abs((turn := turn_between(base_from_flange, j, j + 1)).miss)
        <= tolerance.angle
    ]
    empty = np.zeros(3)
    if not candidates:
        return FoundTurns((), (), empty, empty)
    agree = [
        [_difference(one, other, tolerance) == "" for other in candidates]
        for one in candidates
    ]
    # What does not even agree with itself moved along its axis.
    support = np.sum(agree, axis=1) * np.diagonal(agree)
    leader = candidates[int(np.argmax(support))]
    turns: list[Turn] = []
    others = []
    for turn in candidates:
        name = f"{turn.before}-{turn.after}"
        why = _difference(leader, turn, tolerance)
        if why:
            others.append(f"{name}: {why}")
        elif turns and turns[-1].after == turn.before:
            last = f"{turns[-1].before}-{turns[-1].after}"
            others.append(f"{name}: station {turn.before} already belongs to {last}")
        else:
            turns.append(turn)
    if not turns:
        return FoundTurns((), tuple(others), empty, empty)
    signs = [1.0 if turn.axis @ leader.axis > 0 else -1.0 for turn in turns]
    axis = np.mean([s * t.axis for s, t in zip(signs, turns, strict=True)], axis=0)
    foot = np.mean([turn.foot for turn in turns], axis=0)
    return FoundTurns(
        tuple(turns), tuple(others), axis / np.linalg.norm(axis), np.asarray(foot)
    )


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
