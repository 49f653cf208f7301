"""Gauss-Newton on X, Z, scale and clock, with the noise found by the way."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from handeye_tri.hand_eye.consensus import scene_length
from handeye_tri.hand_eye.pose_model import PoseFit, PoseInput
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

# Of the noise under one tail: it need not settle to the last digit.
_NOISE_ITERATIONS = 20
# Successive errors correlate (visual odometry drifts, a stream is denser than its
# errors change) where at least so much, found in so many poses, says so.
_LEAST_CORRELATION = 0.3
_LEAST_FOR_CORRELATION = 30
_CORRELATION_ROUNDS = 4
# Steps in standard deviations while the noise is still moving.
_SETTLED = 1e-3
_NOISE_SETTLED = 5e-2
ROUNDING = 1e-13
# A step turns by at most this, radians, or moves by as many scene lengths.
_LARGEST_STEP = 0.5
# A direction known to worse than one scene length or one radian counts as unknown; so
# does one that only rounding tells.
_LEAST_INFORMATION = 1.0
_LEAST_RELATIVE = 1e-12
# A direction whose information per pose is below this could come from noise alone:
# noisy poses about parallel axes seem to carry about 1, whatever the noise.
_NOISE_INFORMATION = 16.0


class PoseIteration:
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
        self.correlation = 0.0
        self.near = noise is not None
        # The camera's part of a residual, shape (n, 6, 6); None while far off.
        self.from_camera: Floats | None = None
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
        self.raw, jacobian, by_b = residuals_axzb(a, b, self.x, self.z)
        if self.from_camera is not None:
            # Derivatives taken where the noise has put the poses correlate with it: a
            # factor on noisy lengths comes out too small. Taken at the observations
            # with their share of the residuals off, they do not (Gauss-Helmert model;
            # Lenzmann and Lenzmann 2004, avn 111).
            share = np.einsum("nij,nj->ni", self.from_camera, self.raw)
            b = b @ se3_exp(-share)
            jacobian[:, :, :6], jacobian[:, :, 6:] = (
                -np.eye(6),
                se3_adjoint(se3_inverse(b)),
            )
            by_b = np.broadcast_to(np.eye(6), by_b.shape)
        columns = [jacobian]
        if data.free_scale:
            moved = np.einsum("nba,nb->na", b[:, :3, :3], b[:, :3, 3])
            columns.append(by_b[:, :, :3] @ moved[:, :, None])
        if rate is not None:
            # A pose taken later by d moves by exp(rate d): A exp(v) X = A X exp(Ad v).
            rate = rate / np.array([*3 * [self.length], 1, 1, 1])
            carried = rate @ se3_adjoint(se3_inverse(self.x)).T
            columns.append(-jacobian[:, :, :6] @ carried[:, :, None])
        self.e, self.jacobian = self.raw, np.concatenate(columns, axis=2)
        # An error d of the pose before is T d here: B exp(d) B^-1 B' = B' exp(T d).
        self.carry = se3_adjoint(se3_inverse(b[1:]) @ b[:-1])
        if self.correlation > 0:
            self.e = self._whiten(self.e[:, :, None])[:, :, 0]
            self.jacobian = self._whiten(self.jacobian)
        self.shapes = noise_shapes(camera, self.x, eye_in_hand=data.eye_in_hand)

    def _whiten(self, rows: Floats) -> Floats:
        """What is new in each pose's rows against those of the pose before."""
        first = np.sqrt(1 - self.correlation**2) * rows[:1]
        return np.concatenate(
            [first, rows[1:] - self.correlation * self.carry @ rows[:-1]]
        )

    def _weigh(self) -> tuple[Floats, Floats, Floats]:
        """Inverse covariances, squared whitened residuals, and information."""
        covariance = np.einsum("k,knij->nij", np.exp(self.log_variances), self.shapes)
        scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        scale = scale[:, :, None] * scale[:, None, :]
        inverse = np.linalg.inv(covariance / scale) / scale
        if self.near:
            camera = np.einsum(
                "k,knij->nij", np.exp(self.log_variances[2:]), self.shapes[2:]
            )
            # What drifts is the camera's alone.
            self.from_camera = (
                np.broadcast_to(np.eye(6), inverse.shape)
                if self.correlation > 0
                else camera @ inverse
            )
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

    def adopt(self, part: PoseIteration) -> None:
        """Go on from where a fit of some of the poses ended, its noise included."""
        back = part.length / self.length
        self.x, self.z = np.array(part.x), np.array(part.z)
        self.x[:3, 3] *= back
        self.z[:3, 3] *= back
        self.scale, self.offset = part.scale * back, part.offset
        self.log_variances, self.tail = np.array(part.log_variances), part.tail
        self.near = True
        self.log_variances[[0, 2, 3]] += 2 * np.log(back)
        # Errors a few poses apart are less correlated than those of neighbours.
        if part.correlation > 0:
            self.correlation = part.correlation ** (len(part.e) / len(self.e))
            news = (1 - self.correlation**2) / (1 - part.correlation**2)
            self.log_variances += np.log(news)
        self._linearise()

    def settle_noise(self) -> None:
        """Find the motions together with the noise and its tail."""
        # Two pooled sizes until the motions are good, then all five.
        self._settle(self._pool)
        self._settle_components()
        for _ in range(_CORRELATION_ROUNDS):
            found = self._successive()
            if found < _LEAST_CORRELATION or abs(found - self.correlation) < 1e-3:
                break
            self.correlation = found
            self._linearise()
            self._settle(self._pool)
            self._settle_components()

    def _settle_components(self) -> None:
        self.centre, self.tail, self.near = self.log_variances, np.inf, True
        tried: set[float] = set()
        while self.tail not in tried:
            tried.add(self.tail)
            self._settle(self._score)
            self.tail = best_tail(self._weigh()[1], self.tail)

    def _successive(self) -> float:
        """Correlation of successive poses' errors, at most 0.999."""
        if len(self.raw) < _LEAST_FOR_CORRELATION:
            return 0.0
        inverse, _, _ = self._weigh()
        before = np.einsum("nij,nj->ni", self.carry, self.raw[:-1])
        weighted = np.einsum("nij,nj->ni", inverse[1:], before) * self.weights[1:, None]
        both = np.einsum("ni,ni->", weighted, self.raw[1:])
        return float(
            min(both / max(np.einsum("ni,ni->", weighted, before), 1e-300), 0.999)
        )

    def _settle(self, update: Callable[[], float]) -> None:
        for _ in range(_NOISE_ITERATIONS):
            step, std = self.move()
            moved = update()
            small = np.maximum(_SETTLED * std, ROUNDING)
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
        # In exact data rounding pretends more than noise could.
        above = self.values / max(_NOISE_INFORMATION * n * excess, self.least)
        back = np.ones(len(covariance))
        back[[0, 1, 2, 6, 7, 8]] = self.length
        sigma = np.exp(0.5 * self.log_variances) / np.sqrt(1 - self.correlation**2)
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
            self.correlation,
            chi2,
            dof,
            self.length,
        )
