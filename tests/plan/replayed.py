"""A plan driven in MuJoCo, another engine than the one it was planned with."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from handeye_tri.arm import Arm
from handeye_tri.config import Cell
from handeye_tri.plan.sequence import travel_time
from handeye_tri.records import Plan
from handeye_tri.simulate.compile import compile_cell

Floats = NDArray[np.float64]


def way_points(plan: Plan, arm: Arm) -> list[tuple[int, Floats]]:
    """Joints passed with each mount from home on, back home too, (mount, (n, q))."""
    change = plan.tool_change
    ways = [(plan.stations[0].mount, [arm.home[None]])]
    for station, via in zip(plan.stations, plan.via, strict=True):
        if change is not None and change.before == station.index:
            ways[-1][1].extend([change.via, change.joints[None]])
            ways.append((station.mount, [change.joints[None]]))
        ways[-1][1].extend([via, station.joints[None]])
    return [(mount, np.concatenate(way)) for mount, way in ways]


def driven(start: Floats, end: Floats, speed: Floats, ramp: float) -> Floats:
    """Joints every millisecond of a move from rest to rest, shape (n, q).

    All joints speed up evenly, travel and slow down together.
    """
    seconds = float(travel_time(start, end, speed, ramp))
    if seconds == 0:
        return start[None]
    ramp = min(ramp, seconds / 2)
    time = np.append(np.arange(0, seconds, 1e-3), seconds)
    rest = np.minimum(time, seconds - time)
    slow = np.where(rest < ramp, rest**2 / (2 * ramp), rest - ramp / 2)
    part = slow / (seconds - ramp)
    part = np.where(time < seconds / 2, part, 1 - part)
    return np.asarray(start + part[:, None] * (end - start))


def contacts(cell: Cell, model_path: Path, arm: Arm, plan: Plan) -> tuple[int, int]:
    """Milliseconds of a plan at which solids touch, and all of them."""
    touching = steps = 0
    for mount, way in way_points(plan, arm):
        model, _ = compile_cell(cell.mounted[mount], model_path)
        data = mujoco.MjData(model)
        for start, end in pairwise(way):
            for joints in driven(start, end, arm.speed, cell.arm.acceleration_time_s):
                data.qpos[:] = joints
                mujoco.mj_kinematics(model, data)
                mujoco.mj_collision(model, data)
                touching += int(data.ncon > 0 and data.contact.dist.min() <= 0)
                steps += 1
    return touching, steps
