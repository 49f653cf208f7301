"""Programmes with a tool change: of one plan with two mounts, or of two sessions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from handeye_tri import storage
from handeye_tri.arm import Arm
from handeye_tri.config import Cell, RigConfig
from handeye_tri.errors import InputError
from handeye_tri.exchange.robot_programme import Programme, ToolChange
from handeye_tri.pipeline.run import Run
from handeye_tri.plan.sequence import travel_time
from handeye_tri.records import Floats, Plan

# What may differ between the two cells: what they are called, the rig, what is planned.
_MAY_DIFFER = ("name", "rig", "plan", "imaging")


def change_of(plan: Plan, cell: Cell) -> ToolChange | None:
    """The tool change of a plan, in words for a person."""
    change = plan.tool_change
    if change is None:
        return None
    new = plan.stations[change.before].mount
    old = plan.stations[change.before - 1].mount if change.before else 1 - new
    ahead = cell.mounted[new].rig.ahead_mm
    return ToolChange(
        before=change.before,
        joints=change.joints,
        via=change.via,
        tools=(cell.mount_name(old), cell.mount_name(new)),
        mount=f"{cell.mount_name(new)}, {ahead:g} mm ahead of the flange",
    )


def check_other_rig(run: Run, then: Run) -> None:
    """See that two sessions are of the same arm and cameras, with different rigs.

    Raises:
        InputError: they are not, naming what differs; or one changes the tool itself.
    """
    for one in (run, then):
        if one.designed_cell.second_mount is not None:
            raise InputError(
                f"{one.folder.path}: its own plan changes the tool, between the mounts "
                "of its cell, and a programme does so once; write it without --then"
            )
    first, second = (
        r.designed_cell.model_dump(mode="json", by_alias=True) for r in (run, then)
    )
    where = f"{run.folder.path} and {then.folder.path}"
    for key in first:
        if key not in _MAY_DIFFER and first[key] != second[key]:
            raise InputError(
                f"{where}: a tool change leaves all but the rig as it is, but "
                f"{_differing(key, first[key], second[key])} differs; plan both in "
                "cells that differ in name, rig and plan only"
            )
    if storage.sha256(run.model_path) != storage.sha256(then.model_path):
        raise InputError(f"{where}: the arm's model files differ; plan both with one")
    if first["rig"] == second["rig"]:
        raise InputError(
            f"{where}: both cells have the same rig, so there is no tool to change; "
            "name a session of a cell with another rig"
        )
    if first["name"] == second["name"]:
        raise InputError(
            f"{where}: both cells are called {first['name']}, and a person could not "
            "tell which rig to mount; give one of them another name"
        )


def _differing(key: str, first: Any, second: Any) -> str:
    """The first key inside of two different values, dotted."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        for inner in first:
            if first[inner] != second.get(inner):
                return _differing(f"{key}.{inner}", first[inner], second.get(inner))
    return key


def with_tool_change(
    first: Programme, second: Programme, run: Run, then: Run
) -> Programme:
    """One programme: all stations of the first rig, a tool change, then the others.

    The robot waits for it where both programmes start, in the arm's home, which both
    plans found free with their own rig.
    """
    before, after = run.designed_cell, then.designed_cell
    change = ToolChange(
        before=len(first.stops),
        joints=second.home,
        via=way_back(run.arm, first),
        tools=(f"the rig of {before.name}", f"the rig of {after.name}"),
        mount=f"the rig of {after.name} ({described(after.rig)})",
    )
    return replace(
        first,
        head=(
            *first.head[:-1],
            change.of_programme(len(first.stops) + len(second.stops)),
            *second.head,
        ),
        stops=np.concatenate([first.stops, second.stops]),
        kinds=(*first.kinds, *second.kinds),
        via=(*first.via, *second.via),
        change=change,
    )


def described(rig: RigConfig) -> str:
    """What a person must mount, in words."""
    turns = "a normal" if rig.axis == "normal" else f"its edge {rig.axis}"
    return (
        f"half-turns about {turns}; AB {rig.side_ab_mm:g} mm, AC {rig.side_ac_mm:g} "
        f"mm, {rig.angle_deg:g} degrees at A"
    )


def seconds_of_moves(programme: Programme) -> float:
    """Time of all moves, that to a tool change among them, without any standing."""
    legs = []
    for k in range(len(programme.stops)):
        to_change = programme.way_to_change(k)
        legs += (
            [programme.leg(k)] if to_change is None else [to_change, programme.leg(k)]
        )
    return sum(
        float(
            travel_time(
                leg[:-1], leg[1:], programme.speed, programme.acceleration_time
            ).sum()
        )
        for leg in legs
    )


def way_back(arm: Arm, programme: Programme) -> Floats:
    """Joints passed on a free way from the last station home, shape (k, q).

    Back along the way that was driven, up to where home is straight ahead; all of
    that way is free, so there is always one.
    """
    driven = np.concatenate(
        [programme.home[None]]
        + [programme.leg(k)[1:] for k in range(len(programme.stops))]
    )[::-1]
    for count in range(1, len(driven)):
        if arm.path_collision(driven[count - 1], driven[-1]) is None:
            return np.asarray(driven[1:count])
    return np.asarray(driven[1:-1])
