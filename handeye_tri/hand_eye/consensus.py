"""Starts for AX = ZB that wrong poses cannot spoil: random samples of three poses.

Fischler and Bolles 1981 (doi:10.1145/358669.358692): solve from as few poses as will
do, keep what most poses agree with. No threshold is asked for. With m poses within a
radius r of a hypothesis and the others anywhere within the radius R of the scene, the
description length of all residuals is (6 m - 12) log r + 6 (n - m) log R up to
constants; the best m is taken for each hypothesis, and the shortest wins (as in
a-contrario RANSAC, Moisan and Stival 2004, doi:10.1023/B:VISI.0000013094.38752.0a).
Where the right poses turn about one direction only, no sample of them tells all turns:
samples are then solved for such turns, and the shorter description decides which.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.hand_eye.few_axes import rotations_of_few_axes, turns_are_few
from handeye_tri.se3 import nearest_rotation

Floats = NDArray[np.float64]

# With 30 % of wrong poses 34 % of the samples are good, with half of them 12 %: the
# chance that not one of 300 is good is below 1e-16.
_SAMPLES = 300
# Hypotheses that are improved on the poses they agree with, and how often.
_IMPROVED = 12
_ROUNDS = 5
# Poses are scored on at most this many, evenly spread: bounds the cost of streams.
_SCORED = 200
# Poses within this many of the agreeing poses' own RMS residuals agree.
_REACH = 3.0
# Shifts along directions told by less than this share of the best told one (turns of a
# milliradian beside turns of a radian) are left at zero: a start must stay in the cell.
_LEAST_TOLD = 1e-6
# A scale stays 1 where shifts explain all but this share of b's places (turns on the
# spot, where only noise is left), or what is left on both sides hardly correlates.
_SCALE_TOLD = 1e-4
_ALIKE = 0.5
# Residuals below this share of the scene are rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """What most poses agree on.

    Attributes:
        x: Shape (4, 4).
        z: Shape (4, 4).
        scale: Metres per unit of b's translations; 1 where it was not asked for.
        agreeing: Whether each pose agrees, shape (n,).
        description: Its length, in units of information; comparable between solutions
            of the same poses.
        few_axes: Whether it takes the turns to be about one direction or none; what
            the poses leave open is then as short as can be.
    """

    x: Floats
    z: Floats
    scale: float
    agreeing: NDArray[np.bool_]
    description: float
    few_axes: bool


def find_start(
    a: Floats, b: Floats, *, free_scale: bool = False, seed: int = 0
) -> Consensus:
    """What most poses agree on, whether they turn about several directions or few.

    Args:
        a: Shape (n, 4, 4), n >= 3.
        b: Shape (n, 4, 4).
        free_scale: Whether b's translations have a unit of their own.
        seed: Of the random samples; the same seed gives the same result.
    """
    several, few = (
        find_consensus(a, b, free_scale=free_scale, seed=seed, few_axes=few_axes)
        for few_axes in (False, True)
    )
    best = min(several, few, key=lambda one: one.description)
    # Only among the poses that agree do turns, and does a misfit tell the noise.
    right = best.agreeing
    return few if turns_are_few(a[right], b[right], best.x, best.z) else several


def find_consensus(
    a: Floats,
    b: Floats,
    *,
    free_scale: bool = False,
    seed: int = 0,
    few_axes: bool = False,
) -> Consensus:
    """Solve ``a_i X = Z b_i`` for most of the poses; up to half may be wrong.

    Args:
        a: Shape (n, 4, 4), n >= 3.
        b: Shape (n, 4, 4).
        free_scale: Whether b's translations have a unit of their own.
        seed: Of the random samples; the same seed gives the same result.
        few_axes: Whether all turns are about one direction, or there are none.
    """
    n = len(a)
    rng = np.random.default_rng(seed)
    picked = np.unique(np.linspace(0, n - 1, min(n, _SCORED)).round().astype(int))
    scored_a, scored_b = a[picked], b[picked]
    length = scene_length(a)
    samples = rng.random((_SAMPLES, n)).argpartition(2, axis=1)[:, :3]
    x, z, scale = solve_samples(
        a[samples], b[samples], np.ones(samples.shape), free_scale, few_axes
    )
    # All poses together are one more hypothesis: the best where none is wrong.
    hypotheses = [
        np.concatenate([one, other])
        for one, other in zip(
            (x, z, scale),
            solve_samples(a[None], b[None], np.ones((1, n)), free_scale, few_axes),
            strict=True,
        )
    ]
    scores, radii = _lengths(scored_a, scored_b, hypotheses, length)
    best = np.argsort(scores)[:_IMPROVED]
    hypotheses = [part[best] for part in hypotheses]
    scores, radii = scores[best], radii[best]
    for _ in range(_ROUNDS):
        weights = _residuals(scored_a, scored_b, hypotheses, length) <= radii[:, None]
        shape = (len(best), len(picked), 4, 4)
        improved = solve_samples(
            np.broadcast_to(scored_a, shape),
            np.broadcast_to(scored_b, shape),
            weights.astype(float),
            free_scale,
            few_axes,
        )
        again, reach = _lengths(scored_a, scored_b, list(improved), length)
        better = again < scores
        for part, new in zip(hypotheses, improved, strict=True):
            part[better] = new[better]
        scores = np.where(better, again, scores)
        radii = np.where(better, reach, radii)
        if not better.any():
            break
    winner = int(np.argmin(scores))
    chosen = [part[winner : winner + 1] for part in hypotheses]
    agreeing = _residuals(a, b, chosen, length)[0] <= radii[winner]
    return Consensus(
        chosen[0][0],
        chosen[1][0],
        float(chosen[2][0]),
        agreeing,
        float(scores[winner]),
        few_axes,
    )


def scene_length(a: Floats) -> float:
    """Typical distance between positions, metres: what a radian is worth.

    Args:
        a: Poses, shape (n, 4, 4).
    """
    positions = a[:, :3, 3]
    around = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    # A flange that turns on the spot still has an arm's length; where all is at the
    # origin any length will do.
    reach = 0.1 * np.linalg.norm(positions, axis=1).max()
    return float(max(np.median(around), reach)) or 1.0


def solve_samples(
    a: Floats,
    b: Floats,
    weights: Floats,
    free_scale: bool = False,
    few_axes: bool = False,
) -> tuple[Floats, Floats, Floats]:
    """Rotations, then translations, for many samples at once, scale on request.

    Args:
        a: Shape (h, k, 4, 4): k poses for each of h samples.
        b: Shape (h, k, 4, 4).
        weights: Shape (h, k), not negative.
        free_scale: Whether a factor on b's translations is solved for.
        few_axes: Whether all turns are about one direction, or there are none.

    Returns:
        X and Z, shape (h, 4, 4) each, and the factors, shape (h,), 1 where nothing
        tells them. A sample that determines nothing gives some motion: score it.
    """
    h = len(weights)
    solve = rotations_of_few_axes if few_axes else _rotations
    rx, rz = solve(a, b, weights)
    ra, ta = a[..., :3, :3], a[..., :3, 3]
    turned = b[..., :3, 3] @ np.swapaxes(rz, 1, 2)
    total, weighted = weights.sum(axis=1), weights[..., None, None] * ra
    # R_A t_X - t_Z = f R_Z t_B - t_A, by normal equations in (t_X, t_Z).
    normal = np.zeros((h, 6, 6))
    normal[:, :3, :3] = normal[:, 3:, 3:] = total[:, None, None] * np.eye(3)
    normal[:, :3, 3:] = -np.swapaxes(weighted.sum(axis=1), 1, 2)
    normal[:, 3:, :3] = np.swapaxes(normal[:, :3, 3:], 1, 2)
    inverse = np.linalg.pinv(normal, rcond=_LEAST_TOLD, hermitian=True)

    def explained(places: Floats) -> tuple[Floats, Floats]:
        """Shifts (h, 6) by which both sides' frames explain places, and the rest."""
        right = np.concatenate(
            [
                np.einsum("hkab,hka->hb", weighted, places),
                -np.einsum("hk,hka->ha", weights, places),
            ],
            axis=1,
        )
        shifts = (inverse @ right[..., None])[..., 0]
        moved = np.einsum("hkab,hb->hka", ra, shifts[:, :3]) - shifts[:, None, 3:]
        return shifts, places - moved

    shifts_a, rest_a = explained(ta)
    shifts_b, rest_b = explained(turned)
    scale = np.ones(h)
    if free_scale:
        # The factor is told by what shifts leave of the places on both sides.
        centre = np.einsum("hk,hka->ha", weights, turned)
        centre /= np.maximum(total, 1e-300)[:, None]
        away = turned - centre[:, None]
        spread, left_b, left_a, along = (
            np.einsum("hk,hka,hka->h", weights, one, other)
            for one, other in (
                *((away, away), (rest_b, rest_b)),
                *((rest_a, rest_a), (rest_a, rest_b)),
            )
        )
        told = (left_b > _SCALE_TOLD * spread) & (
            along > _ALIKE * np.sqrt(left_a * left_b)
        )
        scale = np.where(told, along / np.where(told, left_b, 1.0), 1.0)
    shifts = scale[:, None] * shifts_b - shifts_a
    x, z = np.tile(np.eye(4), (2, h, 1, 1))
    x[:, :3, :3], x[:, :3, 3] = rx, shifts[:, :3]
    z[:, :3, :3], z[:, :3, 3] = rz, shifts[:, 3:]
    return x, z, scale


def _rotations(a: Floats, b: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """X's and Z's by Shah 2013 (doi:10.1115/1.4024473), shape (h, 3, 3) each."""
    h, k = weights.shape
    left = (weights[..., None, None] * a[..., :3, :3]).reshape(h, k, 9)
    kronecker = np.swapaxes(left, 1, 2) @ b[..., :3, :3].reshape(h, k, 9)
    kronecker = kronecker.reshape(h, 3, 3, 3, 3).transpose(0, 1, 3, 2, 4)
    u, _, vt = np.linalg.svd(kronecker.reshape(h, 9, 9))
    entries = vt[:, 0].reshape(h, 3, 3)
    sign = np.sign(np.linalg.det(entries))[:, None, None]
    return (
        nearest_rotation(sign * entries),
        nearest_rotation(sign * u[:, :, 0].reshape(h, 3, 3)),
    )


def _residuals(a: Floats, b: Floats, found: list[Floats], length: float) -> Floats:
    """Position and angle residuals as one length, shape (h, n), metres."""
    x, z, scale = found
    moved = a[None] @ x[:, None]
    scaled = np.broadcast_to(b, (len(x), *b.shape)).copy()
    scaled[..., :3, 3] *= scale[:, None, None]
    seen = z[:, None] @ scaled
    apart = ((moved[..., :3, 3] - seen[..., :3, 3]) ** 2).sum(axis=-1)
    # |R - R'|^2 / 2 = (2 sin(angle / 2))^2.
    turned = ((moved[..., :3, :3] - seen[..., :3, :3]) ** 2).sum(axis=(-2, -1)) / 2
    return np.asarray(np.sqrt(apart + length**2 * turned))


def _lengths(
    a: Floats, b: Floats, found: list[Floats], length: float
) -> tuple[Floats, Floats]:
    """Description lengths of hypotheses, and the radii within which poses agree."""
    n = len(a)
    residuals = np.sort(_residuals(a, b, found, length), axis=1)
    count = np.arange(1, n + 1)
    mean = np.cumsum(residuals**2, axis=1) / count
    # Three poses with residuals of twelve unknowns taken off: 6 m - 12 are left.
    freedom = np.maximum(6 * count - 12, 0)
    variance = mean * count / np.maximum(count - 2, 1)
    floor = (_ROUNDING * length) ** 2
    bits = 0.5 * freedom * np.log(np.maximum(variance, floor) / (2 * length**2))
    bits[:, : min(n, 4) - 1] = np.inf
    best = np.argmin(bits, axis=1)
    rows = np.arange(len(residuals))
    radii = _REACH * np.sqrt(np.maximum(variance[rows, best], floor))
    return bits[rows, best], np.maximum(radii, residuals[rows, best])
