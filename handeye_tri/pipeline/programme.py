"""A session's plan as files that a robot can run."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from handeye_tri import storage
from handeye_tri.counting import counted
from handeye_tri.errors import InputError
from handeye_tri.exchange.robot_programme import (
    Programme,
    joint_trajectory_yaml,
    programme_json,
    urscript,
)
from handeye_tri.pipeline.execution import require
from handeye_tri.pipeline.run import Run
from handeye_tri.pipeline.stages import stages_of
from handeye_tri.pipeline.tool_change import (
    change_of,
    check_other_rig,
    with_tool_change,
)
from handeye_tri.records import Floats, Plan

# What each is for, in a few words.
LAYOUTS = {
    "csv": "joint values by station, units in the column names",
    "json": "the same with the points passed on the way",
    "joint_trajectory": "ROS 2 JointTrajectory message in YAML",
    "urscript": "URScript: moves, and a stop at each station",
}


# How long the robot stands at a station where nobody says otherwise, seconds.
_DWELL = 1.0


def plan_more(run: Run, half_turns: int) -> tuple[Plan, Path]:
    """Half-turns that add most to what a session has observed, as a file.

    It is ``next.csv``, or ``next.json`` where ways pass points that a list of stations
    cannot hold.

    Args:
        run: A session whose views were looked at, all or some of them.
        half_turns: How many.

    Returns:
        The new stations, and the file written.

    Raises:
        StorageError: nothing was detected yet.
        NoPlanError: no plan was found.
    """
    from handeye_tri.plan import Visited, plan_next

    stages = stages_of(run)
    require(run, stages, stages["detect"])
    session = run.observed()
    views = np.asarray(np.isfinite(session.pixels).all(axis=(2, 3)).T)
    seen = np.asarray(views.any(axis=1))
    used = [
        k for k, s in enumerate(session.stations) if s.kind == "calibration" and seen[k]
    ]
    place = {station: number for number, station in enumerate(used)}
    turns = [
        (place[turn.before], place[turn.after])
        for turn in session.half_turns
        if turn.before in place and turn.after in place
    ]
    last = max(np.flatnonzero(seen), default=None)
    here = run.arm.home if last is None else session.stations[last].joints
    visited = Visited(
        session.base_from_flange[used].reshape(-1, 4, 4),
        views[used].reshape(-1, len(session.cameras)),
        session.mounts[used],
        np.array(turns, dtype=np.intp).reshape(-1, 2),
        here,
        0 if last is None else session.stations[last].mount,
    )
    plan = plan_next(
        run.designed_cell,
        run.arms,
        visited,
        run.seed,
        half_turns,
        run.progress.advance,
    )
    programme = _programme(run, plan, here, _DWELL)
    listed, whole = (run.folder.file(f"next.{kind}") for kind in ("csv", "json"))
    path, other = (listed, whole) if programme.straight else (whole, listed)
    _write(programme, path.suffix[1:], path)
    # What was planned before is not left beside it.
    other.unlink(missing_ok=True)
    return plan, path


def planned_outcome(run: Run) -> str:
    """The verdict of a session's plan that is whole and up to date.

    Raises:
        StorageError: there is none, it is damaged, or the cell changed since.
    """
    stages = stages_of(run)
    require(run, stages, stages["plan"])
    return run.plan().outcome


def write_programme(
    run: Run, layout: str, path: Path, dwell: float, then: Run | None = None
) -> Programme:
    """Write the plan of a session, or of two with a tool change between them.

    Args:
        run: A session that is planned.
        layout: One of LAYOUTS.
        path: The file.
        dwell: How long the robot stands at a station, seconds.
        then: Another planned session of the same arm and cameras, with another rig.

    Returns:
        What was written.

    Raises:
        InputError: the layout is unknown or cannot hold the programme, or the two
            sessions differ in more than their rigs.
        StorageError: there is no plan, or the file cannot be written.
    """
    programme = _programme(run, run.plan(), run.arm.home, dwell)
    if then is not None:
        check_other_rig(run, then)
        second = _programme(then, then.plan(), then.arm.home, dwell)
        programme = with_tool_change(programme, second, run, then)
    _write(programme, layout, path)
    return programme


def _programme(run: Run, plan: Plan, start: Floats, dwell: float) -> Programme:
    """A plan that begins at joints ``start``."""
    arm, cell = run.arm, run.designed_cell
    change = change_of(plan, cell)
    mounts = tuple(station.mount for station in plan.stations)
    outcome = f"verdict {plan.outcome}: " + ("; ".join(plan.findings) or "no finding")
    return Programme(
        head=(
            f"handeye-tri: {counted(len(plan.half_turns), 'half-turn')} of cell "
            f"{cell.name}, seed {plan.seed}",
            outcome,
            *([change.of_programme(len(plan.stations))] if change else []),
            "Planned in the model of the cell: try it slowly, a hand on the stop.",
        ),
        joint_names=arm.joint_names,
        slides=arm.slides,
        home=start,
        stops=np.array([station.joints for station in plan.stations]),
        kinds=tuple(station.kind for station in plan.stations),
        via=plan.via,
        speed=arm.speed,
        acceleration_time=cell.arm.acceleration_time_s,
        dwell=dwell,
        change=change,
        mounts=mounts if len(cell.mounted) > 1 else None,
    )


def _write(programme: Programme, layout: str, path: Path) -> None:
    """A programme in one of LAYOUTS."""
    if layout == "csv":
        if programme.change is not None and programme.mounts is None:
            raise InputError(
                "csv holds stations only, and this programme changes the tool; "
                "choose json, joint_trajectory or urscript"
            )
        if not programme.straight:
            raise InputError(
                "csv holds stations only, and this plan passes points between them; "
                "choose json, joint_trajectory or urscript"
            )
        mounts = programme.mounts
        storage.write_joint_list(
            path,
            programme.joint_names,
            programme.slides,
            programme.stops,
            None if mounts is None else np.array(mounts),
        )
        return
    writers = {
        "json": programme_json,
        "joint_trajectory": joint_trajectory_yaml,
        "urscript": urscript,
    }
    if layout not in writers:
        raise InputError(f"there is no {layout!r}; there are {', '.join(LAYOUTS)}")
    storage.write_bytes(path, writers[layout](programme).encode())
