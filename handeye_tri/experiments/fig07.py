"""Fig. 7: how the triangle's angle at A reaches the intrinsics; 0.3 px, 22 images."""

from __future__ import annotations

from handeye_tri.experiments.accuracy import Setting, run_study
from handeye_tri.experiments.outcome import Options, Outcome

SETTINGS = tuple(Setting(k / 10, 0.3, 11, k / 10) for k in range(10))


def run(options: Options) -> Outcome:
    """Cosine of theta from 0 to 0.9."""
    return run_study(
        options,
        "fig07",
        "Fig. 7: calibration results at different cosine values of theta",
        "cos(theta)",
        SETTINGS,
    )
