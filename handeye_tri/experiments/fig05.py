"""Fig. 5: how the noise of the pixels reaches the intrinsics; 22 images."""

from __future__ import annotations

from handeye_tri.experiments.accuracy import Setting, run_study
from handeye_tri.experiments.outcome import Options, Outcome

SETTINGS = tuple(Setting(k / 10, k / 10, 11, 0.5) for k in range(1, 11))


def run(options: Options) -> Outcome:
    """Noise from 0.1 to 1 px."""
    return run_study(
        options,
        "fig05",
        "Fig. 5: calibration results at different noise levels",
        "noise, px",
        SETTINGS,
        log_x=True,
    )
