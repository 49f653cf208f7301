"""Plan many seeds in every cell of scenes/ and print how often and how fast.

Example: python scripts/check_planning.py --seeds 50
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from handeye_tri.arm import Arm
from handeye_tri.errors import NoPlanError
from handeye_tri.plan import plan_motions
from handeye_tri.simulate import compile_mechanism
from handeye_tri.storage.cells import read_cell

REPO = Path(__file__).resolve().parent.parent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("cells", nargs="*", help="names in scenes/; default: all")
    asked = parser.parse_args()
    names = asked.cells or sorted(p.stem for p in (REPO / "scenes").glob("*.yaml"))
    print(
        f"{'cell':<18} {'plans':>9} {'median s':>9} {'max s':>7} "
        f"{'spread deg':>11} {'track mm':>9}"
    )
    for name in names:
        path = REPO / "scenes" / f"{name}.yaml"
        cell = read_cell(path)
        arm = Arm(compile_mechanism(cell, REPO / "robot_models" / cell.arm.model))
        seconds, spreads, track, failures = [], [], [], []
        for seed in range(1, asked.seeds + 1):
            start = time.perf_counter()
            try:
                plan = plan_motions(cell, arm, seed)
            except NoPlanError as error:
                failures.append(f"  seed {seed}: {error}")
            else:
                spreads.append(plan.certificate["plane_spread_deg"])
                track.append(plan.certificate["track_calibration_rms_mm"])
            seconds.append(time.perf_counter() - start)
        print(
            f"{name:<18} {asked.seeds - len(failures):>3} of {asked.seeds:<2} "
            f"{np.median(seconds):>9.2f} {max(seconds):>7.2f} "
            f"{min(spreads, default=np.nan):>11.1f} "
            f"{np.median(track) if track else np.nan:>9.4f}"
        )
        print("\n".join(failures), end="\n" if failures else "")


if __name__ == "__main__":
    main()
