"""Fills the report's page: verdict first, and how to get it again last."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from handeye_tri.diagnose import radius_95
from handeye_tri.evaluate import track_map
from handeye_tri.evaluate.views import check_views, predicted_pixels
from handeye_tri.records import (
    CameraCalibration,
    HandEyeCalibration,
    Session,
    TrackEvaluation,
    triangle_name,
)
from handeye_tri.report import figures, geometry, spreads, tables
from handeye_tri.report.figures import Photograph
from handeye_tri.summary import against_prediction_text, tested_stations

# So many of the worst views are shown as pictures.
_CROPS = 6
# Places of the workspace map along x, y and z; the middle height is shown.
_MAP = (5, 5, 3)


@dataclass(frozen=True, slots=True)
class Origin:
    """Where a result came from, so that it can be had again.

    Attributes:
        cell: Name of the cell.
        seed: What everything random was drawn from.
        command: What to type.
        software: Versions by package.
        files: SHA-256 by the session's file.
        certificate: What the plan promised, by name; units in the names.
    """

    cell: str
    seed: int
    command: str
    software: Mapping[str, str]
    files: Mapping[str, str]
    certificate: Mapping[str, float] = field(default_factory=dict)


def render_report(
    evaluation: Mapping[str, Any],
    session: Session,
    cameras: CameraCalibration,
    calibration: HandEyeCalibration,
    track: TrackEvaluation,
    *,
    origin: Origin,
    photograph: Photograph | None = None,
) -> str:
    """The result as one page of HTML; it asks nothing of the network.

    Args:
        evaluation: The content of ``evaluation.json``: verdict, gates, result.
        session: What was observed.
        cameras: Its calibrated cameras.
        calibration: Its calibrated cell.
        track: Its held-out track.
        origin: Where the result came from.
        photograph: Image of a camera (name) at a station (index), uint8, to show the
            worst views; None where there are no images.
    """
    predicted = predicted_pixels(calibration, session)
    checks = check_views(calibration, session, cameras.details.get("dropped", ()))
    radii = (1e3 * radius_95(track.predicted_covariance)).tolist()
    arrows, factor = figures.residual_maps(session, predicted)
    drawings = {
        "frames": geometry.frames(session, calibration),
        "track": figures.held_out_track(track, radii),
        "map": _map(calibration, session),
        "origin": figures.origin_of_error(evaluation["track"]["predicted_parts_mm"]),
        "residuals": arrows,
    }
    if session.half_turns:
        drawings["planes"] = geometry.plane_directions(session, calibration)
    worst = [check for check in checks if check.worst][:_CROPS]
    if photograph is not None and worst:
        drawings["crops"] = figures.crops(worst, session, predicted, photograph)
    environment = Environment(
        loader=PackageLoader("handeye_tri.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    ran = [gate for gate in evaluation["gates"] if gate["verdict"] != "not run"]
    rows = evaluation["result"]
    parts = evaluation["track"]["predicted_parts_mm"]
    return environment.get_template("report.html.j2").render(
        evaluation=evaluation,
        origin=origin,
        track=evaluation["track"],
        met=sum(gate["verdict"] != "bad" for gate in ran),
        ran=len(ran),
        gates=tables.gates_worst_first(evaluation["gates"]),
        findings=tables.findings_with_places(evaluation["findings"]),
        truth=any(row["error"] is not None for row in rows),
        motions=_motions(session, calibration, rows),
        lenses=[
            {
                "name": camera.name,
                "rows": tables.quantities(rows, camera.name),
                "text": tables.camera_text(camera, info),
                "rms": f"{_rms(cameras.residuals[i]):.3f}",
                "size": f"{camera.image_size[0]} x {camera.image_size[1]}",
            }
            for i, (camera, info) in enumerate(
                zip(calibration.cameras, session.cameras, strict=True)
            )
        ],
        others=tables.remaining(rows, session),
        positions=tables.track_rows(evaluation["track"], radii),
        mounts=tables.station_mounts(session),
        checks=checks,
        far=sum(check.code == "FAR" for check in checks),
        factor=factor,
        expectations=tables.expectations(origin.certificate, session, rows, parts),
        alternatives=tables.alternatives(calibration),
        tested_stations=tested_stations(evaluation["track"]),
        against_prediction=against_prediction_text(evaluation["track"]),
        validation=evaluation["cross_checks"]["cross_validation"],
        spreads=spreads.spread_table(evaluation["cross_checks"]),
        unspread=spreads.not_run(evaluation["cross_checks"]),
        assumptions=tables.assumptions(session, calibration),
        cameras=cameras,
        calibration=calibration,
        turns=tables.half_turn_words(session),
        used=len(session.indices("calibration")),
        # matplotlib escapes what it draws.
        figure={name: Markup(svg) for name, svg in drawings.items()},
    )


def _map(calibration: HandEyeCalibration, session: Session) -> str:
    """The predicted error at the middle height of where the markers were."""
    workspace = track_map(calibration, session, _MAP)
    middle = _MAP[2] // 2
    covariance = workspace.covariance[:, :, middle]
    seen = np.isfinite(covariance).all(axis=(2, 3))
    radii = np.full(seen.shape, np.nan)
    radii[seen] = 1e3 * radius_95(covariance[seen])
    return figures.workspace_map(workspace.points[:, :, middle], covariance, radii)


def _rms(residuals: Any) -> float:
    """Root mean square distance of residuals (..., 2), NaN left out."""
    square = (np.asarray(residuals) ** 2).sum(axis=-1)
    return float(np.sqrt(np.nanmean(square)))


def _motions(
    session: Session, calibration: HandEyeCalibration, rows: Any
) -> list[dict[str, Any]]:
    """The motions to use, each with its direction in words."""
    found = []
    for camera, motion in zip(
        calibration.cameras, calibration.base_from_camera, strict=True
    ):
        name = f"base_from_{camera.name}"
        found.append(
            {
                "name": name,
                "title": f"Where camera {camera.name} stands",
                "words": f"Takes a point from the frame of camera {camera.name} "
                "(x right, y down, z forward) to the robot base: "
                f"p_base = {name} p_{camera.name}. The translation is where its "
                "optical centre is, seen from the base.",
                "rows": tables.quantities(rows, name),
                "text": tables.motion_text(motion),
            }
        )
    for k, mount in enumerate(calibration.mounts):
        name, title = triangle_name(k), "How the rig sits on the flange"
        if calibration.other_mounts:
            title += f", {session.mount_name(k)}"
        found.append(
            {
                "name": name,
                "title": title,
                "words": "Takes a point from the triangle's frame (origin at A, x to "
                "B, C on the side of +y) to the frame that the robot reports: "
                f"p_flange = {name} p_triangle.",
                "rows": tables.quantities(rows, name),
                "text": tables.motion_text(mount.flange_from_triangle),
            }
        )
    return found
