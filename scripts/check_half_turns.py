"""How often half-turns defeat a hand-eye solver: one table.

    python scripts/check_half_turns.py [--trials 60]

Sixteen poses are eight and their half-turn twins, with 0.1 degrees and 0.5 mm of noise
on what the camera sees. A trial is bad where the solution is more than 20 mm off. Exits
with 1 where any trial is bad.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from handeye_tri.errors import HandEyeError
from handeye_tri.hand_eye import (
    ABSOLUTE_METHODS,
    RELATIVE_METHODS,
    relative_motions,
    solve_axxb,
    solve_axzb,
    solve_pose_pairs,
)
from handeye_tri.records import PosePairs
from handeye_tri.se3 import (
    rotation_from_quaternion_wxyz,
    se3_exp,
    se3_inverse,
    so3_exp,
)

SIGMA = np.repeat([0.5e-3, np.radians(0.1)], 3)
BAD = 0.02


def poses(rng: np.random.Generator, n: int, spread: float) -> np.ndarray:
    found = np.tile(np.eye(4), (n, 1, 1))
    found[:, :3, :3] = rotation_from_quaternion_wxyz(rng.standard_normal((n, 4)))
    found[:, :3, 3] = spread * rng.standard_normal((n, 3))
    return found


def trial(seed: int) -> dict[tuple[str, str], float]:
    """Position errors of X, metres, by input and method; infinite where refused."""
    rng = np.random.default_rng([180, seed])
    x, z = poses(rng, 2, 0.2)
    first = poses(rng, 8, 0.3)
    axes = rng.standard_normal((8, 3))
    turns = np.tile(np.eye(4), (8, 1, 1))
    turns[:, :3, :3] = so3_exp(
        np.pi * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    )
    # Twins stand side by side: pose 2 i and 2 i + 1 are a half-turn apart.
    a = np.stack([first, first @ turns], axis=1).reshape(-1, 4, 4)
    b = se3_inverse(z) @ a @ x @ se3_exp(SIGMA * rng.standard_normal((16, 6)))
    pairs = {
        "half-turns only": (
            se3_inverse(a[::2]) @ a[1::2],
            se3_inverse(b[::2]) @ b[1::2],
        ),
        "all pairs": (
            relative_motions(a, side="right"),
            relative_motions(b, side="right"),
        ),
    }
    errors = {}
    for name, (left, right) in pairs.items():
        for method in RELATIVE_METHODS:
            errors[name, method] = solve_axxb(left, right, method=method)
    for method in ABSOLUTE_METHODS:
        errors["absolute poses", method] = solve_axzb(a, b, method=method)[0]
    stated = ("eye_to_hand", "flange_in_base", "target_in_camera")
    try:
        found = solve_pose_pairs(PosePairs(a, b, *stated)).x
    except HandEyeError:
        found = None
    errors["absolute poses", "likelihood (default)"] = found
    return {
        key: np.inf if one is None else np.linalg.norm(one.translation - x[:3, 3])
        for key, one in errors.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=60)
    trials = [trial(seed) for seed in range(parser.parse_args().trials)]
    worst = 0.0
    print(f"{'input':<18}{'method':<24}{'bad':>6}{'median':>10}{'worst':>10}")
    for key in trials[0]:
        errors = np.array([one[key] for one in trials])
        bad = float((errors > BAD).mean())
        worst = max(worst, bad)
        print(
            f"{key[0]:<18}{key[1]:<24}{bad:>6.0%}{1e3 * np.median(errors):>7.2f} mm"
            f"{1e3 * errors.max():>7.2f} mm"
        )
    sys.exit(1 if worst > 0 else 0)


if __name__ == "__main__":
    main()
