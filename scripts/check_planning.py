"""Plan many seeds in every cell of scenes/ and print how often, how fast, how well.

The last row is hp3_stereo with an arm of seven joints: the same with a roll in its
lower arm and a flange that leans, so that no joint makes a half-turn by itself.

The calibration's part of the predicted track error is compared with the bound on
every choice among the plan's candidates, and with random plans: as many half-turns
as planned, by the sampler ``RandomPlans`` in tests/plan/random_plans.py.

The time of all moves is compared with the mean of 100 random orders of the same
stations, moves straight and looked at by nobody. "/order" is an arm that is told the
stations' poses one after the other: at each it takes, of the solutions that pass every
check of a plan, the one nearest to where it stands, as the sampler of a plan does
(``CandidateSearch.free``). "/joints" goes by the very joints that the plan chose, which
only its own order made worth choosing; it has no gate. Of a cell with two mounts the
stations with each are in random order, and the arm goes home for the tool change as in
the plan. Every plan is driven in MuJoCo, looked at every millisecond: "touch" counts
those at which solids touch.

Seconds of planning are of one core at work, so that other work on the machine does
not count. Exits with 1 where a plan fails, takes more than 15 s, touches, or takes
more than 0.7 times as long as a random order of its stations ("/order", worst seed).

Example: python scripts/check_planning.py --seeds 50 --random 200 --jobs 2
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import joblib
import numpy as np
from numpy.typing import NDArray

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
from handeye_tri.plan.candidates import CandidateSearch, Prospect  # noqa: E402
from handeye_tri.plan.poses import View  # noqa: E402
from handeye_tri.plan.sequence import travel_time  # noqa: E402
from handeye_tri.records import Plan  # noqa: E402
from handeye_tri.simulate import compile_mechanism  # noqa: E402
from handeye_tri.storage.cells import read_cell  # noqa: E402


@dataclass(frozen=True)
class Outcome:
    """One seed: the plan's numbers, or why there is none."""

    seconds: float
    touching: int
    certificate: dict[str, float]
    of_order: float
    of_joints: float
    refused: str = ""


def scene(name: str, model: Path) -> tuple[Cell, list[Arm]]:
    """A cell, and the arm with each of its mounts."""
    cell = read_cell(REPO / "scenes" / f"{CELLS.get(name, name)}.yaml")
    return cell, [Arm(compile_mechanism(one, model)) for one in cell.mounted]


def outcome(name: str, model: Path, seed: int, half_turns: int) -> Outcome:
    cell, arms = scene(name, model)
    start = time.process_time()
    try:
        plan = plan_motions(cell, arms, seed, half_turns)
    except NoPlanError as error:
        return Outcome(np.nan, 0, {}, np.nan, np.nan, f"{name}, seed {seed}: {error}")
    seconds = time.process_time() - start
    cycle = plan.certificate["cycle_time_s"]
    by_order = random_order_time(cell, arms, plan, solutions_of(cell, arms, plan))
    own = [s.joints[None] for s in plan.stations]
    by_joints = random_order_time(cell, arms, plan, own)
    return Outcome(
        seconds,
        contacts(cell, model, arms[0], plan)[0],
        dict(plan.certificate),
        cycle / by_order,
        cycle / by_joints,
    )


def solutions_of(
    cell: Cell, arms: Sequence[Arm], plan: Plan
) -> list[NDArray[np.float64]]:
    """Joints by which each station may be visited, shapes (k, q)."""
    rng = np.random.default_rng(0)
    views = [View(mounted) for mounted in cell.mounted]
    searches = [
        CandidateSearch(view, arm, rng) for view, arm in zip(views, arms, strict=True)
    ]
    poses = np.array([station.base_from_flange.matrix for station in plan.stations])
    world = arms[0].base_from_world.inverse().matrix @ poses
    found = []
    solved = arms[0].inverse(poses, rng).joints
    for k, station in enumerate(plan.stations):
        # Near its limits an arm of seven joints may be hard to solve anew.
        joints = solved[k] if len(solved[k]) else station.joints[None]
        seen = views[station.mount].seen(world[[k]])[0]
        free = searches[station.mount].free(
            Prospect(poses[k, None], seen, joints[:, None]), len(joints)
        )
        found.append(np.array([candidate.joints[0] for candidate in free]))
    return found


def random_order_time(
    cell: Cell,
    arms: Sequence[Arm],
    plan: Plan,
    solutions: Sequence[NDArray[np.float64]],
) -> float:
    """Mean seconds of all moves in a random order, each to the nearest solution."""
    rng, arm = np.random.default_rng(0), arms[0]
    times = []
    for _ in range(100):
        route = [arm.home]
        for mount in range(len(arms)):
            if mount > 0:
                route.append(arm.home)
            own = [s.index for s in plan.stations if s.mount == mount]
            for k in rng.permutation(own):
                gaps = np.linalg.norm(solutions[k] - route[-1], axis=1)
                route.append(solutions[k][gaps.argmin()])
        moves = travel_time(
            np.array(route[:-1]),
            np.array(route[1:]),
            arm.speed,
            cell.arm.acceleration_time_s,
        )
        times.append(moves.sum())
    return float(np.mean(times))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--random", type=int, default=200, help="random plans")
    parser.add_argument("--half-turns", type=int, default=11)
    parser.add_argument("--jobs", type=int, default=1, help="seeds at once")
    parser.add_argument("cells", nargs="*", help="names in scenes/; default: all")
    asked = parser.parse_args()
    every = [*sorted(p.stem for p in (REPO / "scenes").glob("hp3*.yaml")), SEVEN]
    print(
        f"{'cell':<16} {'plans':>9} {'median s':>8} {'max s':>6} {'spread':>6} "
        f"{'track mm':>8} {'/bound':>7} {'/random':>7} {'time s':>6} {'/order':>7} "
        f"{'/joints':>7} {'touch':>5}"
    )
    missed = [
        miss
        for name in asked.cells or every
        for miss in check(name, asked.seeds, asked.random, asked.half_turns, asked.jobs)
    ]
    for miss in missed:
        print(f"missed: {miss}")
    sys.exit(bool(missed))


def check(
    name: str, seeds: int, random_plans: int, half_turns: int, jobs: int
) -> list[str]:
    """Prints a row; returns what is outside its gate."""
    with tempfile.TemporaryDirectory() as folder:
        model = REPO / "robot_models" / "hp3_like.xml"
        if name == SEVEN:
            model = seven_joints(Path(folder))
        cell, arms = scene(name, model)
        every = joblib.Parallel(n_jobs=jobs)(
            joblib.delayed(outcome)(name, model, seed, half_turns)
            for seed in range(1, seeds + 1)
        )
    missed = [one.refused for one in every if one.refused]
    plans = [one for one in every if not one.refused]
    if not plans:
        return missed
    seconds = [one.seconds for one in plans]
    touching = sum(one.touching for one in plans)
    numbers = [one.certificate for one in plans]
    track = np.array([c["track_calibration_rms_mm"] for c in numbers])
    bound = np.array([c["relaxed_bound_mm"] for c in numbers])
    cycle = np.array([c["cycle_time_s"] for c in numbers])
    of_order = max(one.of_order for one in plans)
    of_joints = max(one.of_joints for one in plans)
    random = RandomPlans.of(arms, predictions(cell, arms[0]))
    rng = np.random.default_rng(2)
    drawn = [random.draw(rng, half_turns) for _ in range(random_plans)]
    usual = np.median([random.track_mm(chosen) for chosen in drawn])
    print(
        f"{name:<16} {len(plans):>3} of {seeds:<2} "
        f"{np.median(seconds):>8.2f} {max(seconds):>6.2f} "
        f"{min(c['plane_spread_deg'] for c in numbers):>6.1f} "
        f"{np.median(track):>8.4f} {np.max(track / bound):>7.3f} "
        f"{np.max(track) / usual:>7.3f} {np.median(cycle):>6.1f} "
        f"{of_order:>7.3f} {of_joints:>7.3f} {touching:>5}",
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
