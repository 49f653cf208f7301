"""What every importer ends in: stations with the robot's pose and the images there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import InputError
from handeye_tri.records import Floats, locked
from handeye_tri.se3 import SE3

Picture = Callable[[], NDArray[np.uint8]]
# More stations, poses or images than any calibration has; refuses bombs.
MAX_POSES = 2_000_000
MAX_STATIONS = 2_000


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One station of a real robot.

    Attributes:
        base_from_flange: As the robot reports it.
        joints: Shape (q,), rad or m; empty where only the pose is known.
        pictures: Reads the image of a camera, by its name; absent: not taken.
        origin: Where it comes from, in words.
    """

    base_from_flange: SE3
    joints: Floats
    pictures: Mapping[str, Picture]
    origin: str

    def __post_init__(self) -> None:
        """Lock the joints."""
        object.__setattr__(self, "joints", locked("joints", self.joints, (None,)))


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """All stations in the order in which the robot visited them.

    Attributes:
        shots: The stations.
        remarks: What was left out or chosen, one sentence each, for the user.
    """

    shots: tuple[Shot, ...]
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raise InputError where there is no station, or far too many."""
        if not 0 < len(self.shots) <= MAX_STATIONS:
            raise InputError(
                f"an import needs 1 to {MAX_STATIONS} stations, got {len(self.shots)}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class PoseStream:
    """What the robot reported over time.

    Attributes:
        times: Shape (n,), seconds, increasing.
        base_from_flange: Shape (n, 4, 4), metres.
        joints: Shape (n, q), rad or m; q = 0 where poses are all there is.
    """

    times: Floats
    base_from_flange: Floats
    joints: Floats

    def __post_init__(self) -> None:
        """Lock; raise InputError where shapes do not fit."""
        n = len(np.asarray(self.times))
        for name, shape in (
            ("times", (n,)),
            ("base_from_flange", (n, 4, 4)),
            ("joints", (n, None)),
        ):
            object.__setattr__(self, name, locked(name, getattr(self, name), shape))


@dataclass(frozen=True, slots=True)
class ImageStream:
    """When a camera took images.

    Attributes:
        times: Seconds, increasing.
        read: Reads the image of that index.
    """

    times: tuple[float, ...]
    read: Callable[[int], NDArray[np.uint8]]


@dataclass(frozen=True, slots=True)
class Stillness:
    """When the robot counts as standing.

    Attributes:
        translation: Farthest that the flange may move, metres.
        rotation: Farthest that it may turn, radians.
        seconds: Shortest stand.
        gap: Longest silence of the robot within one stand, seconds.
    """

    translation: float = 1e-4
    rotation: float = field(default_factory=lambda: float(np.radians(0.02)))
    seconds: float = 0.3
    gap: float = 1.0
