"""TUM trajectories: ``t x y z qx qy qz qw``, seconds and metres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from handeye_tri.exchange.results import Results
from handeye_tri.records import Floats
from handeye_tri.storage import tum_text


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
    return tum_text(np.array(times, dtype=float), poses, lines)
