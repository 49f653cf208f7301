"""A rendered cell with one thing wrong in it, put in before anything is detected.

What is wrong is in the simulation: where cameras, rig and joints truly are, what the
images show, or what is stated about them. Nothing that estimates or judges is told.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from handeye_tri.experiments.rendered_cell import Image, Observed, RenderedCell, View
from handeye_tri.records import Floats, Station
from handeye_tri.se3 import SE3, se3_exp, se3_inverse, se3_log
from handeye_tri.triangle import TriangleRig

Ranges = Mapping[str, tuple[float, float]]

# Exposures that make up a blurred image, for each pixel of its length.
_EXPOSURES_PER_PX = 1.5
# Wrong units: metres for centimetres or inches, on the rig; metres for millimetres or
# inches for metres, in the robot's poses.
_RIG_UNITS = (0.1, 1 / 25.4)
_POSE_UNITS = (1e3, 1 / 0.0254)


def _direction(rng: np.random.Generator, length: float, count: int = 3) -> Floats:
    way = rng.normal(size=count)
    return np.asarray(length * way / np.linalg.norm(way))


def _step_station(
    stations: Sequence[Station], ranges: Ranges, rng: np.random.Generator
) -> int:
    """Station at which something moves, as far into these as so many calibrate."""
    count = sum(station.kind == "calibration" for station in stations)
    return stations[max(1, round(count * rng.uniform(*ranges["from_share"])))].index


def camera_moved(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """One camera stands elsewhere from some station on."""
    station = _step_station(healthy.plan.stations, ranges, rng)
    i = int(rng.integers(len(healthy.cell.cameras)))
    step = SE3.exp(
        np.r_[
            _direction(rng, 1e-3 * rng.uniform(*ranges["moved_mm"])),
            _direction(rng, np.radians(rng.uniform(*ranges["turned_deg"]))),
        ]
    )
    camera = healthy.cell.cameras[i]
    place = camera.world_from_camera @ step
    level = camera.model_copy(
        update={
            "position_m": tuple(place.translation.tolist()),
            "look_at_m": tuple((place.translation + place.rotation[:, 2]).tolist()),
            "roll_deg": 0.0,
        }
    )
    right = level.world_from_camera.rotation.T @ place.rotation[:, 0]
    moved = level.model_copy(
        update={"roll_deg": float(np.degrees(np.arctan2(right[1], right[0])))}
    )
    cameras = list(healthy.cell.cameras)
    cameras[i] = moved
    cell = healthy.cell.model_copy(update={"cameras": tuple(cameras)})
    views = [view for view in healthy.views if view[0] == i and view[1] >= station]
    return healthy.observed(healthy.rendered(cell, healthy.joints, views))


def rig_slipped(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """The rig slides and turns in its clamp, on one of its mounts, at some station."""
    mounts, mounted = healthy.mounts, healthy.cell.mounted
    mount = int(rng.integers(len(mounted))) if len(mounted) > 1 else 0
    held = [one for one in healthy.plan.stations if one.mount == mount]
    station = _step_station(held, ranges, rng)
    alone = mounted[mount]
    rig = alone.rig
    along, across, ahead = _direction(rng, rng.uniform(*ranges["moved_mm"]))
    turned = rng.choice([-1, 1]) * rng.uniform(*ranges["turned_deg"])
    foot = 1e3 * rig.triangle.circumcentre if rig.o_mm is None else np.array(rig.o_mm)
    slipped = rig.model_copy(
        update={
            "turn_deg": rig.turn_deg + float(turned),
            "ahead_mm": rig.ahead_mm + float(ahead),
            "o_mm": (float(foot[0] + along), float(foot[1] + across)),
        }
    )
    cell = alone.model_copy(update={"rig": slipped})
    views = [
        view
        for view in healthy.views
        if view[1] >= station and mounts[view[1]] == mount
    ]
    only = [0] * len(mounts)
    return healthy.observed(healthy.rendered(cell, healthy.joints, views, only))


def joint_offset(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """One joint between the first and the last is not where it reports."""
    joints = healthy.joints.copy()
    k = int(rng.integers(1, joints.shape[1] - 1))
    offset = np.radians(rng.uniform(*ranges["offset_deg"]))
    joints[:, k] += rng.choice([-1, 1]) * offset
    return healthy.observed(healthy.rendered(healthy.cell, joints, healthy.views))


def side_wrong(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """One of AB, AC and the angle at A is stated wrongly."""
    observed = healthy.observed()
    factor = 1.0 + rng.choice([-1, 1]) * 0.01 * rng.uniform(*ranges["by_percent"])
    stated = observed.session.triangle
    values = [stated.side_ab, stated.side_ac, stated.angle]
    values[int(rng.integers(3))] *= factor
    session = replace(observed.session, triangle=TriangleRig(*values))
    return replace(observed, session=session)


def unit_wrong(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """The rig, or the robot's poses, are stated in another unit."""
    observed = healthy.observed()
    session = observed.session
    which = int(rng.uniform(*ranges["which"]))
    if which < len(_RIG_UNITS):
        factor = _RIG_UNITS[which]
        stated = session.triangle
        return replace(
            observed,
            session=replace(
                session,
                triangle=TriangleRig(
                    factor * stated.side_ab, factor * stated.side_ac, stated.angle
                ),
                marker_radii=factor * session.marker_radii,
            ),
        )
    factor = _POSE_UNITS[which - len(_RIG_UNITS)]
    stations = tuple(
        replace(
            station,
            base_from_flange=SE3.from_parts(
                station.base_from_flange.rotation,
                factor * station.base_from_flange.translation,
            ),
        )
        for station in session.stations
    )
    return replace(observed, session=replace(session, stations=stations))


def _some_views(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> list[View]:
    count = int(rng.uniform(*ranges["views"]))
    later = [view for view in healthy.views if view[1] > 0]
    return [later[k] for k in rng.choice(len(later), count, replace=False)]


def labels_exchanged(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """Two markers have each other's colour in a few images."""
    changed = {}
    for view in _some_views(healthy, ranges, rng):
        order = [[1, 0, 2], [2, 1, 0], [0, 2, 1]][int(rng.integers(3))]
        changed[view] = np.ascontiguousarray(healthy.images[view][..., order])
    return healthy.observed(changed)


def image_stale(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """A few images are still those of the station before."""
    views = _some_views(healthy, ranges, rng)
    return healthy.observed({(i, j): healthy.images[i, j - 1] for i, j in views})


def _ways(healthy: RenderedCell) -> list[Floats]:
    """From each station but the last, the first stretch of the way to the next one."""
    commanded = np.array([station.joints for station in healthy.plan.stations])
    ways = []
    for j in range(len(commanded) - 1):
        change = healthy.plan.tool_change
        passed, there = healthy.plan.via[j + 1], commanded[j + 1]
        if change is not None and change.before == j + 1:
            passed, there = change.via, change.joints
        ways.append((passed[0] if len(passed) else there) - commanded[j])
    return ways


def clock_offset(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """All images are taken when the robot has already left, by the same time.

    It speeds up evenly, its leading joint to full speed in the cell's time for that.
    """
    seconds = rng.uniform(*ranges["offset_s"])
    speed = np.array(
        [
            healthy.arm.mechanism.joints[k].speed
            for k in healthy.arm.mechanism.arm_joints
        ]
    )
    rise = healthy.cell.arm.acceleration_time_s
    joints = healthy.joints.copy()
    for j, way in enumerate(_ways(healthy)):
        cruise = float((np.abs(way) / speed).max())
        joints[j] += way * 0.5 * seconds**2 / (rise * max(cruise, 1e-9))
    return healthy.observed(healthy.rendered(healthy.cell, joints, healthy.views))


def motion_blur(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """At a few stations the robot still arrives while all cameras expose."""
    ways = _ways(healthy)
    count = int(rng.uniform(*ranges["stations"]))
    changed: dict[View, Image] = {}
    for j in rng.choice(np.arange(1, len(ways) + 1), count, replace=False):
        length = rng.uniform(*ranges["length_px"])
        back = -ways[j - 1]
        mount = healthy.mounts[j]
        share = length / _pixels_per_way(healthy, mount, healthy.joints[j], back)
        exposures = int(np.ceil(_EXPOSURES_PER_PX * length)) + 1
        many = healthy.joints[j] + share * np.linspace(0, 1, exposures)[:, None] * back
        for i in range(len(healthy.cell.cameras)):
            views = [(i, k) for k in range(exposures)]
            held = [mount] * exposures
            drawn = healthy.rendered(healthy.cell, many, views, held)
            mean = np.mean([drawn[view].astype(float) for view in views], axis=0)
            changed[i, int(j)] = np.rint(mean).astype(np.uint8)
    return healthy.observed(changed)


def _pixels_per_way(
    healthy: RenderedCell, mount: int, joints: Floats, way: Floats
) -> float:
    """By how much a whole way would move the markers in the images, on the mean, px."""
    small = 1e-4
    moved = []
    rig = healthy.cell.mounted[mount].rig
    points = rig.flange_from_triangle.apply(rig.triangle.points)
    poses = healthy.arm.forward(np.stack([joints, joints + small * way]))
    for camera in healthy.cell.cameras:
        place = healthy.arm.base_from_world @ camera.world_from_camera
        base = points @ poses[:, :3, :3].mT + poses[:, None, :3, 3]
        pixels = camera.camera.project(place.inverse().apply(base))
        moved.append(np.linalg.norm(pixels[1] - pixels[0], axis=-1) / small)
    return float(np.mean(moved))


def motion_insufficient(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """All half-turns are near the first one: their planes are nearly parallel."""
    plan, joints = healthy.plan, healthy.joints.copy()
    first = plan.half_turns[0]
    stations = list(plan.stations)
    reach = np.radians(rng.uniform(*ranges["joints_deg"]))
    for turn in plan.half_turns:
        near = rng.uniform(-reach, reach, joints.shape[1])
        for mine, of_first in ((turn.before, first.before), (turn.after, first.after)):
            error = healthy.joints[mine] - plan.stations[mine].joints
            told = plan.stations[of_first].joints.copy()
            # The last joint makes the half-turn; the others are alike.
            told[:-1] = plan.stations[first.before].joints[:-1]
            told = told + near
            joints[mine] = told + error
            stations[mine] = replace(
                stations[mine],
                joints=told,
                base_from_flange=SE3(healthy.arm.forward(told)),
            )
    images = healthy.rendered(healthy.cell, joints, healthy.views)
    return healthy.observed(images, tuple(stations))


def detection_poor(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """All images of one camera, or of all, are flat and noisy."""
    contrast = rng.uniform(*ranges["contrast"])
    noise = rng.uniform(*ranges["noise_levels"])
    m = len(healthy.cell.cameras)
    poor = [int(rng.integers(m))] if rng.random() < 0.5 else list(range(m))
    changed = {}
    for view in healthy.views:
        if view[0] in poor:
            image = healthy.images[view].astype(float)
            flat = image.mean() + contrast * (image - image.mean())
            flat += noise * rng.standard_normal(image.shape)
            changed[view] = np.clip(np.rint(flat), 0, 255).astype(np.uint8)
    return healthy.observed(changed)


def turn_not_180(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """A few half-turns stop early; the robot reports that, or reports 180 degrees."""
    turns = healthy.plan.half_turns
    count = int(rng.uniform(*ranges["half_turns"]))
    reported = bool(rng.random() < 0.5)
    joints, stations = healthy.joints.copy(), list(healthy.plan.stations)
    wrong = [turns[k] for k in rng.choice(len(turns), count, replace=False)]
    for turn in wrong:
        before, after = (
            stations[j].base_from_flange.matrix for j in (turn.before, turn.after)
        )
        screw = se3_log(se3_inverse(before) @ after)
        angle = float(np.linalg.norm(screw[3:]))
        lack = np.radians(180.0 - rng.uniform(*ranges["angle_deg"]))
        back = -lack / angle * screw
        joints[turn.after] = healthy.arm.perturbed(joints[turn.after], back)
        if reported:
            station = stations[turn.after]
            stations[turn.after] = replace(
                station,
                joints=healthy.arm.perturbed(station.joints, back),
                base_from_flange=SE3(after @ se3_exp(back)),
            )
    late = {turn.after for turn in wrong}
    views = [view for view in healthy.views if view[1] in late]
    images = healthy.rendered(healthy.cell, joints, views)
    return healthy.observed(images, tuple(stations))


def poses_inverted(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """The robot's poses are stated the wrong way round."""
    del ranges, rng
    observed = healthy.observed()
    stations = tuple(
        replace(station, base_from_flange=station.base_from_flange.inverse())
        for station in observed.session.stations
    )
    return replace(observed, session=replace(observed.session, stations=stations))


def pairs_shifted(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """Each image stands beside the pose of the station before or after its own."""
    del ranges
    way = int(rng.choice([-1, 1]))
    observed = healthy.observed()
    session = replace(
        observed.session,
        pixels=np.roll(observed.session.pixels, way, axis=1),
        pixel_covariance=np.roll(observed.session.pixel_covariance, way, axis=1),
    )
    return Observed(session, np.roll(observed.edges, way, axis=1))


def tool_change_misstated(
    healthy: RenderedCell, ranges: Ranges, rng: np.random.Generator
) -> Observed:
    """The tool change is stated some stations too early or too late.

    A half-turn that would go on over it is not stated.
    """
    change = healthy.plan.tool_change
    assert change is not None
    by = int(rng.choice([-1, 1])) * int(rng.uniform(*ranges["stations"]))
    stations = tuple(
        replace(station, mount=int(station.index >= change.before + by))
        for station in healthy.plan.stations
    )
    turns = tuple(
        replace(turn, axis=healthy.cell.axes[stations[turn.before].mount])
        for turn in healthy.plan.half_turns
        if stations[turn.before].mount == stations[turn.after].mount
    )
    return healthy.observed(None, stations, turns)


INJECTIONS: dict[
    str, Callable[[RenderedCell, Ranges, np.random.Generator], Observed]
] = {
    one.__name__: one
    for one in (
        camera_moved,
        rig_slipped,
        joint_offset,
        side_wrong,
        unit_wrong,
        labels_exchanged,
        image_stale,
        clock_offset,
        motion_blur,
        motion_insufficient,
        detection_poor,
        turn_not_180,
        poses_inverted,
        pairs_shifted,
        tool_change_misstated,
    )
}
