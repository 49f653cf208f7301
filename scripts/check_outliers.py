"""Rejection of half-turns that are none, by Monte-Carlo: one line per damage.

Four of twenty half-turns bad: root mean square errors of (fx, fy, skew, cx, cy) over
those of the sixteen good ones alone; bad ones kept, bad ones dropped for a reason that
is not theirs, good ones dropped, failed runs. Exits with 1 where a ratio is above 1.2,
a run failed, more than one in fifty bad ones is kept (a turn of 170 degrees about an
edge can misfit by less than what drops hardly any good one), or good half-turns are
dropped: more than one, and one in a thousand.

    python scripts/check_outliers.py [--trials 50] [--healthy 200]
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "calibrate_cameras"))

from half_turn_damage import (  # noqa: E402
    SIGMA,
    repeated,
    swapped,
    turned_by_170,
    wrong_point,
)
from half_turn_scene import IMAGE_SIZE, make_scene  # noqa: E402

from handeye_tri import calibrate_camera  # noqa: E402
from handeye_tri.errors import HandEyeError  # noqa: E402
from handeye_tri.triangle import AXES  # noqa: E402

DAMAGES = (wrong_point, swapped, repeated, turned_by_170)
MAX_RATIO = 1.2
MAX_LOST = 1e-3
MAX_KEPT = 0.02


def run(axis: str, damage: Callable[..., str] | None, trials: int) -> bool:
    """Run and print one line; say whether it is as good as it must be."""
    without, rejected = [], []
    kept = misnamed = lost = failed = good_ones = 0
    spent = 0.0
    for trial in range(trials):
        rng = np.random.default_rng([11, trial])
        scene = make_scene(rng, 20, axis)
        before, after = scene.noisy(rng, SIGMA)
        bad: dict[int, str] = {}
        if damage is not None:
            for i in rng.choice(20, 4, replace=False):
                bad[int(i)] = damage(scene, before, after, int(i), rng)
        good = [i for i in range(20) if i not in bad]
        good_ones += len(good)
        options = {"image_size": IMAGE_SIZE, "axis": axis, "sigma_px": SIGMA}
        triangle = scene.triangle
        best = calibrate_camera(before[good], after[good], triangle, **options)
        start = time.process_time()
        try:
            result = calibrate_camera(before, after, triangle, reject=True, **options)
        except HandEyeError as error:
            failed += 1
            print(f"  run {trial}: {error}")
            continue
        spent += time.process_time() - start
        dropped = result.details["dropped"]
        kept += len(bad.keys() - dropped.keys())
        lost += len(dropped.keys() - bad.keys())
        misnamed += sum(
            re.search(bad[i], why) is None for i, why in dropped.items() if i in bad
        )
        true = scene.camera.intrinsics.vector
        without.append(best.camera.intrinsics.vector - true)
        rejected.append(result.camera.intrinsics.vector - true)
    ratio = np.sqrt(np.square(rejected).mean(0) / np.square(without).mean(0))
    name = "none" if damage is None else damage.__name__
    print(
        f"{axis:7}{name:15}{trials:5}  "
        + " ".join(f"{x:.3f}" for x in ratio)
        + f"{kept:10}{misnamed:10}{lost:13}{failed:7}{1e3 * spent / trials:6.0f}",
        flush=True,
    )
    clean = kept <= MAX_KEPT * 4 * trials and failed == 0
    clean &= lost <= 1 + MAX_LOST * good_ones
    return clean and bool(ratio.max() <= MAX_RATIO)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--healthy", type=int, default=200)
    parser.add_argument("--axes", nargs="+", choices=AXES, default=list(AXES))
    options = parser.parse_args()
    print(
        "axis   damage         runs  RMSE over 16 good ones alone  bad kept  misnamed "
        "good dropped failed   ms"
    )
    passed = []
    for axis in options.axes:
        passed.append(run(axis, None, options.healthy))
        passed += [run(axis, damage, options.trials) for damage in DAMAGES]
    print(f"{sum(passed)} of {len(passed)} lines as good as they must be")
    sys.exit(0 if all(passed) else 1)


if __name__ == "__main__":
    main()
