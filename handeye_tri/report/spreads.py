"""Sigmas by resampling beside those of the covariance, as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from handeye_tri.camera import INTRINSIC_NAMES
from handeye_tri.summary import digits

_COLUMNS = {
    "bootstrap": "half-turns drawn again",
    "parametric_bootstrap": "noise drawn again",
}


def not_run(checks: Mapping[str, Any]) -> list[str]:
    """Why a resampling is missing, for each that is."""
    return [checks[name]["not_run"] for name in _COLUMNS if "not_run" in checks[name]]


def spread_table(checks: Mapping[str, Any]) -> dict[str, Any] | None:
    """Columns, rows and notes; None where nothing was resampled.

    Args:
        checks: "cross_checks" of ``evaluation.json``.
    """
    found = {name: checks[name] for name in _COLUMNS if "not_run" not in checks[name]}
    if not found:
        return None
    stated = next(iter(found.values()))["sigma_by_covariance"]
    rows = []
    for label, sigma in stated.items():
        if label.startswith("reference_from_"):
            # They follow from the cameras in the base.
            continue
        factor, unit = _unit(label)
        places = digits(factor * sigma)
        values = [sigma, *(check["sigma"][label] for check in found.values())]
        rows.append(
            {
                "name": label,
                "unit": unit,
                "sigmas": [f"{factor * value:.{places}f}" for value in values],
            }
        )
    return {
        "columns": [_COLUMNS[name] for name in found],
        "rows": rows,
        "notes": [_note(name, check) for name, check in found.items()],
    }


def _unit(label: str) -> tuple[float, str]:
    """What to multiply a sigma by, and its unit then."""
    owner, quantity = label.rsplit(".", 1)
    if "_from_" in owner or owner.startswith("marker_"):
        return (180 / np.pi, "deg") if quantity[0] == "r" else (1e3, "mm")
    return 1.0, "px" if quantity in INTRINSIC_NAMES else ""


def _note(name: str, check: Mapping[str, Any]) -> str:
    failed = f", {check['failed']} more failed" if check["failed"] else ""
    return (
        f"{_COLUMNS[name].capitalize()}: {check['replicates']} calibrations{failed}; "
        f"each sigma is known to {100 * check['relative_error']:.0f} %; over all "
        f"quantities {check['rms_ratio_to_covariance']:.2f} times the covariance's; "
        f"the calibration's part of the track error "
        f"{check['track_calibration_mm']:.3f} mm "
        f"({check['track_calibration_by_covariance_mm']:.3f} by the covariance)."
    )
