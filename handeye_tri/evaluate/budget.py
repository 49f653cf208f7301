"""How much of the predicted track error each part of the cell is answerable for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from handeye_tri.evaluate.derivatives import rig_labels
from handeye_tri.records import HandEyeCalibration, motion_labels

Floats = NDArray[np.float64]

# With more cameras their intrinsics are one part: subsets double with every part.
_MAX_SINGLE_CAMERAS = 4


@dataclass(frozen=True, slots=True, eq=False)
class TrackBudget:
    """Where the predicted track error comes from; RMS of the 3-D distance, metres.

    Attributes:
        calibration: From the calibration's covariance.
        pixels: From the noise of the held-out views.
        robot: From the robot's repeatability at the held-out stations.
        calibration_parts: The calibration's part split further, by name: each camera
            ("<camera> camera"; "cameras" where there are more than four), "stereo",
            "hand-eye", "rig" ("rig, mount 1" ... where there are several mounts),
            "robot parameters". Their squares add up to its square.
    """

    calibration: float
    pixels: float
    robot: float
    calibration_parts: Mapping[str, float] = field(default_factory=dict)

    @property
    def total(self) -> float:
        """All three together, metres; they are independent."""
        return float(np.hypot(np.hypot(self.calibration, self.pixels), self.robot))

    def parts(self) -> dict[str, float]:
        """Everything that adds up (in squares) to the total, metres, by name."""
        return {**self.calibration_parts, "pixels": self.pixels, "robot": self.robot}


def calibration_parts(
    calibration: HandEyeCalibration, by_parameters: Floats
) -> dict[str, float]:
    """Shapley effects of the parts of a cell on the mean square track error.

    Estimates of one calibration correlate strongly, so that parts' own variances do
    not add up. The variance that knowing a part would remove, averaged over all orders
    in which the parts could become known, does, and is never negative (Song, Nelson
    and Staum 2016, doi:10.1137/15M1048070; in closed form for normal errors).

    Args:
        calibration: The cell with its covariance.
        by_parameters: Derivative of positions by its labels, shape (r, 3, p).

    Returns:
        RMS in metres by part, see :class:`TrackBudget`.
    """
    owners, change = _parameters(calibration)
    covariance = change @ calibration.covariance.matrix @ change.T
    # Positions depend on the labels through these parameters alone.
    slope = by_parameters @ _inverse_change(calibration, change)
    weight = np.einsum("rai,raj->ij", slope, slope) / len(slope)
    parts = list(dict.fromkeys(owners))
    groups = [np.flatnonzero([owner == part for owner in owners]) for part in parts]
    known = {
        subset: _explained(covariance, weight, [groups[k] for k in subset])
        for size in range(len(parts) + 1)
        for subset in combinations(range(len(parts)), size)
    }
    shares = {}
    for k, part in enumerate(parts):
        total = 0.0
        for subset, value in known.items():
            if k not in subset:
                joined = tuple(sorted((*subset, k)))
                share = len(parts) * comb(len(parts) - 1, len(subset))
                total += (known[joined] - value) / share
        shares[part] = float(np.sqrt(max(total, 0.0)))
    return shares


def _explained(
    covariance: Floats, weight: Floats, groups: Sequence[NDArray[np.intp]]
) -> float:
    """Mean square that disappears when some parameters become known, m^2."""
    if not groups:
        return 0.0
    index = np.concatenate(groups)
    std = np.sqrt(np.diagonal(covariance)[index])
    index, std = index[std > 0], std[std > 0]
    scaled = covariance[np.ix_(index, index)] / np.outer(std, std)
    columns = covariance[:, index] / std
    inverse = np.linalg.pinv(scaled, rcond=1e-11, hermitian=True)
    # The trace of weight @ columns @ inverse @ columns.T.
    return float(((weight @ columns) * (columns @ inverse)).sum())


def _parameters(calibration: HandEyeCalibration) -> tuple[list[str], Floats]:
    """The part that each independent parameter belongs to; those by the labels, (q, p).

    Camera places are taken as the first in the base and the others in the first.
    """
    labels = calibration.covariance.labels
    eye = np.eye(len(labels))

    def rows(names: Sequence[str]) -> Floats:
        return eye[[labels.index(name) for name in names]]

    owners: list[str] = []
    change: list[Floats] = []
    names = [camera.name for camera in calibration.cameras]
    for name in names:
        own = [label for label in labels if label.rsplit(".", 1)[0] == name]
        part = f"{name} camera" if len(names) <= _MAX_SINGLE_CAMERAS else "cameras"
        owners += [part] * len(own)
        change.append(rows(own))
    first = rows(motion_labels(f"base_from_{names[0]}"))
    for name, motion in zip(names[1:], calibration.base_from_camera[1:], strict=True):
        # Z0 exp(d0) M exp(d) = Zi exp(di): d = di - Ad(M^-1) d0.
        back = (motion.inverse() @ calibration.base_from_camera[0]).adjoint()
        owners += ["stereo"] * 6
        change.append(rows(motion_labels(f"base_from_{name}")) - back @ first)
    owners += ["hand-eye"] * 6
    change.append(first)
    mounts = len(calibration.mounts)
    for mount in range(mounts):
        rig = rig_labels(calibration, mount)
        owners += ["rig" if mounts == 1 else f"rig, mount {mount + 1}"] * len(rig)
        change.append(rows(rig))
    owners += ["robot parameters"] * len(calibration.robot)
    change.append(rows(tuple(calibration.robot)))
    return owners, np.concatenate(change)


def _inverse_change(calibration: HandEyeCalibration, change: Floats) -> Floats:
    """The labels on which positions depend, by the parameters of a part, (p, q)."""
    used = np.flatnonzero(change.any(axis=0))
    inverse = np.zeros(change.shape[::-1])
    inverse[used] = np.linalg.inv(change[:, used])
    return inverse
