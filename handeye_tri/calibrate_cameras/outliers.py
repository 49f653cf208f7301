"""Half-turns that are none: found by consensus, named, and told why.

Up to a quarter of the half-turns may be bad: a wrong point, exchanged labels, a
repeated image, a turn by another angle. (1) Each half-turn's own homography: does any
plane fit? (2) The conic that the best three quarters agree on, by least trimmed squares
(Rousseeuw 1984, doi:10.1080/01621459.1984.10477105) from random subsets. (3) Maximum
likelihood on those, and a test of every half-turn against it (:mod:`outlier_tests`),
which the camera's own uncertainty is part of; repeated until nothing changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from handeye_tri.calibrate_cameras.closed_form import NOMINAL_FOCAL
from handeye_tri.calibrate_cameras.degeneracy import is_turn
from handeye_tri.calibrate_cameras.half_turns import HalfTurnData
from handeye_tri.calibrate_cameras.homography import (
    Homographies,
    OMode,
    conic_constraints,
    constraint_covariance,
    fit_homographies,
)
from handeye_tri.calibrate_cameras.known_camera import (
    Build,
    build_of,
    fit_poses,
    joined,
    own_homography,
)
from handeye_tri.calibrate_cameras.least_squares import NormalEquations
from handeye_tri.calibrate_cameras.outlier_tests import (
    CHANCE,
    FREEDOM,
    TESTS,
    TURN_FREEDOM,
    Noise,
    discovered,
    left_over,
)
from handeye_tri.calibrate_cameras.refine import HalfTurnModel, State
from handeye_tri.calibrate_cameras.special_motion import (
    intrinsics_from_conic,
    solve_conic,
)
from handeye_tri.calibrate_cameras.turn_angle import other_turns
from handeye_tri.errors import DegenerateMotionError

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

# Part of the half-turns that must agree.
_MAJORITY = 0.75
_SUBSETS = 60
# Variance over what was stated beyond which nothing has been agreed upon.
_MAX_SCALE = 1e4


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """What the good half-turns agree on.

    Attributes:
        kept: Rows of the half-turns that agree.
        lost: Rows of the others.
        state: Camera, poses and O from those kept.
        spread: Covariance of camera and O where noise is as stated, shape (g, g).
        noise: How large it is.
    """

    kept: Indices
    lost: Indices
    state: State
    spread: Floats
    noise: Noise


def find_consensus(
    data: HalfTurnData,
    build: Build,
    solve: Callable[[HalfTurnModel, Homographies], State],
    basis: Floats,
    o_mode: OMode,
    o: Floats | None,
    noise_known: bool,
) -> Consensus:
    """Find the half-turns that one camera explains.

    Args:
        data: All half-turns.
        build: Makes the model of some rows of them.
        solve: Maximum likelihood of such a model, from its homographies.
        basis: Of the conics to choose from, shape (6, k).
        o_mode: How the foot of a normal axis is treated.
        o: The known foot, shape (2,), metres; else None.
        noise_known: Whether the data's whiteners are absolute.

    Raises:
        DegenerateMotionError: fewer than three quarters agree on anything.
    """
    n = len(data)
    bends = bool(build(data, np.arange(n)).lens)
    found = [own_homography(data.take([i]), o) for i in range(n)]
    fits = {
        i: one
        for i, one in enumerate(found)
        if one is not None
        and is_turn(data.take([i]), one.residual_px, lens_ahead=bends).all()
    }
    sound, each = np.array(list(fits), dtype=np.intp), list(fits.values())
    least = int(np.ceil(_MAJORITY * n))
    if len(sound) < least:
        raise _no_majority(n, len(sound))
    freedom = FREEDOM - 2.0 * data.about_normal[sound] * (o_mode == "free")

    def agreed(rows: Indices) -> tuple[State, Floats]:
        """Camera, poses and O from these rows; covariance of camera and O."""
        part = data.take(rows)
        model = build(part, rows)
        state = solve(model, fit_homographies(part, o_mode, o))
        blocks = model.evaluate(state)
        assert blocks is not None
        information = NormalEquations.of(blocks).reduced()
        return state, np.asarray(
            np.linalg.pinv(information, hermitian=True, rcond=1e-12)
        )

    def gained(i: int, kept: Indices, judge: tuple[State, Floats]) -> float:
        """What another turn explains of a half-turn, chi-square, as the others say."""
        row = sound[i : i + 1]
        if row[0] in kept:
            try:
                judge = agreed(np.setdiff1d(kept, row))
            except DegenerateMotionError:
                # The others alone determine no camera, so that they cannot judge.
                return 0.0
        return gain_of_another_turn(
            data.take(row), build_of(build, row), each[i], *judge
        )

    def bad(chance: Floats) -> NDArray[np.bool_]:
        """Which of those with a plane are bad, by the lowest chance of their tests.

        Of several tests the lowest chance is as many times as likely.
        """
        no_plane = np.zeros(n - len(sound))
        return discovered(np.concatenate([TESTS * chance, no_plane]))[: len(sound)]

    core = np.sort(sound[_trimmed(joined(each), basis, least)])
    kept = core
    for _ in range(8):
        state, spread = agreed(kept)
        whole = build(data.take(sound), sound)
        fitted = fit_poses(whole, joined(each), state)
        if fitted is None:
            raise _no_majority(n, 0)
        sign = np.where(np.isin(sound, kept), -1.0, 1.0)
        left = left_over(whole, fitted, spread, sign)
        square = left.square
        # The core is the best part, at worst: its median is no median of them all.
        expected = chdtri(freedom, 1.0 - 0.5 * _MAJORITY)
        typical = float(np.median((square / expected)[np.isin(sound, core)]))
        noise = Noise.of(typical, len(core), noise_known)
        chance = np.minimum(
            noise.chances(square, freedom),
            noise.chances(left.by_angle, np.ones(len(sound))),
        )
        # What another turn gains is a part of what is left over: it decides only on
        # those that would be dropped if it were all of it, and are not without it.
        most = noise.chances(square, np.full(len(sound), TURN_FREEDOM))
        dropped = bad(chance)
        for i in np.flatnonzero(bad(np.minimum(chance, most)) & ~dropped).tolist():
            gain = gained(i, kept, (state, spread))
            other = noise.chances(np.array(gain), np.array(TURN_FREEDOM))
            chance[i] = min(chance[i], float(other))
        dropped = bad(chance)
        good = sound[~dropped]
        if len(good) < least:
            order = np.lexsort((square / freedom, -chance))
            good = np.sort(sound[order[:least]])
        if np.array_equal(good, kept):
            break
        kept = good
    if noise_known and noise.scale > _MAX_SCALE:
        raise _no_majority(n, int((square <= chdtri(freedom, CHANCE)).sum()))
    lost = np.setdiff1d(np.arange(n), kept)
    return Consensus(kept, lost, state, spread, noise)


def gain_of_another_turn(
    data: HalfTurnData, build: Build, own: Homographies, state: State, spread: Floats
) -> float:
    """By how much a turn by another angle explains a half-turn better, chi-square.

    Args:
        data: That half-turn alone.
        build: Makes the model of copies of it.
        own: Its own homography, to start from.
        state: Camera, lens and O of the others.
        spread: Covariance of camera and O, shape (g, g).
    """
    model = build(data, np.zeros(1, dtype=np.intp))
    fitted = fit_poses(model, own, state)
    if fitted is None:
        return 0.0
    square = float(left_over(model, fitted, spread, np.ones(1)).square[0])
    turns = other_turns(data, build, state, spread)
    return max(square - min((turn.square for turn in turns), default=square), 0.0)


def _no_majority(n: int, count: int) -> DegenerateMotionError:
    return DegenerateMotionError(
        f"only {count} of {n} half-turns agree with each other, and rejection needs "
        f"{int(np.ceil(_MAJORITY * n))}: check the axis, the triangle, the order of A, "
        "B, C and which images belong together"
    )


def _trimmed(joined: Homographies, basis: Floats, least: int) -> Indices:
    """The homographies that agree best on one conic."""
    count = len(joined.matrix)
    rows = conic_constraints(joined.matrix)
    w = 1.0 / NOMINAL_FOCAL**2
    nominal = np.array([w, 0.0, w, 0.0, 0.0, 1.0])

    def solution(chosen: Indices, b: Floats) -> Floats | None:
        spread = constraint_covariance(joined, b)[chosen]
        whitened = np.linalg.solve(np.linalg.cholesky(spread), rows[chosen])
        b = solve_conic(whitened.reshape(-1, 6), basis)[0]
        try:
            intrinsics_from_conic(b)
        except (DegenerateMotionError, np.linalg.LinAlgError):
            return None
        return b

    def misfit(b: Floats) -> Floats:
        missed = rows @ b
        spread = constraint_covariance(joined, b)
        solved = np.linalg.solve(spread, missed[..., None])[..., 0]
        return np.asarray((missed * solved).sum(axis=1))

    rng = np.random.default_rng(0)
    size = min(max(3, (basis.shape[1] + 1) // 2 + 1), count)
    best: Indices = np.arange(least)
    lowest = np.inf
    for _ in range(_SUBSETS):
        chosen = rng.choice(count, size, replace=False)
        b = solution(chosen, nominal)
        for _ in range(3):
            if b is None:
                break
            square = misfit(b)
            order = np.argsort(square)[:least]
            score = float(square[order].sum())
            if score < lowest:
                best, lowest = order, score
            b = solution(order, b)
    return best
