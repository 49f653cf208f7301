"""Rejection of half-turns that are none, by Monte-Carlo: one line per damage.

Four of twenty half-turns bad: root mean square errors of (fx, fy, skew, cx, cy) over
those of the sixteen good ones alone; bad ones kept, good ones dropped, failed runs.

    python scripts/check_outliers.py [--trials 50] [--healthy 200]
"""

from __future__ import annotations

import argparse
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

DAMAGES = (wrong_point, swapped, repeated, turned_by_170)


def run(axis: str, damage: Callable[..., str] | None, trials: int) -> None:
    """Run and print one line."""
    without, rejected = [], []
    kept = lost = failed = 0
    spent = 0.0
    for trial in range(trials):
        rng = np.random.default_rng([11, trial])
        scene = make_scene(rng, 20, axis)
        before, after = scene.noisy(rng, SIGMA)
        bad: set[int] = set()
        if damage is not None:
            bad = {int(i) for i in rng.choice(20, 4, replace=False)}
            for i in bad:
                damage(scene, before, after, i, rng)
        good = [i for i in range(20) if i not in bad]
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
        dropped = set(result.details["dropped"])
        kept, lost = kept + len(bad - dropped), lost + len(dropped - bad)
        true = scene.camera.intrinsics.vector
        without.append(best.camera.intrinsics.vector - true)
        rejected.append(result.camera.intrinsics.vector - true)
    ratio = np.sqrt(np.square(rejected).mean(0) / np.square(without).mean(0))
    name = "none" if damage is None else damage.__name__
    print(
        f"{axis:7}{name:15}{trials:5}  "
        + " ".join(f"{x:.3f}" for x in ratio)
        + f"{kept:10}{lost:13}{failed:7}{1e3 * spent / trials:6.0f}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--healthy", type=int, default=200)
    options = parser.parse_args()
    print(
        "axis   damage         runs  RMSE over 16 good ones alone  bad kept "
        "good dropped failed   ms"
    )
    for axis in ("normal", "CA"):
        run(axis, None, options.healthy)
        for damage in DAMAGES:
            run(axis, damage, options.trials)


if __name__ == "__main__":
    main()
