"""How often `compare` names a change that is none, and whether it names a true one.

    python scripts/check_compare.py --trials 200

Pairs of simulated calibrations of one cell (11 half-turns, two cameras, 0.1 px, a robot
that repeats to 0.03 mm and 0.005 degrees), each with a programme of its own: unchanged;
one camera moved by 3 mm and 0.2 degrees; the rig slipped by 0.5 mm. Gates, exit code 1
on a miss: false alarms as rare as stated (1 %, to the 99.9 % quantile of as many
pairs), the right parts named in 95 % of the pairs that did change, others in 2 %.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys

import numpy as np
from scipy import stats

from handeye_tri.adjustment import adjust
from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.evaluate import part_changes
from handeye_tri.evaluate.change import FALSE_ALARMS
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.records import Repeatability
from handeye_tri.se3 import SE3
from handeye_tri.synthesize import reference_geometry, synthesize

ROBOT = Repeatability(3e-5, float(np.radians(0.005)))
parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--trials", type=int, default=200, help="pairs of each kind")
arguments = parser.parse_args()


def calibrated(seed: int, change: str):
    """A calibration of the cell with its own programme and noise."""
    geometry = reference_geometry(np.random.default_rng([seed, 0]))
    if change == "camera":
        left, right = geometry.base_from_camera
        moved = right @ SE3.exp([3e-3, 0, 0, 0, np.radians(0.2), 0])
        geometry = dataclasses.replace(geometry, base_from_camera=(left, moved))
    elif change == "rig":
        slipped = SE3.exp([0, 0, 5e-4, 0, 0, 0]) @ geometry.flange_from_triangle
        geometry = dataclasses.replace(geometry, flange_from_triangle=slipped)
    session, _ = synthesize(
        geometry,
        np.random.default_rng([seed, 1]),
        sigma_px=0.1,
        repeatability=ROBOT,
    )
    start = calibrate_hand_eye(session, calibrate_session_cameras(session))
    return adjust(session, start)


RIGHT = {
    "none": set(),
    "camera": {("place", "right"), ("between", "right")},
    "rig": {("rig", "")},
}
failed = False
print(
    "change    pairs   its parts named   other parts named   chi2/dof where unchanged"
)
for number, (change, expected) in enumerate(RIGHT.items()):
    named = others = 0
    ratios = []
    for trial in range(arguments.trials):
        seed = 10_000 * (number + 1) + 2 * trial
        parts = part_changes(calibrated(seed, "none"), calibrated(seed + 1, change))
        found = {(part.part, part.camera) for part in parts if part.changed}
        named += expected <= found
        others += bool(found - expected)
        ratios += [p.chi2 / p.dof for p in parts if (p.part, p.camera) not in expected]
    n = arguments.trials
    limit = FALSE_ALARMS if change == "none" else 2 * FALSE_ALARMS
    met = others <= stats.binom.ppf(0.999, n, limit) and named >= 0.95 * n
    failed |= not met
    print(
        f"{change:<10}{n:<8}{named if expected else '-':<18}{others:<20}"
        f"{np.mean(ratios):.3f}{'' if met else '   MISSED'}"
    )
sys.exit(1 if failed else 0)
