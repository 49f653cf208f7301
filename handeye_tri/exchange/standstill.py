"""Stations in continuous recordings: where the robot stood, and the images there."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import InputError
from handeye_tri.exchange.capture import (
    Capture,
    ImageStream,
    Picture,
    PoseStream,
    Shot,
    Stillness,
)
from handeye_tri.records import Floats
from handeye_tri.se3 import SE3, nearest_rotation, so3_log

# Samples compared at a time: a robot that creeps is not compared to its whole path.
_BLOCK = 64


def standstills(stream: PoseStream, still: Stillness) -> list[tuple[int, int]]:
    """First and last sample of each stand.

    A stand begins at a sample and lasts while the flange stays near to where it was
    then, without a silence longer than ``still.gap``.
    """
    times, poses = stream.times, stream.base_from_flange
    # Cheap first: neighbours that are apart break every stand between them.
    apart = _apart(poses[:-1], poses[1:], still) | (np.diff(times) > still.gap)
    found, first, n = [], 0, len(times)
    breaks = np.append(np.flatnonzero(apart), n - 1)
    while first < n:
        # The last sample before the next break between neighbours.
        end = int(breaks[np.searchsorted(breaks, first)])
        last = _last_near(poses, first, end, still)
        if times[last] - times[first] >= still.seconds:
            found.append((first, last))
            first = last + 1
        elif last == end:
            # Too short up to the break: no later start can be longer.
            first = end + 1
        else:
            first += 1
    return found


def _last_near(poses: Floats, first: int, end: int, still: Stillness) -> int:
    """The last of the samples up to ``end`` before one is away from the first."""
    for start in range(first, end + 1, _BLOCK):
        block = poses[start : min(start + _BLOCK, end + 1)]
        away = _apart(poses[first : first + 1], block, still)
        if away.any():
            return start + int(np.argmax(away)) - 1
    return end


def _apart(one: Floats, other: Floats, still: Stillness) -> NDArray[np.bool_]:
    moved = np.linalg.norm(other[..., :3, 3] - one[..., :3, 3], axis=-1)
    turn = so3_log(np.swapaxes(one[..., :3, :3], -1, -2) @ other[..., :3, :3])
    turned = np.linalg.norm(turn, axis=-1)
    away: NDArray[np.bool_] = (moved > still.translation) | (turned > still.rotation)
    return away


def stations_from_streams(
    robot: PoseStream, cameras: Mapping[str, ImageStream], still: Stillness
) -> Capture:
    """Stands of the robot with the image of each camera nearest to their middle.

    Pose and joints are the means over the middle half of a stand. Robot and cameras
    must share a clock.

    Raises:
        InputError: the robot never stood, or no camera took an image while it did.
    """
    found = standstills(robot, still)
    if not found:
        raise InputError(
            f"the robot never stood: in {len(robot.times)} poses over "
            f"{_span(robot.times):.1f} s it did not keep within "
            f"{1e3 * still.translation:g} mm and {np.degrees(still.rotation):g} deg "
            f"for {still.seconds:g} s; see --still"
        )
    shots, empty = [], 0
    for first, last in found:
        begin, end = robot.times[first], robot.times[last]
        middle = 0.5 * (begin + end)
        pictures = {}
        for name, images in cameras.items():
            inside = [i for i, t in enumerate(images.times) if begin <= t <= end]
            if inside:
                nearest = min(inside, key=lambda i: abs(images.times[i] - middle))
                pictures[name] = _later(images, nearest)
        if not pictures:
            empty += 1
            continue
        near = np.abs(robot.times[first : last + 1] - middle)
        core = first + np.flatnonzero(near <= max(0.25 * (end - begin), near.min()))
        shots.append(
            Shot(
                _mean_pose(robot.base_from_flange[core]),
                _mean(robot.joints[core]),
                pictures,
                f"stood from {begin:.3f} to {end:.3f} s",
            )
        )
    if not shots:
        spans = ", ".join(
            f"{name} {min(s.times):.1f} to {max(s.times):.1f} s"
            for name, s in cameras.items()
            if s.times
        )
        raise InputError(
            f"no camera took an image while the robot stood ({len(found)} times, "
            f"{robot.times[0]:.1f} to {robot.times[-1]:.1f} s; images: "
            f"{spans or 'none'}); do robot and cameras share a clock?"
        )
    remarks = []
    if empty:
        remarks.append(f"{empty} of {len(found)} stands have no image and are left out")
    return Capture(tuple(shots), tuple(remarks))


def _mean(rows: Floats) -> Floats:
    """Mean of rows, shape (n, ...); of equal rows it is that row to the last bit."""
    same = bool((rows == rows[:1]).all())
    return np.asarray(rows[0] if same else rows.mean(axis=0))


def _mean_pose(poses: Floats) -> SE3:
    """Mean of poses next to each other, shape (n, 4, 4), metres."""
    mean = _mean(poses)
    if (mean == poses[0]).all():
        return SE3(mean)
    # So near to each other, the mean of rotations is the nearest to that of matrices.
    return SE3.from_parts(nearest_rotation(mean[:3, :3]), mean[:3, 3])


def _later(images: ImageStream, index: int) -> Picture:
    return lambda: images.read(index)


def _span(times: Floats) -> float:
    return float(times[-1] - times[0]) if len(times) else 0.0
