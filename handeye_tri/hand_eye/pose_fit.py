"""Maximum-likelihood AX = ZB of bare poses: noise, scale and clock unknown or stated.

Unknown are X and Z, on request a factor on B's translations and the offset of two
clocks, and, unless stated, the five variances of
:mod:`handeye_tri.hand_eye.pose_noise` and the tail of the residuals' distribution
(Student's, by iterative reweighting: Lange, Little and Taylor 1989,
doi:10.1080/01621459.1989.10478852). Directions that the poses do not determine are
found from the information matrix, left where the start has them, and named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import ConvergenceError
from handeye_tri.hand_eye.clock import RobotTrack
from handeye_tri.hand_eye.consensus import scene_length
from handeye_tri.hand_eye.pose_noise import (
    LEAST_LOG_VARIANCE,
    best_tail,
    noise_shapes,
    pooled_start,
    score_step,
    tail_weights,
)
from handeye_tri.hand_eye.refine import residuals_axzb
from handeye_tri.records import PoseNoise
from handeye_tri.se3 import se3_adjoint, se3_exp, se3_inverse

Floats = NDArray[np.float64]

_MAX_ITERATIONS = 40
# Of the noise under one tail: it need not settle to the last digit.
_NOISE_ITERATIONS = 20
# Of longer streams an evenly spread part tells the noise.
_ENOUGH_FOR_NOISE = 400
# Steps in standard deviations: while the noise is still moving, and at the end.
_SETTLED = 1e-3
_CONVERGED = 1e-6
# Heavy tails and the kinks of an interpolated track can leave steps that do not die
# out; up to this many standard deviations they do not matter.
_UNSETTLED = 0.3
_NOISE_SETTLED = 5e-2
_ROUNDING = 1e-13
# A step turns by at most this, radians, or moves by as many scene lengths.
_LARGEST_STEP = 0.5
# A direction known to worse than one scene length or one radian counts as unknown; so
# does one that only rounding tells.
_LEAST_INFORMATION = 1.0
_LEAST_RELATIVE = 1e-12
# A direction whose information per pose is below this could come from noise alone:
# noisy poses about parallel axes seem to carry about 1, whatever the noise.
_NOISE_INFORMATION = 16.0


@dataclass(frozen=True, slots=True, eq=False)
class PoseInput:
    """Poses to fit.

    Attributes:
        a: base_from_flange, shape (n, 4, 4); ignored where there is a track.
        camera_from_target: Shape (n, 4, 4).
        eye_in_hand: Whether B is target_from_camera, else camera_from_target.
        free_scale: Whether B's translations have a unit of their own.
        few_axes: Whether the poses turn about one direction or not at all: what noise
            alone could pretend to tell is then left where the start has it.
        track: The robot's stream, where its poses must be interpolated.
        times: Of the observed poses on the camera's clock, shape (n,).
    """

    a: Floats
    camera_from_target: Floats
    eye_in_hand: bool
    free_scale: bool = False
    few_axes: bool = False
    track: RobotTrack | None = None
    times: Floats | None = None

    @property
    def b(self) -> Floats:
        """The B of AX = ZB, shape (n, 4, 4)."""
        c = self.camera_from_target
        return se3_inverse(c) if self.eye_in_hand else c

    def robot(self, offset: float) -> tuple[Floats, Floats | None]:
        """Robot poses when the pictures were taken, and their velocities."""
        if self.track is None or self.times is None:
            return self.a, None
        return self.track.at(self.times - offset)

    def take(self, rows: NDArray[np.bool_]) -> PoseInput:
        """The same with some of the poses, ``rows`` of shape (n,)."""
        return PoseInput(
            self.a[rows] if self.track is None else self.a,
            self.camera_from_target[rows],
            self.eye_in_hand,
            self.free_scale,
            self.few_axes,
            self.track,
            None if self.times is None else self.times[rows],
        )


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """The optimum.

    Attributes:
        x: Shape (4, 4).
        z: Shape (4, 4).
        scale: Metres per unit of B's translations.
        offset: Camera clock less robot clock, seconds.
        covariance: Of the right tangents of X and Z, then the logarithm of the scale
            and the offset where they are unknown, shape (p, p); directions that are
            undetermined are left out.
        undetermined: Directions in these p numbers, translations in scene lengths,
            that the poses do not determine, shape (u, p).
        certainty: How many times the least certain direction stands above what noise
            alone would pretend; below 1 it is undetermined.
        noise: The noise, stated or estimated.
        tail: Degrees of freedom of Student's distribution; infinite for the normal.
        chi2: Weighted sum of squared whitened residuals.
        dof: Its degrees of freedom.
        length: The scene's length, metres.
    """

    x: Floats
    z: Floats
    scale: float
    offset: float
    covariance: Floats
    undetermined: Floats
    certainty: float
    noise: PoseNoise
    tail: float
    chi2: float
    dof: int
    length: float


def fit_poses(
    data: PoseInput,
    x: Floats,
    z: Floats,
    *,
    scale: float = 1.0,
    offset: float = 0.0,
    noise: PoseNoise | None = None,
) -> PoseFit:
    """Fit by Gauss-Newton, noise and tail by the way; cost linear in the poses.

    Args:
        data: The poses.
        x: Start, shape (4, 4).
        z: Start, shape (4, 4).
        scale: Start; kept unless ``data.free_scale``.
        offset: Start; kept unless there is a track.
        noise: Stated; None estimates it.

    Raises:
        ConvergenceError: the iteration did not settle.
    """
    state = _State(data, x, z, scale, offset, noise)
    n = len(data.camera_from_target)
    if noise is None and n > _ENOUGH_FOR_NOISE:
        some = np.zeros(n, bool)
        some[np.linspace(0, n - 1, _ENOUGH_FOR_NOISE).astype(int)] = True
        part = _State(data.take(some), x, z, scale, offset, None)
        part.settle_noise()
        state.adopt(part)
    elif noise is None:
        state.settle_noise()
    for _ in range(_MAX_ITERATIONS):
        step, std = state.move()
        if (np.abs(step) < np.maximum(_CONVERGED * std, _ROUNDING)).all():
            break
    if (np.abs(step) > _UNSETTLED * std + _ROUNDING).any():
        raise ConvergenceError(
            f"the fit of {n} poses did not settle in "
            f"{_MAX_ITERATIONS} iterations (last step {np.abs(step / std).max():.2g} "
            "standard deviations); check that robot and observed poses belong together"
        )
    return state.result()


class _State:
    """Where the iteration is. All lengths are in scene lengths."""

    def __init__(
        self,
        data: PoseInput,
        x: Floats,
        z: Floats,
        scale: float,
        offset: float,
        noise: PoseNoise | None,
    ) -> None:
        self.data = data
        self.offset = offset
        self.length = scene_length(data.robot(offset)[0]) or 1.0
        self.x, self.z = self._shrunk(x), self._shrunk(z)
        self.scale = scale / self.length
        self.stated = noise is not None
        self.tail = np.inf
        self.log_variances = np.zeros(5)
        self.centre = np.zeros(5)
        self.last_step, self.share = np.zeros(5), 1.0
        if noise is not None:
            sigma = np.array([value for _, value in noise.items()])
            sigma[[0, 2, 3]] /= self.length
            self.log_variances = 2 * np.log(np.maximum(sigma, 1e-14))
        self._linearise()
        if noise is None:
            self.log_variances = pooled_start(self.e, self.jacobian.shape[2])

    def _shrunk(self, motion: Floats) -> Floats:
        result = np.array(motion)
        result[..., :3, 3] /= self.length
        return result

    def _linearise(self) -> None:
        data = self.data
        a, rate = data.robot(self.offset)
        a = self._shrunk(a)
        camera = np.array(data.camera_from_target)
        camera[:, :3, 3] *= self.scale
        b = se3_inverse(camera) if data.eye_in_hand else camera
        self.e, jacobian, by_b = residuals_axzb(a, b, self.x, self.z)
        columns = [jacobian]
        if data.free_scale:
            moved = np.einsum("nba,nb->na", b[:, :3, :3], b[:, :3, 3])
            columns.append(by_b[:, :, :3] @ moved[:, :, None])
        if rate is not None:
            # A pose taken later by d moves by exp(rate d): A exp(v) X = A X exp(Ad v).
            rate = rate / np.array([*3 * [self.length], 1, 1, 1])
            carried = rate @ se3_adjoint(se3_inverse(self.x)).T
            columns.append(-jacobian[:, :, :6] @ carried[:, :, None])
        self.jacobian = np.concatenate(columns, axis=2)
        self.shapes = noise_shapes(camera, self.x, eye_in_hand=data.eye_in_hand)

    def _weigh(self) -> tuple[Floats, Floats, Floats]:
        """Inverse covariances, squared whitened residuals, and information."""
        covariance = np.einsum("k,knij->nij", np.exp(self.log_variances), self.shapes)
        scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        scale = scale[:, :, None] * scale[:, None, :]
        inverse = np.linalg.inv(covariance / scale) / scale
        distances = np.einsum("ni,nij,nj->n", self.e, inverse, self.e)
        self.weighted = np.swapaxes(self.jacobian, 1, 2) @ inverse
        self.weights = tail_weights(distances, self.tail)
        information = np.einsum(
            "n,nij,njk->ik", self.weights, self.weighted, self.jacobian
        )
        return inverse, distances, information

    def _invert(self, information: Floats) -> Floats:
        """Inverse on the directions that the poses tell."""
        # A unit of the clock's offset is as much as its own information says.
        self.unit = np.ones(len(information))
        if self.data.track is not None:
            self.unit[-1] = 1 / np.sqrt(max(information[-1, -1], 1e-300))
            self.unit[-1] *= np.sqrt(max(np.diagonal(information)[3:6].max(), 1e-300))
        scaled = information * self.unit[:, None] * self.unit
        self.values, self.vectors = np.linalg.eigh(scaled)
        self.least = max(_LEAST_INFORMATION, _LEAST_RELATIVE * self.values[-1])
        if self.data.few_axes:
            self.least = max(self.least, _NOISE_INFORMATION * len(self.e))
        self.told = self.values > self.least
        kept = self.unit[:, None] * self.vectors[:, self.told]
        return np.asarray(kept / self.values[self.told] @ kept.T)

    def move(self) -> tuple[Floats, Floats]:
        """One Gauss-Newton step: the step and the standard deviations.

        What the poses hardly tell moves little (Levenberg's damping).
        """
        _, _, information = self._weigh()
        self._invert(information)
        axes = self.unit[:, None] * self.vectors
        damping = np.maximum(self.values, 0.0) + self.least
        if self.data.few_axes:
            damping[~self.told] = np.inf
        damped = axes / damping @ axes.T
        right = np.einsum("n,nij,nj->i", self.weights, self.weighted, self.e)
        step = -damped @ right
        largest = np.abs(step / self.unit).max()
        step *= min(1.0, _LARGEST_STEP / max(largest, 1e-300))
        self.x = self.x @ se3_exp(step[:6])
        self.z = self.z @ se3_exp(step[6:12])
        rest = list(step[12:])
        if self.data.free_scale:
            self.scale *= np.exp(rest.pop(0))
        if rest:
            self.offset += rest[0]
        self._linearise()
        return step, np.sqrt(np.diagonal(damped))

    def adopt(self, part: _State) -> None:
        """Go on from where a fit of some of the poses ended, its noise included."""
        back = part.length / self.length
        self.x, self.z = np.array(part.x), np.array(part.z)
        self.x[:3, 3] *= back
        self.z[:3, 3] *= back
        self.scale, self.offset = part.scale * back, part.offset
        self.log_variances, self.tail = np.array(part.log_variances), part.tail
        self.log_variances[[0, 2, 3]] += 2 * np.log(back)
        self._linearise()

    def settle_noise(self) -> None:
        """Find the motions together with the noise and its tail."""
        # Two pooled sizes until the motions are good, then all five.
        self._settle(self._pool)
        self.centre = self.log_variances
        tried: set[float] = set()
        while self.tail not in tried:
            tried.add(self.tail)
            self._settle(self._score)
            self.tail = best_tail(self._weigh()[1], self.tail)

    def _settle(self, update: Callable[[], float]) -> None:
        for _ in range(_NOISE_ITERATIONS):
            step, std = self.move()
            moved = update()
            small = np.maximum(_SETTLED * std, _ROUNDING)
            if moved < _NOISE_SETTLED and (np.abs(step) < small).all():
                return

    def _pool(self) -> float:
        before = self.log_variances
        self.log_variances = pooled_start(self.e, int(self.told.sum()))
        return float(np.abs(self.log_variances - before).max())

    def _score(self) -> float:
        inverse, _, information = self._weigh()
        covariance = self._invert(information)
        taken = self.jacobian @ covariance @ np.swapaxes(self.jacobian, 1, 2)
        squares = self.weights[:, None, None] * (
            self.e[:, :, None] * self.e[:, None, :]
        )
        step = score_step(
            self.log_variances, self.centre, self.shapes, inverse, squares + taken
        )
        # Components that trade with each other make full steps swing: go halfway then.
        swings = step @ self.last_step < 0
        self.share = max(0.5 * self.share, 0.1) if swings else min(1.5 * self.share, 1)
        self.last_step = step
        before = self.log_variances
        self.log_variances = np.maximum(before + self.share * step, LEAST_LOG_VARIANCE)
        return float(np.abs(self.log_variances - before).max())

    def result(self) -> PoseFit:
        """In metres."""
        _, distances, information = self._weigh()
        covariance = self._invert(information)
        if np.isfinite(self.tail):
            # Information of Student's distribution against the reweighted one.
            plain = np.einsum("nij,njk->ik", self.weighted, self.jacobian)
            covariance = self._invert(plain * (self.tail + 6) / (self.tail + 8))
        n, unknowns = len(self.e), int(self.told.sum())
        chi2 = float(self.weights @ distances)
        dof = max(6 * n - unknowns, 0)
        excess = max(chi2 / dof, 1.0) if self.stated and dof else 1.0
        above = self.values / (_NOISE_INFORMATION * n * excess)
        back = np.ones(len(covariance))
        back[[0, 1, 2, 6, 7, 8]] = self.length
        sigma = np.exp(0.5 * self.log_variances)
        sigma[[0, 2, 3]] *= self.length
        x, z = np.array(self.x), np.array(self.z)
        x[:3, 3] *= self.length
        z[:3, 3] *= self.length
        return PoseFit(
            x,
            z,
            self.scale * self.length,
            self.offset,
            covariance * back[:, None] * back,
            (self.vectors[:, above < 1] * self.unit[:, None]).T,
            float(np.sqrt(max(above[0], 0.0))),
            PoseNoise(*(float(value) for value in sigma)),
            self.tail,
            chi2,
            dof,
            self.length,
        )
