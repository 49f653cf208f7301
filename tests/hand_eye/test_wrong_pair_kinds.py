"""Every flag, choice and seed that the solvers of pose pairs take."""

from __future__ import annotations

import numpy as np
import pytest
from pose_scene import pairs_of, scene

from handeye_tri.errors import InputError
from handeye_tri.evaluate import evaluate_track
from handeye_tri.hand_eye import (
    calibrate_hand_eye,
    solve_axxb,
    solve_axzb,
    solve_pose_pairs,
)
from handeye_tri.se3 import se3_inverse

A, B, _, _ = scene(0, 5)
PAIRS = pairs_of(A, B)
NOT_METHODS = (None, 3, True, "best", ["shah"], np.array([1, 2]))
NOT_SEEDS = (None, -1, 0.5, True, "0", [0], np.array([1, 2]))
CASES = [
    *((lambda **k: solve_axxb(A, B, **k), "method", one) for one in NOT_METHODS),
    *((lambda **k: solve_axzb(A, B, **k), "method", one) for one in NOT_METHODS),
    *((lambda **k: solve_axzb(A, B, **k), "robust", one) for one in (None, 1, "yes")),
    *((lambda **k: solve_axzb(A, B, **k), "seed", one) for one in NOT_SEEDS),
    *((lambda **k: solve_pose_pairs(PAIRS, **k), "method", m) for m in NOT_METHODS),
    *((lambda **k: solve_pose_pairs(PAIRS, **k), "seed", one) for one in NOT_SEEDS),
    *(
        (lambda **k: solve_pose_pairs(PAIRS, **k), "shift_along_axis", one)
        for one in (True, "0.1", [0.1])
    ),
    *((lambda **k: solve_pose_pairs(**k), "pairs", one) for one in (None, "a", A)),
    *((lambda **k: pairs_of(A, B, **k), "mounting", one) for one in NOT_METHODS),
    *((lambda **k: pairs_of(A, B, **k), "metric", one) for one in (None, 1, "yes")),
    *((lambda **k: pairs_of(A, B, **k), "names", one) for one in ("abcde", 3)),
]


@pytest.mark.parametrize(("call", "argument", "value"), CASES)
def test_an_argument_of_the_wrong_kind_is_named(call, argument, value) -> None:
    with pytest.raises(InputError, match=rf"^{argument} must be "):
        call(**{argument: value})


def test_covariances_are_numbers() -> None:
    with pytest.raises(InputError, match="covariance_a must be real numbers"):
        solve_axzb(A, se3_inverse(B), method="refined", covariance_a="small")


def test_what_is_no_record_is_named() -> None:
    with pytest.raises(InputError, match="session must be a Session, got None"):
        calibrate_hand_eye(None, None)
    with pytest.raises(InputError, match="calibration must be a HandEyeCalibration"):
        evaluate_track(None, None)
