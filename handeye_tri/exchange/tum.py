"""TUM trajectories: ``t x y z qx qy qz qw``, seconds and metres."""

from __future__ import annotations

from collections.abc import Sequence

from handeye_tri.exchange.results import Results, number
from handeye_tri.records import Floats
from handeye_tri.se3 import quaternion_wxyz


def tum_tracks(results: Results) -> dict[str, str]:
    """The robot's and the observed track of the flange in the base, by name.

    ``evo_ape tum FILE_robot FILE_observed`` compares them. The time of a pose is the
    number of its station, so that poses that belong together have the same.
    """
    frames = results.frames
    what = f"pose of {frames.flange} in {frames.base}"
    return {
        "robot": _track(
            [*results.head, f"{what}, as the robot reports it."],
            range(len(results.base_from_flange)),
            results.base_from_flange,
        ),
        "observed": _track(
            [*results.head, f"{what}, as the cameras observe it."],
            results.stations,
            results.observed_base_from_flange,
        ),
    }


def _track(lines: list[str], times: Sequence[int], poses: Floats) -> str:
    text = "".join(f"# {line}\n" for line in lines)
    text += "# t (station number) x y z (m) qx qy qz qw\n"
    for time, pose in zip(times, poses, strict=True):
        w, x, y, z = quaternion_wxyz(pose[:3, :3])
        row = [time, *pose[:3, 3], x, y, z, w]
        text += " ".join(number(v) for v in row) + "\n"
    return text
