"""Half-turns that agree, where more are bad than calibration leaves out.

Calibration asks three quarters of a camera's half-turns to agree. To say what is wrong
fewer will do: half-turns are drawn at random until a camera explains those drawn
(Fischler and Bolles 1981, doi:10.1145/358669.358692), and what else it explains joins
them.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.session_camera import alone, alone_without_outliers
from handeye_tri.errors import HandEyeError
from handeye_tri.records import DroppedHalfTurn, Session

# A drawn camera is believed up to this chi2 per degree of freedom.
_BELIEVED = 4.0
# So many are drawn at once, more than a camera needs, since few fit by chance.
_DRAWN = 5
# With two in five bad, as many draws hold no bad one in 99 of 100 cases.
_DRAWS = 60


def without_bad_half_turns(session: Session) -> list[DroppedHalfTurn] | None:
    """What each camera must not be calibrated from; None where nothing agrees.

    Args:
        session: What was detected.
    """
    lost: list[DroppedHalfTurn] = []
    for i in range(len(session.cameras)):
        own = _of_camera(session, i)
        if own is None:
            return None
        lost += own
    return lost


def _of_camera(session: Session, i: int) -> list[DroppedHalfTurn] | None:
    shift = np.zeros_like(session.pixels[i])
    try:
        return alone_without_outliers(session, i, shift)[1]
    except HandEyeError:
        pass
    seen = np.isfinite(session.pixels[i]).all(axis=(1, 2))
    turns = [
        k
        for k, turn in enumerate(session.half_turns)
        if seen[turn.before] and seen[turn.after]
    ]
    if len(turns) <= _DRAWN:
        return None
    rng = np.random.default_rng(0)
    for _ in range(_DRAWS):
        drawn = set(rng.choice(turns, _DRAWN, replace=False).tolist())
        if not _explained(session, i, shift, drawn):
            continue
        for k in turns:
            if k not in drawn and _explained(session, i, shift, drawn | {k}):
                drawn.add(k)
        # Half that agree are more than chance, and the other half more than a few.
        if 2 * len(drawn) > len(turns):
            return _others(session, i, drawn)
    return None


def _others(session: Session, i: int, kept: Collection[int]) -> list[DroppedHalfTurn]:
    name = session.cameras[i].name
    return [
        DroppedHalfTurn(name, k, turn.before, turn.after, "disagrees with the others")
        for k, turn in enumerate(session.half_turns)
        if k not in kept
    ]


def _explained(
    session: Session, i: int, shift: NDArray[np.float64], kept: Collection[int]
) -> bool:
    try:
        found = alone(session.without(_others(session, i, kept)), i, shift)
    except HandEyeError:
        return False
    return found.chi2 < _BELIEVED * found.dof
