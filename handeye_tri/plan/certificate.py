"""What a programme promises before the robot moves, and whether that is enough."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from handeye_tri.config import Cell
from handeye_tri.counting import counted
from handeye_tri.plan.design import Design
from handeye_tri.plan.information import StationInformation
from handeye_tri.plan.poses import HALF_TURN, View, plane_angles
from handeye_tri.records import motion_labels, triangle_name
from handeye_tri.se3 import so3_log

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Outcome = Literal["PASS", "FAIL", "CANNOT TELL"]

# Least spread of the rotation axes between stations over 3-D: the smallest over the
# largest singular value of all axes.
MIN_AXIS_SPREAD = 0.1
# Eigenvalues of the information, scaled to unit diagonal, that count as zero: a
# station list that determines everything is above 1e-7.
_NO_INFORMATION = 1e-10
_EPSILON = float(np.finfo(float).eps)
# A distance of three normal components is below this many rms in 95 of 100 cases
# (root of chi-square's 95 % point, 3 degrees of freedom, over 3).
_WITHIN_95 = 1.614
# A focal length that is known worse than this is not calibrated.
_WORST_FOCAL = 0.01
# One whose focal length its own half-turns leave so open cannot be begun with: in
# simulations they begin to fail at 8 %.
_WORST_START = 0.05
# Half-turns drawn to find the best one to add.
_DRAWN = 1500
_PIXELS = ("fx", "fy", "skew", "cx", "cy")


@dataclass(frozen=True, slots=True, eq=False)
class Certificate:
    """What the stations of a programme tell about the cell.

    Attributes:
        numbers: By name, unit in the name; see :func:`certify`.
        outcome: PASS where everything is determined well enough.
        findings: What is not, with the remedy; one sentence each.
    """

    numbers: Mapping[str, float]
    outcome: Outcome
    findings: tuple[str, ...]


def certify(
    cell: Cell,
    model: StationInformation,
    base_from_flange: Floats,
    seen: NDArray[np.bool_],
    mounts: Ints,
    turns: Ints,
) -> Certificate:
    """Predict a calibration from its stations.

    The numbers are

    * ``sigma_px``: the detection error that the predictions assume,
    * ``plane_spread_deg``: largest angle between the triangle's planes at two
      half-turns; any two may lie nearer,
    * ``axis_spread``: smallest over largest singular value of the rotation axes
      between stations (1: all directions alike, 0: in a plane),
    * ``rank``, ``unknowns``, ``condition`` (at most 1 over the machine's precision):
      of the information, scaled to unit diagonal,
    * ``sigma.<camera>.fx_px`` (``fy_px skew_px cx_px cy_px``, lens by name),
      ``sigma.baseline_mm`` (of the first two cameras),
      ``sigma.base_from_<camera>.translation_mm`` and ``.rotation_deg``, and the same of
      ``flange_from_triangle``, of a second mount ``flange_from_triangle_2``:
      predicted standard deviations (for motions: of the three axes together),
    * ``mount_<k>.stations``, ``mount_<k>.half_turns``: how many have mount k, from 1,
      of a cell with two,
    * ``alone.<camera>.fx_px``: predicted standard deviation of a camera's focal length
      from its own half-turns, with which a calibration begins,
    * ``track_calibration_rms_mm``: the calibration's part of the predicted distance
      between reported and observed markers, over the workspace box,
    * ``track_predicted_rms_mm``: the same with the noise of a new view and of the
      robot.

    Args:
        cell: The cell.
        model: Predicts what stations tell.
        base_from_flange: Calibration stations, shape (n, 4, 4), metres.
        seen: Which cameras see all markers there, shape (n, m).
        mounts: Which mount holds the triangle there, shape (n,).
        turns: Stations before and after each half-turn, shape (k, 2).
    """
    information = model.of_stations(base_from_flange, seen, mounts).sum(axis=0)
    values, vectors = _scaled_spectrum(information)
    covariance = model.covariance(information)
    numbers = {
        "sigma_px": model.sigma_px,
        "plane_spread_deg": plane_spread_deg(
            model, base_from_flange[turns[:, 0]], mounts[turns[:, 0]]
        ),
        "axis_spread": axis_spread(base_from_flange[:, :3, :3]),
        "rank": float((values > _NO_INFORMATION).sum()),
        "unknowns": float(len(values)),
        "condition": _condition(values),
    }
    for camera in cell.cameras:
        for label in covariance.labels:
            owner, quantity = label.rsplit(".", 1)
            if owner == camera.name:
                unit = "_px" if quantity in _PIXELS else ""
                numbers[f"sigma.{label}{unit}"] = covariance.std(label)
    for camera in cell.cameras:
        name = f"base_from_{camera.name}"
        numbers |= _of_motion(name, covariance.block(motion_labels(name)))
    for mount in range(len(model.views)):
        rig = model.rig_covariance(covariance, mount)
        numbers |= _of_motion(triangle_name(mount), rig)
    numbers |= _by_mount(model, mounts, turns)
    if len(cell.cameras) > 1:
        numbers["sigma.baseline_mm"] = 1e3 * model.baseline_sigma(covariance)
    whole = np.asarray(seen[turns].all(axis=1))
    alone = model.focal_sigmas_alone(
        base_from_flange[turns], whole, mounts[turns[:, 0]]
    )
    for camera, sigma in zip(cell.cameras, alone, strict=True):
        numbers[f"alone.{camera.name}.fx_px"] = float(sigma)
    caused = float((model.workspace_cost * covariance.matrix).sum())
    numbers["track_calibration_rms_mm"] = float(1e3 * np.sqrt(caused))
    numbers["track_predicted_rms_mm"] = float(
        1e3 * np.sqrt(caused + model.workspace_noise)
    )
    undetermined = _undetermined(covariance.labels, values, vectors)
    findings = _findings(cell, numbers, undetermined, len(turns))
    findings += _without_station(cell, mounts) + _apart(cell, seen)
    if findings:
        findings.append(_addition(cell, model, information))
    elif small := _too_small(cell, numbers):
        findings = small
    cannot = bool(undetermined) or numbers["axis_spread"] < MIN_AXIS_SPREAD
    outcome: Outcome = "PASS"
    if findings:
        outcome = "CANNOT TELL" if cannot else "FAIL"
    return Certificate(numbers, outcome, tuple(findings))


def _of_motion(name: str, covariance: Floats) -> dict[str, float]:
    """Sigmas of a motion from the covariance (6, 6) of its right tangent."""
    sigma = np.sqrt(np.diag(covariance).reshape(2, 3).sum(axis=1))
    return {
        f"sigma.{name}.translation_mm": float(1e3 * sigma[0]),
        f"sigma.{name}.rotation_deg": float(np.degrees(sigma[1])),
    }


def _by_mount(model: StationInformation, mounts: Ints, turns: Ints) -> dict[str, float]:
    """How many stations and half-turns have each mount; nothing of a single one."""
    count = len(model.views)
    if count == 1:
        return {}
    stations = np.bincount(mounts, minlength=count)
    made = np.bincount(mounts[turns[:, 0]], minlength=count)
    numbers = {}
    for mount in range(count):
        numbers[f"mount_{mount + 1}.stations"] = float(stations[mount])
        numbers[f"mount_{mount + 1}.half_turns"] = float(made[mount])
    return numbers


def _scaled_spectrum(information: Floats) -> tuple[Floats, Floats]:
    """Ascending eigenvalues and eigenvectors at unit diagonal."""
    diagonal = np.diag(information)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    return np.asarray(values), np.asarray(vectors)


def _condition(values: Floats) -> float:
    """Largest over smallest eigenvalue, at most 1 over the machine's precision."""
    if values[-1] <= 0:
        return 1 / _EPSILON
    return float(values[-1] / max(values[0], _EPSILON * values[-1]))


def _undetermined(labels: tuple[str, ...], values: Floats, vectors: Floats) -> str:
    """The quantities that the weakest direction is made of; empty: none is."""
    if values[0] > _NO_INFORMATION:
        return ""
    share = np.square(vectors[:, values <= _NO_INFORMATION]).sum(axis=1)
    worst = np.argsort(-share, kind="stable")[:3]
    return ", ".join(labels[k] for k in worst)


def _findings(
    cell: Cell, numbers: Mapping[str, float], undetermined: str, turns: int
) -> list[str]:
    found = []
    if undetermined:
        found.append(
            f"the stations do not determine {undetermined} "
            f"(rank {numbers['rank']:.0f} of {numbers['unknowns']:.0f})"
        )
    if numbers["axis_spread"] < MIN_AXIS_SPREAD:
        found.append(
            f"the rotations hardly leave a plane (spread {numbers['axis_spread']:.3f}, "
            f"needs {MIN_AXIS_SPREAD}): the hand-eye transform is two-fold or free"
        )
    least = cell.plan.min_plane_spread_deg
    if turns < 2:
        found.append(
            f"{counted(turns, 'half-turn')}: at least 2, in planes "
            f"{least:.0f} degrees apart, are needed to calibrate a camera from three "
            "points"
        )
    elif numbers["plane_spread_deg"] < least:
        found.append(
            "the half-turns' planes are at most "
            f"{numbers['plane_spread_deg']:.1f} degrees apart, needs {least:.0f} "
            "(Proposition 1)"
        )
    for camera in cell.cameras:
        sigma = numbers[f"sigma.{camera.name}.fx_px"]
        if sigma > _WORST_FOCAL * camera.focal_px[0]:
            found.append(
                f"camera {camera.name}: fx would be known to {sigma:.1f} px only"
            )
    within = _WITHIN_95 * numbers["track_predicted_rms_mm"]
    if within > cell.track_limit_mm:
        found.append(
            f"markers would agree within {within:.2f} mm (95 %), limit "
            f"{cell.track_limit_mm:.2f} mm"
        )
    return found


def _too_small(cell: Cell, numbers: Mapping[str, float]) -> list[str]:
    """Cameras whose own half-turns leave too much open to begin with, and the remedy.

    Such a sigma goes with the square of the triangle's size in the image.
    """
    found, factor = [], 1.0
    for camera in cell.cameras:
        sigma = numbers[f"alone.{camera.name}.fx_px"]
        share = sigma / (_WORST_START * camera.focal_px[0])
        if share > 1:
            factor = max(factor, float(np.sqrt(share)))
            found.append(
                f"camera {camera.name}: its own half-turns leave fx open by "
                f"{sigma:.0f} px of {camera.focal_px[0]:.0f}, too much to begin a "
                "calibration with"
            )
    if found:
        found.append(
            f"Do: make the triangle {np.ceil(10 * factor) / 10:.1f} times larger in "
            "the images (a larger one, or nearer cameras), or add half-turns that are "
            "tilted otherwise"
        )
    return found


def _without_station(cell: Cell, mounts: Ints) -> list[str]:
    """Mounts that no station has."""
    return [
        f"no station has {cell.mount_name(mount)}: nothing tells where its markers are"
        for mount in sorted(set(range(len(cell.mounted))) - set(mounts.tolist()))
    ]


def _apart(cell: Cell, seen: NDArray[np.bool_]) -> list[str]:
    """Cameras that share no station with the first, nor through others."""
    together = seen.T.astype(int) @ seen > 0
    reached = np.zeros(len(cell.cameras), dtype=bool)
    reached[0] = True
    for _ in cell.cameras:
        reached |= together[reached].any(axis=0)
    if reached.all():
        return []
    names = [c.name for c, near in zip(cell.cameras, reached, strict=True) if not near]
    return [
        f"no chain of common views joins {cell.cameras[0].name} with "
        f"{', '.join(names)}: only the robot ties them together"
    ]


def _addition(cell: Cell, model: StationInformation, information: Floats) -> str:
    """Which half-turn helps most, in words; looks at cameras, not at the arm."""
    options = []
    for mount, view in enumerate(model.views):
        world = view.draw(np.random.default_rng(0), _DRAWN)
        seen = view.seen(world) & view.seen(world @ HALF_TURN)
        enough = seen.sum(axis=1) >= view.required
        world, seen = world[enough], seen[enough]
        if len(world) == 0:
            continue
        base = model.base_from_world @ world
        design = Design(
            model.of_half_turns(
                np.stack([base, base @ HALF_TURN], axis=1),
                seen,
                np.full(len(world), mount, dtype=np.intp),
            ),
            model.prior + information,
            model.workspace_cost,
        )
        costs = [design.cost(row) for row in np.eye(len(world))]
        best = int(np.argmin(costs))
        options.append((costs[best], mount, world[best]))
    if not options:
        return "Do: turn the cameras to the workspace box; no half-turn there is seen"
    cost, mount, pose = min(options, key=lambda option: option[0])
    whose = f"of {cell.mount_name(mount)}, " if len(model.views) > 1 else ""
    return (
        f"Do: add a half-turn {whose}{_described(model.views[mount], pose)}; then the "
        "calibration's part of the track error is "
        f"{1e3 * np.sqrt(cost):.3f} mm"
    )


def _described(view: View, world_from_flange: Floats) -> str:
    """Tilt about an axis of the first camera's image, and the place, in words."""
    pose = view.world_from_camera[0]
    centre = view.marker_positions(world_from_flange[None])[0].mean(axis=0)
    normal = pose[:3, :3].T @ view.normals(world_from_flange[None])[0]
    normal *= -np.sign(normal[2]) or 1.0
    tilt = np.degrees(np.arctan2(np.hypot(normal[0], normal[1]), abs(normal[2])))
    # The normal leans towards (x, y); it was turned about the axis across that.
    axis = np.degrees(np.arctan2(normal[0], -normal[1])) % 180
    where = ", ".join(f"{value:.2f}" for value in centre)
    name = view.cell.cameras[0].name
    return (
        f"with the triangle at ({where}) m in the world, its plane tilted {tilt:.0f} "
        f"degrees against camera {name}'s image, about the image direction "
        f"{axis:.0f} degrees from its x axis"
    )


def plane_spread_deg(
    model: StationInformation, base_from_flange: Floats, mounts: Ints
) -> float:
    """Largest angle between the triangle's planes at stations, degrees.

    Args:
        model: Knows where the world is, and how each mount holds the triangle.
        base_from_flange: Shape (n, 4, 4), metres.
        mounts: Which mount holds the triangle there, shape (n,).
    """
    world = np.linalg.inv(model.base_from_world) @ base_from_flange
    normals = np.zeros((len(world), 3))
    for mount, view in enumerate(model.views):
        normals[mounts == mount] = view.normals(world[mounts == mount])
    angles = plane_angles(normals[:, None], normals[None])
    return float(np.degrees(angles.max(initial=0.0)))


def axis_spread(rotations: Floats) -> float:
    """Smallest over largest singular value of the axes between all stations.

    Args:
        rotations: Shape (n, 3, 3).
    """
    first, second = np.triu_indices(len(rotations), 1)
    turns = so3_log(rotations[first].swapaxes(-1, -2) @ rotations[second])
    angle = np.linalg.norm(turns, axis=1, keepdims=True)
    moving = angle[:, 0] > 1e-3
    if not moving.any():
        return 0.0
    axes = turns[moving] / angle[moving]
    singular = np.linalg.svd(axes.T @ axes, compute_uv=False)
    return float(np.sqrt(singular[-1] / singular[0]))
