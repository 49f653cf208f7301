"""Plan many seeds in every cell of scenes/ and print how often, how fast, how well.

The last row is hp3_stereo with an arm of seven joints: the same with a roll in its
lower arm and a flange that leans, so that no joint makes a half-turn by itself.

The calibration's part of the predicted track error is compared with the bound on
every choice among the plan's candidates, and with random plans: as many half-turns
as planned, by the sampler ``RandomPlans`` in tests/plan/random_plans.py.

The time of all moves is compared with the mean time of 100 random orders of the same
stations, with the same joints, moves straight and looked at by nobody: "/order", all
stations shuffled; "/turns", half-turns and held-out stations shuffled, the second
station of a half-turn right after the first. Every plan is driven in MuJoCo, looked
at every millisecond: "touch" counts those at which solids touch.

Seconds of planning are of one core at work, so that other work on the machine does
not count. Exits with 1 where a plan fails, takes more than 15 s, touches, or takes
more than 0.7 times as long as a random order of its stations.

Example: python scripts/check_planning.py --seeds 50 --random 200
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

REPO = Path(__file__).resolve().parents[1]
SEVEN = "seven joints"
CELLS = {SEVEN: "hp3_stereo"}
MOST_SECONDS, MOST_OF_ORDER = 15.0, 0.7
sys.path.insert(0, str(REPO / "tests" / "plan"))

from planning_scene import seven_joints  # noqa: E402
from random_plans import RandomPlans  # noqa: E402
from replayed import contacts  # noqa: E402
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
    every = [*sorted(p.stem for p in (REPO / "scenes").glob("hp3*.yaml")), SEVEN]
    print(
        f"{'cell':<16} {'plans':>9} {'median s':>8} {'max s':>6} {'spread':>6} "
        f"{'track mm':>8} {'/bound':>7} {'/random':>7} {'time s':>6} {'/order':>7} "
        f"{'/turns':>7} {'touch':>5}"
    )
    missed = [
        miss
        for name in asked.cells or every
        for miss in check(name, asked.seeds, asked.random, asked.half_turns)
    ]
    for miss in missed:
        print(f"missed: {miss}")
    sys.exit(bool(missed))


def check(name: str, seeds: int, random_plans: int, half_turns: int) -> list[str]:
    """Prints a row; returns what is outside its gate."""
    cell = read_cell(REPO / "scenes" / f"{CELLS.get(name, name)}.yaml")
    with tempfile.TemporaryDirectory() as folder:
        model = REPO / "robot_models" / cell.arm.model
        if name == SEVEN:
            model = seven_joints(Path(folder))
        arm = Arm(compile_mechanism(cell, model))
        seconds, plans, missed, touching = [], [], [], 0
        for seed in range(1, seeds + 1):
            start = time.process_time()
            try:
                plan = plan_motions(cell, arm, seed, half_turns)
            except NoPlanError as error:
                missed.append(f"{name}, seed {seed}: {error}")
                continue
            seconds.append(time.process_time() - start)
            plans.append(plan)
            touching += contacts(cell, model, arm, plan)[0]
    if not plans:
        return missed
    numbers = [plan.certificate for plan in plans]
    track = np.array([c["track_calibration_rms_mm"] for c in numbers])
    bound = np.array([c["relaxed_bound_mm"] for c in numbers])
    cycle = np.array([c["cycle_time_s"] for c in numbers])
    random = RandomPlans.of(cell, arm, predictions(cell, arm))
    rng = np.random.default_rng(2)
    drawn = [random.draw(rng, half_turns) for _ in range(random_plans)]
    usual = np.median([random.track_mm(chosen) for chosen in drawn])
    random_order = np.array([random_order_times(cell, arm, p) for p in plans])
    of_order, of_turns = (cycle[:, None] / random_order).max(axis=0)
    print(
        f"{name:<16} {len(plans):>3} of {seeds:<2} "
        f"{np.median(seconds):>8.2f} {max(seconds):>6.2f} "
        f"{min(c['plane_spread_deg'] for c in numbers):>6.1f} "
        f"{np.median(track):>8.4f} {np.max(track / bound):>7.3f} "
        f"{np.max(track) / usual:>7.3f} {np.median(cycle):>6.1f} "
        f"{of_order:>7.3f} {of_turns:>7.3f} {touching:>5}",
        flush=True,
    )
    if max(seconds) > MOST_SECONDS:
        missed.append(f"{name}: a plan took {max(seconds):.1f} s")
    if touching:
        missed.append(f"{name}: solids touch at {touching} ms")
    if of_order > MOST_OF_ORDER:
        missed.append(f"{name}: {of_order:.3f} of the time of a random order")
    return missed


if __name__ == "__main__":
    main()
