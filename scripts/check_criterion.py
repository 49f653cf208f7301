"""Is a chosen plan worth more than a random one, and does the cell agree?

Criterion: the calibration's own part of the track error, RMS over the workspace box.
For each cell, pixel noise and number of half-turns: the plan's prediction against the
bound on every choice among its candidates, and against the median of random feasible
plans (the sampler is ``RandomPlans`` in tests/plan/random_plans.py). Then Monte-Carlo:
the plan, and a different random plan a run, are executed with simulated points, paired
seeds, and everything is estimated from the start; what the calibration gets wrong over
the box is measured with exact pixels. Exits with 1 on a miss.

    python scripts/check_criterion.py [--runs 100] [--random 200] [CELL ...]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

REPO = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPO / "tests" / "plan"))

from random_plans import RandomPlans  # noqa: E402
from simulated_calibrations import (  # noqa: E402
    calibrated,
    predictions,
    ratio,
    simulated,
    to_calibrate,
    workspace_test,
)

from handeye_tri.arm import Arm  # noqa: E402
from handeye_tri.config import parse_cell  # noqa: E402
from handeye_tri.evaluate import evaluate_track  # noqa: E402
from handeye_tri.plan import plan_motions  # noqa: E402
from handeye_tri.simulate import compile_mechanism  # noqa: E402
from handeye_tri.storage.cells import read_cell  # noqa: E402

# Most over the bound, by half-turns; most over the random median, by pixel noise.
OVER_BOUND = {11: 1.05, 8: 1.10}
OVER_RANDOM = {0.03: 0.85, 0.1: 0.80}
# What Monte-Carlo finds may differ so much from what was predicted.
AGREEMENT = 0.10


def own_part(cell, model, stations, half_turns, seed):
    """Squared RMS over the workspace box that one calibration is wrong by, mm^2."""
    rng = np.random.default_rng(seed)
    session, _ = simulated(cell, model, stations, half_turns, rng)
    test = workspace_test(cell, model, rng)
    return 1e6 * evaluate_track(calibrated(session), test.exact).rms ** 2


def check(name, sigma_px, runs, draws):
    """Prints one cell at one noise; returns what misses its gate."""
    whole = read_cell(REPO / "scenes" / f"{name}.yaml").model_dump(by_alias=True)
    whole["plan"]["expected_sigma_px"] = sigma_px
    cell = parse_cell(whole, name)
    path = REPO / "robot_models" / cell.arm.model
    arms = [Arm(compile_mechanism(mounted, path)) for mounted in cell.mounted]
    model = predictions(cell, arms[0])
    random = RandomPlans.of(arms, model)
    problems, medians, planned = [], {}, {}
    for half_turns, most in OVER_BOUND.items():
        rng = np.random.default_rng([2, half_turns])
        drawn = [random.draw(rng, half_turns) for _ in range(draws)]
        expected = np.array([random.track_mm(chosen) for chosen in drawn])
        median = medians[half_turns] = float(np.median(expected))
        plan = plan_motions(cell, arms, 1, half_turns)
        track = planned[half_turns] = plan.certificate["track_calibration_rms_mm"]
        over_bound = track / plan.certificate["relaxed_bound_mm"]
        mine, theirs = [], []
        for run in range(runs):
            mine.append(own_part(cell, model, *to_calibrate(plan), [3, run]))
            programme = random.programme(drawn[run % draws], cell)
            theirs.append(own_part(cell, model, *programme, [3, run]))
        found = ratio(np.array(mine) / track**2)
        usual = np.sqrt(np.mean(expected[np.arange(runs) % draws] ** 2))
        other = ratio(np.array(theirs) / usual**2)
        print(
            f"{name:<16} {sigma_px:5} {half_turns:3} {track:8.4f} {over_bound:7.3f} "
            f"{median:8.4f} {track / median:7.3f} {track * found.value:9.4f} "
            f"{usual * other.value:8.4f} "
            f"{track * found.value / (usual * other.value):7.3f} "
            f"{found.value:7.3f} +- {found.error:.3f} {other.value:7.3f} +- "
            f"{other.error:.3f}",
            flush=True,
        )
        where = f"{name}, {sigma_px} px, {half_turns} half-turns"
        if over_bound > most:
            problems.append(f"{where}: {over_bound:.3f} times the bound")
        if half_turns == 11 and track / median > OVER_RANDOM[sigma_px]:
            problems.append(f"{where}: {track / median:.3f} of the random median")
        for who, one in (("plan", found), ("random plans", other)):
            if abs(one.value - 1) > AGREEMENT + 2 * one.error:
                problems.append(f"{where}: {who} came out {one.value:.3f} of predicted")
        if found.value * track > other.value * usual:
            problems.append(f"{where}: the plan came out worse than random ones")
    if planned[8] > medians[11]:
        problems.append(
            f"{name}, {sigma_px} px: 8 planned half-turns leave {planned[8]:.4f} mm, "
            f"11 random ones {medians[11]:.4f}"
        )
    return problems


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--random", type=int, default=200)
    parser.add_argument("cells", nargs="*", help="names in scenes/; default: all")
    asked = parser.parse_args()
    names = asked.cells or sorted(p.stem for p in (REPO / "scenes").glob("hp3*.yaml"))
    print(
        "                            predicted, mm                    "
        "   Monte-Carlo, RMS mm           found / predicted\n"
        f"{'cell':<16} {'px':>5} {'n':>3} {'plan':>8} {'/bound':>7} {'median':>8} "
        f"{'/median':>7} {'plan':>9} {'random':>8} {'/random':>7} {'plan':>16} "
        f"{'random':>16}"
    )
    problems = []
    for name in names:
        for sigma_px in OVER_RANDOM:
            problems += check(name, sigma_px, asked.runs, asked.random)
    for problem in problems:
        print(f"MISSED  {problem}")
    sys.exit(1 if problems else 0)


if __name__ == "__main__":
    main()
