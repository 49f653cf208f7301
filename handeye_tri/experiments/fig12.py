"""Fig. 12: the robot's track against the cameras', over a whole simulated run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.experiments.outcome import Options, Outcome, finish, new_figure
from handeye_tri.pipeline import STAGES, VERBS, NullProgress, Run, execute, start

Floats = NDArray[np.float64]

CELL, SEED = "hp3_stereo", 1
# What the paper measured with its robot and cameras.
_PAPER_MM = 2.8


def run(options: Options) -> Outcome:
    """Run the rendered cell up to its evaluation; a session in the folder."""
    folder = start(CELL, options.folder / "fig12_session", SEED, None)
    session = Run(folder, NullProgress())
    verbs = tuple(verb for verb in VERBS if verb != "report")
    with folder.locked():
        execute(session, STAGES, verbs, again=False)
    evaluation = session.evaluation()
    track = evaluation["track"]
    positions = track["positions"]
    rows = [
        {
            "station": position["station"],
            "marker": position["marker"],
            **_millimetres("robot", position["reported_m"]),
            **_millimetres("cameras", position["observed_m"]),
            "error_mm": position["error_mm"],
        }
        for position in positions
    ]
    return finish(
        options,
        "fig12",
        "Fig. 12: the real robot track and the observed robot track",
        passed=evaluation["verdict"] == "PASS" and track["mean_mm"] <= _PAPER_MM,
        sentence=(
            f"{track['stations']} held-out positions of cell {CELL}, rendered: mean "
            f"{track['mean_mm']:.3f} mm, worst {track['max_mm']:.3f}, predicted rms "
            f"{track['predicted_rms_mm']:.3f} (the paper's robot: {_PAPER_MM} mm)"
        ),
        rows=rows,
        figure=_drawn(positions),
    )


def _millimetres(who: str, point: Sequence[float]) -> dict[str, float]:
    return {
        f"{who}_{axis}_mm": 1e3 * value
        for axis, value in zip("xyz", point, strict=True)
    }


def _drawn(positions: Sequence[dict[str, Any]]) -> Any:
    figure, axes = new_figure(13.0, 4.6, 1, 3)
    above, side, errors = axes[0]
    colours = dict(zip("ABC", ("#c0392b", "#2e7d32", "#1f5fa8"), strict=True))
    for marker, colour in colours.items():
        chosen = [p for p in positions if p["marker"] == marker]
        robot = 1e3 * np.array([p["reported_m"] for p in chosen])
        seen = 1e3 * np.array([p["observed_m"] for p in chosen])
        for panel, (x, y) in ((above, (0, 1)), (side, (0, 2))):
            panel.plot(
                robot[:, x],
                robot[:, y],
                "-o",
                color=colour,
                markerfacecolor="none",
                markersize=8,
                linewidth=0.8,
                label=f"{marker}, robot",
            )
            panel.plot(
                seen[:, x], seen[:, y], "x", color="black", markersize=5, zorder=5
            )
        errors.plot(
            [p["station"] for p in chosen],
            [p["error_mm"] for p in chosen],
            "o",
            color=colour,
            label=marker,
        )
    above.plot([], [], "x", color="black", label="cameras")
    above.legend(fontsize=8)
    for panel, name in ((above, "y"), (side, "z")):
        panel.set_xlabel("x in the robot's base, mm")
        panel.set_ylabel(f"{name}, mm")
        panel.set_aspect("equal", adjustable="datalim")
    errors.set_ylim(bottom=0)
    errors.set_xlabel("station")
    errors.set_ylabel("distance of the tracks, mm")
    errors.legend(title="marker", fontsize=8)
    above.set_title("from above")
    side.set_title("from the side")
    errors.set_title("what the crosses hide")
    figure.suptitle("Fig. 12: robot track and observed track")
    return figure
