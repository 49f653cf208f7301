"""Single-camera calibration against the Cramer-Rao bound, by Monte-Carlo.

The triangle of Zhao, Liu and Zhang 2008 (doi:10.1109/TIP.2008.2005562), Sec. IV-A, with
theta, its angle at A, of 60 degrees. For every axis, tilt and noise: root mean square
errors over the bound for the refined estimate, the whitened closed form and, from a
fifth of the trials, the paper's; how often the interval of 1.96 stated sigmas holds the
truth; NEES (1: the stated covariance is true); chi2 / dof. Then the same with a lens
that is estimated, and with a robot whose half-turns miss.

    python scripts/check_calibration.py [--trials 1000] [--half-turns 11]
                                        [--methods refined whitened paper]
                                        [--only-lenses]

Exits with 1 where, with 1000 trials or more, the refined estimate leaves 0.92 to 1.08
times the bound, NEES 0.95 to 1.05 or coverage 93 to 97 %, the whitened closed form
exceeds 1.15 times the bound, NEES with a lens leaves 0.9 to 1.1, or a run fails (with a
lens: more than 1 in 100; it is refused where the data do not determine it). With fewer
trials these bands are wider, as the statistics scatter more.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "calibrate_cameras"))

from half_turn_scene import (  # noqa: E402
    IMAGE_SIZE,
    Scene,
    camera,
    cramer_rao,
    make_scene,
)

from handeye_tri.calibrate_cameras import calibrate_camera  # noqa: E402
from handeye_tri.calibrate_cameras.trials import calibrate_trials  # noqa: E402
from handeye_tri.camera import Lens  # noqa: E402
from handeye_tri.errors import HandEyeError  # noqa: E402
from handeye_tri.triangle import TriangleRig  # noqa: E402

Floats = NDArray[np.float64]
Draw = Callable[[int], tuple[Scene, Floats, Floats]]

TRIANGLE = TriangleRig(0.13, 0.12, np.radians(60.0))
FOOT = tuple(TRIANGLE.points[1:, :2].mean(axis=0))
# Sections of the paper and their axes; AB is the triangle's longest edge.
AXES = {"III-A": "normal", "III-B": "AB"}
TILTS = {"20 to 55": (20.0, 55.0), "60": (60.0, 60.0)}
METHODS: dict[str, dict[str, Any]] = {
    "refined": {},
    "whitened": {"refine": False},
    "paper": {"refine": False, "method": "paper"},
}
NAMES = ("fx", "fy", "skew", "cx", "cy")
LENS = Lens("radtan", np.array([-0.21, 0.13, 1e-3, -6e-4, 0.0]))
LENSES = (("k1",), ("k1", "k2"), ("k1", "k2", "p1", "p2"))
TURN_COVARIANCE = np.diag([3e-5**2] * 3 + [np.radians(0.005) ** 2] * 3)


@dataclass(frozen=True)
class Statistics:
    """Of many runs.

    Attributes:
        errors: Estimate less truth, shape (t, u).
        sigmas: As stated, shape (t, u).
        nees: Mean normalised error squared, per unknown.
        ratio: Mean chi2 / dof.
        failed: Runs that ended in an error.
        milliseconds: Of processor time a run.
        undetermined: Lens coefficients called not determined, of all.
    """

    errors: Floats
    sigmas: Floats
    nees: float
    ratio: float
    failed: int
    milliseconds: float
    undetermined: float

    @property
    def covered(self) -> Floats:
        """Part of the runs whose 95 % interval holds the truth, shape (u,)."""
        return (np.abs(self.errors) < 1.959964 * self.sigmas).mean(axis=0)


def run(draw: Draw, trials: int, **options: Any) -> Statistics:
    """Calibrate as often as there are trials."""
    errors, sigmas, nees, ratio = [], [], [], []
    undetermined = []
    failed, spent = 0, 0.0
    for trial in range(trials):
        scene, before, after = draw(trial)
        start = time.process_time()
        try:
            result = calibrate_camera(
                before,
                after,
                scene.triangle,
                image_size=IMAGE_SIZE,
                axis=scene.axes,
                **options,
            )
        except HandEyeError:
            failed += 1
            continue
        spent += time.process_time() - start
        wanted = [label.split(".")[1] for label in result.covariance.labels]
        error = values(result.camera, wanted) - values(scene.camera, wanted)
        errors.append(error)
        sigmas.append(np.sqrt(np.diagonal(result.covariance.matrix)))
        nees.append(
            error @ np.linalg.solve(result.covariance.matrix, error) / len(error)
        )
        ratio.append(result.chi2 / result.dof)
        verdicts = result.details.get("lens_verdict", ())
        undetermined += [not verdict.determined for verdict in verdicts]
    return Statistics(
        np.array(errors),
        np.array(sigmas),
        float(np.mean(nees)),
        float(np.mean(ratio)),
        failed,
        1e3 * spent / max(len(errors), 1),
        float(np.mean(undetermined)) if undetermined else 0.0,
    )


def run_together(
    scene: Scene, before: Floats, after: Floats, sigma: float, names: Sequence[str]
) -> Statistics:
    """The same from trials in one array, with a lens that is estimated.

    Args:
        scene: Whose camera is the truth.
        before: Shape (t, n, 3, 2), pixels.
        after: Likewise.
        sigma: Of each pixel coordinate.
        names: Of the lens coefficients.
    """
    start = time.process_time()
    found = calibrate_trials(
        before,
        after,
        scene.triangle,
        image_size=IMAGE_SIZE,
        axis=scene.axes,
        distortion=names,
        sigma_px=sigma,
    )
    spent = time.process_time() - start
    good = found.converged
    every = [*NAMES, *LENS.names]
    estimate = np.concatenate([found.intrinsics, found.lens], axis=1)[good]
    estimate = estimate[:, [every.index(name) for name in found.labels]]
    errors, sigmas = estimate - values(scene.camera, found.labels), found.sigma[good]
    whitened = np.linalg.solve(found.covariance[good], errors[..., None])[..., 0]
    lens = slice(len(NAMES), None)
    return Statistics(
        errors,
        sigmas,
        float((errors * whitened).mean()),
        float((found.chi2 / found.dof)[good].mean()),
        int((~good).sum()),
        1e3 * spent / len(found),
        float((np.abs(estimate[:, lens]) < sigmas[:, lens]).mean()),
    )


def values(view: Any, names: Sequence[str]) -> Floats:
    """Intrinsics and lens coefficients by name."""
    known = dict(zip(NAMES, view.intrinsics.vector, strict=True))
    known |= dict(zip(view.lens.names, view.lens.coefficients, strict=True))
    return np.array([known[name] for name in names])


def show(cells: Sequence[str]) -> None:
    print("| " + " | ".join(f"{cell:>9}" for cell in cells) + " |", flush=True)


def pinhole(n: int, trials: int, methods: Sequence[str]) -> list[str]:
    """Print the tables of the pinhole camera; return what is out of its band."""
    wide = max(1.0, np.sqrt(1000 / trials))
    missed = []
    for section, axis in AXES.items():
        for tilt, limits in TILTS.items():
            scene = make_scene(
                np.random.default_rng(2),
                n,
                axis,
                triangle=TRIANGLE,
                foot=FOOT,
                tilt_deg=limits,
            )
            title = f"{section}, axis {axis}, tilt {tilt} degrees"
            print(f"\n{title}, {2 * n} images, {trials} trials")
            print("RMSE over bound, per unknown, and below it coverage of 95 %")
            show(["sigma px", "method", *NAMES, "NEES", "chi2/dof", "failed", "ms"])
            for sigma in (0.1, 0.3, 1.0):
                bound = np.sqrt(np.diagonal(cramer_rao(scene, sigma)))

                def draw(
                    trial: int, scene: Scene = scene, sigma: float = sigma
                ) -> tuple[Scene, Floats, Floats]:
                    rng = np.random.default_rng([3, trial])
                    return scene, *scene.noisy(rng, sigma)

                for name in methods:
                    # The reference takes longest and has no band to meet.
                    count = -(-trials // 5) if name == "paper" else trials
                    found = run(draw, count, sigma_px=sigma, **METHODS[name])
                    rmse = np.sqrt((found.errors**2).mean(axis=0)) / bound
                    show(
                        [f"{sigma:.1f}", name]
                        + [f"{x:.3f}" for x in rmse]
                        + [f"{found.nees:.3f}", f"{found.ratio:.3f}"]
                        + [str(found.failed), f"{found.milliseconds:.1f}"]
                    )
                    covered = [f"{100 * x:.1f} %" for x in found.covered]
                    show(["", "", *covered, *[""] * 4])
                    where = f"{title}, {sigma} px, {name}"
                    if name == "refined":
                        for what, off, band in (
                            ("RMSE / bound", np.abs(rmse - 1.0).max(), 0.08),
                            ("NEES", abs(found.nees - 1.0), 0.05),
                            ("coverage", np.abs(found.covered - 0.95).max(), 0.02),
                        ):
                            if off > band * wide:
                                missed.append(f"{where}: {what} is off by {off:.3f}")
                    if name == "whitened" and rmse.max() > 1.0 + 0.15 * wide:
                        missed.append(f"{where}: {rmse.max():.3f} times the bound")
                    if name != "paper" and found.failed:
                        missed.append(f"{where}: {found.failed} failed")
    return missed


def lenses(n: int, trials: int) -> list[str]:
    """Print the table of estimated lenses; return what is out of its band.

    With the lens's centre, the principal point, known and estimated.
    """
    print(f"\nLens estimated too, triangle in the whole image, {2 * n} images")
    show(
        ["section", "lens", "centre", "sigma px", "NEES", "coverage", "chi2/dof"]
        + ["weak", "failed", "ms"]
    )
    missed = []
    band = 0.1 * max(1.0, np.sqrt(1000 / trials))
    for (section, axis), names in product(AXES.items(), LENSES):
        kept = np.isin(LENS.names, names)
        view = camera(lens=Lens("radtan", LENS.coefficients * kept))
        scene = make_scene(
            np.random.default_rng(2),
            n,
            axis,
            triangle=TRIANGLE,
            foot=FOOT,
            view=view,
            sideways=0.25,
        )
        known = {name: values(view, [name])[0] for name in ("cx", "cy")}
        lens = " ".join(names)
        for centre, sigma in product(("known", "estimated"), (0.1, 0.3, 1.0)):

            def draw(
                trial: int, scene: Scene = scene, sigma: float = sigma
            ) -> tuple[Scene, Floats, Floats]:
                rng = np.random.default_rng([5, trial])
                return scene, *scene.noisy(rng, sigma)

            if centre == "known":
                found = run(draw, trials, sigma_px=sigma, distortion=names, fixed=known)
            else:
                drawn = [draw(trial)[1:] for trial in range(trials)]
                before, after = (np.array(part) for part in zip(*drawn, strict=True))
                found = run_together(scene, before, after, sigma, names)
            low, high = 100 * found.covered.min(), 100 * found.covered.max()
            show(
                [section, lens, centre, f"{sigma:.1f}", f"{found.nees:.3f}"]
                + [f"{low:.0f}-{high:.0f} %", f"{found.ratio:.3f}"]
                + [f"{100 * found.undetermined:.0f} %"]
                + [str(found.failed), f"{found.milliseconds:.1f}"]
            )
            where = f"{section}, {sigma} px, lens {lens}, centre {centre}"
            if found.failed > 0.01 * trials:
                missed.append(f"{where}: {found.failed} failed")
            if abs(found.nees - 1.0) > band:
                missed.append(f"{where}: NEES {found.nees:.3f}")
    return missed


def misses(n: int, trials: int) -> None:
    """Print the table of half-turns that miss."""
    print(
        "\nHalf-turns that miss by 0.03 mm and 0.005 degrees per axis, sigma 0.015 px"
    )
    show(["axis", "told", "NEES", "chi2/dof", "fx rms px"])
    for axis in AXES.values():

        def draw(trial: int, axis: str = axis) -> tuple[Scene, Floats, Floats]:
            rng = np.random.default_rng([4, trial])
            scene = make_scene(rng, n, axis, turn_root=np.sqrt(TURN_COVARIANCE))
            return scene, *scene.noisy(rng, 0.015)

        for told in (True, False):
            given = {"turn_covariance": TURN_COVARIANCE} if told else {}
            found = run(draw, min(trials, 300), sigma_px=0.015, **given)
            rms = np.sqrt((found.errors[:, 0] ** 2).mean())
            cells = [f"{x:.3f}" for x in (found.nees, found.ratio, rms)]
            show([axis, str(told), *cells])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--half-turns", type=int, default=11)
    parser.add_argument(
        "--methods", nargs="+", choices=list(METHODS), default=list(METHODS)
    )
    parser.add_argument("--only-lenses", action="store_true")
    options = parser.parse_args()
    n, trials = options.half_turns, options.trials
    if options.only_lenses:
        finish(lenses(n, trials))
    missed = pinhole(n, trials, options.methods)
    if "refined" in options.methods:
        missed += lenses(n, trials)
        misses(n, trials)
    finish(missed)


def finish(missed: Sequence[str]) -> NoReturn:
    """Say what is out of its band and exit."""
    print("\n" + ("\n".join(missed) if missed else "everything is in its band"))
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
