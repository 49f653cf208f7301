"""What else may be wrong with a robot than its repeatability.

Joint offsets, link corrections and a clock offset all have one form: a parameter
vector theta by which the flange of every station truly is at
``reported @ exp(jacobian @ theta)``. The kinematics stay outside: whoever knows the arm
hands in plain arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.errors import InputError
from handeye_tri.records import MOTION_QUANTITIES, locked
from handeye_tri.se3 import se3_adjoint, se3_exp, se3_left_jacobian

Floats = NDArray[np.float64]
# From parameters (p,): base_from_flange (n, 4, 4) and the derivative of its right
# tangent (n, 6, p).
Kinematics = Callable[[Floats], tuple[Floats, Floats]]


@dataclass(frozen=True, slots=True, eq=False)
class RobotParameters:
    """Systematic errors of a robot as unknowns.

    Attributes:
        labels: "<what>.<quantity>", such as "elbow.offset"; p of them.
        jacobian: Derivative of the right tangent of base_from_flange by the
            parameters, at all n stations of a session, shape (n, 6, p), m and rad.
        sigma: How large each may be (one standard deviation), shape (p,). This is
            its prior, and what decides whether data determine it.
        kinematics: Exact poses and derivatives at any parameters, for all stations;
            None takes ``reported @ exp(jacobian @ theta)``.
    """

    labels: tuple[str, ...]
    jacobian: Floats
    sigma: Floats
    kinematics: Kinematics | None = None

    def __post_init__(self) -> None:
        """Lock; raise InputError unless shapes fit and sigmas are positive."""
        p = len(self.labels)
        object.__setattr__(self, "labels", tuple(self.labels))
        object.__setattr__(
            self, "jacobian", locked("jacobian", self.jacobian, (None, 6, p))
        )
        sigma = locked("sigma", self.sigma, (p,))
        object.__setattr__(self, "sigma", sigma)
        if len(set(self.labels)) < p or not all("." in name for name in self.labels):
            raise InputError(
                "labels of robot parameters must differ and read '<what>.<quantity>', "
                f"got {', '.join(self.labels)}"
            )
        if not (sigma > 0).all():
            raise InputError(
                f"sigma of robot parameters must be positive, got {sigma.tolist()}"
            )

    def __add__(self, other: RobotParameters) -> RobotParameters:
        """Both sets of parameters; only where both are linear."""
        if self.kinematics is not None or other.kinematics is not None:
            raise InputError(
                "robot parameters with kinematics of their own cannot be joined; "
                "give one set whose kinematics knows all of them"
            )
        if len(self.jacobian) != len(other.jacobian):
            raise InputError(
                "robot parameters must be of the same stations, got "
                f"{len(self.jacobian)} and {len(other.jacobian)}"
            )
        return RobotParameters(
            self.labels + other.labels,
            np.concatenate([self.jacobian, other.jacobian], axis=2),
            np.concatenate([self.sigma, other.sigma]),
        )

    def select(self, labels: Sequence[str]) -> RobotParameters:
        """Some of the parameters; the others are taken for zero.

        Raises:
            InputError: a label is not among the parameters.
        """
        missing = [label for label in labels if label not in self.labels]
        if missing:
            raise InputError(
                f"robot parameters lack {', '.join(missing)}; they are "
                f"{', '.join(self.labels)}"
            )
        columns = [self.labels.index(label) for label in labels]
        whole, count = self.kinematics, len(self.labels)

        def kinematics(values: Floats) -> tuple[Floats, Floats]:
            assert whole is not None
            padded = np.zeros(count)
            padded[columns] = values
            poses, jacobian = whole(padded)
            return poses, jacobian[..., columns]

        return RobotParameters(
            tuple(labels),
            self.jacobian[..., columns],
            self.sigma[columns],
            None if whole is None else kinematics,
        )

    def at(self, stations: ArrayLike) -> RobotParameters:
        """The same parameters at some of the stations.

        Args:
            stations: Their indices in any order, shape (k,).
        """
        index = np.asarray(stations, dtype=np.intp)
        whole = self.kinematics

        def kinematics(values: Floats) -> tuple[Floats, Floats]:
            assert whole is not None
            poses, jacobian = whole(values)
            return poses[index], jacobian[index]

        return RobotParameters(
            self.labels,
            self.jacobian[index],
            self.sigma,
            None if whole is None else kinematics,
        )

    def poses(self, reported: Floats, values: Floats) -> tuple[Floats, Floats]:
        """Poses with the parameters applied, and derivatives.

        Args:
            reported: base_from_flange of all stations, shape (n, 4, 4), metres.
            values: The parameters, shape (p,).

        Returns:
            base_from_flange (n, 4, 4); derivative of its right tangent (n, 6, p).
        """
        if self.kinematics is not None:
            return self.kinematics(values)
        tangent = self.jacobian @ values
        return reported @ se3_exp(tangent), right_jacobian(tangent) @ self.jacobian


def right_jacobian(tangent: Floats) -> Floats:
    """``exp(x + d) ~ exp(x) exp(J d)``, shape (..., 6, 6), of tangents x, (..., 6)."""
    return se3_left_jacobian(-tangent)


def joint_offsets(
    names: Sequence[str], jacobian: ArrayLike, sigma: float = np.radians(0.1)
) -> RobotParameters:
    """Errors of the joints' zero positions, labelled "<joint>.offset".

    Args:
        names: Of the q joints.
        jacobian: Of the flange's right tangent by the joints, (n, 6, q).
        sigma: How large they may be, rad (or m).
    """
    return RobotParameters(
        tuple(f"{name}.offset" for name in names),
        np.asarray(jacobian, dtype=float),
        np.full(len(names), float(sigma)),
    )


def link_corrections(
    names: Sequence[str],
    flange_from_link: ArrayLike,
    sigma: tuple[float, float] = (5e-4, float(np.radians(0.1))),
) -> RobotParameters:
    """Each link's end displaced and turned, labelled "<link>.x" ... "<link>.rz".

    ``base_from_link @ exp(d) @ link_from_flange`` is
    ``base_from_flange @ exp(Ad(flange_from_link) d)``.

    Args:
        names: Of the q links.
        flange_from_link: Their frames at every station, shape (n, q, 4, 4), metres.
        sigma: How large a translation (m) and a rotation (rad) may be.
    """
    frames = np.asarray(flange_from_link, dtype=float)
    if frames.ndim != 4 or frames.shape[1:] != (len(names), 4, 4):
        raise InputError(
            f"flange_from_link must have shape (n, {len(names)}, 4, 4), "
            f"got {frames.shape}"
        )
    adjoint = np.moveaxis(se3_adjoint(frames), 1, 2)
    return RobotParameters(
        tuple(f"{name}.{quantity}" for name in names for quantity in MOTION_QUANTITIES),
        adjoint.reshape(len(frames), 6, 6 * len(names)),
        np.tile(np.repeat(sigma, 3), len(names)),
    )


def clock_offset(twist: ArrayLike, sigma: float = 0.05) -> RobotParameters:
    """The cameras' clock ahead of the robot's by "clock.offset" seconds.

    Args:
        twist: Velocity of the flange in its own frame at every station, shape (n, 6),
            m/s and rad/s: ``base_from_flange(t + s) = base_from_flange(t) @ exp(s
            twist)``.
        sigma: How large the offset may be, seconds.
    """
    velocity = np.asarray(twist, dtype=float)
    return RobotParameters(("clock.offset",), velocity[..., None], np.array([sigma]))


def determined(information: Floats, sigma: Floats) -> NDArray[np.intp]:
    """Which parameters the data determine better than they are known before.

    Greedily: the parameter on which the data say most, then the next with those
    before it left free (Cholesky factorisation with pivoting), while that is more
    than the prior says.

    Args:
        information: Of the parameters alone, everything else eliminated, (p, p).
        sigma: Their prior, shape (p,).

    Returns:
        Their indices, ascending.
    """
    left = information * np.outer(sigma, sigma)
    kept: list[int] = []
    while len(kept) < len(sigma):
        pivot = np.diagonal(left).copy()
        pivot[kept] = -np.inf
        best = int(pivot.argmax())
        if pivot[best] <= 1.0:
            break
        kept.append(best)
        left = left - np.outer(left[:, best], left[best]) / pivot[best]
    return np.array(sorted(kept), dtype=np.intp)
