"""What solving bare pose pairs gives: the motions and everything known about them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.records import Covariance, Floats, PoseNoise, locked
from handeye_tri.se3 import SE3


@dataclass(frozen=True, slots=True, eq=False)
class Undetermined:
    """A direction that the poses do not determine.

    Attributes:
        kind: "shift" of X and Z along an axis, "turn" about it (with the shift that
            goes with it), or "scale".
        axis_in_flange: Unit vector, shape (3,); zero for a scale.
        axis_in_base: The same axis in the base, shape (3,).
    """

    kind: str
    axis_in_flange: Floats
    axis_in_base: Floats

    @property
    def text(self) -> str:
        """In words."""
        if self.kind == "scale":
            return "the scale of the observed translations is open"
        flange = ", ".join(f"{v:+.3f}" for v in self.axis_in_flange)
        base = ", ".join(f"{v:+.3f}" for v in self.axis_in_base)
        words = "shift along" if self.kind == "shift" else "turn about"
        return (
            f"the {words} the axis ({flange}) of the flange, ({base}) of the base, "
            "is open"
        )


@dataclass(frozen=True, slots=True, eq=False)
class PoseSolution:
    """X and Z of ``base_from_flange X = Z b`` with their uncertainty.

    Attributes:
        names: Of X and Z, such as ("flange_from_camera", "base_from_target").
        x: The motion on the flange.
        z: The motion in the base.
        scale: Metres per unit of the observed translations; 1 where they are metres.
        clock_offset: Camera clock less robot clock, seconds; None without clocks.
        clock_correlation: Of both angular speeds at the start; None without clocks.
        covariance: Labels "<name of X>.x" ..., "<name of Z>.x" ... (right tangents, m
            and rad), then "log_scale" and "clock_offset" where they were unknown.
            Directions that are undetermined are left out: no sigma speaks of them.
        residuals: ``log((base_from_flange X)^-1 Z b)`` of every pose, shape (n, 6).
        poses: Names of the poses, n of them.
        used: Whether each was used, shape (n,).
        base_from_flange: The robot's poses, interpolated where there are clocks,
            (n, 4, 4).
        b: target_from_camera or camera_from_target in metres, shape (n, 4, 4).
        noise: The noise, stated or estimated.
        noise_is_stated: Which of the two.
        tail: Degrees of freedom of the residuals' Student distribution, infinite for
            the normal one; None where the method is a closed form.
        correlation: Of successive poses' errors; 0 for independent ones.
        chi2: Sum of squared whitened residuals; None for a closed form.
        dof: Its degrees of freedom.
        undetermined: What the poses leave open.
        certainty: How many times the least certain direction stands above what noise
            alone would pretend; below 1 it is undetermined.
        method: How this was reached.
    """

    names: tuple[str, str]
    x: SE3
    z: SE3
    scale: float
    clock_offset: float | None
    clock_correlation: float | None
    covariance: Covariance
    residuals: Floats
    poses: tuple[str, ...]
    used: NDArray[np.bool_]
    base_from_flange: Floats
    b: Floats
    noise: PoseNoise | None
    noise_is_stated: bool
    tail: float | None
    correlation: float
    chi2: float | None
    dof: int
    undetermined: tuple[Undetermined, ...]
    certainty: float
    method: str

    def __post_init__(self) -> None:
        """Lock the arrays."""
        n = len(self.poses)
        for key, shape in (
            ("residuals", (n, 6)),
            ("base_from_flange", (n, 4, 4)),
            ("b", (n, 4, 4)),
        ):
            object.__setattr__(self, key, locked(key, getattr(self, key), shape))
        self.used.setflags(write=False)

    @property
    def dropped(self) -> tuple[str, ...]:
        """Names of the poses that were left out as wrong."""
        return tuple(
            name for name, used in zip(self.poses, self.used, strict=True) if not used
        )

    @property
    def residual_positions(self) -> Floats:
        """Length of each position residual, shape (n,), metres."""
        return np.asarray(np.linalg.norm(self.residuals[:, :3], axis=1))

    @property
    def residual_angles(self) -> Floats:
        """Size of each orientation residual, shape (n,), radians."""
        return np.asarray(np.linalg.norm(self.residuals[:, 3:], axis=1))

    def placing(self) -> Floats:
        """Covariance of an observed origin's place in the base, from X and Z alone.

        With the target on the flange that is the target's origin through Z, with the
        camera on it the target's origin through the robot and X.

        Returns:
            Shape (n, 3, 3), metres squared.
        """
        rotation = np.zeros((len(self.poses), 3, 6))
        if self.names[0] == "flange_from_camera":
            rows, turned = slice(0, 6), self.base_from_flange[:, :3, :3]
            turned = turned @ self.x.rotation
            place = -np.einsum("nba,nb->na", self.b[:, :3, :3], self.b[:, :3, 3])
        else:
            rows, turned = slice(6, 12), np.tile(self.z.rotation, (len(self.b), 1, 1))
            place = self.b[:, :3, 3]
        # p = M exp(d) q moves by R_M (d_t + d_r x q).
        rotation[:, :, :3] = turned
        for k in range(3):
            rotation[:, :, 3 + k] = np.einsum(
                "nab,nb->na", turned, np.cross(np.eye(3)[k], place)
            )
        covariance = self.covariance.matrix[rows, rows]
        return np.asarray(rotation @ covariance @ np.swapaxes(rotation, 1, 2))


def residuals_of(
    base_from_flange: Floats, b: Floats, x: SE3, z: SE3
) -> tuple[Floats, Floats]:
    """Position and angle residuals of poses under given motions.

    Args:
        base_from_flange: Shape (n, 4, 4).
        b: Shape (n, 4, 4).
        x: X.
        z: Z.

    Returns:
        Distances, metres, and angles, radians, shape (n,) each.
    """
    moved, seen = base_from_flange @ x.matrix, z.matrix @ b
    apart = np.linalg.norm(moved[:, :3, 3] - seen[:, :3, 3], axis=1)
    chord = np.linalg.norm(moved[:, :3, :3] - seen[:, :3, :3], axis=(1, 2))
    return apart, 2 * np.arcsin(np.minimum(chord / np.sqrt(8), 1.0))
