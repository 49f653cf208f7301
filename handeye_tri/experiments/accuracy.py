"""Figs. 5, 6 and 7: errors of the intrinsics against one thing that varies.

For half-turns about a normal (Sec. III-A) and about the longest edge (III-B), for the
paper's closed form, the whitened closed form and the refined estimate, beside the
Cramer-Rao bound. Errors are relative to fu, as in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras import calibrate_camera
from handeye_tri.camera import INTRINSIC_NAMES
from handeye_tri.errors import HandEyeError
from handeye_tri.experiments.half_turn_views import (
    IMAGE_SIZE,
    TRUE_CAMERA,
    HalfTurnViews,
    draw_half_turns,
)
from handeye_tri.experiments.outcome import Options, Outcome, finish, new_figure
from handeye_tri.sweep import Result

Floats = NDArray[np.float64]

SECTIONS = {"III-A": True, "III-B": False}
SYMBOLS = dict(zip(INTRINSIC_NAMES, ("fu", "fv", "s", "u0", "v0"), strict=True))
ESTIMATES: dict[str, dict[str, Any]] = {
    "paper": {"method": "paper", "refine": False},
    "whitened": {"method": "whitened", "refine": False},
    "refined": {},
}
# From as many half-turns on, the refined estimate is Gaussian enough for root mean
# squares; with fewer a handful of trials makes up most of them.
_MANY_TURNS = 8
# Allowed difference of a root mean square from the bound, with 1000 trials or more.
_BAND = 0.08
# With fewer trials that band is too wide to tell anything.
_FEWEST_TRIALS = 50
# Median of |x| of a standard normal x, and its mean.
_MEDIAN, _MEAN = 0.6744897501960817, np.sqrt(2 / np.pi)


@dataclass(frozen=True, slots=True)
class Setting:
    """One place on the horizontal axis.

    Attributes:
        x: Where it is drawn.
        sigma_px: Noise of every pixel coordinate.
        half_turns: Each makes two images.
        cos_theta: Cosine of the triangle's angle at A.
    """

    x: float
    sigma_px: float
    half_turns: int
    cos_theta: float

    @property
    def skew(self) -> bool:
        """Whether skew is estimated: two half-turns need it to be known."""
        return self.half_turns > 2


@dataclass(frozen=True, slots=True)
class Trial:
    """Calibrates from fresh views at every setting; the views depend on the seed."""

    settings: tuple[Setting, ...]

    def __call__(self, seed: int) -> Result:
        """Bound and errors by section, one entry per setting."""
        return {
            section: [
                _calibrated(np.random.default_rng([seed, i, normal]), setting, normal)
                for i, setting in enumerate(self.settings)
            ]
            for section, normal in SECTIONS.items()
        }


def _calibrated(rng: np.random.Generator, setting: Setting, normal: bool) -> Result:
    views = draw_half_turns(
        rng, setting.half_turns, cos_theta=setting.cos_theta, normal=normal
    )
    noise = setting.sigma_px * rng.standard_normal(views.pixels.shape)
    result: Result = {
        "bound": views.bound(setting.sigma_px, skew=setting.skew).tolist()
    }
    for name, options in ESTIMATES.items():
        try:
            result[name] = _errors(views, views.pixels + noise, setting, options)
        except HandEyeError as error:
            result[name] = {"failed": type(error).__name__}
    return result


def _errors(
    views: HalfTurnViews, pixels: Floats, setting: Setting, options: Result
) -> Result:
    found = calibrate_camera(
        pixels[:, 0],
        pixels[:, 1],
        views.triangle,
        image_size=IMAGE_SIZE,
        axis=views.axis,
        skew=setting.skew,
        sigma_px=setting.sigma_px,
        **options,
    )
    error = found.camera.intrinsics.vector - TRUE_CAMERA.intrinsics.vector
    known = error if setting.skew else np.delete(error, 2)
    nees = known @ np.linalg.solve(found.covariance.matrix, known) / len(known)
    return {"error": error.tolist(), "nees": float(nees)}


@dataclass(frozen=True, slots=True)
class Summary:
    """Statistics of one quantity at one setting, in percent of fu where it says so.

    Attributes:
        x: Of the setting.
        section: III-A or III-B.
        estimate: Which estimate.
        quantity: fu, fv, s, u0 or v0.
        trials: That succeeded.
        failed: That did not.
        mean_percent: Mean of the absolute error.
        std_percent: Standard deviation of the error.
        median_percent: Median of the absolute error.
        bound_percent: Root mean square of the trials' bounds.
        rms_over_bound: Root mean square of error over bound.
        median_over_bound: Median absolute error over bound, over that of a Gaussian.
        nees: Mean normalised squared error of all intrinsics by the stated
            covariance; 1 where that is true.
    """

    x: float
    section: str
    estimate: str
    quantity: str
    trials: int
    failed: int
    mean_percent: float
    std_percent: float
    median_percent: float
    bound_percent: float
    rms_over_bound: float
    median_over_bound: float
    nees: float


def summarise(settings: Sequence[Setting], trials: Sequence[Result]) -> list[Summary]:
    """One row per setting, section, estimate and quantity that is estimated."""
    rows = []
    for section in SECTIONS:
        for i, setting in enumerate(settings):
            results = [trial[section][i] for trial in trials]
            for estimate in ESTIMATES:
                good = [r for r in results if "error" in r[estimate]]
                if len(good) > 1:
                    rows += _summaries(setting, section, estimate, good, len(trials))
    return rows


def _summaries(
    setting: Setting, section: str, estimate: str, good: list[Result], count: int
) -> list[Summary]:
    error = np.array([r[estimate]["error"] for r in good])
    bound = np.array([r["bound"] for r in good])
    nees = float(np.mean([r[estimate]["nees"] for r in good]))
    percent = 100.0 / TRUE_CAMERA.intrinsics.fx
    rows = []
    for k, symbol in enumerate(SYMBOLS.values()):
        if not bound[:, k].all():
            continue
        ratio = np.abs(error[:, k] / bound[:, k])
        rows.append(
            Summary(
                setting.x,
                section,
                estimate,
                symbol,
                len(good),
                count - len(good),
                percent * float(np.abs(error[:, k]).mean()),
                percent * float(error[:, k].std(ddof=1)),
                percent * float(np.median(np.abs(error[:, k]))),
                percent * float(np.sqrt((bound[:, k] ** 2).mean())),
                float(np.sqrt((ratio**2).mean())),
                float(np.median(ratio)) / _MEDIAN,
                nees,
            )
        )
    return rows


def run_study(
    options: Options,
    name: str,
    title: str,
    x_label: str,
    settings: tuple[Setting, ...],
    *,
    log_x: bool = False,
    remark: str = "",
) -> Outcome:
    """Run, draw and judge one of the three figures.

    It passes where nothing failed that has enough half-turns, and there the refined
    estimate is at the bound: within 8 % (wider below 1000 trials, as their root mean
    square scatters more). Fewer than 50 trials cannot tell.

    Args:
        options: How to run it.
        name: Of the experiment.
        title: What the figure shows.
        x_label: Of the horizontal axis.
        settings: Along the horizontal axis.
        log_x: Whether that axis is logarithmic.
        remark: Ends the verdict.
    """
    identity = {"settings": [asdict(setting) for setting in settings]}
    rows = summarise(settings, options.sweep(name, Trial(settings), identity))
    passed, sentence = judge(settings, rows, options.trials)
    return finish(
        options,
        name,
        title,
        passed=passed,
        sentence=sentence + remark,
        rows=[asdict(row) for row in rows],
        figure=_drawn(rows, f"{title} ({options.trials} trials)", x_label, log_x),
    )


def judge(
    settings: Sequence[Setting], rows: Sequence[Summary], trials: int
) -> tuple[bool | None, str]:
    """Whether the refined estimate is at the bound, and the numbers in words.

    Args:
        settings: Of the study.
        rows: Its statistics.
        trials: Per setting.

    Returns:
        None where there are too few trials to tell; the sentence.
    """
    many = {setting.x for setting in settings if setting.half_turns >= _MANY_TURNS}
    refined = [row for row in rows if row.estimate == "refined"]
    ratios = [row.rms_over_bound for row in refined if row.x in many]
    nees = [row.nees for row in refined if row.x in many and row.quantity == "fu"]
    failed = sum(r.failed for r in refined if r.x in many and r.quantity == "fu")
    band = _BAND * max(1.0, np.sqrt(1000 / trials))
    passed = None
    if failed > 0:
        passed = False
    elif trials >= _FEWEST_TRIALS:
        passed = bool(max(abs(ratio - 1) for ratio in ratios) <= band)
    closed = {
        name: np.median([r.rms_over_bound for r in rows if r.estimate == name])
        for name in ("whitened", "paper")
    }
    allowed = f"allowed {1 - band:.2f} to {1 + band:.2f} with {trials} trials"
    if trials < _FEWEST_TRIALS:
        allowed = f"{trials} trials are too few to tell, give --trials 100 or more"
    sentence = (
        f"refined RMSE / bound {min(ratios):.2f} to {max(ratios):.2f} ({allowed}), "
        f"NEES {np.mean(nees):.2f}, {failed} failed; typical closed form: whitened "
        f"{closed['whitened']:.2f}, paper's {closed['paper']:.2f} times the bound"
    )
    few = [row for row in refined if row.x not in many]
    if few:
        medians = [row.median_over_bound for row in few]
        lost = sum(row.failed for row in few if row.quantity == "fu")
        sentence += (
            f"; under {_MANY_TURNS} half-turns median error / bound "
            f"{min(medians):.2f} to {max(medians):.2f}, {lost} undetermined"
        )
    return passed, sentence


_STYLES: dict[str, dict[str, Any]] = {
    "paper": {"color": "#999999", "marker": "^", "label": "closed form, paper's"},
    # Wide, because what is refined runs over it where there are many images.
    "whitened": {
        "color": "#f2a65a",
        "marker": "s",
        "linewidth": 3.5,
        "markersize": 6.0,
        "label": "closed form, whitened",
    },
    "refined": {"color": "#1f5fa8", "marker": "o", "label": "refined"},
}


def _drawn(rows: Sequence[Summary], title: str, x_label: str, log_x: bool) -> Any:
    """Sections and statistics down, quantities across."""
    from matplotlib.ticker import LogLocator, NullLocator

    panels = [(s, k) for s in SECTIONS for k in ("mean_percent", "std_percent")]
    figure, axes = new_figure(13.0, 10.5, len(panels), len(SYMBOLS), share_y=True)
    for (section, statistic), line in zip(panels, axes, strict=True):
        factor = _MEAN if statistic == "mean_percent" else 1.0
        for symbol, panel in zip(SYMBOLS.values(), line, strict=True):
            for estimate, style in _STYLES.items():
                drawn = [
                    row
                    for row in rows
                    if (row.section, row.estimate, row.quantity)
                    == (section, estimate, symbol)
                ]
                x = [row.x for row in drawn]
                panel.plot(
                    x,
                    [getattr(row, statistic) for row in drawn],
                    **{"linewidth": 1.2, "markersize": 3.5, **style},
                )
            panel.plot(
                x,
                [factor * row.bound_percent for row in drawn],
                color="black",
                linestyle="--",
                linewidth=1.2,
                label="Cramer-Rao bound",
                zorder=5,
            )
            panel.set_yscale("log")
            panel.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            panel.yaxis.set_minor_locator(NullLocator())
            if log_x:
                panel.set_xscale("log")
                ticks = sorted({row.x for row in rows})
                panel.set_xticks([t for t in ticks if t in (0.1, 0.2, 0.5, 1.0)])
                panel.minorticks_off()
                panel.xaxis.set_major_formatter("{x:g}")
            panel.grid(True, which="both", color="#e4e4e4", linewidth=0.5)
            panel.yaxis.set_major_formatter("{x:g}")
            panel.set_title(symbol, fontsize=10)
            panel.tick_params(labelsize=8)
        what = "mean |error|" if statistic == "mean_percent" else "STD of error"
        line[0].set_ylabel(f"{section}: {what}, % of fu", fontsize=9)
    for panel in axes[-1]:
        panel.set_xlabel(x_label, fontsize=9)
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=9)
    figure.suptitle(title, fontsize=12)
    return figure
