"""Seven wrong inputs, on simulated cells and on real poses: does any end as PASS?

    python scripts/check_wrong_inputs.py [--trials 20] [--data DATA]

Each trial draws a cell: mounting, 8 to 40 poses, how far they turn (15 to 60 degrees)
and the noise (0.05 to 2 mm, 0.01 to 0.5 degrees) are random. DATA is the folder that
`check_real_data.py` takes; poses of a real robot are spoilt the same way. Where the
motion is what is wrong, real residuals are put on other motions of the same cell. A
wrong input is *named* where the first finding says what was done. Exits with 1 where
a wrong input passes, or right input does not.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from check_real_data import STREAMS, eth_pairs

from handeye_tri.errors import HandEyeError
from handeye_tri.hand_eye import solve_pose_pairs
from handeye_tri.records import PosePairs
from handeye_tri.se3 import (
    rotation_from_quaternion_wxyz,
    se3_exp,
    se3_inverse,
    se3_log,
    so3_exp,
)
from handeye_tri.solve import SolvedPairs, solve_and_judge

OPPOSITE = {
    "eye_in_hand": "eye_to_hand",
    "eye_to_hand": "eye_in_hand",
    "flange_in_base": "base_in_flange",
    "base_in_flange": "flange_in_base",
    "target_in_camera": "camera_in_target",
    "camera_in_target": "target_in_camera",
}


@dataclass(frozen=True)
class Cell:
    """Poses that belong together, and what they leave under the true motions.

    Attributes:
        robot: base_from_flange, (n, 4, 4), metres.
        observed: camera_from_target, (n, 4, 4), metres.
        mounting: See PosePairs.
        x: The true motion on the flange.
        z: The true motion in the base.
    """

    robot: Any
    observed: Any
    mounting: Any
    x: Any
    z: Any

    def pairs(self, **changes: Any) -> PosePairs:
        stated = {
            "robot": self.robot,
            "observed": self.observed,
            "mounting": self.mounting,
            "robot_direction": "flange_in_base",
            "observed_direction": "target_in_camera",
        }
        return PosePairs(**(stated | changes))

    def at(self, robot: Any, rng: np.random.Generator) -> PosePairs:
        """What would be seen at other robot poses, with this cell's own noise."""
        seen = self.seen_at(self.robot)
        noise = se3_log(se3_inverse(seen) @ self.observed)
        drawn = noise[rng.integers(0, len(noise), len(robot))]
        # Signs are as likely either way; it also keeps exact copies apart.
        drawn *= rng.choice([-1.0, 1.0], (len(robot), 1))
        observed = self.seen_at(robot) @ se3_exp(drawn)
        return self.pairs(robot=robot, observed=observed)

    def seen_at(self, robot: Any) -> Any:
        b = se3_inverse(self.z) @ robot @ self.x
        return se3_inverse(b) if self.mounting == "eye_in_hand" else b


def simulated(seed: int, mounting: Any) -> Cell:
    rng = np.random.default_rng([7, seed])
    n = int(rng.integers(8, 41))
    tilt = np.radians(rng.uniform(15, 60))
    sigma = np.repeat(
        [
            10 ** rng.uniform(np.log10(5e-5), np.log10(2e-3)),
            np.radians(10 ** rng.uniform(-2, np.log10(0.5))),
        ],
        3,
    )
    x, z = np.tile(np.eye(4), (2, 1, 1))
    for motion in (x, z):
        motion[:3, :3] = rotation_from_quaternion_wxyz(rng.standard_normal(4))
        motion[:3, 3] = 0.1 * rng.standard_normal(3)
    z[:3, 3] += (0.6, 0.1, 0.5)
    seen = np.tile(np.eye(4), (n, 1, 1))
    axes = rng.standard_normal((n, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    seen[:, :3, :3] = so3_exp(tilt * rng.uniform(0.3, 1, (n, 1)) * axes)
    seen[:, :3, 3] = (0, 0, 0.7) + 0.12 * rng.standard_normal((n, 3))
    b = se3_inverse(seen) if mounting == "eye_in_hand" else seen
    robot = z @ b @ se3_inverse(x)
    observed = seen @ se3_exp(sigma * rng.standard_normal((n, 6)))
    return Cell(robot, observed, mounting, x, z)


def real(data: Path) -> Iterator[tuple[str, Cell]]:
    """Poses of real robots; what the right input gives stands for the truth."""
    path = data / "moveit_pose_samples" / "pose_samples.json"
    if path.exists():
        poses = np.array(json.loads(path.read_text()))
        stated = ("eye_to_hand", "flange_in_base", "target_in_camera")
        found = solve_pose_pairs(PosePairs(poses[:, 0], poses[:, 1], *stated))
        yield (
            "real: moveit",
            Cell(poses[:, 0], poses[:, 1], stated[0], found.x.matrix, found.z.matrix),
        )
    if (data / "eth_robot_arm").exists():
        for name in STREAMS:
            pairs = eth_pairs(data / "eth_robot_arm", name, every=20)
            found = solve_pose_pairs(pairs)
            used = found.used
            yield (
                f"real: eth, {name}",
                Cell(
                    np.array(found.base_from_flange[used]),
                    se3_inverse(found.b[used]),
                    "eye_in_hand",
                    found.x.matrix,
                    found.z.matrix,
                ),
            )
    path = data / "opencv_24871" / "poses.json"
    if path.exists():
        exact = json.loads(path.read_text())
        robot, observed = (np.array(exact[k]) for k in ("gripper2base", "target2cam"))
        x = np.array(exact["cam2gripper_true"])
        z = robot[0] @ x @ observed[0]
        yield "exact: opencv, 4 poses", Cell(robot, observed, "eye_in_hand", x, z)


def scaled(poses: Any, factor: float) -> Any:
    result = np.array(poses)
    result[:, :3, 3] *= factor
    return result


def no_rotation(cell: Cell, rng: np.random.Generator) -> PosePairs:
    still = np.tile(cell.robot[0], (15, 1, 1))
    still[:, :3, 3] += 0.1 * rng.standard_normal((15, 3))
    return cell.at(still, rng)


def one_axis(cell: Cell, rng: np.random.Generator) -> PosePairs:
    turned = np.zeros((15, 6))
    axis = rng.standard_normal(3)
    angles = rng.uniform(-0.8, 0.8, (15, 1))
    turned[:, 3:] = angles * axis / np.linalg.norm(axis)
    turned[:, :3] = 0.1 * rng.standard_normal((15, 3))
    return cell.at(cell.robot[0] @ se3_exp(turned), rng)


Spoil = Callable[[Cell, np.random.Generator], PosePairs]
# What is done, how the input is spoilt, and the finding that names it.
WRONG: dict[str, tuple[Spoil, str]] = {
    "unit: observed mm as m": (
        lambda cell, _: cell.pairs(observed=scaled(cell.observed, 1e3)),
        "SCALE",
    ),
    "unit: robot mm as m": (
        lambda cell, _: cell.pairs(robot=scaled(cell.robot, 1e3)),
        "SCALE",
    ),
    "unit: inches as m": (
        lambda cell, _: cell.pairs(observed=scaled(cell.observed, 1 / 0.0254)),
        "SCALE",
    ),
    "inverted robot poses": (
        lambda cell, _: cell.pairs(robot_direction="base_in_flange"),
        "READING",
    ),
    "inverted observed poses": (
        lambda cell, _: cell.pairs(observed_direction="camera_in_target"),
        "READING",
    ),
    "swapped mounting": (
        lambda cell, _: cell.pairs(mounting=OPPOSITE[cell.mounting]),
        "READING",
    ),
    "pairs shifted by one": (
        lambda cell, _: cell.pairs(observed=np.roll(cell.observed, 1, axis=0)),
        "READING",
    ),
    "no rotation": (no_rotation, "MOTION"),
    "one axis only": (one_axis, "MOTION"),
    "three poses": (
        lambda cell, _: cell.pairs(robot=cell.robot[:3], observed=cell.observed[:3]),
        "FEW",
    ),
}


def judged(pairs: PosePairs) -> tuple[str, str, SolvedPairs | None]:
    """Outcome, the first finding's code, and everything."""
    try:
        solved = solve_and_judge(pairs, limit_position=0.05, limit_angle=0.06)
    except HandEyeError as error:
        return type(error).__name__, type(error).__name__, None
    findings = solved.verdict.findings
    return solved.verdict.outcome, findings[0].code if findings else "-", solved


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--data", type=Path)
    arguments = parser.parse_args()
    cells: dict[str, list[Cell]] = {
        f"simulated, {mounting}": [
            simulated(seed, mounting) for seed in range(arguments.trials)
        ]
        for mounting in ("eye_in_hand", "eye_to_hand")
    }
    if arguments.data is not None:
        cells |= {name: [cell] for name, cell in real(arguments.data)}
    good = True
    for name, drawn in cells.items():
        print(f"{name}: {len(drawn)} cells")
        few = len(drawn[0].robot) < 6
        passed = [judged(cell.pairs())[0] for cell in drawn]
        share = passed.count("PASS")
        good &= few or share == len(drawn)
        rest = sorted({one for one in passed if one != "PASS"})
        print(f"  {'right input':<26}{share:>4} PASS {' '.join(rest)}")
        for what, (spoil, code) in WRONG.items():
            outcomes, named, solved = [], 0, 0
            for seed, cell in enumerate(drawn):
                rng = np.random.default_rng([8, seed])
                outcome, first, everything = judged(spoil(cell, rng))
                outcomes.append(outcome)
                named += first == code
                if first != code:
                    print(f"    {what}, cell {seed}: {outcome}, {first}")
                solved += 0 if everything is None else len(everything.readings) - 1
            wrong = outcomes.count("PASS")
            good &= wrong == 0
            rest = [f"{outcomes.count(one)} {one}" for one in sorted(set(outcomes))]
            print(
                f"  {what:<26}{wrong:>4} PASS; named {named}; "
                f"{solved / len(drawn):.1f} other readings solved; {', '.join(rest)}"
            )
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
