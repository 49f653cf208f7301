"""A user's own stations: what forbids them, and what they would tell."""

from __future__ import annotations

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
from handeye_tri.plan.poses import View
from handeye_tri.plan.route import unknown_speeds
from handeye_tri.plan.sequence import travel_time
from handeye_tri.records import HalfTurn, Plan, Station
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Two stations that differ by a half-turn within this are taken for one: a programme
# that was typed by hand is rounded to a hundredth of a degree or a tenth of a mm.
_TURN_TOLERANCE = np.radians(0.1)
_SHIFT_TOLERANCE = 0.5e-3


def certify_stations(cell: Cell, arm: Arm, joints: ArrayLike) -> Plan:
    """Judge a list of stations as a plan is judged.

    Half-turns are found in the stations themselves: any two that differ by 180
    degrees about the flange's z axis, those nearest in order first. All stations are
    for calibration.

    Args:
        cell: The cell.
        arm: The robot in it.
        joints: Shape (n, q), rad or m, in the order driven.

    Returns:
        The programme with its certificate. What forbids a station (limits, view,
        collision, occlusion, the path to the next) is a finding, and the outcome is
        then not PASS.

    Raises:
        InputError: the shape does not fit the arm, or a value is not finite.
    """
    q = np.asarray(joints, dtype=float)
    names = arm.joint_names
    if q.ndim != 2 or q.shape[1] != len(names) or len(q) < 2:
        raise InputError(
            f"joints must have shape (n, {len(names)}) with n at least 2, one column "
            f"for each of {', '.join(names)}, got {q.shape}"
        )
    if not np.isfinite(q).all():
        row, column = np.argwhere(~np.isfinite(q))[0]
        raise InputError(f"joints[{row}, {column}] ({names[column]}) is not finite")
    poses = arm.forward(q)
    turns = _half_turns(poses)
    view = View(cell)
    base = arm.base_from_world.matrix
    model = StationInformation(
        cell, base, cell.repeatability, cell.plan.expected_sigma_px
    )
    seen = view.seen(arm.base_from_world.inverse().matrix @ poses)
    forbidden = _forbidden(arm, view, q, seen)
    certificate = certify(
        cell, model, poses, seen, np.zeros(len(poses), dtype=np.intp), turns
    )
    times = travel_time(
        np.array([arm.home, *q[:-1]]), q, arm.speed, cell.arm.acceleration_time_s
    )
    outcome = certificate.outcome
    if forbidden and outcome == "PASS":
        outcome = "FAIL"
    return Plan(
        tuple(
            Station(k, "calibration", row, SE3(pose))
            for k, (row, pose) in enumerate(zip(q, poses, strict=True))
        ),
        tuple(HalfTurn(int(a), int(b), cell.rig.axis) for a, b in turns),
        {},
        {**certificate.numbers, "cycle_time_s": float(times.sum())},
        0,
        outcome,
        (*forbidden, *certificate.findings, *unknown_speeds(arm)),
    )


def _half_turns(poses: Floats) -> NDArray[np.intp]:
    """Stations that differ by a half-turn, shape (k, 2); none twice."""
    near = cKDTree(poses[:, :3, 3]).query_pairs(3 * _SHIFT_TOLERANCE)
    found: list[tuple[int, int]] = []
    used = set[int]()
    for before, after in sorted(near, key=lambda pair: (pair[1] - pair[0], pair)):
        if used & {before, after}:
            continue
        turn = turn_between(poses, before, after)
        tilt = np.arccos(min(1.0, abs(float(turn.axis[2]))))
        off = max(abs(turn.pitch), float(np.linalg.norm(turn.foot)))
        if max(abs(turn.miss), tilt) < _TURN_TOLERANCE and off < _SHIFT_TOLERANCE:
            found.append((before, after))
            used |= {before, after}
    return np.array(sorted(found), dtype=np.intp).reshape(-1, 2)


def _forbidden(arm: Arm, view: View, joints: Floats, seen: Flags) -> list[str]:
    """What stands against each station and each move, one sentence each.

    Cameras from which something hides a marker are taken out of ``seen``.
    """
    found = []
    world = arm.base_from_world.inverse().matrix @ arm.forward(joints)
    inside = view.in_image(world).sum(axis=1) >= view.required
    for k, q in enumerate(joints):
        beyond = np.flatnonzero((q < arm.lower) | (q > arm.upper))
        for j in beyond:
            found.append(
                f"station {k}: joint {arm.joint_names[j]} at {q[j]:.3f} leaves its "
                f"limits {arm.lower[j]:.3f} to {arm.upper[j]:.3f} (rad or m)"
            )
        if not inside[k]:
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
    for k, (start, end) in enumerate(pairwise(joints)):
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
