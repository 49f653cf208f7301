"""Half-turns that disagree are dropped, each with the simplest account of why."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.closed_form import closed_form
from handeye_tri.calibrate_cameras.half_turns import HalfTurnData
from handeye_tri.calibrate_cameras.homography import Homographies, ImageScale, OMode
from handeye_tri.calibrate_cameras.outliers import (
    Build,
    Consensus,
    find_consensus,
    fit_poses,
    joined,
    own_homography,
)
from handeye_tri.calibrate_cameras.refine import (
    HalfTurnModel,
    State,
    refine_from_starts,
)
from handeye_tri.calibrate_cameras.starts import blank_state, refinement_starts
from handeye_tri.errors import DegenerateMotionError
from handeye_tri.se3 import so3_exp
from handeye_tri.triangle import EDGES, VERTICES

Floats = NDArray[np.float64]

# Turns that are tried, degrees, then more closely about the best.
_ANGLES = np.arange(90.0, 271.0, 3.0)
_CLOSER = np.linspace(-3.0, 3.0, 61)
# Two images are the same where no marker moved by more sigmas than this.
_SAME = 6.0
# Weight of a marker that is left out; zero would leave its homography undefined.
_FAINT = 1e-4


def drop_outliers(
    data: HalfTurnData,
    build: Build,
    coefficients: Floats,
    o_mode: OMode,
    o: Floats | None,
    noise_known: bool,
) -> tuple[NDArray[np.intp], dict[int, str]]:
    """Rows of the half-turns that agree, and why each of the others does not.

    Args:
        data: All half-turns.
        build: Makes the model of some rows of them.
        coefficients: Of the lens to start from, shape (5,) or (8,).
        o_mode: How the foot of a normal axis is treated.
        o: The known foot, shape (2,), metres; else None.
        noise_known: Whether the data's whiteners are absolute.

    Raises:
        DegenerateMotionError: fewer than three quarters agree on anything.
    """
    model = build(data, np.arange(len(data)))
    basis = model.choice.conic_basis(ImageScale.of(data.image_size))

    def solve(part: HalfTurnModel, homographies: Homographies) -> State:
        blank = blank_state(part, coefficients, homographies)
        try:
            first = closed_form(part.data, homographies, basis, "whitened")
        except DegenerateMotionError:
            first = None
        starts = refinement_starts(part, blank, first, homographies)
        found = refine_from_starts(part, list(starts.values()))
        if found is None:
            raise DegenerateMotionError(
                "no start has all markers in front of the camera: check axis, "
                "triangle and marker order"
            )
        return found[0].state

    consensus = find_consensus(data, build, solve, basis, o_mode, o, noise_known)
    why = {}
    for row in consensus.lost:
        one = np.array([row])

        def build_one(
            part: HalfTurnData, rows: NDArray[np.intp], one: NDArray[np.intp] = one
        ) -> HalfTurnModel:
            return build(part, one[rows])

        why[int(data.index[row])] = reason(data.take(one), build_one, consensus)
    return consensus.kept, why


def reason(data: HalfTurnData, build: Build, consensus: Consensus) -> str:
    """Say why one half-turn was dropped.

    Tried in this order: a repeated image, exchanged labels, a turn by another angle, a
    wrong point. The first that makes the residuals as small as noise is the answer.

    Args:
        data: That half-turn alone.
        build: Makes its model.
        consensus: What the good half-turns agree on.
    """
    row = np.zeros(1, dtype=np.intp)
    moved = data.whitener[:, 0] @ (data.pixels[:, 1] - data.pixels[:, 0])[..., None]
    if np.sqrt(consensus.scale) * _SAME > np.abs(moved).max():
        return "before and after are the same image: the triangle was not turned"

    def misfit(changed: HalfTurnData) -> float:
        found = own_homography(changed, consensus.state.o[0])
        if found is None:
            return np.inf
        model = build(changed, row)
        state = fit_poses(model, found, consensus.state)
        blocks = None if state is None else model.evaluate(state)
        return np.inf if blocks is None else blocks.cost

    return (
        _exchanged(data, misfit, consensus.limit(6))
        or _other_angle(data, build, consensus)
        or _wrong_point(data, misfit, build, consensus)
        or "no half-turn of this triangle, and neither one wrong point, exchanged "
        "labels nor another angle explains it"
    )


def _exchanged(
    data: HalfTurnData, misfit: Callable[[HalfTurnData], float], limit: float
) -> str | None:
    for view, word in ((1, "after"), (0, "before")):
        for order in list(permutations(range(3)))[1:]:
            pixels, whitener = data.pixels.copy(), data.whitener.copy()
            pixels[:, view] = pixels[:, view, list(order)]
            whitener[:, view] = whitener[:, view, list(order)]
            changed = replace(data, pixels=pixels, whitener=whitener)
            if misfit(changed) <= limit:
                names = "".join(VERTICES[i] for i in order)
                return f"labels exchanged {word} it: its A, B, C are {', '.join(names)}"
    return None


def _other_angle(data: HalfTurnData, build: Build, consensus: Consensus) -> str | None:
    """The angle nearest to 180 degrees by which it may have been turned instead.

    About an edge there can be two angles that fit.
    """
    found = own_homography(data, None)
    if found is None:
        return None
    foot = consensus.state.o[0]

    def squares(angles: Floats) -> Floats:
        count = len(angles)
        rows = np.zeros(count, dtype=np.intp)
        rotation, offset = _turns(data, foot, angles)
        many = replace(
            data.take(rows),
            rotation=rotation,
            offset=offset,
            about_normal=np.zeros(count),
        )
        model = build(many, rows)
        state = fit_poses(model, joined([found] * count), consensus.state)
        blocks = None if state is None else model.evaluate(state)
        if blocks is None:
            return np.full(count, np.inf)
        return np.asarray((blocks.residuals**2).sum(axis=1))

    coarse = squares(_ANGLES)
    padded = np.concatenate([[np.inf], coarse, [np.inf]])
    lowest = (coarse <= padded[:-2]) & (coarse <= padded[2:]) & np.isfinite(coarse)
    for start in sorted(_ANGLES[lowest], key=lambda angle: abs(angle - 180.0)):
        fine = squares(start + _CLOSER)
        best = float(start + _CLOSER[np.argmin(fine)])
        # The grid is a twentieth of a degree fine, a matter of pixels at most.
        if fine.min() <= 4.0 * consensus.limit(5) and abs(best - 180.0) >= 0.2:
            return f"a turn of {min(best, 360.0 - best):.1f} degrees, not 180"
    return None


def _turns(data: HalfTurnData, foot: Floats, angles: Floats) -> tuple[Floats, Floats]:
    """Rotations (k, 3, 3) and translations (k, 3) of turns by angles in degrees."""
    axis = data.axes[0]
    if axis == "normal":
        through, along = np.append(foot, 0.0), np.array([0.0, 0.0, 1.0])
    else:
        through, end = data.points[list(EDGES[axis])]
        along = (end - through) / np.linalg.norm(end - through)
    rotation = so3_exp(np.radians(angles)[:, None] * along)
    return rotation, through - rotation @ through


def _wrong_point(
    data: HalfTurnData,
    misfit: Callable[[HalfTurnData], float],
    build: Build,
    consensus: Consensus,
) -> str | None:
    costs = np.full((2, 3), np.inf)
    for view, marker in np.ndindex(2, 3):
        whitener = data.whitener.copy()
        whitener[:, view, marker] *= _FAINT
        costs[view, marker] = misfit(replace(data, whitener=whitener))
    view, marker = np.unravel_index(int(np.argmin(costs)), costs.shape)
    if costs[view, marker] > consensus.limit(4):
        return None
    whitener = data.whitener.copy()
    whitener[:, view, marker] *= _FAINT
    changed = replace(data, whitener=whitener)
    row = np.zeros(1, dtype=np.intp)
    found = own_homography(changed, consensus.state.o[0])
    assert found is not None
    model = build(changed, row)
    state = fit_poses(model, found, consensus.state)
    assert state is not None
    missed = data.pixels - model.predict(state)
    distance = float(np.linalg.norm(missed[0, view, marker]))
    word = ("before", "after")[int(view)]
    return f"marker {VERTICES[int(marker)]} {word} it is {distance:.1f} px off"
