"""What may be wrong with a cell, each as a cause that competes with the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handeye_tri.adjustment import RobotParameters
from handeye_tri.diagnose.loop import Cause, Fit, Loop
from handeye_tri.records import Session
from handeye_tri.se3 import se3_inverse, se3_log, so3_log

Floats = NDArray[np.float64]

# Chance that a session without any fault is accused of one.
CHANCE = 1e-4
# So many of each kind are fitted in full, best first.
_FITTED = 2
# Turns by less than this are no half-turns, radians.
_LEAST_TURN = 2.0


def possible_causes(session: Session, joints: RobotParameters | None) -> list[Cause]:
    """Every cause that is a motion of the flange or of a camera.

    Args:
        session: What was observed.
        joints: The joints' offsets, where there is a model of the robot.
    """
    causes = [*_steps(session), *_single_stations(session), *_turns(session)]
    causes += _clocks(session, joints)
    if joints is not None:
        causes += [
            Cause(
                "joint",
                np.array(joints.jacobian[..., [k]]),
                siblings=len(joints.labels),
                label=label,
            )
            for k, label in enumerate(joints.labels)
        ]
        causes.append(Cause("joints", np.array(joints.jacobian)))
    return causes


def _steps(session: Session) -> list[Cause]:
    """The rig on its mount, or one camera, is elsewhere from some station on."""
    m, n = session.pixels.shape[:2]
    mounts = session.mounts
    several = bool(mounts.any())
    slips = _where_a_rig_may_slip(mounts)
    causes = []
    for station in range(1, n):
        step = np.zeros((n, 6, 6))
        step[station:] = np.eye(6)
        if station in slips:
            mount = int(mounts[station])
            # With another mount the rig is elsewhere anyway.
            held = step * (mounts == mount)[:, None, None]
            label = session.mount_name(mount) if several else ""
            causes.append(
                Cause("rig", held, station=station, siblings=len(slips), label=label)
            )
        for i in range(m):
            if np.isfinite(session.pixels[i, :station]).any():
                causes.append(
                    Cause("camera", np.zeros((n, 6, 6)), i, step, station, n - 1)
                )
    return causes


def _where_a_rig_may_slip(mounts: NDArray[np.intp]) -> set[int]:
    """Stations before which it may, not the first of a mount.

    A single station between that and a tool change would be one where the robot was
    elsewhere.
    """
    slips: set[int] = set()
    for mount in np.unique(mounts):
        own = np.flatnonzero(mounts == mount).tolist()
        first = 1 if own[0] == 0 else 2
        last = len(own) if own[-1] == len(mounts) - 1 else len(own) - 1
        slips |= set(own[first:last])
    return slips


def _single_stations(session: Session) -> list[Cause]:
    """The flange, or what one camera saw, is wrong at a single station."""
    m, n = session.pixels.shape[:2]
    causes = []
    for station in range(n):
        only = np.zeros((n, 6, 6))
        only[station] = np.eye(6)
        causes.append(Cause("pose", only, station=station, siblings=n))
        causes += [
            Cause("view", np.zeros((n, 6, 6)), i, only, station, m * n)
            for i in range(m)
            if m > 1 and np.isfinite(session.pixels[i, station]).any()
        ]
    return causes


def _turns(session: Session) -> list[Cause]:
    """A half-turn went on, or stopped, about its own axis."""
    poses, n = session.base_from_flange, len(session.stations)
    causes = []
    for turn in session.half_turns:
        screw = se3_log(se3_inverse(poses[turn.before]) @ poses[turn.after])
        angle = float(np.linalg.norm(screw[3:]))
        if angle < _LEAST_TURN:
            continue
        for station in (turn.before, turn.after):
            more = np.zeros((n, 6, 1))
            more[station, :, 0] = screw / angle
            causes.append(
                Cause(
                    "turn", more, station=station, siblings=2 * len(session.half_turns)
                )
            )
    return causes


def _clocks(session: Session, joints: RobotParameters | None) -> list[Cause]:
    """All images were taken on the way from, or to, the next station.

    A robot that leaves a station accelerates first: after the same time it is equally
    far on its way in the joint that leads, or, where joints are not known, it has done
    the same part of the way. The way to a tool change is not known; it counts as none.
    """
    poses, n = session.base_from_flange, len(session.stations)
    ahead, behind = np.zeros((n, 6)), np.zeros((n, 6))
    angles = np.array([station.joints for station in session.stations])
    if joints is None or joints.jacobian.shape[2] != angles.shape[1]:
        ahead[:-1] = se3_log(se3_inverse(poses[:-1]) @ poses[1:])
        behind[1:] = se3_log(se3_inverse(poses[1:]) @ poses[:-1])
    else:
        way = np.diff(angles, axis=0)
        way /= np.maximum(np.abs(way).max(axis=1, keepdims=True), 1e-9)
        ahead[:-1] = (joints.jacobian[:-1] @ way[..., None])[..., 0]
        behind[1:] = (joints.jacobian[1:] @ -way[..., None])[..., 0]
    changes = np.flatnonzero(np.diff(session.mounts))
    ahead[changes], behind[changes + 1] = 0.0, 0.0
    return [
        Cause("clock", tangent[..., None], siblings=2, label=label)
        for tangent, label in ((ahead, "late"), (behind, "early"))
    ]


def significant(drop: float, rank: int, fit: Fit, families: int) -> bool:
    """Whether a drop of chi2 is more than chance gives in any of so many tries.

    Fisher's F of the drop against what the cause leaves, so that noise which is larger
    than stated accuses nobody.
    """
    from scipy.special import fdtrc

    if rank == 0 or fit.dof <= 0:
        return False
    noise = max(fit.chi2 / fit.dof, 1.0)
    return bool(fdtrc(rank, fit.dof, drop / rank / noise) < CHANCE / families)


def best_cause(
    loop: Loop, start: Fit, causes: Sequence[Cause]
) -> tuple[Cause, Fit, float] | None:
    """The cause that explains most, and whether it is more than chance.

    Of each kind the best by its first-order drop are fitted in full. They are compared
    by Schwarz's criterion, with the choice among siblings counted as well: chi2 over
    the noise that the best of them leaves, plus log(N) for each number, plus 2 log of
    the siblings.

    Returns:
        Cause, its fit, by how much chi2 fell; None where nothing is significant.
    """
    drops = loop.drops(start, list(causes))
    by_kind: dict[str, list[int]] = {}
    for k, cause in enumerate(causes):
        by_kind.setdefault(cause.kind, []).append(k)
    chosen = [
        k
        for rows in by_kind.values()
        for k in sorted(rows, key=lambda k: -drops[k][0])[:_FITTED]
    ]
    fitted = [(causes[k], loop.fitted(start, causes[k])) for k in chosen]
    noise = max(1.0, min(fit.chi2 / max(fit.dof, 1) for _, fit in fitted))
    count = 2 * int(loop.seen.sum())

    def criterion(one: tuple[Cause, Fit]) -> float:
        cause, fit = one
        penalty = fit.rank * np.log(count) + 2.0 * np.log(cause.siblings)
        return float(fit.chi2 / noise + penalty)

    cause, fit = min(fitted, key=criterion)
    drop = start.chi2 - fit.chi2
    if not significant(drop, fit.rank, fit, len(causes)):
        return None
    return cause, fit, drop


def turned_angle(before: Floats, after: Floats) -> float:
    """Angle between two orientations of the flange, shape (4, 4) each, radians."""
    return float(np.linalg.norm(so3_log(before[:3, :3].T @ after[:3, :3])))
