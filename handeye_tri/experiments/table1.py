"""Table I: three points against Zhang's method.

On a rendered clock dial, where the truth is known, and on real views of a chessboard
where there are some.
"""

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
from handeye_tri.experiments.rendered import calibrate_rendered, rendered_board_views
from handeye_tri.sweep import Result

Floats = NDArray[np.float64]

CLOCK = "clock_dial"
# Allowed difference of fu and fv, and of the principal point: from the truth where it
# is known, else from Zhang's.
_FOCAL_PERCENT, _CENTRE_PX = 0.3, 3.0
# Allowed error where the truth is known, in stated sigmas.
_SIGMAS = 4.0


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
        views: "clock" (rendered) or "boards" (real).
        camera: left or right.
        quantity: fu, fv, s, u0, v0 in pixels; k1, k2, p1, p2, k3.
        truth: Of the rendered camera; empty for a real one.
        three_points: By three points.
        sigma: Its standard deviation: as stated, or by the jackknife over real views.
        zhang: By Zhang's method.
        difference: Of three points from the truth; from Zhang's where there is none.
        percent: That, of Zhang's, for fu and fv; else empty.
    """

    views: str
    camera: str
    quantity: str
    truth: float | str
    three_points: float
    sigma: float
    zhang: float
    difference: float
    percent: float | str

    @property
    def reference(self) -> float:
        """What the difference is from."""
        return self.zhang if isinstance(self.truth, str) else self.truth


def run(options: Options) -> Outcome:
    """Calibrate both pairs of cameras by both methods."""
    clock, clock_sentence = _of_the_clock(options)
    rows, sentences, lenses = list(clock), [clock_sentence], None
    if options.images is None:
        sentences.append("no real views (--images)")
    else:
        real, real_sentence, lenses = _of_real_views(options)
        rows += real
        sentences.append(real_sentence)
    focal = max(abs(float(r.percent)) for r in rows if r.percent != "")
    centre = max(abs(r.difference) for r in rows if r.quantity in ("u0", "v0"))
    far = max(abs(r.difference) / r.sigma for r in clock if r.sigma)
    return finish(
        options,
        "table1",
        "Table I: comparison of two camera calibration methods",
        passed=focal <= _FOCAL_PERCENT and centre <= _CENTRE_PX and far <= _SIGMAS,
        sentence=(
            f"{'; '.join(sentences)} (allowed {_FOCAL_PERCENT:g} %, {_CENTRE_PX:g} px, "
            f"{_SIGMAS:g} sigma)"
        ),
        rows=[asdict(row) for row in rows],
        figure=_drawn(rows, lenses),
    )


def _of_the_clock(options: Options) -> tuple[list[Row], str]:
    rendered = calibrate_rendered(options, CLOCK)
    views = rendered_board_views(options, CLOCK)
    rows = []
    true = rendered.true
    for side, truth in enumerate((true.left, true.right)):
        found = rendered.calibration
        labels = found.covariance.labels
        known = [f"{SIDES[side]}.{name}" for name in SYMBOLS]
        sigma = [found.covariance.std(n) if n in labels else 0.0 for n in known]
        ours, theirs = found.cameras[side], zhang(views, side, lens=False)
        for k, symbol in enumerate(SYMBOLS.values()):
            value, other, right = (
                float(camera.intrinsics.vector[k]) for camera in (ours, theirs, truth)
            )
            percent = 100 * (value - right) / right if symbol in ("fu", "fv") else ""
            rows.append(
                Row(
                    *("clock", SIDES[side], symbol, right, value, sigma[k], other),
                    *(value - right, percent),
                )
            )
    focal, others, centre = (
        max(values)
        for values in (
            [abs(float(r.percent)) for r in rows if r.percent != ""],
            [100 * abs(r.zhang / r.reference - 1) for r in rows if r.percent != ""],
            [abs(r.difference) for r in rows if r.quantity in ("u0", "v0")],
        )
    )
    sigmas = max(abs(r.difference) / r.sigma for r in rows if r.sigma)
    return rows, (
        f"rendered clock, {rendered.half_turns} half-turns, against the truth: fu, fv "
        f"within {focal:.2f} % (Zhang, {len(views.names)} boards: {others:.2f}), u0, "
        f"v0 within {centre:.1f} px, all within {sigmas:.1f} sigma"
    )


def _of_real_views(options: Options) -> tuple[list[Row], str, list[_Lens]]:
    """Deviations by leaving views out."""
    assert options.images is not None
    real = calibrate_views(options.images)
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
    sentence = (
        f"real boards, {real.half_turns} half-turns in {count} pairs of views, against "
        f"Zhang: fu, fv within {focal:.2f} %, u0, v0 within {centre:.1f} px; sigma of "
        f"fu left {spread[0, 0]:.1f}, right {spread[1, 0]:.1f} px"
    )
    lenses = [
        _Lens(f"{who}, {SIDES[side]}", camera)
        for who, cameras in (("three points", real.cameras), ("Zhang", others))
        for side, camera in enumerate(cameras)
    ]
    return rows, sentence, lenses


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
        rows.append(
            Row(
                *("boards", SIDES[side], name, "", value, sigma, zhangs),
                *(difference, percent),
            )
        )
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class _Lens:
    """A camera whose lens is drawn, and its name in the legend."""

    label: str
    camera: PinholeCamera


_TITLES = {
    "clock": "rendered clock: difference from the truth",
    "boards": "real boards: difference from Zhang's method",
}


def _drawn(rows: Sequence[Row], lenses: Sequence[_Lens] | None) -> Any:
    sources = list(dict.fromkeys(row.views for row in rows))
    width = 3 if lenses else 2
    figure, axes = new_figure(4.2 * width, 4.2 * len(sources), len(sources), width)
    for line, source in zip(axes, sources, strict=True):
        for panel, names, limit, unit in (
            (line[0], ("fu", "fv"), _FOCAL_PERCENT, "%"),
            (line[1], ("u0", "v0"), _CENTRE_PX, "px"),
        ):
            chosen = [r for r in rows if r.views == source and r.quantity in names]
            _draw_differences(panel, chosen, limit, unit)
        line[0].set_title(_TITLES[source], fontsize=10, loc="left")
        for panel in line[2:]:
            panel.axis("off")
    axes[0][0].legend(fontsize=8, loc="lower left")
    if lenses:
        panel = axes[sources.index("boards")][2]
        panel.axis("on")
        _draw_lenses(panel, lenses)
    figure.suptitle("Table I: three points against Zhang's method")
    return figure


def _draw_differences(panel: Any, rows: Sequence[Row], limit: float, unit: str) -> None:
    scale = [100 / row.reference if unit == "%" else 1.0 for row in rows]
    panel.axhspan(-limit, limit, color="#e8f1e4", label="allowed")
    panel.axhline(0, color="black", linewidth=0.8)
    panel.errorbar(
        range(len(rows)),
        [s * row.difference for s, row in zip(scale, rows, strict=True)],
        [s * row.sigma for s, row in zip(scale, rows, strict=True)],
        fmt="o",
        color="#1f5fa8",
        capsize=4,
        label="three points, 1 sigma",
    )
    if rows[0].truth != "":
        theirs = [s * (r.zhang - r.reference) for s, r in zip(scale, rows, strict=True)]
        places = [k + 0.15 for k in range(len(rows))]
        panel.plot(places, theirs, "s", color="#d95f02", label="Zhang")
    panel.set_xticks(
        range(len(rows)), [f"{row.camera}\n{row.quantity}" for row in rows]
    )
    panel.set_ylim(-1.6 * limit, 1.6 * limit)
    panel.set_ylabel(f"difference, {unit}")


def _draw_lenses(panel: Any, lenses: Sequence[_Lens]) -> None:
    styles = {"left": "-", "right": "--"}
    for lens in lenses:
        camera = lens.camera
        across = np.linspace(0, camera.image_size[0] / 2, 60)
        ideal = np.column_stack([across, 0 * across]) / camera.intrinsics.fx
        bent = camera.intrinsics.fx * camera.lens.distort(ideal)[:, 0] - across
        panel.plot(
            across,
            bent,
            styles[camera.name],
            color="black" if lens.label.startswith("Zhang") else "#1f5fa8",
            linewidth=1.2,
            label=lens.label,
        )
    panel.set_title("real boards: the lens", fontsize=10, loc="left")
    panel.set_xlabel("distance from the principal point, px")
    panel.set_ylabel("displacement by the lens, px")
    panel.legend(fontsize=8)
