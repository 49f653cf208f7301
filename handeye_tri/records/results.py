"""What is estimated, what only a simulation knows, and how well they agree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.records.arrays import Floats, locked
from handeye_tri.records.covariance import Covariance
from handeye_tri.se3 import SE3


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
            (m, views, p, 2), p the points of a target (3 of a triangle), the views in
            the order that the function documents.
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

    def __post_init__(self) -> None:
        """Lock; raise InputError unless each camera has a place and residuals."""
        m = len(self.cameras)
        if len(self.reference_from_camera) != m:
            raise InputError(
                f"{m} cameras need as many motions, "
                f"got {len(self.reference_from_camera)}"
            )
        residuals = locked(
            "residuals", self.residuals, (m, None, None, 2), finite=False
        )
        object.__setattr__(self, "residuals", residuals)

    @property
    def camera(self) -> PinholeCamera:
        """The camera, where there is just one."""
        if len(self.cameras) != 1:
            names = ", ".join(camera.name for camera in self.cameras)
            raise InputError(f"there are several cameras ({names}): use .cameras")
        return self.cameras[0]


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """How the rig sits on the flange.

    Attributes:
        flange_from_triangle: Where the triangle's frame is.
        markers: A, B, C in the flange frame, shape (3, 3), metres.
    """

    flange_from_triangle: SE3
    markers: Floats

    def __post_init__(self) -> None:
        """Lock the markers."""
        object.__setattr__(self, "markers", locked("markers", self.markers, (3, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeCalibration:
    """The whole cell: cameras in the robot base, the rig on the flange.

    Attributes:
        cameras: The m calibrated cameras.
        base_from_camera: Where each camera stands.
        flange_from_triangle: How the rig sits on the flange.
        markers: A, B, C in the flange frame, shape (3, 3), metres.
        covariance: Labels as in CameraCalibration, and "base_from_<camera>.x" ...,
            "flange_from_triangle.x" ...; where the markers are estimated,
            "marker_A.x" ... in the flange frame (m), those of a second mount as
            "flange_from_triangle_2.x" and "marker_A_2.x", and those of ``robot``.
        chi2: Sum of squared whitened residuals of the hand-eye step.
        dof: Its degrees of freedom.
        residuals: One tangent per calibration station, shape (n, 6), m and rad:
            the log of (robot chain)^-1 @ (camera chain).
        method: How this was reached.
        alternatives: What other solvers give for base_from_<first camera>.
        robot: Systematic errors of the robot that were estimated, by label (m, rad,
            s): true poses are the reported ones with these applied.
        details: Numbers that a method adds, by name.
        other_mounts: How the rig sits after a tool change; mostly there is none.
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
    robot: Mapping[str, float] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)
    other_mounts: tuple[Mount, ...] = ()

    def __post_init__(self) -> None:
        """Lock; raise InputError unless each camera has a place."""
        if len(self.base_from_camera) != len(self.cameras):
            raise InputError(
                f"{len(self.cameras)} cameras need as many motions, "
                f"got {len(self.base_from_camera)}"
            )
        object.__setattr__(self, "markers", locked("markers", self.markers, (3, 3)))
        object.__setattr__(
            self, "residuals", locked("residuals", self.residuals, (None, 6))
        )

    @property
    def mounts(self) -> tuple[Mount, ...]:
        """Every mount, in the order of ``Station.mount``."""
        return (Mount(self.flange_from_triangle, self.markers), *self.other_mounts)

    def markers_at(self, mounts: NDArray[np.intp]) -> Floats:
        """A, B, C in the flange frame at stations, shape (n, 3, 3), metres.

        Args:
            mounts: Of each station, shape (n,), from 0.
        """
        return np.array([mount.markers for mount in self.mounts])[mounts]


@dataclass(frozen=True, slots=True, eq=False)
class GroundTruth:
    """What only a simulation knows; estimators never see it.

    Attributes:
        cameras: The true cameras.
        base_from_camera: Where they truly stand.
        flange_from_triangle: How the rig truly sits.
        base_from_flange: True flange poses, shape (n, 4, 4), metres.
        markers: True A, B, C in the flange frame, shape (3, 3), metres; None where
            only the triangle's frame is known.
        other_mounts: How the rig truly sits after a tool change.
    """

    cameras: tuple[PinholeCamera, ...]
    base_from_camera: tuple[SE3, ...]
    flange_from_triangle: SE3
    base_from_flange: Floats
    markers: Floats | None = None
    other_mounts: tuple[Mount, ...] = ()

    def __post_init__(self) -> None:
        """Lock poses and markers."""
        object.__setattr__(
            self,
            "base_from_flange",
            locked("base_from_flange", self.base_from_flange, (None, 4, 4)),
        )
        if self.markers is not None:
            object.__setattr__(self, "markers", locked("markers", self.markers, (3, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class TrackEvaluation:
    """Robot-reported against observed marker positions at held-out stations.

    Rows are markers seen by at least two cameras, station by station; with one camera
    in the cell, those of stations at which it saw all three.

    Attributes:
        stations: Station index of each row, shape (r,).
        markers: Marker index 0, 1, 2 of each row, shape (r,).
        reported: base_from_flange (reported) applied to the markers, (r, 3), m.
        observed: Where the cameras see them in the base, (r, 3), m.
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
                "no marker of a held-out station was seen by two cameras (nor all "
                "three by a cell's only camera); the track cannot be evaluated"
            )
        for name in ("stations", "markers"):
            rows = np.array(getattr(self, name), dtype=np.intp)
            if rows.shape != (r,):
                raise InputError(f"{name} must have shape {(r,)}, got {rows.shape}")
            rows.setflags(write=False)
            object.__setattr__(self, name, rows)
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
