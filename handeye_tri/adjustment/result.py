"""From the minimum of a joint adjustment to its record: covariance, residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.adjustment.linearisation import Linearisation, whitened_rows
from handeye_tri.adjustment.model import AdjustmentModel
from handeye_tri.adjustment.problem import State
from handeye_tri.adjustment.robust import apply_loss
from handeye_tri.calibrate_cameras.least_squares import Minimum
from handeye_tri.camera import INTRINSIC_NAMES, Intrinsics, Lens, PinholeCamera
from handeye_tri.errors import DegenerateMotionError
from handeye_tri.records import (
    Covariance,
    HandEyeCalibration,
    Mount,
    Session,
    marker_labels,
    motion_labels,
    triangle_name,
)
from handeye_tri.se3 import SE3, hat
from handeye_tri.triangle import frame_by_markers, triangle_frame

Floats = NDArray[np.float64]

# Scaled information worse conditioned than this is singular in double precision.
_MAX_CONDITION = 1e13
# What has a smaller part in an undetermined direction is not named for it.
_SHARE = 0.01
# A station's own six equations worse conditioned than this do not fix the flange.
_MAX_STATION_CONDITION = 1e12


def unknown_labels(
    model: AdjustmentModel, cameras: Sequence[PinholeCamera]
) -> tuple[str, ...]:
    """Labels of the shared unknowns, in their order."""
    labels: list[str] = []
    for i, camera in enumerate(cameras):
        labels += [f"{camera.name}.{INTRINSIC_NAMES[k]}" for k in model.intrinsics[i]]
        labels += [f"{camera.name}.{camera.lens.names[k]}" for k in model.lenses[i]]
        labels += motion_labels(f"base_from_{camera.name}")
    for mount in range(len(model.rigs)):
        name = "rig" if mount == 0 else f"rig_{mount + 1}"
        labels += motion_labels(name) if model.sides.exact else marker_labels(mount)
    return (*labels, *(() if model.robot is None else model.robot.labels))


def check_seen(at: Linearisation, cameras: Sequence[PinholeCamera]) -> None:
    """Refuse unknowns that no observation depends on.

    Raises:
        DegenerateMotionError: names them.
    """
    labels = unknown_labels(at.model, cameras)
    _check_dependence(np.diagonal(at.equations().shared), labels)


def _check_dependence(diagonal: Floats, labels: tuple[str, ...]) -> None:
    if (diagonal <= 0).any():
        lost = [labels[k] for k in np.flatnonzero(diagonal <= 0).tolist()]
        raise DegenerateMotionError(
            f"nothing in the data depends on {', '.join(lost)}; add stations that do, "
            "or estimate fewer unknowns"
        )


def check_determined(
    end: Minimum[State, Linearisation], cameras: Sequence[PinholeCamera]
) -> tuple[Floats, float]:
    """Information on the shared unknowns (g, g), and its condition when scaled.

    Raises:
        DegenerateMotionError: the data do not determine them; names those that
            trade against each other.
    """
    information = end.blocks.equations().reduced()
    diagonal = np.diagonal(information)
    labels = unknown_labels(end.blocks.model, cameras)
    _check_dependence(diagonal, labels)
    scale = 1.0 / np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    open_ = vectors[:, values * _MAX_CONDITION < values[-1]]
    if open_.size:
        share: dict[str, float] = {}
        for label, weight in zip(labels, (open_**2).sum(axis=1), strict=True):
            owner = label.rsplit(".", 1)[0]
            share[owner] = share.get(owner, 0.0) + float(weight)
        owners = [name for name, weight in share.items() if weight > _SHARE]
        raise DegenerateMotionError(
            f"the data leave {open_.shape[1]} of {len(labels)} unknowns open: "
            f"{', '.join(owners)} trade against each other; turn the flange about "
            "two or more axes by at least 20 degrees, or estimate fewer unknowns"
        )
    return information, float(values[-1] / values[0])


def adjustment_result(
    session: Session,
    start: HandEyeCalibration,
    end: Minimum[State, Linearisation],
    undetermined: tuple[str, ...],
    correlation: float,
) -> HandEyeCalibration:
    """Put a minimum into the record, see :func:`handeye_tri.adjust`."""
    state, model = end.state, end.blocks.model
    information, condition = check_determined(end, start.cameras)
    scale = 1.0 / np.sqrt(np.diagonal(information))
    shared = np.linalg.inv(information * np.outer(scale, scale))
    shared = 0.5 * (shared + shared.T) * np.outer(scale, scale)
    labels, by_unknowns = _derived(model, state, start.cameras)
    matrix = by_unknowns @ shared @ by_unknowns.T
    stations, residuals = _station_residuals(model, state)
    present = model.stations.index >= 0
    n = len(session.stations)
    pixel_residuals = np.full((len(start.cameras), n, 3, 2), np.nan)
    pixel_residuals[:, model.stations.index[present]] = model.residuals(state)[
        :, present
    ]
    corrections = np.full((n, 6), np.nan)
    corrections[model.stations.index[present]] = model.missed(state, slice(None))[
        present
    ]
    first, *others = (Mount(triangle_frame(m), m) for m in state.markers)
    return HandEyeCalibration(
        cameras=tuple(
            PinholeCamera(
                camera.name,
                Intrinsics.from_vector(state.intrinsics[i]),
                camera.image_size,
                Lens(camera.lens.model, state.lenses[i]),
            )
            for i, camera in enumerate(start.cameras)
        ),
        base_from_camera=tuple(SE3(motion) for motion in state.base_from_camera),
        flange_from_triangle=first.flange_from_triangle,
        markers=first.markers,
        other_mounts=tuple(others),
        covariance=Covariance(labels, 0.5 * (matrix + matrix.T)),
        chi2=end.cost,
        dof=end.blocks.observations - end.blocks.unknowns,
        residuals=residuals,
        method=_method(model),
        alternatives={**start.alternatives, "separate": start.base_from_camera[0]},
        robot={}
        if model.robot is None
        else dict(zip(model.robot.labels, state.robot.tolist(), strict=True)),
        details={
            "pixel_residuals": pixel_residuals,
            "corrections": corrections,
            "stations": stations,
            **_chi2_parts(model, state, end.cost),
            "undetermined": undetermined,
            "on_axis_correlation": correlation,
            "iterations": end.iterations,
            "condition": condition,
        },
    )


def _method(model: AdjustmentModel) -> str:
    words = ["joint adjustment"]
    if model.sides.exact:
        words.append("exact sides")
    elif model.sides.count:
        words.append(f"sides known to {1e3 * model.sides.sigma:g} mm")
    else:
        words.append("markers self-calibrated")
    if model.robot is not None:
        words.append(f"{len(model.robot.labels)} parameters of the robot")
    if model.loss is not None:
        words.append(f"{model.loss.name} loss from {model.loss.threshold:g} sigmas")
    return ", ".join(words)


def _chi2_parts(model: AdjustmentModel, state: State, cost: float) -> dict[str, float]:
    sides = np.array(
        [model.sides.residuals(m)[0] for m in state.markers if model.sides.count]
    )
    scaled = np.empty(0) if model.robot is None else state.robot / model.robot.sigma
    parts = {
        "chi2_robot": float(np.vdot(state.missed, state.missed)),
        "chi2_sides": float(np.vdot(sides, sides)),
        "chi2_parameters": float(scaled @ scaled),
    }
    return {"chi2_pixels": cost - sum(parts.values()), **parts}


def _derived(
    model: AdjustmentModel, state: State, cameras: Sequence[PinholeCamera]
) -> tuple[tuple[str, ...], Floats]:
    """Labels of all reported quantities, and their derivative by the unknowns."""
    g = model.shared
    eye = np.eye(g)
    labels: list[str] = []
    rows, places = [], []
    for columns in model.columns:
        own = eye[columns]
        labels += unknown_labels(model, cameras)[columns][:-6]
        rows.append(own[:-6])
        places.append(own[-6:])
    first = SE3(state.base_from_camera[0])
    for i, camera in enumerate(cameras):
        if i:
            # Z0 exp(d0) M exp(d) = Zi exp(di): d = di - Ad(M^-1) d0.
            motion = SE3(state.base_from_camera[i]).inverse() @ first
            labels += motion_labels(f"reference_from_{camera.name}")
            rows.append(places[i] - motion.adjoint() @ places[0])
    for i, camera in enumerate(cameras):
        labels += motion_labels(f"base_from_{camera.name}")
        rows.append(places[i])
    for mount, (rig, markers) in enumerate(zip(model.rigs, state.markers, strict=True)):
        by_markers = eye[rig]
        if model.sides.exact:
            by_rig = np.concatenate(
                [np.broadcast_to(np.eye(3), (3, 3, 3)), -hat(markers)], axis=-1
            )
            by_markers = by_rig.reshape(9, 6) @ by_markers
        labels += [*motion_labels(triangle_name(mount)), *marker_labels(mount)]
        rows += [frame_by_markers(markers) @ by_markers, by_markers]
    if model.robot is not None:
        labels += model.robot.labels
        rows.append(eye[model.extra])
    return tuple(labels), np.concatenate(rows)


def _station_residuals(
    model: AdjustmentModel, state: State
) -> tuple[NDArray[np.intp], Floats]:
    """Stations whose pixels alone fix the flange, and by how much it is off there.

    One Gauss-Newton step of each station's pose from the adjusted one, which is the
    tangent between robot chain and camera chain to first order.

    Returns:
        Station indices (s,), tangents in the frame of the triangle on the station's
        mount (s, 6), m and rad.
    """
    width = model.stations.index.shape[1]
    every = slice(None)
    xi = model.missed(state, every)
    free = replace(model, root=np.eye(6))
    at = replace(state, missed=xi.reshape(len(xi), -1))
    size = free.own
    normal = np.zeros((model.blocks, size, size))
    gradient = np.zeros((model.blocks, size))
    for chunk, _, _, rows in whitened_rows(free, at):
        apply_loss(rows, model.loss)
        flat = rows.reshape(len(rows), -1, rows.shape[-1])
        own = flat[..., :size]
        normal[chunk] += np.swapaxes(own, -1, -2) @ own
        gradient[chunk] += (np.swapaxes(own, -1, -2) @ flat[..., -1:])[..., 0]
    diagonal = np.einsum("bii->bi", normal)
    unseen = diagonal == 0
    diagonal[unseen] = 1.0
    scale = 1.0 / np.sqrt(diagonal)
    scaled = normal * scale[:, :, None] * scale[:, None, :]
    values = np.linalg.eigvalsh(scaled)
    fixed = values[:, 0] * _MAX_STATION_CONDITION > values[:, -1]
    step = np.zeros((model.blocks, size))
    step[fixed] = -(
        scale[fixed]
        * np.linalg.solve(scaled[fixed], (scale * gradient)[fixed][..., None])[..., 0]
    )
    tangent = xi + step.reshape(-1, width, 6)
    ok = fixed[:, None] & ~unseen.reshape(-1, width, 6).any(axis=-1)
    for part, markers in zip(model.parts, state.markers, strict=True):
        adjoint = triangle_frame(markers).inverse().adjoint()
        tangent[part] = (tangent[part].reshape(-1, 6) @ adjoint.T).reshape(-1, width, 6)
    index = model.stations.index[ok]
    order = np.argsort(index)
    return index[order], tangent[ok][order]
