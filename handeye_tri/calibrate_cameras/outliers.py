"""Half-turns that are none: found by consensus, named, and told why.

Up to a quarter of the half-turns may be bad: a wrong point, exchanged labels, a
repeated image, a turn by another angle. (1) Each half-turn's own homography: does any
plane fit? (2) The conic that the best three quarters agree on, by least trimmed squares
(Rousseeuw 1984, doi:10.1080/01621459.1984.10477105) from random subsets. (3) Maximum
likelihood on those, and a chi-square test of every half-turn against it, which the
camera's own uncertainty is part of; repeated until nothing changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri

from handeye_tri.calibrate_cameras.closed_form import NOMINAL_FOCAL
from handeye_tri.calibrate_cameras.degeneracy import is_turn, least_noise
from handeye_tri.calibrate_cameras.extrinsics import poses_from_homographies
from handeye_tri.calibrate_cameras.half_turns import HalfTurnData
from handeye_tri.calibrate_cameras.homography import (
    Homographies,
    OMode,
    conic_constraints,
    constraint_covariance,
    fit_homographies,
)
from handeye_tri.calibrate_cameras.least_squares import NormalEquations, minimise
from handeye_tri.calibrate_cameras.refine import HalfTurnModel, State
from handeye_tri.calibrate_cameras.special_motion import (
    intrinsics_from_conic,
    solve_conic,
)
from handeye_tri.errors import DegenerateMotionError

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

# Part of the half-turns that must agree.
_MAJORITY = 0.75
_SUBSETS = 60
# Chance that a good half-turn is dropped, if noise is normal and as stated.
_CHANCE = 1e-4
# Observations of a half-turn less its pose, camera and O being known.
_FREEDOM = 6
# Of a median of chi-squares of that freedom against their mean.
_MEDIAN_EFFICIENCY = 0.58
# Standard deviations of that median by which stated noise is contradicted.
_CONTRADICTION = 2.33
# Part of a residual's variance that is taken to be left at least.
_LEAST_LEFT = 1e-3
# Variance over what was stated beyond which nothing has been agreed upon.
_MAX_SCALE = 1e4

Build = Callable[[HalfTurnData, Indices], HalfTurnModel]


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """What the good half-turns agree on.

    Attributes:
        kept: Rows of the half-turns that agree.
        lost: Rows of the others.
        state: Camera, poses and O from those kept.
        scale: Factor by which the noise exceeds what was stated, squared.
        votes: Half-turns that this factor was estimated from, none where the noise
            is as stated.
    """

    kept: Indices
    lost: Indices
    state: State
    scale: float
    votes: int

    def limit(self, freedom: int) -> float:
        """Largest chi-square of that freedom that a good half-turn may have."""
        return float(_limits(np.array([freedom]), self.scale, self.votes)[0])


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
    freedom = _FREEDOM - 2.0 * data.about_normal[sound] * (o_mode == "free")
    core = np.sort(sound[_trimmed(joined(each), basis, least)])
    kept = core
    for _ in range(8):
        part = data.take(kept)
        model = build(part, kept)
        state = solve(model, fit_homographies(part, o_mode, o))
        square = _misfits(data, build, sound, each, model, state, kept)
        # The core is the best part, at worst: its median is no median of them all.
        expected = chdtri(freedom, 1.0 - 0.5 * _MAJORITY)
        typical = float(np.median((square / expected)[np.isin(sound, core)]))
        scale, votes = _noise(typical, len(core), noise_known)
        excess = square / _limits(freedom, scale, votes)
        good = sound[excess <= 1.0]
        if len(good) < least:
            good = np.sort(sound[np.argsort(excess)[:least]])
        if np.array_equal(good, kept):
            break
        kept = good
    if noise_known and scale > _MAX_SCALE:
        raise _no_majority(n, int((square <= chdtri(freedom, _CHANCE)).sum()))
    lost = np.setdiff1d(np.arange(n), kept)
    return Consensus(kept, lost, state, scale, votes)


def _noise(typical: float, votes: int, noise_known: bool) -> tuple[float, int]:
    """By how much the noise exceeds what was stated, and how many say so.

    Noise that was stated is believed unless the half-turns contradict it: their
    median is more than chance makes it in 1 of 100 data sets.

    Args:
        typical: Median chi-square of the half-turns over what is expected.
        votes: How many half-turns that is the median of.
        noise_known: Whether the noise was stated at all.
    """
    if not noise_known:
        return max(typical, least_noise(0.0, noise_known)), votes
    spread = np.sqrt(2.0 / (_MEDIAN_EFFICIENCY * _FREEDOM * votes))
    return (1.0, 0) if typical <= 1.0 + _CONTRADICTION * spread else (typical, votes)


def _limits(freedom: Floats, scale: float, votes: int) -> Floats:
    """Largest chi-squares that good half-turns may have.

    Chi-square's own limit where the noise is as stated; where it is more, Fisher's F,
    since by how much is itself estimated, by a median.

    Args:
        freedom: Of each chi-square, any shape.
        scale: Factor by which the noise exceeds what was stated, squared.
        votes: Half-turns that this factor was estimated from, none where the noise
            is as stated.
    """
    if votes == 0:
        return np.asarray(chdtri(freedom, _CHANCE))
    known = _MEDIAN_EFFICIENCY * _FREEDOM * votes
    return np.asarray(scale * freedom * fdtri(freedom, known, 1.0 - _CHANCE))


def _no_majority(n: int, count: int) -> DegenerateMotionError:
    return DegenerateMotionError(
        f"only {count} of {n} half-turns agree with each other, and rejection needs "
        f"{int(np.ceil(_MAJORITY * n))}: check the axis, the triangle, the order of A, "
        "B, C and which images belong together"
    )


def own_homography(data: HalfTurnData, o: Floats | None) -> Homographies | None:
    """The homography of one half-turn alone, None where there is none.

    Args:
        data: That half-turn.
        o: The foot of a normal axis, shape (2,), metres; None where it is not known.
    """
    try:
        return fit_homographies(data, "free" if o is None else "known", o)
    except (DegenerateMotionError, np.linalg.LinAlgError):
        return None


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


def _misfits(
    data: HalfTurnData,
    build: Build,
    rows: Indices,
    each: list[Homographies],
    model: HalfTurnModel,
    state: State,
    kept: Indices,
) -> Floats:
    """Chi-square of each of the rows against what the others say, shape (r,).

    The residuals of a row that the camera and O were estimated from are smaller than
    those against an estimate without it: they spread by I - L S L', those of the other
    rows by I + L S L', with S the covariance of camera and O and L their effect. So
    weighed, either is the chi-square of the row against an estimate without it.
    """
    whole = build(data.take(rows), rows)
    fitted = fit_poses(whole, joined(each), state)
    if fitted is None:
        raise _no_majority(len(data), 0)
    blocks, known = whole.evaluate(fitted), model.evaluate(state)
    assert blocks is not None
    assert known is not None
    information = NormalEquations.of(known).reduced()
    spread = np.linalg.pinv(information, hermitian=True, rcond=1e-12)
    # What of the camera's change a pose cannot take up.
    pose = np.linalg.pinv(blocks.own)
    left = blocks.shared - blocks.own @ (pose @ blocks.shared)
    sign = np.where(np.isin(rows, kept), -1.0, 1.0)[:, None, None]
    # Where the camera hangs on one row alone, nothing else can judge it.
    unit = (1.0 + _LEAST_LEFT) * np.eye(blocks.residuals.shape[1])
    wide = unit + sign * (left @ spread @ np.swapaxes(left, 1, 2))
    solved = np.linalg.solve(wide, blocks.residuals[..., None])[..., 0]
    return np.asarray((blocks.residuals * solved).sum(axis=1))


def joined(each: list[Homographies]) -> Homographies:
    """Homographies of single half-turns as those of many."""
    return replace(
        each[0],
        matrix=np.concatenate([one.matrix for one in each]),
        covariance=np.concatenate([one.covariance for one in each]),
        o=np.concatenate([one.o for one in each]),
    )


def fit_poses(
    model: HalfTurnModel, homographies: Homographies, state: State
) -> State | None:
    """Poses of half-turns before a known camera; None where one is behind it.

    Args:
        model: Of these half-turns.
        homographies: One each, to start from.
        state: Camera, lens and O; its poses are not read.
    """
    fx, fy, skew, cx, cy = state.intrinsics
    k = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    n = len(model.data)
    start = replace(
        state,
        poses=poses_from_homographies(k, homographies, model.data.triangle),
        o=homographies.o if model.free_o else np.tile(state.o[0], (n, 1)),
        turn=np.zeros((n, model.turn_unknowns)),
    )
    fixed = model.with_camera_known()
    end = minimise(fixed.evaluate, fixed.retract, start, 1e-9, max_iterations=60)
    return None if end is None else end.state
