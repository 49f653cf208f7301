"""A user's own stations: what forbids them, and what they would tell."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from handeye_tri.arm import Arm
from handeye_tri.config import Cell
from handeye_tri.counting import counted
from handeye_tri.errors import InputError
from handeye_tri.exchange.half_turns import turn_between
from handeye_tri.plan.candidates import SIGHT_MARGIN
from handeye_tri.plan.certificate import certify
from handeye_tri.plan.information import StationInformation
from handeye_tri.plan.mounted import arms_by_mount
from handeye_tri.plan.poses import View
from handeye_tri.plan.route import RoutePlanner, unknown_speeds
from handeye_tri.plan.sequence import travel_time
from handeye_tri.records import HalfTurn, Plan, Station, ToolChange
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Ints = NDArray[np.intp]

# Two stations that differ by a half-turn within this are taken for one: a programme
# that was typed by hand is rounded to a hundredth of a degree or a tenth of a mm.
_TURN_TOLERANCE = np.radians(0.1)
_SHIFT_TOLERANCE = 0.5e-3


def certify_stations(
    cell: Cell,
    arms: Arm | Sequence[Arm],
    joints: ArrayLike,
    mounts: ArrayLike | None = None,
) -> Plan:
    """Judge a list of stations as a plan is judged.

    Half-turns are found in the stations themselves: any two with one mount that differ
    by 180 degrees about the flange's z axis, those nearest in order first. All stations
    are for calibration. Where the mount changes, the arm goes home for it.

    Args:
        cell: The cell.
        arms: The robot in it, by mount; alone where there is one.
        joints: Shape (n, q), rad or m, in the order driven.
        mounts: Which mount holds the triangle there, from 0, shape (n,); None: the
            cell's only one.

    Returns:
        The programme with its certificate. What forbids a station (limits, view,
        collision, occlusion, the path to the next) is a finding, and the outcome is
        then not PASS.

    Raises:
        InputError: a shape does not fit, a value is not finite, the cell has no such
            mount, or the tool is changed more than once.
    """
    arms = arms_by_mount(cell, arms)
    q = np.asarray(joints, dtype=float)
    names = arms[0].joint_names
    if q.ndim != 2 or q.shape[1] != len(names) or len(q) < 2:
        raise InputError(
            f"joints must have shape (n, {len(names)}) with n at least 2, one column "
            f"for each of {', '.join(names)}, got {q.shape}"
        )
    if not np.isfinite(q).all():
        row, column = np.argwhere(~np.isfinite(q))[0]
        raise InputError(f"joints[{row}, {column}] ({names[column]}) is not finite")
    held = _held(cell, mounts, len(q))
    poses = arms[0].forward(q)
    turns = _half_turns(poses, held)
    base = arms[0].base_from_world
    model = StationInformation(
        cell, base.matrix, cell.repeatability, cell.plan.expected_sigma_px
    )
    world = base.inverse().matrix @ poses
    seen = np.zeros((len(q), len(cell.cameras)), dtype=bool)
    forbidden, seconds, start = [], 0.0, arms[0].home
    change = None
    parts = np.split(np.arange(len(q)), np.flatnonzero(np.diff(held)) + 1)
    for part in parts:
        mount = int(held[part[0]])
        arm, view = arms[mount], model.views[mount]
        seen[part] = view.seen(world[part])
        forbidden += _forbidden(arm, view, part, q, seen)
        way = [start[None], q[part]]
        if part is not parts[-1]:
            route = RoutePlanner(
                *(arm, cell.arm.acceleration_time_s, 0, Counter(), Counter())
            )
            via = _way_home(route, arm, int(part[-1]), q, forbidden)
            change = ToolChange(int(part[-1]) + 1, arm.home, via)
            way += [via, arm.home[None]]
        points = np.concatenate(way)
        times = travel_time(
            points[:-1], points[1:], arm.speed, cell.arm.acceleration_time_s
        )
        seconds += float(times.sum())
        start = arm.home
    certificate = certify(cell, model, poses, seen, held, turns)
    outcome = certificate.outcome
    if forbidden and outcome == "PASS":
        outcome = "FAIL"
    return Plan(
        tuple(
            Station(k, "calibration", row, SE3(pose), int(held[k]))
            for k, (row, pose) in enumerate(zip(q, poses, strict=True))
        ),
        tuple(HalfTurn(int(a), int(b), cell.axes[held[a]]) for a, b in turns),
        {},
        {**certificate.numbers, "cycle_time_s": seconds},
        0,
        outcome,
        (*forbidden, *certificate.findings, *unknown_speeds(arms[0])),
        tool_change=change,
    )


def _held(cell: Cell, mounts: ArrayLike | None, count: int) -> Ints:
    """The mount at each station, shape (n,).

    Raises:
        InputError: it is not said, none of the cell's, or changes more than once.
    """
    known = len(cell.mounted)
    if mounts is None and known > 1:
        raise InputError(
            f"mounts must say which of the {known} mounts of cell {cell.name!r} holds "
            "the triangle at each station, from 0"
        )
    held = np.zeros(count, dtype=np.intp) if mounts is None else np.asarray(mounts)
    if held.shape != (count,) or held.dtype.kind not in "iu":
        raise InputError(
            f"mounts must be {count} whole numbers, one by station, got shape "
            f"{held.shape} of {held.dtype}"
        )
    if (wrong := held[(held < 0) | (held >= known)]).size:
        raise InputError(
            f"mounts must be from 0 to {known - 1} in cell {cell.name!r}, got "
            f"{wrong[0]}"
        )
    changes = np.flatnonzero(np.diff(held)) + 1
    if len(changes) > 1:
        where = ", ".join(str(k) for k in changes)
        raise InputError(
            f"the mount changes before stations {where}, but a programme has one tool "
            "change; put all stations of one mount before those of the other"
        )
    return held.astype(np.intp)


def _way_home(
    route: RoutePlanner, arm: Arm, station: int, joints: Floats, forbidden: list[str]
) -> Floats:
    """Points to pass from a station to the tool change; what is in the way is added."""
    start = joints[station]
    if arm.collision(start) is None is arm.collision(arm.home):
        via = route.way(start, arm.home)
        if via is not None:
            return via
        hit = arm.path_collision(start, arm.home)
        what = f"{hit[0]} touches {hit[1]}" if hit else "no way is free"
        forbidden.append(f"from station {station} home for the tool change: {what}")
    return np.zeros((0, len(start)))


def _half_turns(poses: Floats, mounts: Ints) -> Ints:
    """Stations with one mount that differ by a half-turn, shape (k, 2); none twice."""
    near = cKDTree(poses[:, :3, 3]).query_pairs(3 * _SHIFT_TOLERANCE)
    found: list[tuple[int, int]] = []
    used = set[int]()
    for before, after in sorted(near, key=lambda pair: (pair[1] - pair[0], pair)):
        if used & {before, after} or mounts[before] != mounts[after]:
            continue
        turn = turn_between(poses, before, after)
        tilt = np.arccos(min(1.0, abs(float(turn.axis[2]))))
        off = max(abs(turn.pitch), float(np.linalg.norm(turn.foot)))
        if max(abs(turn.miss), tilt) < _TURN_TOLERANCE and off < _SHIFT_TOLERANCE:
            found.append((before, after))
            used |= {before, after}
    return np.array(sorted(found), dtype=np.intp).reshape(-1, 2)


def _forbidden(
    arm: Arm, view: View, stations: Ints, joints: Floats, seen: Flags
) -> list[str]:
    """What stands against stations with one mount and the moves between them.

    One sentence each. Cameras from which something hides a marker are taken out of
    ``seen``.

    Args:
        arm: The robot with the mount.
        view: Cameras and rig.
        stations: Which, in the order driven, shape (k,).
        joints: Of all stations, shape (n, q).
        seen: Of all stations, shape (n, m).
    """
    found = []
    world = arm.base_from_world.inverse().matrix @ arm.forward(joints[stations])
    inside = view.in_image(world).sum(axis=1) >= view.required
    for k, whole in zip(stations, inside, strict=True):
        q = joints[k]
        beyond = np.flatnonzero((q < arm.lower) | (q > arm.upper))
        for j in beyond:
            found.append(
                f"station {k}: joint {arm.joint_names[j]} at {q[j]:.3f} leaves its "
                f"limits {arm.lower[j]:.3f} to {arm.upper[j]:.3f} (rad or m)"
            )
        if not whole:
            found.append(
                f"station {k}: all markers are in the images of fewer than "
                f"{counted(view.required, 'camera')}"
            )
        elif seen[k].sum() < view.required:
            found.append(
                f"station {k}: the triangle is seen by fewer than "
                f"{counted(view.required, 'camera')} at less than "
                f"{view.cell.plan.max_tilt_deg:.0f} degrees"
            )
        hit = arm.collision(q)
        if hit is not None:
            found.append(f"station {k}: {hit[0]} touches {hit[1]}")
        found += _hidden(arm, view, k, q, seen[k])
    for k, following in pairwise(stations):
        start, end = joints[k], joints[following]
        hit = arm.path_collision(start, end)
        if hit is not None and arm.collision(start) is None is arm.collision(end):
            found.append(f"from station {k} to {k + 1}: {hit[0]} touches {hit[1]}")
    return found


def _hidden(arm: Arm, view: View, station: int, q: Floats, seen: Flags) -> list[str]:
    found = []
    for i in np.flatnonzero(seen):
        place = view.world_from_camera[i, :3, 3]
        for marker, radius in enumerate(SIGHT_MARGIN * view.radii):
            blocker = arm.sight_blocked(q, place, marker, radius)
            if blocker is not None:
                seen[i] = False
                found.append(
                    f"station {station}: {blocker} hides marker {'ABC'[marker]} from "
                    f"camera {view.cell.cameras[i].name}"
                )
    return found if seen.sum() < view.required else []
