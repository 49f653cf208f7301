"""The report's tables: numbers as text whose digits follow the uncertainty."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import PinholeCamera
from handeye_tri.counting import counted
from handeye_tri.records import (
    CameraInfo,
    HandEyeCalibration,
    Session,
    motion_labels,
    triangle_name,
)
from handeye_tri.se3 import SE3
from handeye_tri.summary import digits

Floats = NDArray[np.float64]
Row = dict[str, str]

_ORDER = {"bad": 0, "marginal": 1, "good": 2, "not run": 3}
_MEANING = {
    "fx": "focal length along the rows",
    "fy": "focal length along the columns",
    "skew": "skew factor",
    "cx": "principal point, column",
    "cy": "principal point, row",
}


def number(value: float, sigma: float, *, signed: bool = False) -> str:
    """A value with the digits that its standard deviation allows."""
    sign = "+" if signed else ""
    return f"{value:{sign}.{digits(sigma)}f}"


def quantities(rows: Sequence[Mapping[str, Any]], owner: str) -> list[Row]:
    """What was estimated of a camera or a motion.

    Args:
        rows: ``result`` of ``evaluation.json``: name, unit, value, sigma, error.
        owner: "left", "base_from_left", "flange_from_triangle" and so on.
    """
    return [
        _quantity(row, row["name"].rsplit(".", 1)[1])
        for row in rows
        if row["name"].rsplit(".", 1)[0] == owner
    ]


def remaining(rows: Sequence[Mapping[str, Any]], session: Session) -> list[Row]:
    """What was estimated beyond cameras and motions, by its full name."""
    shown = {triangle_name(mount) for mount in session.mounts.tolist()}
    for camera in session.cameras:
        shown |= {camera.name, f"base_from_{camera.name}"}
    return [
        _quantity(row, row["name"])
        for row in rows
        if row["name"].rsplit(".", 1)[0] not in shown
    ]


def _quantity(row: Mapping[str, Any], symbol: str) -> Row:
    error, sigma = row["error"], row["sigma"]
    return {
        "symbol": symbol,
        "name": _MEANING.get(symbol, ""),
        "unit": row["unit"],
        "value": number(row["value"], sigma),
        "sigma": f"{sigma:.{digits(sigma)}f}",
        "truth": "" if error is None else number(-error, sigma, signed=True),
    }


def station_mounts(session: Session) -> list[str]:
    """The number of each station's mount, from 1; nothing where there is one mount."""
    mounts = session.mounts
    return [str(mount + 1) for mount in mounts] if mounts.any() else []


def half_turn_words(session: Session) -> str:
    """How many half-turns there are, with each mount where there are several."""
    made = [session.stations[turn.before].mount for turn in session.half_turns]
    text = counted(len(made), "half-turn")
    if not session.mounts.any() or not made:
        return text
    parts = [f"{made.count(k)} with mount {k + 1}" for k in sorted(set(made))]
    return f"{text}, {' and '.join(parts)}"


def gates_worst_first(gates: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Gates by verdict, then by the share of the limit that is used up."""
    return sorted(gates, key=lambda gate: (_ORDER[gate["verdict"]], -gate["use"]))


def findings_with_places(findings: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Findings in their order, each with where it is in words ("" for everywhere)."""
    rows = []
    for finding in findings:
        stations, camera = finding["stations"], finding["camera"]
        where = [f"camera {camera}"] if camera else []
        if stations:
            word = "station" if len(stations) == 1 else "stations"
            where.append(f"{word} {', '.join(map(str, stations))}")
        rows.append({**finding, "where": ", ".join(where)})
    return rows


# What a solver that is not of AX = XB solves.
_FORMS = {"shah": "AX = ZB", "li": "AX = ZB", "separate": "step by step"}


def alternatives(calibration: HandEyeCalibration) -> list[Row]:
    """Other solvers' ``base_from_<first camera>`` beside the result's."""
    first = calibration.cameras[0].name
    block = calibration.covariance.block(motion_labels(f"base_from_{first}"))
    sigma_mm = 1e3 * float(np.sqrt(np.trace(block[:3, :3])))
    sigma_deg = float(np.degrees(np.sqrt(np.trace(block[3:, 3:]))))
    rows = []
    for name, motion in calibration.alternatives.items():
        moved = (calibration.base_from_camera[0].inverse() @ motion).log()
        shift = 1e3 * float(np.linalg.norm(moved[:3]))
        turn = float(np.degrees(np.linalg.norm(moved[3:])))
        rows.append(
            {
                "name": name,
                "form": _FORMS.get(name, "AX = XB"),
                "shift": number(shift, sigma_mm),
                "shift_sigmas": f"{shift / sigma_mm:.1f}",
                "turn": number(turn, sigma_deg),
                "turn_sigmas": f"{turn / sigma_deg:.1f}",
            }
        )
    return sorted(rows, key=lambda row: float(row["shift"]))


def motion_text(motion: SE3) -> str:
    """A motion to copy: a 4 x 4 matrix, metres, one row a line."""
    rows = [
        "[" + ", ".join(f"{value:.9f}" for value in row) + "]" for row in motion.matrix
    ]
    return "[" + ",\n ".join(rows) + "]"


def camera_text(camera: PinholeCamera, info: CameraInfo) -> str:
    """A camera to copy, as JSON with the units in the keys."""
    k = camera.intrinsics
    data: dict[str, Any] = {
        "image_size_px": list(camera.image_size),
        **{f"{name}_px": getattr(k, name) for name in ("fx", "fy", "skew", "cx", "cy")},
    }
    if info.lens:
        data["lens_model"] = camera.lens.model
        data["lens"] = dict(
            zip(camera.lens.names, camera.lens.coefficients.tolist(), strict=True)
        )
    lines = [f' "{key}": {json.dumps(value)}' for key, value in data.items()]
    return "{\n" + ",\n".join(lines) + "\n}"


def expectations(
    certificate: Mapping[str, float],
    session: Session,
    rows: Sequence[Mapping[str, Any]],
    parts_mm: Mapping[str, float],
) -> list[Row]:
    """What the plan promised beside what was reached; what has no pair is left out.

    Args:
        certificate: Of the plan; units in the keys.
        session: For the cameras' names.
        rows: ``result`` of ``evaluation.json``.
        parts_mm: Predicted track error by its origin, mm rms.
    """
    sigmas = {row["name"]: row["sigma"] for row in rows}
    found = []
    for camera in session.cameras:
        for quantity in ("fx", "fy", "cx", "cy"):
            label = f"{camera.name}.{quantity}"
            planned = certificate.get(f"sigma.{label}_px")
            if planned is not None and label in sigmas:
                found.append(_pair(f"sigma of {label}", "px", planned, sigmas[label]))
        motion = f"base_from_{camera.name}"
        planned = certificate.get(f"sigma.{motion}.translation_mm")
        parts = [sigmas.get(f"{motion}.{axis}") for axis in "xyz"]
        if planned is not None and None not in parts:
            reached = float(np.linalg.norm(np.array(parts, dtype=float)))
            found.append(
                _pair(f"sigma of {motion}, translation", "mm", planned, reached)
            )
    planned = certificate.get("track_calibration_rms_mm")
    if planned is not None:
        # What neither the held-out pixels nor the robot brought in.
        own = [v for name, v in parts_mm.items() if name not in ("pixels", "robot")]
        reached = float(np.linalg.norm(own))
        found.append(_pair("calibration's part of the track", "mm", planned, reached))
    return found


def _pair(name: str, unit: str, planned: float, reached: float) -> Row:
    places = digits(planned)
    return {
        "name": name,
        "unit": unit,
        "planned": f"{planned:.{places}f}",
        "reached": f"{reached:.{places}f}",
    }


def assumptions(session: Session, calibration: HandEyeCalibration) -> list[Row]:
    """What was taken for granted, with its rough effect where the rig works."""
    sides = session.triangle.points
    longest = max(float(np.linalg.norm(sides[a] - sides[b])) for a, b in _PAIRS)
    rig = session.base_from_flange[:, :3, 3].mean(axis=0)
    distance = float(
        np.mean(
            [np.linalg.norm(m.translation - rig) for m in calibration.base_from_camera]
        )
    )
    focal = float(np.mean([c.intrinsics.fx for c in calibration.cameras]))
    robot = session.repeatability
    radii = session.marker_radii
    rows = [
        (
            "The triangle's sides are exact.",
            f"A side of {1e3 * longest:.0f} mm that is 0.1 mm longer makes every "
            f"length {100 * 1e-4 / longest:.2f} % wrong: "
            f"{1e3 * distance * 1e-4 / longest:.2f} mm at the working distance of "
            f"{distance:.2f} m. The gate on free scale sees this.",
        ),
        (
            "The robot's reported poses are right but for its repeatability "
            f"({1e3 * robot.translation:.3f} mm, "
            f"{np.degrees(robot.rotation):.4f} deg per axis).",
            "An error of its geometry (link lengths, joint zeros) is not seen where it "
            "is the same at all stations; else it shows as noise in the loop.",
        ),
        (
            "Robot base and cameras stand still, the rig is rigid on the flange.",
            "What moved by 0.1 mm between stations is 0.1 mm wrong there.",
        ),
        (
            "The lens follows its model over the whole image.",
            f"A model that is 0.1 px wrong is {1e3 * 0.1 * distance / focal:.3f} mm "
            "wrong across the line of sight at the working distance.",
        ),
    ]
    if radii.any():
        rows.append(
            (
                "Markers are spheres of the stated radii "
                f"({', '.join(f'{1e3 * r:g}' for r in radii)} mm).",
                "A radius that is 1 % wrong moves an outline's centre by less than "
                f"{_radius_effect(session, calibration, distance):.4f} px.",
            )
        )
    return [{"text": text, "effect": effect} for text, effect in rows]


_PAIRS = ((0, 1), (1, 2), (2, 0))


def _radius_effect(
    session: Session, calibration: HandEyeCalibration, distance: float
) -> float:
    """Pixels that 1 % of a radius moves an outline's centre, in the image's corner.

    The shift is u r^2 / (Z^2 - r^2) at u pixels from the principal point.
    """
    radius = float(session.marker_radii.max())
    corner = max(
        float(np.linalg.norm(camera.image_size)) for camera in calibration.cameras
    )
    return 0.02 * 0.5 * corner * radius**2 / (distance**2 - radius**2)


def track_rows(track: Mapping[str, Any], radii_95_mm: Sequence[float]) -> list[Row]:
    """Held-out positions as text, with the digits of a typical error."""
    places = digits(track["predicted_rms_mm"])
    rows = []
    for position, radius in zip(track["positions"], radii_95_mm, strict=True):
        rows.append(
            {
                "station": str(position["station"]),
                "marker": position["marker"],
                "error": f"{position['error_mm']:.{places}f}",
                "radius": f"{radius:.{places}f}",
                **{
                    f"{source}_{axis}": f"{1e3 * value:.{places}f}"
                    for source in ("reported", "observed")
                    for axis, value in zip("xyz", position[f"{source}_m"], strict=True)
                },
            }
        )
    return rows
