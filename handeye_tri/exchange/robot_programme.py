"""A planned programme as files that a robot can run: joint moves and stops."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from handeye_tri.counting import counted
from handeye_tri.errors import InputError

Floats = NDArray[np.float64]

PROGRAMME_SCHEMA = "handeye_tri.programme/1"
# Radius within which a URScript move may cut the corner at a point it passes, metres.
_BLEND = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class ToolChange:
    """Where the robot waits until a person has put on another tool.

    Attributes:
        before: Number of the first station with the new tool; 0: the robot carries
            the old one where the programme starts.
        joints: Where the robot waits, shape (q,), rad or m.
        via: Joints passed on the way there from the station before, shape (k, q).
        tools: What the tools are called, the one taken off first.
        mount: What is to be put on, in a few words.
    """

    before: int
    joints: Floats
    via: Floats
    tools: tuple[str, str]
    mount: str

    def __str__(self) -> str:
        """What a person must do."""
        return f"tool change: take off {self.tools[0]}, put on {self.mount}"

    def of_programme(self, stations: int) -> str:
        """The same, and after how many of a programme's stations."""
        return (
            f"{self}; the robot waits for it in its home after {self.before} of "
            f"{counted(stations, 'station')}"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Programme:
    """Stations in the order driven, and the joint moves between them.

    Attributes:
        head: What a reader of the file must know, a line each.
        joint_names: Of the arm's q joints.
        slides: Which of them slide, shape (q,).
        home: Where the programme starts, shape (q,), rad or m.
        stops: Joints of the stations, shape (n, q), rad or m.
        kinds: "calibration" or "evaluation", by station.
        via: Joints passed on the way to each station, shapes (k, q), straight in
            joint space from one to the next; k is 0 where the way is straight.
        speed: Speed limits, shape (q,), rad/s or m/s.
        acceleration_time: From rest to full speed, seconds.
        dwell: How long the robot stands at a station, seconds.
        change: Where the tool is exchanged; None: one tool throughout.
        mounts: Which mount holds the triangle, from 0, by station; None: the cell has
            one.
    """

    head: tuple[str, ...]
    joint_names: tuple[str, ...]
    slides: NDArray[np.bool_]
    home: Floats
    stops: Floats
    kinds: Sequence[str]
    via: Sequence[Floats]
    speed: Floats
    acceleration_time: float
    dwell: float
    change: ToolChange | None = None
    mounts: Sequence[int] | None = None

    def __post_init__(self) -> None:
        """Raise InputError where the dwell time is none."""
        if not (np.isfinite(self.dwell) and self.dwell >= 0):
            raise InputError(f"dwell must be 0 s or longer, got {self.dwell}")

    @property
    def acceleration(self) -> Floats:
        """Acceleration limits, shape (q,), rad/s^2 or m/s^2."""
        return self.speed / self.acceleration_time

    def leg(self, station: int) -> Floats:
        """Where the way to a station leads, from the stop before, shape (k + 2, q)."""
        start = self.stops[station - 1] if station else self.home
        if self.change is not None and self.change.before == station:
            start = self.change.joints
        return np.concatenate([start[None], self.via[station], self.stops[[station]]])

    def way_to_change(self, station: int) -> Floats | None:
        """Where the way to a tool change before this station leads, (k + 2, q)."""
        change = self.change
        if change is None or change.before != station:
            return None
        start = self.stops[station - 1] if station else self.home
        return np.concatenate([start[None], change.via, change.joints[None]])

    @property
    def straight(self) -> bool:
        """Whether no way passes a point between two stops."""
        ways = [*self.via, *([self.change.via] if self.change else [])]
        return not any(len(points) for points in ways)

    def called(self, station: int) -> str:
        """A station's number: of two sessions, in its own; and the tool there."""
        if self.change is None:
            return str(station)
        after = station >= self.change.before
        tool = self.change.tools[int(after)]
        if self.mounts is not None:
            return f"{station}, {tool}"
        return f"{station - self.change.before if after else station} of {tool}"


def programme_json(programme: Programme) -> str:
    """The stations with their joints by name, rad or m.

    ``tool_change`` is there where the tool is exchanged, before the station that
    ``before_station`` names by its index; ``mount`` of a station, from 1, where the
    cell has two.
    """
    change = programme.change
    data = {
        "schema": PROGRAMME_SCHEMA,
        "notice": programme.head,
        "joint_names": programme.joint_names,
        "joint_units": ["m" if s else "rad" for s in programme.slides],
        "dwell_s": programme.dwell,
        "home": programme.home.tolist(),
        "stations": [
            {
                "index": k,
                "kind": kind,
                **({"mount": programme.mounts[k] + 1} if programme.mounts else {}),
                "via": programme.via[k].tolist(),
                "joints": programme.stops[k].tolist(),
            }
            for k, kind in enumerate(programme.kinds)
        ],
    }
    if change is not None:
        data["tool_change"] = {
            "before_station": change.before,
            "via": change.via.tolist(),
            "joints": change.joints.tolist(),
            "take_off": change.tools[0],
            "mount": change.mount,
        }
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def joint_trajectory_yaml(programme: Programme) -> str:
    """A ROS 2 ``trajectory_msgs/msg/JointTrajectory`` message in YAML.

    Every station is two points, arrival and departure. All points are at rest. A
    controller joins points at rest by cubic polynomials that all joints pass through
    in step: straight in joint space, with 1.5 times the mean speed in the middle and
    6 times the distance over the squared time at the ends. The times keep both in
    the limits.

    A trajectory cannot wait for a person: with a tool change there are two messages,
    a YAML document each, to be sent one after the other.
    """
    lines = [f"# {line}" for line in programme.head]
    lines += [
        f"# Points at rest; {programme.dwell:g} s at each station. rad or m, seconds.",
        *_message(programme, programme.home),
    ]
    now = 0.0
    for k in range(len(programme.stops)):
        to_change = programme.way_to_change(k)
        if to_change is not None:
            now = _moves(programme, to_change, now, lines)
            lines += [
                "---",
                f"# {programme.change}; then send this second message.",
                *_message(programme, to_change[-1]),
            ]
            now = 0.0
        leg = programme.leg(k)
        now = _moves(programme, leg, now, lines)
        if programme.dwell > 0:
            now += programme.dwell
            lines += _point(leg[-1], now)
    return "\n".join(lines) + "\n"


def _message(programme: Programme, start: Floats) -> list[str]:
    """How a message begins, at joints ``start``."""
    return [
        "header:",
        "  frame_id: ''",
        f"joint_names: [{', '.join(programme.joint_names)}]",
        "points:",
        *_point(start, 0.0),
    ]


def _moves(programme: Programme, leg: Floats, now: float, lines: list[str]) -> float:
    """Add the points of a leg after moment ``now``; when it ends, seconds."""
    for start, end in pairwise(leg):
        distance = np.abs(end - start)
        slowest = np.maximum(
            1.5 * distance / programme.speed,
            np.sqrt(6 * distance / programme.acceleration),
        )
        now += max(float(slowest.max()), 1e-3)
        lines += _point(end, now)
    return now


def _point(joints: Floats, time: float) -> list[str]:
    seconds, rest = divmod(round(time * 1e9), 1_000_000_000)
    values = ", ".join(repr(float(q)) for q in joints)
    still = ", ".join(["0.0"] * len(joints))
    return [
        f"- positions: [{values}]",
        f"  velocities: [{still}]",
        f"  time_from_start: {{sec: {seconds}, nanosec: {rest}}}",
    ]


def urscript(programme: Programme) -> str:
    """A URScript programme: moves, blended where they pass a point, and stops.

    ``movej`` takes speed and acceleration of the joint that travels farthest; both
    are chosen so that every joint stays within its own limits. At a tool change a
    popup holds the programme until a person lets it go on.

    Raises:
        InputError: the arm does not have six hinges.
    """
    if len(programme.joint_names) != 6 or programme.slides.any():
        raise InputError(
            "urscript needs an arm of six hinges, got "
            f"{', '.join(programme.joint_names)}; choose csv, json or joint_trajectory"
        )
    speed, acceleration = programme.speed, programme.acceleration
    lines = [f"# {line}" for line in programme.head]
    lines += ["# Joints in rad, base to wrist.", "def calibration_programme():"]
    start = _joints(programme.home)
    lines += [f"  movej({start}, a={acceleration.min():.6g}, v={speed.min():.6g})"]
    for k, kind in enumerate(programme.kinds):
        to_change = programme.way_to_change(k)
        if to_change is not None:
            lines += [f"  # {programme.change}", *_script_moves(programme, to_change)]
            lines.append(
                f'  popup("{programme.change}", title="Tool change", warning=True, '
                "blocking=True)"
            )
        called = programme.called(k)
        lines += [f"  # station {called}, {kind}"]
        lines += _script_moves(programme, programme.leg(k))
        told = str(k) if programme.change is None else f'"{called}"'
        lines += [f'  textmsg("station ", {told})', f"  sleep({programme.dwell:g})"]
    lines += ["end", "calibration_programme()"]
    return "\n".join(lines) + "\n"


def _script_moves(programme: Programme, leg: Floats) -> list[str]:
    """The moves along a leg, blended at the points passed."""
    lines = []
    for number, (start, end) in enumerate(pairwise(leg), 2):
        share = np.abs(end - start) / max(float(np.abs(end - start).max()), 1e-12)
        share = np.maximum(share, 1e-12)
        blend = "" if number == len(leg) else f", r={_BLEND}"
        lines.append(
            f"  movej({_joints(end)}, a={(programme.acceleration / share).min():.6g}, "
            f"v={(programme.speed / share).min():.6g}{blend})"
        )
    return lines


def _joints(values: Floats) -> str:
    return "[" + ", ".join(f"{q:.9f}" for q in values) + "]"
