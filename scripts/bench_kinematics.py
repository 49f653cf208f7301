"""Row 10 of `bench.py`: inverse kinematics.

Ours starts from nothing and finds one solution of each target within the limits. The
peers move step by step from a start, and from far away often do not arrive: they are
started near the joints that the target was made with, which no caller knows.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
from bench_rows import Gate, Measured, Peers, Row

from handeye_tri.kinematics import InverseKinematics, SerialChain
from handeye_tri.se3 import se3_inverse, se3_log, so3_exp

TARGETS = 1000
# The peers are slow and alike in all targets: they do as many as this.
PEER_TARGETS = 100
NEAR_RAD = 0.5
BAR, LEAST_SHARE, TOLERANCE = 15.0, 0.995, 1e-6
QUARTER = 90.0
# Each joint about z, then along z, along x, and a turn about x by degrees
# (Denavit and Hartenberg), and limits in degrees.
ARMS: dict[str, list[tuple[float, float, float, float, float]]] = {
    # As robot_models/hp3_like.xml: a spherical wrist.
    "HP3-like": [
        (0.3, 0.1, -QUARTER, -170, 170),
        (0.0, 0.29, 0.0, -175, 0),
        (0.0, 0.085, -QUARTER, -130, 240),
        (0.3, 0.0, QUARTER, -180, 180),
        (0.0, 0.0, -QUARTER, -125, 125),
        (0.09, 0.0, 0.0, -360, 360),
    ],
    # Three parallel axes and no spherical wrist.
    "UR5e-like": [
        (0.1625, 0.0, QUARTER, -360, 360),
        (0.0, -0.425, 0.0, -360, 360),
        (0.0, -0.3922, 0.0, -180, 180),
        (0.1333, 0.0, QUARTER, -360, 360),
        (0.0997, 0.0, -QUARTER, -360, 360),
        (0.0996, 0.0, 0.0, -360, 360),
    ],
    "7 joints": [
        (0.36, 0.0, -QUARTER, -170, 170),
        (0.0, 0.0, QUARTER, -120, 120),
        (0.42, 0.0, QUARTER, -170, 170),
        (0.0, 0.0, -QUARTER, -120, 120),
        (0.40, 0.0, -QUARTER, -170, 170),
        (0.0, 0.0, QUARTER, -120, 120),
        (0.15, 0.0, 0.0, -175, 175),
    ],
}


def chain(arm: str) -> SerialChain:
    placements, frame = [], np.eye(4)
    for along_z, along_x, twist, _, _ in ARMS[arm]:
        placements.append(frame)
        frame = np.eye(4)
        frame[:3, :3] = so3_exp([np.radians(twist), 0.0, 0.0])
        frame[:3, 3] = along_x, 0.0, along_z
    limits = np.radians([row[3:] for row in ARMS[arm]]).T
    slides = np.zeros(len(placements), dtype=bool)
    return SerialChain(np.array(placements), slides, frame, *limits)


@cache
def targets(arm: str) -> tuple[Any, Any]:
    """base_from_flange, (n, 4, 4), and joints near to those that reach them."""
    rng = np.random.default_rng(10)
    robot = chain(arm)
    joints = robot.random(rng, TARGETS)
    near = joints + rng.uniform(-NEAR_RAD, NEAR_RAD, joints.shape)
    return robot.forward(joints), np.clip(near, robot.lower, robot.upper)


def solving(arm: str) -> Callable[[], Any]:
    solver = InverseKinematics(chain(arm))
    poses, _ = targets(arm)
    return lambda: solver.solve(poses, np.random.default_rng(0), first=True)


def peer(arm: str, factory: str, peers: Peers) -> Measured:
    robot, (poses, near) = chain(arm), targets(arm)
    limits = np.array([robot.lower, robot.upper])
    some = poses[:PEER_TARGETS], near[:PEER_TARGETS]
    arguments = (robot.placements, robot.last_from_flange, limits, *some)
    needs = "'pin-pink' mink quadprog"
    return peers.elsewhere("bench_pink", factory, arguments, needs=needs)


def almost_all_reached(arm: str, ours: Any, theirs: Any) -> Gate:
    """Within the limits, and as near to the target as is asked."""
    robot, (poses, _) = chain(arm), targets(arm)
    found = np.array([len(joints) > 0 for joints in ours.joints])
    joints = np.array([rows[0] for rows in ours.joints if len(rows)])
    off = np.abs(se3_log(se3_inverse(robot.forward(joints)) @ poses[found])).max(axis=1)
    good = (off < TOLERANCE) & (joints >= robot.lower).all(axis=1)
    good &= (joints <= robot.upper).all(axis=1)
    share = float(good.sum() / TARGETS)
    says = f"{100 * share:.1f} % reached from nothing, {100 * theirs[1].mean():.0f} % "
    return Gate(share >= LEAST_SHARE, f"{says}by the peer from near")


def rows() -> list[Row]:
    return [
        Row(
            number=10,
            work=f"inverse kinematics, {arm}, {TARGETS} targets",
            peer=name,
            bar=BAR,
            ours=partial(solving, arm),
            theirs=partial(peer, arm, factory),
            gate=partial(almost_all_reached, arm),
            units=(TARGETS, PEER_TARGETS),
            threads=factory == "pink",
        )
        for arm in ARMS
        for name, factory in (("pin-pink", "pink"), ("mink", "mink"))
    ]
