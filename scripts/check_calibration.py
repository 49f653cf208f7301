"""Single-camera calibration against the Cramer-Rao bound, by Monte-Carlo.

One table per axis: root mean square errors over the bound for the refined estimate, the
whitened closed form and the paper's closed form; NEES (1: the stated covariance is
true); chi2 / dof. Then the same with a robot whose half-turns miss.

    python scripts/check_calibration.py [--trials 1000] [--half-turns 11]
                                        [--methods refined whitened paper]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "calibrate_cameras"))

from half_turn_scene import (  # noqa: E402
    IMAGE_SIZE,
    TRIANGLE,
    Scene,
    cramer_rao,
    make_scene,
)

from handeye_tri.calibrate_cameras import calibrate_camera  # noqa: E402
from handeye_tri.errors import HandEyeError  # noqa: E402

Floats = NDArray[np.float64]
METHODS = {
    "refined": {},
    "whitened": {"refine": False},
    "paper": {"refine": False, "method": "paper"},
}
NAMES = ("fx", "fy", "skew", "cx", "cy")
TURN_COVARIANCE = np.diag([3e-5**2] * 3 + [np.radians(0.005) ** 2] * 3)


def run(
    draw: Callable[[int], tuple[Scene, Floats, Floats]],
    trials: int,
    **options: object,
) -> tuple[Floats, float, float, int, float]:
    """Errors (t, 5), mean NEES, mean chi2 / dof, failures, milliseconds a call."""
    errors, nees, ratio, failed, spent = [], [], [], 0, 0.0
    for trial in range(trials):
        scene, before, after = draw(trial)
        start = time.process_time()
        try:
            result = calibrate_camera(
                before,
                after,
                TRIANGLE,
                image_size=IMAGE_SIZE,
                axis=scene.axes,
                **options,
            )
        except HandEyeError:
            failed += 1
            continue
        spent += time.process_time() - start
        error = result.camera.intrinsics.vector - scene.camera.intrinsics.vector
        errors.append(error)
        nees.append(error @ np.linalg.solve(result.covariance.matrix, error) / 5)
        ratio.append(result.chi2 / result.dof)
    done = max(len(errors), 1)
    return (
        np.array(errors),
        float(np.mean(nees)),
        float(np.mean(ratio)),
        failed,
        1e3 * spent / done,
    )


def show(cells: list[str]) -> None:
    print("| " + " | ".join(f"{cell:>9}" for cell in cells) + " |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--half-turns", type=int, default=11)
    parser.add_argument(
        "--methods", nargs="+", choices=list(METHODS), default=list(METHODS)
    )
    options = parser.parse_args()
    n, trials = options.half_turns, options.trials
    for axis, section in (("normal", "III-A"), ("CA", "III-B")):
        for label, tilt in (("tilt 20-55", (20.0, 55.0)), ("tilt 60", (60.0, 60.0))):
            scene = make_scene(np.random.default_rng(2), n, axis, tilt_deg=tilt)
            print(
                f"\n{section}, axis {axis}, {label} degrees, {2 * n} images, "
                f"{trials} trials"
            )
            print("RMSE over bound, per unknown; bound of fx in % of fx")
            show(
                [
                    "sigma px",
                    "method",
                    "bound %",
                    *NAMES,
                    "NEES",
                    "chi2/dof",
                    "failed",
                    "ms",
                ]
            )
            for sigma in (0.1, 0.3, 1.0):
                bound = np.sqrt(np.diagonal(cramer_rao(scene, sigma)))
                relative = 100 * bound[0] / scene.camera.intrinsics.fx

                def draw(
                    trial: int, scene: Scene = scene, sigma: float = sigma
                ) -> tuple[Scene, Floats, Floats]:
                    rng = np.random.default_rng([3, trial])
                    return scene, *scene.noisy(rng, sigma)

                for name in options.methods:
                    errors, nees, ratio, failed, ms = run(
                        draw, trials, sigma_px=sigma, **METHODS[name]
                    )
                    rmse = np.sqrt((errors**2).mean(axis=0)) / bound
                    show(
                        [f"{sigma:.1f}", name, f"{relative:.3f}"]
                        + [f"{x:.3f}" for x in rmse]
                        + [f"{nees:.3f}", f"{ratio:.3f}", str(failed), f"{ms:.1f}"]
                    )
    print(
        "\nHalf-turns that miss by 0.03 mm and 0.005 degrees per axis, sigma 0.015 px"
    )
    show(["axis", "told", "NEES", "chi2/dof", "fx rms px"])
    for axis in ("normal", "CA"):

        def miss(trial: int, axis: str = axis) -> tuple[Scene, Floats, Floats]:
            rng = np.random.default_rng([4, trial])
            scene = make_scene(rng, n, axis, turn_root=np.sqrt(TURN_COVARIANCE))
            return scene, *scene.noisy(rng, 0.015)

        for told in (True, False):
            given = {"turn_covariance": TURN_COVARIANCE} if told else {}
            errors, nees, ratio, _, _ = run(
                miss, min(trials, 300), sigma_px=0.015, **given
            )
            rms = np.sqrt((errors[:, 0] ** 2).mean())
            show([axis, str(told), f"{nees:.3f}", f"{ratio:.3f}", f"{rms:.3f}"])


if __name__ == "__main__":
    main()
