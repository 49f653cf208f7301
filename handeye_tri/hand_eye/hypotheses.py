"""Other ways to read the same pose pairs, each solved: is the stated one the best?

Inverting one side's poses and swapping the mounting give the same equation: from
``A^-1 X = Z B`` follows ``A Z = X B^-1``. Three mistakes, one residual; all are named.
Inverting both sides changes nothing but which unknown is which, so that no residual
sees it. Where poses do not fit as stated, rotations are also read as transposed
(matrices written column by column) and one side as left-handed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.hand_eye.consensus import find_start, scene_length
from handeye_tri.hand_eye.pose_fit import fit_poses
from handeye_tri.hand_eye.pose_model import PoseInput
from handeye_tri.hand_eye.pose_solution import PoseSolution, residuals_of
from handeye_tri.records import PosePairs
from handeye_tri.se3 import SE3, se3_inverse

Floats = NDArray[np.float64]

# Known factors between units that people confuse, metres per unit.
_UNITS = ((1e-3, "millimetres"), (1e-2, "centimetres"), (0.0254, "inches"))
_UNIT_TOLERANCE = 0.1
# Poses that fit to this share of the scene's length have the right rotations.
_RIGHT = 0.02
# Any mirror: which one is up to the unknown frames.
_MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])


@dataclass(frozen=True, slots=True)
class Reading:
    """One way to read the poses, solved for most of them.

    Attributes:
        key: "stated", "inverted", "later", "earlier", "scaled", or "transposed" or
            "left-handed" with the side.
        meaning: What would be the case.
        position: Median position residual, metres.
        angle: Median orientation residual, radians.
        misfit: Both as one length, metres: an angle counts by the scene's length.
        scale: Metres per unit of the observed translations.
    """

    key: str
    meaning: str
    position: float
    angle: float
    misfit: float
    scale: float


def solve_readings(
    solution: PoseSolution, pairs: PosePairs, seed: int = 0
) -> tuple[Reading, ...]:
    """Solve the stated reading and the others alike.

    Args:
        solution: Of the stated reading; brings paired poses on one clock.
        pairs: What was stated.
        seed: Of the random samples.
    """
    a, b = np.array(solution.base_from_flange), np.array(solution.b)
    other_mounting, other_robot, other_observed = _opposites(pairs)
    free = not pairs.metric
    # What the whole fit found for the stated reading counts, if it is better.
    stated = min(
        _read("stated", "as stated", a, b, seed, free),
        _reading("stated", "as stated", a, b, solution.x, solution.z, solution.scale),
        key=lambda one: one.misfit,
    )
    found = [
        stated,
        _read(
            "inverted",
            f'robot poses are "{other_robot}", or observed ones "{other_observed}", or '
            f'the mounting is "{other_mounting}" (these three give the same equation)',
            a,
            se3_inverse(b),
            seed,
            free,
        ),
    ]
    if not pairs.timed and len(a) > 3:
        found += [
            _read(
                "later",
                "each observed pose belongs to the robot pose after it",
                a[1:],
                b[:-1],
                seed,
                free,
            ),
            _read(
                "earlier",
                "each observed pose belongs to the robot pose before it",
                a[:-1],
                b[1:],
                seed,
                free,
            ),
        ]
    if stated.misfit > _RIGHT * scene_length(a):
        others = (
            _read(key, meaning, left, right, seed, free)
            for key, meaning, left, right in _other_rotations(a, b, pairs)
        )
        found += [one for one in others if one.misfit <= _RIGHT * scene_length(a)]
    if pairs.metric:
        scaled = _read("scaled", "", a, b, seed, free_scale=True)
        found.append(
            Reading(
                scaled.key,
                _unit(scaled.scale),
                scaled.position,
                scaled.angle,
                scaled.misfit,
                scaled.scale,
            )
        )
    return tuple(found)


def free_scale_of(solution: PoseSolution) -> tuple[float, float]:
    """Metres of the robot per metre of the camera, and its standard deviation.

    The poses used are fitted once more with that factor free, the noise held.

    Args:
        solution: A solution in metres by maximum likelihood.
    """
    eye_in_hand = solution.names[0] == "flange_from_camera"
    used = solution.used
    b = np.array(solution.b[used])
    data = PoseInput(
        np.array(solution.base_from_flange[used]),
        se3_inverse(b) if eye_in_hand else b,
        eye_in_hand,
        free_scale=True,
    )
    fit = fit_poses(data, solution.x.matrix, solution.z.matrix, noise=solution.noise)
    if len(fit.undetermined) and np.abs(fit.undetermined[:, 12]).max() > 0.5:
        return fit.scale, np.inf
    # Residuals larger than the noise make every figure less certain.
    excess = max(1.0, fit.chi2 / fit.dof) if fit.dof else 1.0
    return fit.scale, float(fit.scale * np.sqrt(excess * fit.covariance[12, 12]))


def _read(
    key: str, meaning: str, a: Floats, b: Floats, seed: int, free_scale: bool
) -> Reading:
    found = find_start(a, b, free_scale=free_scale, seed=seed)
    scaled = np.array(b)
    scaled[:, :3, 3] *= found.scale
    return _reading(key, meaning, a, scaled, SE3(found.x), SE3(found.z), found.scale)


def _reading(
    key: str, meaning: str, a: Floats, b: Floats, x: SE3, z: SE3, scale: float
) -> Reading:
    apart, turned = residuals_of(a, b, x, z)
    misfits = np.hypot(apart, scene_length(a) * turned)
    return Reading(
        key,
        meaning,
        float(np.median(apart)),
        float(np.median(turned)),
        float(np.median(misfits)),
        scale,
    )


def _other_rotations(
    a: Floats, b: Floats, pairs: PosePairs
) -> list[tuple[str, str, Floats, Floats]]:
    """Key, meaning and poses of readings with other rotations at the same places."""
    robot = _transposed(a, pairs.robot_direction == "base_in_flange")
    inverse = pairs.mounting == "eye_in_hand"
    observed = _transposed(
        b, inverse == (pairs.observed_direction == "target_in_camera")
    )
    wrong = "rotations are transposed (written column by column, or of the inverse)"
    return [
        ("transposed robot", f"the robot poses' {wrong}", robot, b),
        ("transposed observed", f"the observed poses' {wrong}", a, observed),
        ("transposed both", f"both sides' {wrong}", robot, observed),
        (
            "left-handed side",
            "the frames of one side, robot or observed, are left-handed",
            a,
            _MIRROR @ b @ _MIRROR,
        ),
    ]


def _transposed(poses: Floats, inverse: bool) -> Floats:
    """Poses whose file holds transposed rotations; whether it holds their inverses."""
    given = se3_inverse(poses) if inverse else np.array(poses)
    given[:, :3, :3] = np.swapaxes(given[:, :3, :3], 1, 2).copy()
    return se3_inverse(given) if inverse else given


def _opposites(pairs: PosePairs) -> tuple[str, str, str]:
    return (
        "eye_to_hand" if pairs.mounting == "eye_in_hand" else "eye_in_hand",
        "base_in_flange"
        if pairs.robot_direction == "flange_in_base"
        else "flange_in_base",
        "camera_in_target"
        if pairs.observed_direction == "target_in_camera"
        else "target_in_camera",
    )


def _unit(scale: float) -> str:
    """What a factor between both sides' lengths could mean."""
    for factor, name in _UNITS:
        if abs(scale / factor - 1) < _UNIT_TOLERANCE:
            return f"observed translations are {name} beside robot metres"
        if abs(scale * factor - 1) < _UNIT_TOLERANCE:
            return f"robot translations are {name} beside observed metres"
    return f"one observed unit is {scale:.6g} of the robot's"
