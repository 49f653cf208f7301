"""Fig. 13: six cameras from general motions (Appendix A), over the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras import calibrate_cameras_general
from handeye_tri.camera import PinholeCamera
from handeye_tri.errors import HandEyeError, NoPlanError
from handeye_tri.experiments.accuracy import SYMBOLS
from handeye_tri.experiments.half_turn_views import (
    IMAGE_SIZE,
    SIDE_AB,
    SIDE_AC,
    TRUE_CAMERA,
)
from handeye_tri.experiments.outcome import Options, Outcome, finish, new_figure
from handeye_tri.se3 import SE3, se3_exp, so3_exp
from handeye_tri.sweep import Result
from handeye_tri.triangle import TriangleRig

Floats = NDArray[np.float64]

NOISES = tuple(k / 10 for k in range(1, 11))
CAMERAS, VIEWS = 6, 22
TRIANGLE = TriangleRig(SIDE_AB, SIDE_AC, float(np.arccos(0.5)))
# Cameras on part of a circle about the triangle's workspace, looking at its middle.
_DISTANCE_M, _ARC_DEG = 0.9, 100.0
_MARGIN_PX = 5.0
_MOST_DRAWS = 1000
_QUANTITIES = tuple(SYMBOLS.values())
# Part of the runs that must converge, and the allowed NEES of many trials.
_CONVERGED, _NEES = 298 / 300, 0.07


@dataclass(frozen=True, slots=True)
class Trial:
    """Calibrates six cameras from fresh views at every noise."""

    noises: tuple[float, ...]

    def __call__(self, seed: int) -> Result:
        """One entry per noise: errors and bound of all cameras, or why not."""
        return {
            "runs": [
                _calibrated(np.random.default_rng([seed, 13, i]), sigma)
                for i, sigma in enumerate(self.noises)
            ]
        }


def _calibrated(rng: np.random.Generator, sigma: float) -> Result:
    exact = draw_views(rng)
    pixels = exact + sigma * rng.standard_normal(exact.shape)
    try:
        found = calibrate_cameras_general(
            pixels, TRIANGLE, image_sizes=IMAGE_SIZE, sigma_px=sigma
        )
    except HandEyeError as error:
        return {"failed": type(error).__name__}
    errors = np.array(
        [
            camera.intrinsics.vector - TRUE_CAMERA.intrinsics.vector
            for camera in found.cameras
        ]
    )
    labels = [
        f"{camera.name}.{quantity}" for camera in found.cameras for quantity in SYMBOLS
    ]
    rows = [found.covariance.labels.index(label) for label in labels]
    covariance = found.covariance.matrix[np.ix_(rows, rows)]
    flat = errors.ravel()
    return {
        "error": errors.tolist(),
        "sigma": np.sqrt(np.diagonal(covariance)).reshape(errors.shape).tolist(),
        "nees": float(flat @ np.linalg.solve(covariance, flat) / len(flat)),
    }


def draw_views(rng: np.random.Generator) -> Floats:
    """Exact pixels of the three points, shape (cameras, views, 3, 2).

    The cameras are equal, as in the paper; the triangle turns any way and is seen by
    all of them.

    Raises:
        NoPlanError: almost no pose is seen whole by every camera.
    """
    places = _camera_places()
    views: list[Floats] = []
    for _ in range(_MOST_DRAWS):
        rotation = so3_exp(rng.normal(size=3) * 2.0)
        offset = rng.uniform(-0.06, 0.06, 3)
        middle = TRIANGLE.points.mean(axis=0)
        points = (TRIANGLE.points - middle) @ rotation.T + offset
        seen = np.array(
            [_project(TRUE_CAMERA, place.inverse(), points) for place in places]
        )
        limit = np.array(IMAGE_SIZE) - 1 - _MARGIN_PX
        if ((seen > _MARGIN_PX) & (seen < limit)).all():
            views.append(seen)
        if len(views) == VIEWS:
            return np.stack(views, axis=1)
    raise NoPlanError(
        f"of {_MOST_DRAWS} poses only {len(views)} are seen whole by all cameras",
        {"outside an image": _MOST_DRAWS - len(views)},
    )


def _project(camera: PinholeCamera, camera_from_world: SE3, points: Floats) -> Floats:
    return camera.project(camera_from_world.apply(points))


def _camera_places() -> list[SE3]:
    """world_from_camera of cameras on an arc, at two heights, looking at its middle."""
    places = []
    for i, angle in enumerate(np.radians(np.linspace(-0.5, 0.5, CAMERAS) * _ARC_DEG)):
        lift = np.radians(20.0 if i % 2 else -15.0)
        turn = so3_exp([0.0, angle, 0.0]) @ so3_exp([lift, 0.0, 0.0])
        back = se3_exp([0.0, 0.0, -_DISTANCE_M, 0.0, 0.0, 0.0])
        places.append(SE3.from_parts(turn, np.zeros(3)) @ SE3(back))
    return places


@dataclass(frozen=True, slots=True)
class Row:
    """Errors of one quantity at one noise, over all cameras, in percent of fu.

    Attributes:
        noise_px: Of every pixel coordinate.
        quantity: fu, fv, s, u0 or v0.
        trials: That converged.
        failed: That did not.
        mean_percent: Mean absolute error.
        std_percent: Standard deviation of the error.
        predicted_percent: Root mean square of the stated sigmas, which is the bound.
        rms_over_predicted: Root mean square of error over stated sigma.
        nees: Mean normalised squared error of all intrinsics of all cameras.
    """

    noise_px: float
    quantity: str
    trials: int
    failed: int
    mean_percent: float
    std_percent: float
    predicted_percent: float
    rms_over_predicted: float
    nees: float


def run(options: Options) -> Outcome:
    """Noise from 0.1 to 1 px."""
    task = Trial(NOISES)
    identity = {"noises": list(NOISES), "cameras": CAMERAS, "views": VIEWS}
    trials = options.sweep("fig13", task, identity)
    rows = summarise(NOISES, trials)
    total = len(trials) * len(NOISES)
    failed = sum("failed" in entry for trial in trials for entry in trial["runs"])
    every = [e["nees"] for t in trials for e in t["runs"] if "nees" in e]
    nees = float(np.mean(every)) if every else np.inf
    # The mean of NEES of 30 quantities scatters by sqrt(2 / 30) a run.
    band = max(_NEES, 3 * float(np.sqrt(2 / 30 / max(len(every), 1))))
    ratios = [row.rms_over_predicted for row in rows]
    return finish(
        options,
        "fig13",
        "Fig. 13: multicamera calibration results at different noise levels",
        passed=failed <= (1 - _CONVERGED) * total and abs(nees - 1) <= band,
        sentence=(
            f"{CAMERAS} cameras, {VIEWS} views: {total - failed} of {total} runs "
            f"converged, NEES {nees:.3f} (allowed {1 - band:.2f} to {1 + band:.2f}), "
            f"error / predicted sigma {min(ratios, default=np.nan):.2f} to "
            f"{max(ratios, default=np.nan):.2f}"
        ),
        rows=[asdict(row) for row in rows],
        figure=_drawn(rows, len(trials)),
    )


def summarise(noises: Sequence[float], trials: Sequence[Result]) -> list[Row]:
    """One row per noise and quantity; none where no run converged."""
    percent = 100.0 / TRUE_CAMERA.intrinsics.fx
    rows = []
    for i, noise in enumerate(noises):
        good = [t["runs"][i] for t in trials if "error" in t["runs"][i]]
        if not good:
            continue
        error = np.array([entry["error"] for entry in good])
        sigma = np.array([entry["sigma"] for entry in good])
        nees = float(np.mean([entry["nees"] for entry in good]))
        for k, symbol in enumerate(_QUANTITIES):
            e, s = error[..., k], sigma[..., k]
            rows.append(
                Row(
                    noise,
                    symbol,
                    len(good),
                    len(trials) - len(good),
                    percent * float(np.abs(e).mean()),
                    percent * float(e.std()),
                    percent * float(np.sqrt((s**2).mean())),
                    float(np.sqrt(((e / s) ** 2).mean())),
                    nees,
                )
            )
    return rows


def _drawn(rows: Sequence[Row], trials: int) -> Any:
    figure, axes = new_figure(10.0, 4.4, 1, 2, share_y=True)
    colours = ("#1f5fa8", "#d95f02", "#2e7d32", "#7b3f99", "#999999")
    titles = ("mean |error|", "STD of error")
    statistics = ("mean_percent", "std_percent")
    factors = (np.sqrt(2 / np.pi), 1.0)
    columns = zip(axes[0], titles, statistics, factors, strict=True)
    for panel, title, statistic, factor in columns:
        for symbol, colour in zip(_QUANTITIES, colours, strict=True):
            drawn = [row for row in rows if row.quantity == symbol]
            x = [row.noise_px for row in drawn]
            panel.plot(
                x,
                [getattr(row, statistic) for row in drawn],
                "o-",
                color=colour,
                markersize=4,
                linewidth=1.0,
                label=symbol,
            )
            panel.plot(
                x,
                [factor * row.predicted_percent for row in drawn],
                "--",
                color=colour,
                linewidth=1.0,
            )
        panel.plot([], [], "--", color="black", label="bound (stated sigma)")
        panel.grid(True, color="#e4e4e4", linewidth=0.5)
        panel.set_xlabel("noise, px")
        panel.set_title(title, fontsize=10)
    axes[0][0].set_ylabel("% of fu, all six cameras")
    axes[0][0].set_ylim(bottom=0)
    axes[0][0].legend(fontsize=8)
    figure.suptitle(
        f"Fig. 13: six cameras, {VIEWS} views, general motions ({trials} trials)"
    )
    return figure
