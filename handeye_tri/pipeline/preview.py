"""A session's plan as a recording: ``plan.rrd``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, groupby, pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import MissingDependencyError
from handeye_tri.pipeline.run import Run
from handeye_tri.records import Plan
from handeye_tri.summary import plan_text

if TYPE_CHECKING:
    from handeye_tri.config import Cell

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

PREVIEW = "plan.rrd"
# Moments of the moving arm are this far apart, and it stands so long at a station.
_STEP_S, _STAND_S = 0.08, 1.0
# A person changes the tool so soon, for those who look on.
_CHANGE_S = 2.0
# Views are smaller than the images, by a whole factor, and at most so wide.
_WIDEST_PX = 512


def write_plan_recording(run: Run) -> tuple[Path, str]:
    """Write what a planned session's robot will do and its cameras will see.

    Returns:
        The file, and why its views are outlines alone; "" where they are rendered.

    Raises:
        StorageError: there is no plan, or the file cannot be written.
    """
    from handeye_tri import replay, simulate

    plan, arm, cell = run.plan(), run.arm, reduced(run.designed_cell)
    times, joints, station, mounts = driven(
        plan, arm.home, arm.speed, cell.arm.acceleration_time_s
    )
    markers = np.array([one.marker_positions(joints) for one in run.arms])
    motion = replay.PlannedMotion(
        plan,
        times,
        station,
        mounts,
        tuple(cell.mount_name(mount) for mount in range(len(cell.mounted))),
        arm.body_poses(joints),
        markers[mounts, np.arange(len(times))],
        tuple(camera.camera for camera in cell.cameras),
        tuple(arm.base_from_world @ c.world_from_camera for c in cell.cameras),
        np.array(cell.rig.marker_colours),
    )
    path, missing = run.folder.file(PREVIEW), ""
    views: Iterator[replay.View] = iter(())
    try:
        simulate.check_rendering()
    except MissingDependencyError as error:
        missing = str(error)
    else:
        held = mounts.tolist()
        # Mount by mount in the order driven, as the recording goes through time.
        views = chain.from_iterable(
            simulate.render_views(
                cell,
                run.model_path,
                joints,
                run.seed,
                [(i, k) for k in there for i in range(len(cell.cameras))],
                mounts=held,
            )
            for _, there in groupby(motion.arrivals().tolist(), held.__getitem__)
        )
    replay.write_preview(
        path,
        name=f"{cell.name}, plan",
        mechanisms=run.mechanisms,
        base_from_world=arm.base_from_world,
        motion=motion,
        certificate=plan_text(plan, cell),
        views=views,
    )
    return path, missing


def reduced(cell: Cell) -> Cell:
    """The same cell with cameras of fewer, larger pixels, none wider than a limit."""
    cameras = []
    for camera in cell.cameras:
        factor = -(-camera.image_size_px[0] // _WIDEST_PX)
        width, height = (size // factor for size in camera.image_size_px)
        focal, centre = np.array(camera.focal_px), np.array(camera.principal_point_px)
        update = {
            "image_size_px": (width, height),
            "focal_px": tuple((focal / factor).tolist()),
            # The first pixel's centre is (0, 0), its corner half a pixel before.
            "principal_point_px": tuple(((centre + 0.5) / factor - 0.5).tolist()),
            "skew_px": camera.skew_px / factor,
        }
        cameras.append(camera.model_copy(update=update))
    # Nothing is measured in them.
    plain = {"supersample": 1, "blur_px": 0.0, "noise_percent": 0.0}
    imaging = cell.imaging.model_copy(update=plain)
    return cell.model_copy(update={"cameras": tuple(cameras), "imaging": imaging})


def driven(
    plan: Plan, home: Floats, speed: Floats, acceleration_time: float
) -> tuple[Floats, Floats, Ints, Ints]:
    """A programme in time: straight moves from rest to rest, a stop per station.

    For a tool change the arm goes home and waits there.

    The slowest joint of a move speeds up evenly, travels at its speed limit if it
    gets there, and slows down evenly; the others keep in step.

    Args:
        plan: The programme.
        home: Where the arm starts, shape (q,), rad or m.
        speed: Of the joints, shape (q,), rad/s or m/s.
        acceleration_time: From rest to full speed, seconds.

    Returns:
        Seconds (t,), joints (t, q), the station stood at, -1 on the way (t,), and the
        mount that holds the triangle (t,).
    """
    times, joints, station = [0.0], [home], [-1]
    mounts = [plan.stations[0].mount]
    change = plan.tool_change

    def stood(seconds: float, there: Floats, index: int, mount: int) -> None:
        times.append(times[-1] + seconds)
        joints.append(there)
        station.append(index)
        mounts.append(mount)

    def moved(way: Sequence[Floats]) -> None:
        for start, end in pairwise([joints[-1], *way]):
            cruise = float((np.abs(end - start) / speed).max())
            moments, shares = _move(cruise, acceleration_time)
            times.extend((times[-1] + moments).tolist())
            joints.extend(start + share * (end - start) for share in shares)
            station.extend([-1] * len(moments))
            mounts.extend([mounts[-1]] * len(moments))

    for index, (stop, via) in enumerate(zip(plan.stations, plan.via, strict=True)):
        if change is not None and change.before == index:
            moved([*change.via, change.joints])
            stood(0.5 * _CHANGE_S, change.joints, -1, mounts[-1])
            stood(0.5 * _CHANGE_S, change.joints, -1, stop.mount)
        moved([*via, stop.joints])
        # Arrival and departure.
        stood(_STEP_S, stop.joints, index, stop.mount)
        stood(_STAND_S - _STEP_S, stop.joints, index, stop.mount)
    return (
        np.array(times),
        np.array(joints),
        np.array(station, dtype=np.intp),
        np.array(mounts, dtype=np.intp),
    )


def _move(cruise: float, acceleration_time: float) -> tuple[Floats, Floats]:
    """Moments (k,) of a move and the share of it that is done by then (k,).

    Args:
        cruise: Seconds that the slowest joint would take at full speed.
        acceleration_time: Seconds from rest to full speed.
    """
    rise = min(acceleration_time, float(np.sqrt(cruise * acceleration_time)))
    if rise == 0.0:
        return np.zeros(0), np.zeros(0)
    total = cruise * acceleration_time / rise + rise
    steps = max(int(np.ceil(total / _STEP_S)), 1)
    moments = total * np.arange(1, steps + 1) / steps
    early, late = np.minimum(moments, rise), np.minimum(total - moments, rise)
    way = np.where(moments < rise, 0.5 * early**2, rise * (moments - 0.5 * rise))
    way = np.where(total - moments < rise, rise * (total - rise) - 0.5 * late**2, way)
    return moments, way / (rise * (total - rise))
