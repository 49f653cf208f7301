"""A plan's certificate against Monte-Carlo of the whole estimation.

Each cell's plan is executed many times with simulated points and the noise that its
certificate assumes; every time everything is estimated from the start (each camera,
all cameras, hand-eye, joint adjustment). Printed is the root mean square of each error
over its predicted sigma, with its own standard error: from n runs a sigma is known to
1 / sqrt(2 n). Exits with 1 where a ratio leaves 0.90 to 1.10 by more than two of its
standard errors, or a pool of ratios (all intrinsics, all places, the rig, the track)
leaves it at all.

    python scripts/check_certificate.py [--runs 400] [CELL ...]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

REPO = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPO / "tests" / "plan"))

from simulated_calibrations import (  # noqa: E402
    by_block,
    by_quantity,
    calibrated,
    predictions,
    ratio,
    simulated,
    squared_errors,
    to_calibrate,
    workspace_test,
)

from handeye_tri.arm import Arm  # noqa: E402
from handeye_tri.plan import plan_motions  # noqa: E402
from handeye_tri.simulate import compile_mechanism  # noqa: E402
from handeye_tri.storage.cells import read_cell  # noqa: E402

LOW, HIGH = 0.90, 1.10


def check(name: str, runs: int) -> list[str]:
    """Prints a cell's ratios; returns what is outside its gate."""
    cell = read_cell(REPO / "scenes" / f"{name}.yaml")
    path = REPO / "robot_models" / cell.arm.model
    arms = [Arm(compile_mechanism(mounted, path)) for mounted in cell.mounted]
    plan = plan_motions(cell, arms, seed=1)
    model = predictions(cell, arms[0])
    started = time.perf_counter()
    errors = []
    for run in range(runs):
        rng = np.random.default_rng([5, run])
        session, truth = simulated(cell, model, *to_calibrate(plan), rng)
        test = workspace_test(cell, model, rng)
        errors.append(squared_errors(calibrated(session), truth, test))
    seconds = time.perf_counter() - started
    print(f"\n{name}: {runs} runs, {seconds:.0f} s")
    quantities = by_quantity(errors, plan.certificate)
    problems = []
    for quantity, squares in quantities.items():
        found = ratio(squares)
        print(
            f"  {quantity:<44} {plan.certificate[quantity]:11.5f}"
            f"  x {found.value:.3f} +- {found.error:.3f}"
        )
        if not LOW - 2 * found.error <= found.value <= HIGH + 2 * found.error:
            problems.append(f"{name}: {quantity} is {found.value:.3f} of its sigma")
    for pool, squares in by_block(quantities).items():
        found = ratio(squares)
        print(f"  {'all of ' + pool:<57} x {found.value:.3f} +- {found.error:.3f}")
        if not LOW <= found.value <= HIGH:
            problems.append(f"{name}: {pool} together are {found.value:.3f}")
    return problems


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=400)
    parser.add_argument("cells", nargs="*", help="names in scenes/; default: all")
    asked = parser.parse_args()
    names = asked.cells or sorted(p.stem for p in (REPO / "scenes").glob("hp3*.yaml"))
    problems = [problem for name in names for problem in check(name, asked.runs)]
    for problem in problems:
        print(f"MISSED  {problem}")
    sys.exit(1 if problems else 0)


if __name__ == "__main__":
    main()
