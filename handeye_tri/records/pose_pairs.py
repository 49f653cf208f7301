"""What a robot reported and what a camera saw, station by station, of any target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from handeye_tri import arguments
from handeye_tri.errors import InputError
from handeye_tri.records.arrays import Floats, locked
from handeye_tri.se3 import se3_inverse

Mounting = Literal["eye_in_hand", "eye_to_hand"]
RobotDirection = Literal["flange_in_base", "base_in_flange"]
ObservedDirection = Literal["target_in_camera", "camera_in_target"]


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """Standard deviations of one robot pose and of one observed pose.

    Attributes:
        robot_translation: Per axis of the flange, metres.
        robot_rotation: Per axis of the flange, radians.
        lateral: Of the target's origin, per axis across the line of sight, metres.
        depth: Of the target's origin along the line of sight, metres.
        rotation: Of the target's orientation, per axis, radians.
    """

    robot_translation: float
    robot_rotation: float
    lateral: float
    depth: float
    rotation: float

    def __post_init__(self) -> None:
        """Raise InputError unless both chains together have noise everywhere."""
        for name, value in self.items():
            arguments.number(f"noise.{name}", value)
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"noise.{name} must not be negative, got {value}")
        if self.robot_translation + min(self.lateral, self.depth) <= 0:
            raise InputError(
                "noise: robot_translation is 0, so lateral and depth must be above 0"
            )
        if self.robot_rotation + self.rotation <= 0:
            raise InputError(
                "noise: robot_rotation or rotation must be above 0; both are 0"
            )

    def items(self) -> tuple[tuple[str, float], ...]:
        """Names and values, in order."""
        return tuple((name, getattr(self, name)) for name in self.__slots__)


@dataclass(frozen=True, slots=True, eq=False)
class PosePairs:
    """Bare poses of any robot, camera and target, directions and mounting by name.

    Attributes:
        robot: What the robot reported, shape (n, 4, 4), metres.
        observed: What the camera saw, shape (m, 4, 4), metres (or the target's own
            unit where ``metric`` is False); m = n unless both have times.
        mounting: "eye_in_hand" (the camera rides on the flange, the target stands)
            or "eye_to_hand" (the camera stands, the target rides).
        robot_direction: "flange_in_base" maps flange to base coordinates,
            "base_in_flange" is its inverse.
        observed_direction: "target_in_camera" maps target to camera coordinates,
            "camera_in_target" is its inverse.
        metric: Whether the observed translations are in metres; False for a target
            or a monocular map of unknown size.
        names: What to call each observed pose, each another name; ("0", "1", ...)
            where empty.
        robot_times: On the robot's clock, shape (n,), seconds; or None.
        observed_times: On the camera's clock, shape (m,), seconds; or None.
        noise: What is known of the noise; None estimates it from the residuals.
    """

    robot: Floats
    observed: Floats
    mounting: Mounting
    robot_direction: RobotDirection
    observed_direction: ObservedDirection
    metric: bool = True
    names: tuple[str, ...] = ()
    robot_times: Floats | None = None
    observed_times: Floats | None = None
    noise: PoseNoise | None = None

    def __post_init__(self) -> None:
        """Lock; raise InputError where words, names, counts or times do not fit."""
        for key, known in (
            ("mounting", Mounting),
            ("robot_direction", RobotDirection),
            ("observed_direction", ObservedDirection),
        ):
            arguments.check_one_of(key, getattr(self, key), get_args(known))
        arguments.flag("metric", self.metric)
        if isinstance(self.names, str) or not isinstance(self.names, Sequence):
            raise InputError(
                "names must be a sequence of names, got " + arguments.shown(self.names)
            )
        for key in ("robot", "observed"):
            value = locked(key, getattr(self, key), (None, 4, 4), finite=False)
            object.__setattr__(self, key, value)
        n, m = len(self.robot), len(self.observed)
        names = tuple(self.names) or tuple(str(i) for i in range(m))
        if len(names) != m:
            raise InputError(f"{m} observed poses need as many names, got {len(names)}")
        first: dict[str, int] = {}
        for i, name in enumerate(names):
            if first.setdefault(name, i) != i:
                raise InputError(
                    f"names must differ, and {name!r} is that of observed poses "
                    f"{first[name]} and {i} (counted from 0)"
                )
        object.__setattr__(self, "names", names)
        if (self.robot_times is None) != (self.observed_times is None):
            raise InputError(
                "give the times of both streams or of none: the robot's are "
                f"{'absent' if self.robot_times is None else 'there'}, the camera's "
                f"{'absent' if self.observed_times is None else 'there'}"
            )
        if not self.timed and n != m:
            raise InputError(
                f"there are {n} robot poses and {m} observed ones; without times the "
                "i-th of both must belong together: drop the robot poses whose "
                "picture failed, or give both streams with their times"
            )
        if self.timed:
            for key, poses in (("robot_times", n), ("observed_times", m)):
                object.__setattr__(self, key, _times(key, getattr(self, key), poses))

    @property
    def timed(self) -> bool:
        """Whether these are two streams with clocks rather than pairs."""
        return self.robot_times is not None

    @property
    def base_from_flange(self) -> Floats:
        """Shape (n, 4, 4), whatever direction was given."""
        given = self.robot_direction == "flange_in_base"
        return self.robot if given else se3_inverse(self.robot)

    @property
    def camera_from_target(self) -> Floats:
        """Shape (m, 4, 4), whatever direction was given."""
        given = self.observed_direction == "target_in_camera"
        return self.observed if given else se3_inverse(self.observed)

    @property
    def unknowns(self) -> tuple[str, str]:
        """Names of X and Z in ``base_from_flange X = Z b``.

        With the camera on the flange, b = target_from_camera; with the target on
        it, b = camera_from_target.
        """
        if self.mounting == "eye_in_hand":
            return "flange_from_camera", "base_from_target"
        return "flange_from_target", "base_from_camera"


def _times(name: str, value: Any, n: int) -> Floats:
    times = locked(name, value, (n,))
    if n > 1 and not (np.diff(times) > 0).all():
        i = int(np.argmin(np.diff(times)))
        raise InputError(
            f"{name} must increase, but {name}[{i + 1}] = {times[i + 1]:.6f} s follows "
            f"{times[i]:.6f} s; drop repeated and unordered samples first"
        )
    return times
