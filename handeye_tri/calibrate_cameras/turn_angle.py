"""By what angle a triangle was turned before a known camera, if not by 180 degrees.

Three points are seen alike from up to four places (Grunert 1841; Haralick et al. 1994,
doi:10.1007/BF02028352). What is no half-turn of the triangle from one of them can look
like one from another, however far from 180 degrees it is: about an edge, where the
third marker's two images are all that shows the turn.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.half_turns import HalfTurnData
from handeye_tri.calibrate_cameras.known_camera import Build
from handeye_tri.calibrate_cameras.least_squares import Blocks, minimise
from handeye_tri.calibrate_cameras.outlier_tests import left_over
from handeye_tri.calibrate_cameras.refine import HalfTurnModel, State
from handeye_tri.camera import Intrinsics, Lens, LensModel, PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.se3 import nearest_rotation, so3_exp

Floats = NDArray[np.float64]

# Turns that are tried first.
_ANGLES = np.radians(np.arange(3.0, 358.0, 3.0))
# Of each place that the first image may have been seen from.
_TRIED = 2


@dataclass(frozen=True, slots=True)
class OtherTurn:
    """A turn that explains a half-turn's images best among those near it.

    Attributes:
        angle: Radians, between 0 and 2 pi.
        sigma: Its standard deviation where noise is as stated.
        square: Chi-square that it leaves, of one degree of freedom less.
    """

    angle: float
    sigma: float
    square: float


@dataclass(frozen=True, slots=True, eq=False)
class _Turn:
    """Pose of one half-turn before a known camera, and its angle, radians."""

    state: State
    angle: float


def turned(data: HalfTurnData, foot: Floats, angles: Floats) -> HalfTurnData:
    """Half-turns as turns by other angles about their axes.

    Args:
        data: k half-turns.
        foot: Where each normal axis meets the plane, shape (k, 2), metres.
        angles: Shape (k,), radians.
    """
    through, along = data.axis_lines(foot)
    rotation = so3_exp(angles[:, None] * along)
    offset = through - (rotation @ through[..., None])[..., 0]
    # What the model adds for the foot of a normal axis.
    offset[:, :2] -= (2.0 * data.about_normal)[:, None] * foot
    return replace(data, rotation=rotation, offset=offset)


def other_turns(
    data: HalfTurnData, build: Build, state: State, spread: Floats
) -> list[OtherTurn]:
    """Angles by which the triangle may have been turned, each the best near it.

    Args:
        data: One half-turn.
        build: Makes the model of copies of it.
        state: The camera, lens and O; its poses are not read.
        spread: Covariance of camera and O, shape (g, g).
    """
    poses = _places(data, state)
    if len(poses) == 0:
        return []
    angles = np.tile(_ANGLES, len(poses))
    rows = np.zeros(len(angles), dtype=np.intp)
    foot = np.tile(state.o[0], (len(angles), 1))
    many = turned(data.take(rows), foot, angles)
    every = replace(
        state,
        poses=np.repeat(poses, len(_ANGLES), axis=0),
        o=foot,
        turn=np.zeros((len(angles), build(data, rows[:1]).turn_unknowns)),
    )
    missed = (many.pixels - build(many, rows).predict(every))[..., None]
    square = ((many.whitener @ missed) ** 2).sum(axis=(1, 2, 3, 4))
    result = []
    for of_pose in np.split(np.arange(len(angles)), len(poses)):
        values = square[of_pose]
        lowest = (values <= np.roll(values, 1)) & (values <= np.roll(values, -1))
        order = np.argsort(np.where(lowest, values, np.inf))
        for start in of_pose[order[: min(_TRIED, int(lowest.sum()))]]:
            one = _Turn(
                replace(
                    every, poses=every.poses[[start]], o=foot[:1], turn=every.turn[:1]
                ),
                float(angles[start]),
            )
            best = _best_near(data, build, one, spread)
            if best is not None:
                result.append(best)
    return result


def _places(data: HalfTurnData, state: State) -> Floats:
    """camera_from_triangle of the image before, up to four, shape (k, 4, 4), metres.

    Pairs of roots that noise has made complex are taken for the double root between.
    """
    model: LensModel = "radtan" if len(state.lens) == 5 else "rational"
    camera = PinholeCamera(
        "camera",
        Intrinsics.from_vector(state.intrinsics),
        data.image_size,
        Lens(model, state.lens),
    )
    try:
        xy = camera.normalised(data.pixels[0, 0])
    except InputError:
        # Where the lens cannot be inverted nothing was seen by it.
        return np.zeros((0, 4, 4))
    rays = np.column_stack([xy, np.ones(3)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    # As Haralick et al.: sides a, b, c opposite of A, B, C, the rays' angles likewise.
    a2, b2, c2 = (
        float(((data.points[i] - data.points[j]) ** 2).sum())
        for i, j in ((1, 2), (2, 0), (0, 1))
    )
    alpha, beta, gamma = rays[1] @ rays[2], rays[2] @ rays[0], rays[0] @ rays[1]
    q, p = (a2 - c2) / b2, (a2 + c2) / b2
    quartic = [
        (q - 1.0) ** 2 - 4.0 * c2 / b2 * alpha**2,
        4.0
        * (
            q * (1.0 - q) * beta
            - (1.0 - p) * alpha * gamma
            + 2.0 * c2 / b2 * alpha**2 * beta
        ),
        2.0
        * (
            q**2
            - 1.0
            + 2.0 * q**2 * beta**2
            + 2.0 * (b2 - c2) / b2 * alpha**2
            - 4.0 * p * alpha * beta * gamma
            + 2.0 * (b2 - a2) / b2 * gamma**2
        ),
        4.0
        * (
            -q * (1.0 + q) * beta
            + 2.0 * a2 / b2 * gamma**2 * beta
            - (1.0 - p) * alpha * gamma
        ),
        (1.0 + q) ** 2 - 4.0 * a2 / b2 * gamma**2,
    ]
    v = np.roots(quartic).real
    # Where both are 0 the place is on a line of symmetry, and its neighbours will do.
    with np.errstate(divide="ignore", invalid="ignore"):
        u = (q - 1.0) * v**2 - 2.0 * q * beta * v + 1.0 + q
        u /= 2.0 * (gamma - v * alpha)
    first = np.sqrt(b2 / (1.0 + v**2 - 2.0 * v * beta))
    ahead = np.isfinite(u) & (u > 0.0) & (v > 0.0)
    depths = (first * np.stack([np.ones(len(v)), u, v])).T[ahead]
    seen = depths[..., None] * rays
    middle, centre = seen.mean(axis=1), data.points.mean(axis=0)
    spread = np.swapaxes(seen - middle[:, None], 1, 2) @ (data.points - centre)
    poses = np.tile(np.eye(4), (len(seen), 1, 1))
    poses[:, :3, :3] = nearest_rotation(spread)
    poses[:, :3, 3] = middle - poses[:, :3, :3] @ centre
    return poses


def _best_near(
    data: HalfTurnData, build: Build, start: _Turn, spread: Floats
) -> OtherTurn | None:
    """Pose and angle adjusted together from where they are."""
    row = np.zeros(1, dtype=np.intp)
    foot = start.state.o

    def model(turn: _Turn) -> HalfTurnModel:
        return build(turned(data, foot, np.array([turn.angle])), row)

    def evaluate(turn: _Turn) -> Blocks | None:
        at = model(turn).with_camera_known()
        blocks = at.evaluate(turn.state)
        if blocks is None:
            return None
        by_angle = at.by_angle(turn.state, blocks)
        own = np.concatenate([blocks.own, by_angle[..., None]], axis=-1)
        return Blocks(blocks.residuals, own, blocks.shared)

    def retract(turn: _Turn, own: Floats, shared: Floats) -> _Turn:
        moved = model(turn).with_camera_known().retract(turn.state, own[:, :-1], shared)
        return _Turn(moved, turn.angle + float(own[0, -1]))

    end = minimise(evaluate, retract, start, 1e-9)
    if end is None:
        return None
    turn = end.state
    left = left_over(model(turn), turn.state, spread, np.ones(1))
    return OtherTurn(
        turn.angle % (2.0 * np.pi),
        float(left.sigma[0]),
        float(left.square[0] - left.by_angle[0]),
    )
