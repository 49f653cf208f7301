"""Table I: three points against Zhang's method, on the same real images."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import PinholeCamera
from handeye_tri.experiments.accuracy import SYMBOLS
from handeye_tri.experiments.chessboard import BoardViews, zhang
from handeye_tri.experiments.outcome import Options, Outcome, finish, new_figure
from handeye_tri.experiments.real_views import SIDES, calibrate_side, calibrate_views
from handeye_tri.sweep import Result

Floats = NDArray[np.float64]

# Allowed difference from Zhang's fu and fv, and from his principal point.
_FOCAL_PERCENT, _CENTRE_PX = 0.3, 3.0


@dataclass(frozen=True, slots=True, eq=False)
class LeaveOut:
    """Calibrates without one view, for the jackknife."""

    views: BoardViews

    def __call__(self, seed: int) -> Result:
        """The camera's numbers; the seed counts views, first left then right."""
        side, view = divmod(seed, len(self.views.names))
        return {"values": _values(calibrate_side(self.views, side, view).camera)}


@dataclass(frozen=True, slots=True)
class Row:
    """One number of one camera, by both methods.

    Attributes:
        camera: left or right.
        quantity: fu, fv, s, u0, v0 in pixels; k1, k2, p1, p2, k3.
        three_points: By three points.
        sigma: Its standard deviation, by the jackknife over views.
        zhang: By Zhang's method.
        difference: The first less the last.
        percent: That, of Zhang's, for fu and fv; else empty.
    """

    camera: str
    quantity: str
    three_points: float
    sigma: float
    zhang: float
    difference: float
    percent: float | str


def run(options: Options) -> Outcome:
    """Calibrate both cameras by both methods; deviations by leaving views out."""
    real = calibrate_views(options)
    views = real.views
    count = len(views.names)
    identity = {"corners": hashlib.sha256(views.corners.tobytes()).hexdigest()}
    without = options.sweep("table1", LeaveOut(views), identity, 2 * count)
    left_out = np.array([result["values"] for result in without]).reshape(2, count, -1)
    # Tukey's jackknife: views are independent of each other, half-turns are not.
    spread = np.sqrt((count - 1) * left_out.var(axis=1))
    others = [zhang(views, side) for side in range(2)]
    rows = [
        row
        for side in range(2)
        for row in _rows(side, real.cameras[side], spread[side], others[side])
    ]
    focal = max(abs(float(r.percent)) for r in rows if r.percent != "")
    centre = max(abs(r.difference) for r in rows if r.quantity in ("u0", "v0"))
    return finish(
        options,
        "table1",
        "Table I: comparison of two camera calibration methods",
        passed=focal <= _FOCAL_PERCENT and centre <= _CENTRE_PX,
        sentence=(
            f"{real.half_turns} half-turns in {count} pairs of views, against Zhang: "
            f"fu, fv within {focal:.2f} % (allowed {_FOCAL_PERCENT:g}), u0, v0 within "
            f"{centre:.1f} px (allowed {_CENTRE_PX:g}); sigma of fu left "
            f"{spread[0, 0]:.1f}, right {spread[1, 0]:.1f} px"
        ),
        rows=[asdict(row) for row in rows],
        figure=_drawn(rows, real.cameras, others),
    )


def _values(camera: PinholeCamera) -> list[float]:
    return [*camera.intrinsics.vector.tolist(), *camera.lens.coefficients.tolist()]


def _rows(
    side: int, ours: PinholeCamera, spread: Floats, other: PinholeCamera
) -> list[Row]:
    names = [*SYMBOLS.values(), *other.lens.names]
    rows = []
    columns = zip(names, _values(ours), spread.tolist(), _values(other), strict=True)
    for name, value, sigma, zhangs in columns:
        difference = value - zhangs
        percent = 100 * difference / zhangs if name in ("fu", "fv") else ""
        rows.append(Row(SIDES[side], name, value, sigma, zhangs, difference, percent))
    return rows


def _drawn(
    rows: Sequence[Row],
    ours: Sequence[PinholeCamera],
    others: Sequence[PinholeCamera],
) -> Any:
    figure, axes = new_figure(12.0, 4.2, 1, 3)
    groups = [
        (("fu", "fv"), _FOCAL_PERCENT, "% of Zhang's"),
        (("u0", "v0"), _CENTRE_PX, "px"),
    ]
    for panel, (names, limit, unit) in zip(axes[0], groups, strict=False):
        chosen = [row for row in rows if row.quantity in names]
        scale = [100 / row.zhang if unit != "px" else 1.0 for row in chosen]
        panel.axhspan(-limit, limit, color="#e8f1e4", label="allowed")
        panel.axhline(0, color="black", linewidth=0.8)
        panel.errorbar(
            range(len(chosen)),
            [s * row.difference for s, row in zip(scale, chosen, strict=True)],
            [s * row.sigma for s, row in zip(scale, chosen, strict=True)],
            fmt="o",
            color="#1f5fa8",
            capsize=4,
            label="three points, 1 sigma (jackknife)",
        )
        panel.set_xticks(
            range(len(chosen)), [f"{row.camera}\n{row.quantity}" for row in chosen]
        )
        panel.set_ylim(-1.6 * limit, 1.6 * limit)
        panel.set_ylabel(f"difference from Zhang, {unit}")
    axes[0][0].legend(fontsize=8, loc="lower left")
    panel = axes[0][2]
    for side, style in enumerate(("-", "--")):
        for camera, colour, who in (
            (ours[side], "#1f5fa8", "three points"),
            (others[side], "black", "Zhang"),
        ):
            across = np.linspace(0, camera.image_size[0] / 2, 60)
            ideal = np.column_stack([across, 0 * across]) / camera.intrinsics.fx
            bent = camera.intrinsics.fx * camera.lens.distort(ideal)[:, 0] - across
            label = f"{who}, {SIDES[side]}"
            panel.plot(across, bent, style, color=colour, linewidth=1.2, label=label)
    panel.set_xlabel("distance from the principal point, px")
    panel.set_ylabel("displacement by the lens, px")
    panel.legend(fontsize=8)
    figure.suptitle("Table I: three points against Zhang's method")
    return figure
