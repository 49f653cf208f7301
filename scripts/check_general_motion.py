"""Several cameras under general motions, by Monte-Carlo: one table.

Runs that converged to the truth's minimum, NEES of the intrinsics and of the cameras'
places (1: the stated covariance is true), chi2 / dof, root mean square error of fx, and
time. "Said": runs that ended in a typed error. "Wrong": runs that returned cameras ten
or more sigmas from the truth without saying so.

    python scripts/check_general_motion.py [--trials 300] [--views 22] [--large]

Exits with 1 where more than 2 of 300 runs did not converge, one was wrong without
saying so, or a NEES leaves 0.93 to 1.07 by more than three of its standard errors.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "calibrate_cameras"))

from general_motion_scene import (  # noqa: E402
    IMAGE_SIZE,
    TRIANGLE,
    make_scene,
    nees,
    nees_of_places,
)

from handeye_tri import calibrate_cameras_general  # noqa: E402
from handeye_tri.errors import HandEyeError  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--views", type=int, default=22)
    parser.add_argument("--cameras", type=int, nargs="+", default=[2, 3, 6])
    parser.add_argument("--sigmas", type=float, nargs="+", default=[0.1, 0.5, 1.0])
    parser.add_argument("--large", action="store_true", help="64 cameras x 1000 views")
    options = parser.parse_args()
    print(
        "cameras sigma px  right  said wrong    NEES   +-   places   +-  chi2/dof  "
        "fx rms %     ms"
    )
    passed = [
        row(m, sigma, options.trials, options.views)
        for m in options.cameras
        for sigma in options.sigmas
    ]
    if options.large:
        large()
    print(f"{sum(passed)} of {len(passed)} lines as good as they must be")
    sys.exit(0 if all(passed) else 1)


def row(m: int, sigma: float, trials: int, views: int) -> bool:
    """Run and print one line of the table; say whether it is as good as it must be."""
    scores, places, ratios, errors = [], [], [], []
    said = wrong = 0
    spent = 0.0
    for trial in range(trials):
        rng = np.random.default_rng([m, trial])
        scene = make_scene(rng, m, views)
        pixels = scene.noisy(rng, sigma)
        start = time.process_time()
        try:
            result = calibrate_cameras_general(
                pixels, TRIANGLE, image_sizes=IMAGE_SIZE, sigma_px=sigma
            )
        except HandEyeError as error:
            said += 1
            print(f"  run {trial}: {type(error).__name__}: {str(error)[:160]}")
            continue
        finally:
            spent += time.process_time() - start
        score = nees(result, scene)
        if score > 100.0:
            wrong += 1
            continue
        scores.append(score)
        places.append(nees_of_places(result, scene))
        ratios.append(result.chi2 / result.dof)
        errors += [
            found.intrinsics.fx / true.intrinsics.fx - 1
            for found, true in zip(result.cameras, scene.cameras, strict=True)
        ]
    rms = 100 * float(np.sqrt(np.mean(np.square(errors))))
    text, good = "", wrong == 0 and len(scores) >= trials - max(2, trials // 150)
    for values in (scores, places):
        mean, error = np.mean(values), np.std(values) / len(values) ** 0.5
        text += f"{mean:8.3f} {error:5.3f}"
        good &= bool(abs(mean - 1.0) <= 0.07 + 3 * error)
    print(
        f"{m:7}{sigma:9.1f}{len(scores):7}{said:6}{wrong:6}{text}"
        f"{np.mean(ratios):10.4f}{rms:10.3f}{1e3 * spent / trials:7.0f}",
        flush=True,
    )
    return good


def large() -> None:
    """64 cameras all around, 1000 views, three in ten points missing."""
    rng = np.random.default_rng(64)
    scene = make_scene(rng, 64, 1000, around=2 * np.pi, steepest_deg=75.0)
    pixels = scene.noisy(rng, 0.1)
    pixels[rng.random(pixels.shape[:3]) < 0.3] = np.nan
    start = time.process_time()
    result = calibrate_cameras_general(
        pixels, TRIANGLE, image_sizes=IMAGE_SIZE, sigma_px=0.1
    )
    spent = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(
        f"64 cameras x 1000 views, {int(np.isfinite(pixels[..., 0]).sum())} points: "
        f"{spent:.1f} s, peak {peak:.0f} MB, NEES {nees(result, scene):.3f}, "
        f"chi2/dof {result.chi2 / result.dof:.4f}"
    )


if __name__ == "__main__":
    main()
