"""Fig. 6: how the number of images reaches the intrinsics; 0.2 px of noise.

With 4 images the skew must be known, and is; from 6 images on it is estimated.
"""

from __future__ import annotations

from handeye_tri.experiments.accuracy import Setting, run_study
from handeye_tri.experiments.outcome import Options, Outcome

SETTINGS = tuple(Setting(2 * turns, 0.2, turns, 0.5) for turns in range(2, 12))


def run(options: Options) -> Outcome:
    """From 4 to 22 images."""
    return run_study(
        options,
        "fig06",
        "Fig. 6: calibration results with different image numbers",
        "images",
        SETTINGS,
    )
