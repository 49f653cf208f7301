"""Half-turns that disagree are dropped, each with the likeliest account of why.

Accounts with more freedom fit better. They are compared by their evidence, the
likelihood averaged over all that an account allows beforehand, in Laplace's
approximation (MacKay 1992, doi:10.1162/neco.1992.4.3.415).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.closed_form import closed_form
from handeye_tri.calibrate_cameras.half_turns import HalfTurnData
from handeye_tri.calibrate_cameras.homography import Homographies, ImageScale, OMode
from handeye_tri.calibrate_cameras.known_camera import (
    Build,
    build_of,
    fit_poses,
    own_homography,
)
from handeye_tri.calibrate_cameras.outlier_tests import left_over
from handeye_tri.calibrate_cameras.outliers import Consensus, find_consensus
from handeye_tri.calibrate_cameras.refine import (
    HalfTurnModel,
    State,
    refine_from_starts,
)
from handeye_tri.calibrate_cameras.starts import blank_state, refinement_starts
from handeye_tri.calibrate_cameras.turn_angle import OtherTurn, other_turns
from handeye_tri.errors import DegenerateMotionError
from handeye_tri.triangle import VERTICES

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

# An error of an angle that counts as one, and the likeliest, radians.
_LEAST_OFF = float(np.radians(0.1))
# Angles are ruled out by another that leaves so much less chi-square: three sigmas.
_RULED_OUT = 9.0
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
) -> tuple[Indices, dict[int, str]]:
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
        why[int(data.index[row])] = reason(
            data.take(one), build_of(build, one), consensus
        )
    return consensus.kept, why


def reason(data: HalfTurnData, build: Build, consensus: Consensus) -> str:
    """Say why one half-turn was dropped.

    A repeated image is seen without any camera. Of exchanged labels, a turn by another
    angle and a wrong point, the likeliest of those that leave nothing unexplained.

    Args:
        data: That half-turn alone.
        build: Makes its model.
        consensus: What the good half-turns agree on.
    """
    moved = data.whitener[:, 0] @ (data.pixels[:, 1] - data.pixels[:, 0])[..., None]
    if np.sqrt(consensus.noise.scale) * _SAME > np.abs(moved).max():
        return "before and after are the same image: the triangle was not turned"
    accounts = [
        *_exchanged(data, build, consensus),
        *_other_angles(data, build, consensus),
        *_wrong_points(data, build, consensus),
    ]
    believed = [
        one for one in accounts if one.square <= consensus.noise.limit(one.freedom)
    ]
    if not believed:
        return (
            "no half-turn of this triangle, and neither one wrong point, exchanged "
            "labels nor another angle explains it"
        )
    return min(believed, key=lambda one: one.unlikeliness(consensus)).words


@dataclass(frozen=True, slots=True)
class _Account:
    """What may have happened to a half-turn.

    Attributes:
        words: It, in words.
        square: Chi-square that it leaves.
        freedom: Of that chi-square.
        choices: How many equally likely cases it is one of beforehand: of a quantity,
            its range over sqrt(2 pi) of its sigma where the noise is as stated.
    """

    words: str
    square: float
    freedom: int
    choices: float

    def unlikeliness(self, consensus: Consensus) -> float:
        """-2 log of the evidence, up to what is the same for all accounts."""
        scale = consensus.noise.scale
        quantities = 6 - self.freedom
        choices = self.choices * scale ** (-0.5 * quantities)
        return self.square / scale + 2.0 * float(np.log(choices))


def _fit(
    changed: HalfTurnData, build: Build, consensus: Consensus
) -> tuple[HalfTurnModel, State] | None:
    """One half-turn before the agreed camera, as something in it is changed."""
    row = np.zeros(1, dtype=np.intp)
    found = own_homography(changed, consensus.state.o[0])
    if found is None:
        return None
    model = build(changed, row)
    state = fit_poses(model, found, consensus.state)
    return None if state is None else (model, state)


def _exchanged(
    data: HalfTurnData, build: Build, consensus: Consensus
) -> Iterator[_Account]:
    orders = list(permutations(range(3)))[1:]
    for view, word in ((1, "after"), (0, "before")):
        for order in orders:
            pixels, whitener = data.pixels.copy(), data.whitener.copy()
            pixels[:, view] = pixels[:, view, list(order)]
            whitener[:, view] = whitener[:, view, list(order)]
            changed = replace(data, pixels=pixels, whitener=whitener)
            fit = _fit(changed, build, consensus)
            if fit is not None:
                left = left_over(*fit, consensus.spread, np.ones(1))
                names = ", ".join(VERTICES[i] for i in order)
                yield _Account(
                    f"labels exchanged {word} it: its A, B, C are {names}",
                    float(left.square[0]),
                    6,
                    2.0 * len(orders),
                )


def _other_angles(
    data: HalfTurnData, build: Build, consensus: Consensus
) -> Iterator[_Account]:
    """Turns by another angle: before a camera a triangle has up to four poses."""
    scale = consensus.noise.scale
    turns = other_turns(data, build, consensus.state, consensus.spread)
    for turn in turns:
        off = abs(turn.angle - np.pi)
        if off < _LEAST_OFF:
            continue
        possible = {
            f"{_degrees(other):.1f}"
            for other in turns
            if other.square - turn.square < _RULED_OUT * scale
        }
        possible -= {f"{_degrees(turn):.1f}"}
        sigma = np.degrees(np.sqrt(scale) * turn.sigma)
        yield _Account(
            f"a turn of {_degrees(turn):.1f} +- {max(sigma, 0.1):.1f} degrees, not 180"
            + (f"; {', '.join(sorted(possible))} not ruled out" if possible else ""),
            turn.square,
            5,
            # Either way, and in each octave alike: small errors are likelier.
            2.0
            * float(np.log(np.pi / _LEAST_OFF) / np.sqrt(2.0 * np.pi))
            * max(off, _LEAST_OFF)
            / turn.sigma,
        )


def _degrees(turn: OtherTurn) -> float:
    """Between 0 and 180, either way round."""
    return float(np.degrees(min(turn.angle, 2.0 * np.pi - turn.angle)))


def _wrong_points(
    data: HalfTurnData, build: Build, consensus: Consensus
) -> Iterator[_Account]:
    for view, marker in np.ndindex(2, 3):
        whitener = data.whitener.copy()
        whitener[:, view, marker] *= _FAINT
        fit = _fit(replace(data, whitener=whitener), build, consensus)
        if fit is None:
            continue
        model, state = fit
        left = left_over(model, state, consensus.spread, np.ones(1))
        missed = (data.pixels - model.predict(state))[0, view, marker]
        word = ("before", "after")[view]
        yield _Account(
            f"marker {VERTICES[marker]} {word} it is {np.linalg.norm(missed):.1f} px "
            "off",
            float(left.square[0]),
            4,
            6.0 * _places(data, model, state, view, marker),
        )


def _places(
    data: HalfTurnData, model: HalfTurnModel, state: State, view: int, marker: int
) -> float:
    """In how many places a point could lie in the image that the others tell apart."""
    blocks = model.evaluate(state)
    assert blocks is not None
    at = 6 * view + 2 * marker
    by_pose = blocks.own[0, at : at + 2] / _FAINT
    covariance = np.linalg.pinv(blocks.own[0].T @ blocks.own[0], hermitian=True)
    whitened = np.eye(2) + by_pose @ covariance @ by_pose.T
    sigmas = np.sqrt(np.linalg.det(whitened))
    sigmas /= np.linalg.det(data.whitener[0, view, marker])
    width, height = data.image_size
    return float(width * height / (2.0 * np.pi * sigmas))
