"""What is planned and measured: stations, half-turns, detected markers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from handeye_tri import arguments
from handeye_tri.camera import LENS_COEFFICIENTS
from handeye_tri.errors import InputError
from handeye_tri.records.arrays import Floats, locked
from handeye_tri.se3 import SE3
from handeye_tri.triangle import AXES, VERTICES, Axis, TriangleRig

StationKind = Literal["calibration", "evaluation"]


@dataclass(frozen=True, slots=True, eq=False)
class Station:
    """Where the robot stops.

    Attributes:
        index: Position in the programme, from 0.
        kind: "calibration" stations are used, "evaluation" stations held out.
        joints: Shape (q,), rad or m; empty where the robot reports poses only.
        base_from_flange: The pose that the robot reports (in a plan: commands).
        mount: Which of the cell's mounts holds the triangle there, from 0.
    """

    index: int
    kind: StationKind
    joints: Floats
    base_from_flange: SE3
    mount: int = 0

    def __post_init__(self) -> None:
        """Lock the joints; raise InputError where the kind or the mount is none."""
        object.__setattr__(self, "joints", locked("joints", self.joints, (None,)))
        if self.kind not in get_args(StationKind):
            raise InputError(
                f"station {self.index}: kind must be one of "
                f"{', '.join(get_args(StationKind))}, got {self.kind!r}"
            )
        if self.mount < 0:
            raise InputError(
                f"station {self.index}: mount must be 0 or more, got {self.mount}"
            )


@dataclass(frozen=True, slots=True)
class HalfTurn:
    """Two stations that differ by 180 degrees about an axis of the triangle.

    Attributes:
        before: Index of the station before the turn.
        after: Index of the station after it.
        axis: "normal", "AB", "BC" or "CA".
    """

    before: int
    after: int
    axis: Axis

    def __post_init__(self) -> None:
        """Raise InputError where the axis is none or nothing turns."""
        if self.axis not in AXES:
            raise InputError(
                f"a half-turn's axis must be one of {', '.join(AXES)}, "
                f"got {self.axis!r}"
            )
        if self.before == self.after:
            raise InputError(
                f"a half-turn needs two stations, got {self.before} for both"
            )


@dataclass(frozen=True, slots=True)
class DroppedHalfTurn:
    """A half-turn that disagrees with the others, as one camera saw it.

    Attributes:
        camera: Name of the camera.
        half_turn: Index among the session's half-turns.
        before: Index of its first station.
        after: Index of its second station.
        why: What is likely wrong, as "labels exchanged after it: its A, B, C are BAC".
    """

    camera: str
    half_turn: int
    before: int
    after: int
    why: str

    def __str__(self) -> str:
        """One line."""
        return (
            f"{self.camera}, half-turn {self.half_turn} (stations {self.before} and "
            f"{self.after}): {self.why}"
        )


@dataclass(frozen=True, slots=True, eq=False)
class ToolChange:
    """Where a programme waits for the triangle to be put on another mount.

    Attributes:
        before: Index of the first station with the other mount; 0: the robot carries
            another one where the programme starts.
        joints: Where the robot waits, shape (q,), rad or m.
        via: Joints to pass on the way there, shape (k, q), rad or m, straight in
            joint space from one to the next.
    """

    before: int
    joints: Floats
    via: Floats

    def __post_init__(self) -> None:
        """Lock the joints; raise InputError where their shapes differ."""
        joints = locked("joints", self.joints, (None,))
        object.__setattr__(self, "joints", joints)
        via = locked("via", self.via, (None, len(joints)))
        object.__setattr__(self, "via", via)


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A robot programme.

    Attributes:
        stations: In the order of execution.
        half_turns: Which stations belong together.
        rejected: Rejected candidates by the check that rejected them.
        certificate: Numbers that the plan promises, by name; unit in the name.
        seed: What the plan was drawn from.
        outcome: PASS where the stations determine everything well enough, else FAIL
            or CANNOT TELL.
        findings: What is not determined well, and what to do; one sentence each.
        via: Joints to pass on the way to each station, shapes (k, q), rad or m,
            straight in joint space from one to the next; nothing given: no points.
        tool_change: Where the triangle is put on the cell's other mount; None where
            all stations have the same one.
    """

    stations: tuple[Station, ...]
    half_turns: tuple[HalfTurn, ...]
    rejected: Mapping[str, int]
    certificate: Mapping[str, float]
    seed: int
    outcome: Literal["PASS", "FAIL", "CANNOT TELL"]
    findings: tuple[str, ...]
    via: tuple[Floats, ...] = ()
    tool_change: ToolChange | None = None

    def __post_init__(self) -> None:
        """Lock the points passed.

        Raises:
            InputError: they are not one array a station, or the tool change is not
                where the stations' mount changes.
        """
        if not self.via:
            straight = tuple(np.zeros((0, len(s.joints))) for s in self.stations)
            object.__setattr__(self, "via", straight)
        if len(self.via) != len(self.stations):
            raise InputError(
                f"via must have one array for each of {len(self.stations)} stations, "
                f"got {len(self.via)}"
            )
        passed = tuple(locked("via", points, (None, None)) for points in self.via)
        object.__setattr__(self, "via", passed)
        mounts = [s.mount for s in self.stations]
        changes = [k for k in range(1, len(mounts)) if mounts[k] != mounts[k - 1]]
        stated = [] if self.tool_change is None else [self.tool_change.before]
        # Before the first station: the robot carries the other mount until then.
        if changes != stated and not (stated == [0] and not changes):
            raise InputError(
                f"the stations' mount changes before {changes or 'no station'}, the "
                f"tool change is before {stated or 'no station'}; there must be one "
                "tool change, where the mount changes"
            )


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """What is known of a camera before calibration, and what is to be estimated.

    Attributes:
        name: What the camera is called.
        image_size: (width, height), pixels.
        skew: Whether the skew factor is estimated (else it is zero).
        lens: Names of the lens coefficients to estimate; empty for a pinhole.
        lens_model: "radtan" or "rational"; the meaning of those names.
    """

    name: str
    image_size: tuple[int, int]
    skew: bool = True
    lens: tuple[str, ...] = ()
    lens_model: Literal["radtan", "rational"] = "radtan"

    def __post_init__(self) -> None:
        """Raise InputError where a field cannot be used."""
        arguments.title("name of a camera", self.name)
        size = arguments.image_size(
            f"camera {self.name!r}: image_size", self.image_size
        )
        object.__setattr__(self, "image_size", size)
        arguments.flag(f"camera {self.name!r}: skew", self.skew)
        known = LENS_COEFFICIENTS.get(self.lens_model, ())
        if not known or not set(self.lens) <= set(known):
            raise InputError(
                f"camera {self.name!r}: lens {list(self.lens)} must name coefficients "
                f"of a {' or '.join(LENS_COEFFICIENTS)} lens, got model "
                f"{self.lens_model!r}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Repeatability:
    """One standard deviation of the robot's pose error, per axis.

    Attributes:
        translation: Metres.
        rotation: Radians.
    """

    translation: float
    rotation: float

    def __post_init__(self) -> None:
        """Raise InputError where a deviation is negative or not finite."""
        for name in ("translation", "rotation"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InputError(
                    f"repeatability: {name} must be 0 or more, got {value}"
                )

    @property
    def covariance(self) -> Floats:
        """Covariance of the tangent (translation, rotation), shape (6, 6)."""
        return np.diag([self.translation**2] * 3 + [self.rotation**2] * 3)


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """All that the estimators get to know, whatever its source.

    Attributes:
        triangle: The three-point rig.
        marker_radii: Shape (3,), metres; zero for flat dots.
        cameras: What is known of the m cameras.
        stations: The n stations, with the poses that the robot reported.
        half_turns: Pairs of calibration stations.
        pixels: Shape (m, n, 3, 2); centres of A, B, C as detected; NaN = unseen.
        pixel_covariance: Shape (m, n, 3, 2, 2), px^2; NaN where unseen.
        repeatability: The robot's stated repeatability.
        simulated: Whether a ground truth exists somewhere.
    """

    triangle: TriangleRig
    marker_radii: Floats
    cameras: tuple[CameraInfo, ...]
    stations: tuple[Station, ...]
    half_turns: tuple[HalfTurn, ...]
    pixels: Floats
    pixel_covariance: Floats
    repeatability: Repeatability
    simulated: bool

    def __post_init__(self) -> None:
        """Lock; raise InputError where shapes or indices do not fit together."""
        m, n = len(self.cameras), len(self.stations)
        for name, value, shape, finite in (
            ("marker_radii", self.marker_radii, (3,), True),
            ("pixels", self.pixels, (m, n, 3, 2), False),
            ("pixel_covariance", self.pixel_covariance, (m, n, 3, 2, 2), False),
        ):
            object.__setattr__(self, name, locked(name, value, shape, finite=finite))
        names = [camera.name for camera in self.cameras]
        if len(set(names)) < m:
            raise InputError(f"camera names must differ, got {', '.join(names)}")
        carried = set(self.mounts.tolist())
        if carried != set(range(len(carried))):
            raise InputError(
                f"the stations' mounts must be numbered from 0 without a gap, got "
                f"{sorted(carried)}"
            )
        for j, station in enumerate(self.stations):
            if station.index != j:
                raise InputError(
                    f"station {j} in the session has index {station.index}"
                )
        for turn in self.half_turns:
            if not (0 <= turn.before < n and 0 <= turn.after < n):
                raise InputError(f"{turn} names a station beyond the {n} there are")
            for j in (turn.before, turn.after):
                if self.stations[j].kind != "calibration":
                    raise InputError(
                        f"{turn} uses station {j}, which is held out for evaluation"
                    )
            if self.stations[turn.before].mount != self.stations[turn.after].mount:
                raise InputError(
                    f"{turn} joins stations with different mounts; a half-turn is "
                    "made without a tool change"
                )
        seen = np.isfinite(self.pixels).all(axis=-1)
        weighed = np.isfinite(self.pixel_covariance).all(axis=(-2, -1))
        if (seen & ~weighed).any():
            i, j, k = np.argwhere(seen & ~weighed)[0]
            raise InputError(
                f"camera {names[i]!r}, station {j}, marker {VERTICES[k]}: a detected "
                "pixel needs a finite covariance"
            )

    @property
    def base_from_flange(self) -> Floats:
        """Robot-reported poses, shape (n, 4, 4), metres."""
        return np.array([s.base_from_flange.matrix for s in self.stations])

    @property
    def mounts(self) -> NDArray[np.intp]:
        """Which mount holds the triangle at each station, shape (n,), from 0."""
        return np.array([s.mount for s in self.stations], dtype=np.intp)

    def mount_name(self, mount: int) -> str:
        """What a person calls a mount (from 0): by its number and its half-turns."""
        axes = dict.fromkeys(
            turn.axis
            for turn in self.half_turns
            if self.stations[turn.before].mount == mount
        )
        about = " and ".join(
            "a normal" if axis == "normal" else f"its edge {axis}" for axis in axes
        )
        return f"mount {mount + 1}" + (f" (about {about})" if about else "")

    def without(self, dropped: Sequence[DroppedHalfTurn]) -> Session:
        """The same session with the views of these half-turns unseen.

        Only the camera that is named loses them; others keep theirs.

        Raises:
            InputError: the session has no camera of that name.
        """
        if not dropped:
            return self
        names = [camera.name for camera in self.cameras]
        pixels, covariance = self.pixels.copy(), self.pixel_covariance.copy()
        for one in dropped:
            if one.camera not in names:
                raise InputError(
                    f"the session has no camera {one.camera!r}, only {', '.join(names)}"
                )
            views = names.index(one.camera), [one.before, one.after]
            pixels[views], covariance[views] = np.nan, np.nan
        return replace(self, pixels=pixels, pixel_covariance=covariance)

    def indices(self, kind: StationKind) -> NDArray[np.intp]:
        """Indices of the stations of one kind, ascending."""
        return np.array(
            [s.index for s in self.stations if s.kind == kind], dtype=np.intp
        )
