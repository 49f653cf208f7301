"""What changed between two calibrations of one cell, against both covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from handeye_tri.camera import triangulate
from handeye_tri.errors import InputError
from handeye_tri.evaluate.derivatives import observed_by_parameters, rig_labels
from handeye_tri.evaluate.truth import compare_with_truth
from handeye_tri.records import GroundTruth, HandEyeCalibration, motion_labels

Floats = NDArray[np.float64]
Part = Literal["intrinsics", "place", "between", "rig"]

# One in a hundred comparisons of an unchanged cell names a change.
FALSE_ALARMS = 0.01


@dataclass(frozen=True, slots=True)
class PartChange:
    """How one part of a cell changed.

    Attributes:
        part: "intrinsics" and "place" of a camera in the base, its place "between" the
            cameras (in the first), or the "rig" on the flange.
        camera: Whose; "" of the rig.
        moved: Length of its translation, m; of the rig, the markers' rms
            displacement. 0 for intrinsics.
        turned: Its rotation angle, rad; 0 for intrinsics and the rig.
        chi2: Squared Mahalanobis length of the change under the sum of both
            covariances.
        dof: Degrees of freedom of chi2.
        p_value: How often noise alone changes it as much.
        changed: Whether that is too seldom, all parts taken together.
        mount: Of a rig that has several mounts, on which, from 0; else -1.
    """

    part: Part
    camera: str
    moved: float
    turned: float
    chi2: float
    dof: int
    p_value: float
    changed: bool
    mount: int = -1


@dataclass(frozen=True, slots=True)
class PlacementChange:
    """How far off the old calibration places what the cameras see now, metres.

    Attributes:
        points: At how many places.
        rms: Displacement, root mean square.
        max: The largest.
        expected_rms: What the noise of both calibrations alone gives.
    """

    points: int
    rms: float
    max: float
    expected_rms: float


def as_reference(calibration: HandEyeCalibration) -> GroundTruth:
    """A calibration as what another of the same cell is set against."""
    return GroundTruth(
        calibration.cameras,
        calibration.base_from_camera,
        calibration.flange_from_triangle,
        np.empty((0, 4, 4)),
        calibration.markers,
        calibration.other_mounts,
    )


def part_changes(
    before: HandEyeCalibration, after: HandEyeCalibration
) -> tuple[PartChange, ...]:
    """Test every part of the cell for a change.

    The two calibrations must have independent errors. A part is tested in all its
    quantities at once: d' (P_before + P_after)^-1 d is chi-squared where nothing
    changed (a motion's d is the right tangent of before^-1 @ after). All parts
    together raise a false alarm at most FALSE_ALARMS of the time (Holm 1979).

    Args:
        before: The older calibration.
        after: The newer, with the same cameras and the same unknowns.

    Raises:
        InputError: they do not have the same unknowns.
    """
    labels = before.covariance.labels
    mounts = [len(one.mounts) for one in (before, after)]
    if mounts[0] != mounts[1]:
        raise InputError(
            f"before there {_mounts(mounts[0])} of the rig, after there "
            f"{_mounts(mounts[1])}; compare sessions with the same mounts"
        )
    if set(labels) != set(after.covariance.labels):
        odd = sorted(set(labels) ^ set(after.covariance.labels))
        raise InputError(
            f"the calibrations do not have the same unknowns ({', '.join(odd[:3])} in "
            "one of them only); calibrate both sessions alike"
        )
    change = {
        row.quantity: row.error
        for row in compare_with_truth(after, as_reference(before))
    }
    covariance = before.covariance.matrix + after.covariance.block(labels)
    tested: list[tuple[Part, str, float, float, float, int, float]] = []
    parts = _parts(before)
    for part, camera, mount, names in parts:
        rows = [labels.index(name) for name in names]
        step = np.array([change[name] for name in names])
        chi2, dof = _mahalanobis(step, covariance[np.ix_(rows, rows)])
        moved = turned = 0.0
        if part in ("place", "between"):
            moved = float(np.linalg.norm(step[:3]))
            turned = float(np.linalg.norm(step[3:]))
        elif part == "rig":
            markers = [one.mounts[max(mount, 0)].markers for one in (before, after)]
            gaps = np.linalg.norm(markers[1] - markers[0], axis=1)
            moved = float(np.sqrt((gaps**2).mean()))
        p_value = float(stats.chi2.sf(chi2, dof)) if dof else 1.0
        tested.append((part, camera, moved, turned, chi2, dof, p_value))
    changed = _holm([row[-1] for row in tested])
    return tuple(
        PartChange(*row, changed=one, mount=mount)
        for row, one, (_, _, mount, _) in zip(tested, changed, parts, strict=True)
    )


def _mounts(count: int) -> str:
    return "is 1 mount" if count == 1 else f"are {count} mounts"


def placement_change(
    before: HandEyeCalibration, after: HandEyeCalibration, points: Floats
) -> PlacementChange:
    """Where the old calibration places points that the cameras see now.

    Args:
        before: The older calibration.
        after: The newer, with the same cameras and unknowns.
        points: In the base, shape (n, 3), metres, by the newer calibration.

    Raises:
        InputError: no point is seen by two cameras.
    """
    pixels = np.full((len(after.cameras), len(points), 2), np.nan)
    for i, camera in enumerate(after.cameras):
        seen = camera.project(after.base_from_camera[i].inverse().apply(points))
        limit = np.array(camera.image_size, dtype=float) - 0.5
        inside = ((seen > -0.5) & (seen < limit)).all(axis=-1, keepdims=True)
        pixels[i] = np.where(inside, seen, np.nan)
    seen_by = np.isfinite(pixels).all(axis=-1)
    rows = np.flatnonzero(seen_by.sum(axis=0) >= 2)
    if not len(rows):
        raise InputError("none of the places is seen by two cameras")
    noise = np.where(seen_by[..., None, None], np.eye(2), np.nan)[:, rows]
    there, _ = triangulate(
        before.cameras, before.base_from_camera, pixels[:, rows], noise
    )
    _, unit = triangulate(after.cameras, after.base_from_camera, pixels[:, rows], noise)
    slope = observed_by_parameters(after, points[rows], unit, noise)
    labels = after.covariance.labels
    covariance = after.covariance.matrix + before.covariance.block(labels)
    spread = np.einsum("rai,ij,raj->r", slope, covariance, slope)
    gaps = np.linalg.norm(there - points[rows], axis=1)
    return PlacementChange(
        len(rows),
        float(np.sqrt((gaps**2).mean())),
        float(gaps.max()),
        float(np.sqrt(spread.mean())),
    )


def _parts(
    calibration: HandEyeCalibration,
) -> list[tuple[Part, str, int, tuple[str, ...]]]:
    """Every part of a cell: camera, mount, and the labels of its quantities."""
    labels = calibration.covariance.labels
    parts: list[tuple[Part, str, int, tuple[str, ...]]] = []
    names = [camera.name for camera in calibration.cameras]
    for name in names:
        own = tuple(label for label in labels if label.rsplit(".", 1)[0] == name)
        parts.append(("intrinsics", name, -1, own))
    parts += [("place", name, -1, motion_labels(f"base_from_{name}")) for name in names]
    for name in names[1:]:
        parts.append(("between", name, -1, motion_labels(f"reference_from_{name}")))
    count = len(calibration.mounts)
    for mount in range(count):
        own = rig_labels(calibration, mount)
        parts.append(("rig", "", mount if count > 1 else -1, own))
    return parts


def _mahalanobis(step: Floats, covariance: Floats) -> tuple[float, int]:
    """Squared length of a step under a covariance, and the covariance's rank."""
    std = np.sqrt(np.diagonal(covariance))
    used = std > 0
    if not used.any():
        return 0.0, 0
    scaled = covariance[np.ix_(used, used)] / np.outer(std[used], std[used])
    values, vectors = np.linalg.eigh(scaled)
    # What neither calibration left free has no spread to be measured by.
    kept = values > 1e-10
    along = vectors[:, kept].T @ (step[used] / std[used])
    return float((along**2 / values[kept]).sum()), int(kept.sum())


def _holm(p_values: Sequence[float]) -> list[bool]:
    """Which of several tests fail when all are made at once.

    Holm (1979), Scandinavian Journal of Statistics 6, 65-70.
    """
    failed = [False] * len(p_values)
    order = sorted(range(len(p_values)), key=lambda k: p_values[k])
    for rank, k in enumerate(order):
        if p_values[k] > FALSE_ALARMS / (len(p_values) - rank):
            break
        failed[k] = True
    return failed
