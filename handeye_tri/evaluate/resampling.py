"""Sessions made of parts of a session: stations left out, or drawn again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.records import HalfTurn, HandEyeCalibration, Session

Indices = NDArray[np.intp]
# Calibrates a part of a session. The second argument says which station of the whole
# session each of its stations is, shape (n,): parameters of the robot follow it.
Recalibrate = Callable[[Session, Indices], HandEyeCalibration]
# Done and total.
Progress = Callable[[int, int], None]


def station_groups(session: Session) -> list[tuple[int, ...]]:
    """Calibration stations that only make sense together, in the order of the first.

    The stations of a half-turn, and of half-turns that share a station, form one
    group; every other calibration station is a group of its own.
    """
    of = {int(j): {int(j)} for j in session.indices("calibration")}
    for turn in session.half_turns:
        joined = of[turn.before] | of[turn.after]
        for j in joined:
            of[j] = joined
    groups = {tuple(sorted(group)) for group in of.values()}
    return sorted(groups)


def split(
    groups: Sequence[tuple[int, ...]],
    mounts: Indices,
    folds: int,
    rng: np.random.Generator,
) -> list[tuple[int, ...]]:
    """Deal shuffled groups into folds of nearly equal numbers of groups.

    Mount by mount, so that no fold takes all groups of a mount but one that has a
    single group.

    Args:
        groups: What must stay together.
        mounts: Which mount each station has, shape (n,).
        folds: How many folds, 2 or more; with as many as groups, each group is one,
            in order.
        rng: Shuffles.

    Returns:
        Station indices of each fold, ascending.
    """
    if folds >= len(groups):
        return list(groups)
    order = rng.permutation(len(groups))
    order = order[np.argsort([mounts[groups[k][0]] for k in order], kind="stable")]
    return [
        tuple(sorted(j for k in order[start::folds] for j in groups[k]))
        for start in range(folds)
    ]


def held_out(session: Session, fold: Sequence[int]) -> Session:
    """The same stations, with those of a fold held out and no others to test at.

    What was held out before is unseen, so that it serves neither side.
    """
    away = set(fold)
    before = session.indices("evaluation")
    pixels, covariance = session.pixels.copy(), session.pixel_covariance.copy()
    pixels[:, before], covariance[:, before] = np.nan, np.nan
    return replace(
        session,
        stations=tuple(
            replace(station, kind="evaluation") if station.index in away else station
            for station in session.stations
        ),
        half_turns=tuple(
            turn for turn in session.half_turns if not {turn.before, turn.after} & away
        ),
        pixels=pixels,
        pixel_covariance=covariance,
    )


def drawn(
    session: Session, groups: Sequence[tuple[int, ...]]
) -> tuple[Session, Indices]:
    """A session of these groups, as often as each is named; nothing is held out.

    Returns:
        The session, and for each of its stations the one that it was, shape (n,).
    """
    index = np.array([j for group in groups for j in group], dtype=np.intp)
    turns: list[HalfTurn] = []
    start = 0
    for group in groups:
        place = {j: start + k for k, j in enumerate(group)}
        turns += [
            HalfTurn(place[turn.before], place[turn.after], turn.axis)
            for turn in session.half_turns
            if turn.before in place
        ]
        start += len(group)
    stations = tuple(replace(session.stations[j], index=k) for k, j in enumerate(index))
    return replace(
        session,
        stations=stations,
        half_turns=tuple(turns),
        pixels=session.pixels[:, index],
        pixel_covariance=session.pixel_covariance[:, index],
    ), index
