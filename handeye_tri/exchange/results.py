"""What every format is written from, and the words they share."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import InputError
from handeye_tri.records import Floats, HandEyeCalibration
from handeye_tri.se3 import SE3, quaternion_wxyz

_FRAME = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")


@dataclass(frozen=True, slots=True)
class FrameNames:
    """What the frames are called on the robot that uses the result.

    Attributes:
        base: The frame that the robot's poses refer to.
        flange: The frame that the robot reports.
        optical: A camera's optical frame (z forward, x right, y down), with
            ``{camera}`` for the camera's name.
    """

    base: str = "base"
    flange: str = "flange"
    optical: str = "{camera}_optical_frame"

    def __post_init__(self) -> None:
        """Raise InputError where a name cannot be a frame's."""
        for key, name in (
            ("--base-frame", self.base),
            ("--flange-frame", self.flange),
            ("--optical-frame", self.optical.replace("{camera}", "camera")),
        ):
            if not _FRAME.fullmatch(name):
                raise InputError(
                    f"{key} must be letters, digits and _ . / -, starting with a "
                    f"letter, got {name!r}"
                )

    def camera(self, name: str) -> str:
        """The optical frame of one camera."""
        return self.optical.replace("{camera}", name)


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """A calibrated and judged session.

    Attributes:
        cell: Name of the cell.
        calibration: The calibrated cell.
        verdict: "PASS", "FAIL" or "CANNOT TELL".
        sentence: The headline that belongs to the verdict.
        simulated: Whether the data are simulated.
        base_from_flange: Reported flange poses, shape (n, 4, 4), metres.
        mounts: Which mount holds the triangle at each station, shape (n,), from 0.
        stations: Station of each of ``observed_base_from_flange``, shape (s,).
        observed_base_from_flange: Flange poses as the cameras observe them through
            the calibration, shape (s, 4, 4), metres.
        frames: What the frames are called.
    """

    cell: str
    calibration: HandEyeCalibration
    verdict: str
    sentence: str
    simulated: bool
    base_from_flange: Floats
    mounts: NDArray[np.intp]
    stations: tuple[int, ...]
    observed_base_from_flange: Floats
    frames: FrameNames = FrameNames()

    @property
    def head(self) -> list[str]:
        """Lines that every file starts with: the verdict, and where it is from."""
        source = "SIMULATED" if self.simulated else "REAL"
        lines = [
            f"VERDICT {self.verdict}: {' '.join(self.sentence.split())}",
            f"Cell {self.cell}, {source} data, calibrated by handeye-tri "
            f"({' '.join(self.calibration.method.split())}).",
        ]
        if self.verdict != "PASS":
            lines.insert(
                0, "NOT FIT FOR USE: exported although the verdict is no PASS."
            )
        if self.calibration.robot:
            given = ", ".join(
                f"{name} {value:.9g}" for name, value in self.calibration.robot.items()
            )
            lines.append(
                f"The robot's own errors were estimated ({given}; m, rad): the result "
                "holds for poses with these applied."
            )
        return lines


def number(value: float) -> str:
    """A number that reads back to the same bits, in YAML 1.1 as in XML."""
    text = repr(float(value))
    if "e" in text and "." not in text:
        # YAML 1.1 takes 1e-05 for a string.
        text = text.replace("e", ".0e")
    return text


def flat(values: Floats) -> str:
    """Numbers of any shape in one bracket, row by row."""
    return "[" + ", ".join(number(v) for v in np.ravel(values)) + "]"


def xyz_quaternion(motion: SE3) -> tuple[dict[str, str], dict[str, str]]:
    """Translation by x y z, metres, and quaternion by x y z w, as text."""
    w, x, y, z = quaternion_wxyz(motion.rotation).tolist()
    translation = dict(zip("xyz", map(number, motion.translation), strict=True))
    return translation, {
        k: number(v) for k, v in zip("xyzw", (x, y, z, w), strict=True)
    }


def skew_effect_px(fy: float, cy: float, height: int, skew: float) -> float:
    """How far the skew factor moves a pixel at most, in pixels.

    ``u = fx x + skew y + cx``: what a reader without a skew factor leaves out.
    """
    return abs(skew) * max(cy, height - 1 - cy) / fy
