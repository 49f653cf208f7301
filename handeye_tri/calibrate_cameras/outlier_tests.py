"""Whether a half-turn is one, judged by what the others say of the camera.

Three tests of each: chi-square of all that is left over, of six degrees of freedom; the
score of a turn by another angle near 180 degrees, of one, which finds what is lost
among six; and what any other turn gains (:mod:`turn_angle`), which from another of the
places that three points are seen alike from can look like a half-turn. What is bad is
decided for all half-turns at once, by the false discovery rate (Benjamini and Hochberg
1995, doi:10.1111/j.2517-6161.1995.tb02031.x).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri, fdtrc, fdtri

from handeye_tri.calibrate_cameras.degeneracy import least_noise
from handeye_tri.calibrate_cameras.refine import HalfTurnModel, State

Floats = NDArray[np.float64]

# Part of what is dropped that is good, on average, if noise is normal and as stated;
# of good half-turns alone, the chance that any of them is dropped.
FALSE_DISCOVERIES = 2e-3
# Chance that what truly happened is not believed, for what it leaves unexplained.
CHANCE = 1e-4
# Observations of a half-turn less its pose, camera and O being known.
FREEDOM = 6
# Tests of each half-turn; the lowest of their chances is as likely so many times.
TESTS = 3
# Of what another turn gains. Turns near one of the places are a line at a distance d
# from the half-turn, in units of noise; noise x along d, y along the line gains
# 2 d x - d^2 + y^2, at most x^2 + y^2, whatever d is.
TURN_FREEDOM = 2.0
# Of a median of chi-squares of that freedom against their mean.
_MEDIAN_EFFICIENCY = 0.58
# Standard deviations of that median by which stated noise is contradicted.
_CONTRADICTION = 3.09
# Part of a derivative's square below which the pose takes up all of it.
_TAKEN_UP = 1e-9
# Part of a residual's variance that is taken to be left at least.
_LEAST_LEFT = 1e-3


@dataclass(frozen=True, slots=True)
class Noise:
    """How large the noise is.

    Attributes:
        scale: Factor by which it exceeds what was stated, squared.
        votes: Half-turns that this factor was estimated from, by a median; none where
            the noise is as stated.
    """

    scale: float
    votes: int

    @classmethod
    def of(cls, typical: float, votes: int, stated: bool) -> Noise:
        """From the half-turns that agree.

        Noise that was stated is believed unless the half-turns contradict it: their
        median is more than chance makes it in 1 of 1000 data sets.

        Args:
            typical: Their median chi-square over what is expected.
            votes: How many they are.
            stated: Whether the noise was stated at all.
        """
        if not stated:
            return cls(max(typical, least_noise(0.0, stated)), votes)
        spread = np.sqrt(2.0 / (_MEDIAN_EFFICIENCY * FREEDOM * votes))
        if typical <= 1.0 + _CONTRADICTION * spread:
            return cls(1.0, 0)
        return cls(typical, votes)

    @property
    def _freedom(self) -> float:
        """Of the chi-square that the factor is, where it is estimated."""
        return _MEDIAN_EFFICIENCY * FREEDOM * self.votes

    def chances(self, square: Floats, freedom: Floats) -> Floats:
        """Chances that noise makes chi-squares as large.

        Chi-square's own tail where the noise is as stated, else that of Fisher's F.

        Args:
            square: The chi-squares, any shape.
            freedom: Of each, the same shape.
        """
        if self.votes == 0:
            return np.asarray(chdtrc(freedom, square))
        return np.asarray(fdtrc(freedom, self._freedom, square / self.scale / freedom))

    def limit(self, freedom: int) -> float:
        """Largest chi-square of that freedom that leaves nothing to explain."""
        if self.votes == 0:
            return float(chdtri(freedom, CHANCE))
        f = float(fdtri(freedom, self._freedom, 1.0 - CHANCE))
        return self.scale * freedom * f


@dataclass(frozen=True, slots=True, eq=False)
class LeftOver:
    """What r half-turns leave unexplained before a camera that others calibrated.

    Attributes:
        square: Chi-square of each, shape (r,).
        by_angle: Part of it that a small change of the turn's angle would explain
            (Rao's score test, one degree of freedom), shape (r,).
        change: That change to first order, shape (r,), radians; 0 where the pose
            explains all that the angle could.
        sigma: Its standard deviation where noise is as stated; then infinite.
    """

    square: Floats
    by_angle: Floats
    change: Floats
    sigma: Floats


def left_over(
    model: HalfTurnModel, state: State, spread: Floats, sign: Floats
) -> LeftOver:
    """Judge half-turns by what the others say of the camera.

    The residuals of a row that the camera and O were estimated from are smaller than
    those against an estimate without it: they spread by I - L S L', those of the other
    rows by I + L S L', with S the covariance of camera and O and L their effect. So
    weighed, either is the chi-square of the row against an estimate without it.

    Args:
        model: Of the r half-turns.
        state: The camera, and poses that fit best before it.
        spread: Covariance of camera and O, shape (g, g), where a model of few
            half-turns may have no O.
        sign: -1.0 for each that the camera was estimated from, else 1.0, shape (r,).
    """
    blocks = model.evaluate(state)
    assert blocks is not None
    shared = blocks.shared.shape[-1]
    # What of the camera's change, and of the angle's, a pose cannot take up.
    angle = model.by_angle(state, blocks)
    both = np.concatenate([blocks.shared, angle[..., None]], axis=-1)
    rest = both - blocks.own @ (np.linalg.pinv(blocks.own) @ both)
    left, turned = rest[..., :-1], rest[..., -1]
    # Where the camera hangs on one row alone, nothing else can judge it.
    unit = (1.0 + _LEAST_LEFT) * np.eye(blocks.residuals.shape[1])
    around = left @ spread[:shared, :shared] @ np.swapaxes(left, 1, 2)
    wide = unit + sign[:, None, None] * around
    right = np.stack([blocks.residuals, turned], axis=-1)
    solved = np.linalg.solve(wide, right)
    product = np.swapaxes(right, 1, 2) @ solved
    square, slope, steep = product[:, 0, 0], product[:, 0, 1], product[:, 1, 1]
    seen = steep > _TAKEN_UP * (angle**2).sum(axis=1)
    steep = np.where(seen, steep, np.inf)
    sigma = np.where(seen, 1.0 / np.sqrt(steep), np.inf)
    return LeftOver(square, slope**2 / steep, -slope / steep, sigma)


def discovered(chance: Floats) -> NDArray[np.bool_]:
    """Which of n half-turns are bad (Benjamini and Hochberg 1995).

    The k least likely, for the largest k for which each of them has a chance of no more
    than k / n of the rate: where others are bad already, less is needed of the next.

    Args:
        chance: That noise makes each half-turn look as bad, shape (n,).
    """
    n = len(chance)
    allowed = FALSE_DISCOVERIES * np.arange(1, n + 1) / n
    below = np.flatnonzero(np.sort(chance) <= allowed)
    return np.asarray(chance <= (allowed[below[-1]] if len(below) else -1.0))
