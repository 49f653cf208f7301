"""What flows between stages: frozen records whose arrays are copied and locked.

Indices: i counts the m cameras, j the n stations, k the markers A, B, C.
Metres, radians and pixels inside; files and people get mm and degrees by name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.camera import PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.se3 import SE3
from handeye_tri.triangle import Axis, TriangleRig

Floats = NDArray[np.float64]
StationKind = Literal["calibration", "evaluation"]


def locked(
    name: str, value: ArrayLike, shape: Sequence[int | None], *, finite: bool = True
) -> Floats:
    """Copy an array, check its shape, and lock it against writing.

    Args:
        name: What the message calls the array.
        value: Anything numpy reads as numbers.
        shape: Expected shape; None stands for any length.
        finite: Whether NaN and infinity are refused.

    Raises:
        InputError: the shape or a value does not fit.
    """
    array: Floats = np.array(value, dtype=float)
    fits = array.ndim == len(shape) and all(
        want is None or want == have
        for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = tuple("any" if want is None else want for want in shape)
        raise InputError(f"{name} must have shape {wanted}, got {array.shape}")
    if finite and not np.isfinite(array).all():
        raise InputError(f"{name} must be finite, got NaN or infinity")
    array.setflags(write=False)
    return array


@dataclass(frozen=True, slots=True, eq=False)
class Covariance:
    """A covariance matrix whose rows have names.

    Attributes:
        labels: Camera and quantity, such as "left.fx" or "base_from_left.x".
        matrix: Shape (p, p); units of the labelled quantities (px, m, rad).
    """

    labels: tuple[str, ...]
    matrix: Floats

    def __post_init__(self) -> None:
        """Lock; raise InputError where labels and matrix differ in length."""
        n = len(self.labels)
        object.__setattr__(
            self, "matrix", locked("covariance matrix", self.matrix, (n, n))
        )
        if len(set(self.labels)) != n:
            raise InputError("covariance labels must differ from each other")

    def _index(self, label: str) -> int:
        try:
            return self.labels.index(label)
        except ValueError:
            raise InputError(
                f"no quantity {label!r} in this covariance; it has "
                f"{', '.join(self.labels)}"
            ) from None

    def std(self, label: str) -> float:
        """Standard deviation of one quantity, in its unit."""
        i = self._index(label)
        return float(np.sqrt(self.matrix[i, i]))

    def block(self, labels: Sequence[str]) -> Floats:
        """Covariance of some quantities in the order asked, shape (q, q)."""
        rows = [self._index(label) for label in labels]
        return np.array(self.matrix[np.ix_(rows, rows)])

    def correlation(self) -> Floats:
        """Correlation matrix, shape (p, p); 0 beside a quantity without spread."""
        std = np.sqrt(np.diagonal(self.matrix))
        scale = np.where(std > 0, std, np.inf)
        result: Floats = self.matrix / np.outer(scale, scale)
        np.fill_diagonal(result, 1.0)
        return result


MOTION_QUANTITIES = ("x", "y", "z", "rx", "ry", "rz")


def motion_labels(name: str) -> tuple[str, ...]:
    """Labels of a motion's tangent, in order: x y z (m), rx ry rz (rad).

    The tangent is on the right: ``true = estimate @ SE3.exp(tangent)``.
    """
    return tuple(f"{name}.{quantity}" for quantity in MOTION_QUANTITIES)


@dataclass(frozen=True, slots=True, eq=False)
class Station:
    """Where the robot stops.

    Attributes:
        index: Position in the programme, from 0.
        kind: "calibration" stations are used, "evaluation" stations held out.
        joints: Shape (q,), rad or m; empty where the robot reports poses only.
        base_from_flange: The pose that the robot reports (in a plan: commands).
    """

    index: int
    kind: StationKind
    joints: Floats
    base_from_flange: SE3

    def __post_init__(self) -> None:
        """Lock the joints."""
        object.__setattr__(self, "joints", locked("joints", self.joints, (None,)))


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


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A robot programme.

    Attributes:
        stations: In the order of execution.
        half_turns: Which stations belong together.
        rejected: Rejected candidates by the check that rejected them.
        certificate: Numbers that the plan promises, by name; unit in the name.
        seed: What the plan was drawn from.
    """

    stations: tuple[Station, ...]
    half_turns: tuple[HalfTurn, ...]
    rejected: Mapping[str, int]
    certificate: Mapping[str, float]
    seed: int


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


@dataclass(frozen=True, slots=True, eq=False)
class Repeatability:
    """One standard deviation of the robot's pose error, per axis.

    Attributes:
        translation: Metres.
        rotation: Radians.
    """

    translation: float
    rotation: float

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
        for j, station in enumerate(self.stations):
            if station.index != j:
                raise InputError(
                    f"station {j} in the session has index {station.index}"
                )
        for turn in self.half_turns:
            if not (0 <= turn.before < n and 0 <= turn.after < n):
                raise InputError(f"{turn} names a station beyond the {n} there are")

    @property
    def base_from_flange(self) -> Floats:
        """Robot-reported poses, shape (n, 4, 4), metres."""
        return np.array([s.base_from_flange.matrix for s in self.stations])

    def indices(self, kind: StationKind) -> NDArray[np.intp]:
        """Indices of the stations of one kind, ascending."""
        return np.array(
            [s.index for s in self.stations if s.kind == kind], dtype=np.intp
        )


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """Cameras with their uncertainty.

    Attributes:
        cameras: The m calibrated cameras.
        reference_from_camera: Where each is; the first is the reference.
        covariance: Labels "<camera>.fx" ... "<camera>.k1" (px and bare numbers),
            and "reference_from_<camera>.x" ... for every camera after the first.
        chi2: Sum of squared whitened residuals.
        dof: Observations less unknowns; chi2 / dof is 1 for noise as assumed.
        residuals: Detected less predicted, px, NaN where unseen; shape
            (m, views, 3, 2), the views in the order that the function documents.
        condition: Condition number of the scaled normal matrix.
        cost_start: chi2 of the closed form.
        method: How this was reached.
        details: Numbers that a method adds, by name.
    """

    cameras: tuple[PinholeCamera, ...]
    reference_from_camera: tuple[SE3, ...]
    covariance: Covariance
    chi2: float
    dof: int
    residuals: Floats
    condition: float
    cost_start: float
    method: str
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def camera(self) -> PinholeCamera:
        """The camera, where there is just one."""
        if len(self.cameras) != 1:
            names = ", ".join(camera.name for camera in self.cameras)
            raise InputError(f"there are several cameras ({names}): use .cameras")
        return self.cameras[0]


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeCalibration:
    """The whole cell: cameras in the robot base, the rig on the flange.

    Attributes:
        cameras: The m calibrated cameras.
        base_from_camera: Where each camera stands.
        flange_from_triangle: How the rig sits on the flange.
        markers: A, B, C in the flange frame, shape (3, 3), metres.
        covariance: Labels as in CameraCalibration, and "base_from_<camera>.x" ...,
            "flange_from_triangle.x" ....
        chi2: Sum of squared whitened residuals of the hand-eye step.
        dof: Its degrees of freedom.
        residuals: One tangent per calibration station, shape (n, 6), m and rad:
            the log of (robot chain)^-1 @ (camera chain).
        method: How this was reached.
        alternatives: What other solvers give for base_from_<first camera>.
    """

    cameras: tuple[PinholeCamera, ...]
    base_from_camera: tuple[SE3, ...]
    flange_from_triangle: SE3
    markers: Floats
    covariance: Covariance
    chi2: float
    dof: int
    residuals: Floats
    method: str
    alternatives: Mapping[str, SE3] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Lock the arrays."""
        object.__setattr__(self, "markers", locked("markers", self.markers, (3, 3)))
        object.__setattr__(
            self, "residuals", locked("residuals", self.residuals, (None, 6))
        )


@dataclass(frozen=True, slots=True, eq=False)
class GroundTruth:
    """What only a simulation knows; estimators never see it.

    Attributes:
        cameras: The true cameras.
        base_from_camera: Where they truly stand.
        flange_from_triangle: How the rig truly sits.
        base_from_flange: True flange poses, shape (n, 4, 4), metres.
    """

    cameras: tuple[PinholeCamera, ...]
    base_from_camera: tuple[SE3, ...]
    flange_from_triangle: SE3
    base_from_flange: Floats

    def __post_init__(self) -> None:
        """Lock the poses."""
        object.__setattr__(
            self,
            "base_from_flange",
            locked("base_from_flange", self.base_from_flange, (None, 4, 4)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class TrackEvaluation:
    """Robot-reported against observed marker positions at held-out stations.

    Rows are markers seen by at least two cameras, station by station.

    Attributes:
        stations: Station index of each row, shape (r,).
        markers: Marker index 0, 1, 2 of each row, shape (r,).
        reported: base_from_flange (reported) applied to the markers, (r, 3), m.
        observed: Triangulated positions in base, (r, 3), m.
        predicted_covariance: Of observed - reported, shape (r, 3, 3), m^2.
    """

    stations: NDArray[np.intp]
    markers: NDArray[np.intp]
    reported: Floats
    observed: Floats
    predicted_covariance: Floats

    def __post_init__(self) -> None:
        """Lock; raise InputError where there is no row."""
        r = len(self.stations)
        if r == 0:
            raise InputError(
                "no marker of a held-out station was seen by two cameras; "
                "the track cannot be evaluated"
            )
        for name, shape in (
            ("reported", (r, 3)),
            ("observed", (r, 3)),
            ("predicted_covariance", (r, 3, 3)),
        ):
            object.__setattr__(self, name, locked(name, getattr(self, name), shape))

    @property
    def errors(self) -> Floats:
        """Observed less reported, shape (r, 3), metres."""
        return np.asarray(self.observed - self.reported)

    @property
    def distances(self) -> Floats:
        """Length of each error, shape (r,), metres."""
        return np.asarray(np.linalg.norm(self.errors, axis=1))

    @property
    def mean(self) -> float:
        """Mean distance, metres."""
        return float(self.distances.mean())

    @property
    def rms(self) -> float:
        """Root mean square distance, metres."""
        return float(np.sqrt(np.mean(self.distances**2)))

    @property
    def max(self) -> float:
        """Largest distance, metres."""
        return float(self.distances.max())

    @property
    def predicted_rms(self) -> float:
        """Root mean square distance that the covariances predict, metres."""
        return float(
            np.sqrt(np.trace(self.predicted_covariance, axis1=1, axis2=2).mean())
        )
