"""What a fit of bare poses takes and gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.hand_eye.clock import RobotTrack
from handeye_tri.records import PoseNoise
from handeye_tri.se3 import se3_inverse

Floats = NDArray[np.float64]


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
        correlation: Of successive poses' errors (a drift); 0 for independent ones.
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
    correlation: float
    chi2: float
    dof: int
    length: float
