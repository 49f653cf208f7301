"""Plan many seeds in every cell of scenes/ and print how often, how fast, how well.

The calibration's part of the predicted track error is compared with the bound on
every choice among the plan's candidates, and with random plans: as many half-turns
as planned, by the sampler ``RandomPlans`` in tests/plan/random_plans.py.

The time of all moves is compared with the mean time of 100 random orders of the same
stations, with the same joints, moves straight and looked at by nobody: "/order", all
stations shuffled; "/turns", half-turns and held-out stations shuffled, the second
station of a half-turn right after the first.

Example: python scripts/check_planning.py --seeds 50 --random 200
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

REPO = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPO / "tests" / "plan"))

from random_plans import RandomPlans  # noqa: E402
from simulated_calibrations import predictions  # noqa: E402

from handeye_tri.arm import Arm  # noqa: E402
from handeye_tri.config import Cell  # noqa: E402
from handeye_tri.errors import NoPlanError  # noqa: E402
from handeye_tri.plan import plan_motions  # noqa: E402
from handeye_tri.plan.sequence import travel_time  # noqa: E402
from handeye_tri.records import Plan  # noqa: E402
from handeye_tri.simulate import compile_mechanism  # noqa: E402
from handeye_tri.storage.cells import read_cell  # noqa: E402


def random_order_times(cell: Cell, arm: Arm, plan: Plan) -> tuple[float, float]:
    """Mean seconds of all moves with stations, and with half-turns, shuffled."""
    joints = np.array([station.joints for station in plan.stations])
    turns = [(turn.before, turn.after) for turn in plan.half_turns]
    places = [*turns, *((s.index,) for s in plan.stations if s.kind == "evaluation")]
    rng = np.random.default_rng(0)

    def mean(shuffled: Callable[[], Sequence[int]]) -> float:
        times = []
        for _ in range(100):
            route = np.concatenate([arm.home[None], joints[list(shuffled())]])
            moves = travel_time(
                route[:-1], route[1:], arm.speed, cell.arm.acceleration_time_s
            )
            times.append(moves.sum())
        return float(np.mean(times))

    return (
        mean(lambda: rng.permutation(len(joints))),
        mean(lambda: [k for p in rng.permutation(len(places)) for k in places[p]]),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--random", type=int, default=200, help="random plans")
    parser.add_argument("--half-turns", type=int, default=11)
    parser.add_argument("cells", nargs="*", help="names in scenes/; default: all")
    asked = parser.parse_args()
    names = asked.cells or sorted(p.stem for p in (REPO / "scenes").glob("hp3*.yaml"))
    print(
        f"{'cell':<16} {'plans':>9} {'median s':>8} {'max s':>6} {'spread':>6} "
        f"{'track mm':>8} {'/bound':>7} {'/random':>7} {'time s':>6} {'/order':>7} "
        f"{'/turns':>7}"
    )
    for name in names:
        path = REPO / "scenes" / f"{name}.yaml"
        cell = read_cell(path)
        arm = Arm(compile_mechanism(cell, REPO / "robot_models" / cell.arm.model))
        seconds, plans, failures = [], [], []
        for seed in range(1, asked.seeds + 1):
            start = time.perf_counter()
            try:
                plans.append(plan_motions(cell, arm, seed, asked.half_turns))
            except NoPlanError as error:
                failures.append(f"  seed {seed}: {error}")
            seconds.append(time.perf_counter() - start)
        print("\n".join(failures), end="\n" if failures else "")
        if not plans:
            continue
        numbers = [plan.certificate for plan in plans]
        track = np.array([c["track_calibration_rms_mm"] for c in numbers])
        bound = np.array([c["relaxed_bound_mm"] for c in numbers])
        cycle = np.array([c["cycle_time_s"] for c in numbers])
        random = RandomPlans.of(cell, arm, predictions(cell, arm))
        rng = np.random.default_rng(2)
        drawn = [random.draw(rng, asked.half_turns) for _ in range(asked.random)]
        usual = np.median([random.track_mm(chosen) for chosen in drawn])
        random_order = np.array([random_order_times(cell, arm, p) for p in plans])
        of_order, of_turns = (cycle[:, None] / random_order).max(axis=0)
        print(
            f"{name:<16} {len(plans):>3} of {asked.seeds:<2} "
            f"{np.median(seconds):>8.2f} {max(seconds):>6.2f} "
            f"{min(c['plane_spread_deg'] for c in numbers):>6.1f} "
            f"{np.median(track):>8.4f} {np.max(track / bound):>7.3f} "
            f"{np.max(track) / usual:>7.3f} {np.median(cycle):>6.1f} "
            f"{of_order:>7.3f} {of_turns:>7.3f}"
        )


if __name__ == "__main__":
    main()
