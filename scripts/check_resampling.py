"""Cross-validation and repeatability against the truth, over many data sets.

    python scripts/check_resampling.py --trials 40

Each data set is simulated points (0.02 px, a robot that repeats to 0.03 mm and 0.005
degrees per axis), calibrated jointly. Columns: how far the estimates truly scatter,
and what the bootstraps say of it, both over the covariance's sigma (rms over all
quantities and data sets; 1 is agreement); by how much one data set's bootstrap varies;
the calibration's part of the track error likewise; cross-validated track over its
prediction, and the track at stations that were held out from the start.
"""

import argparse
import time

import numpy as np

from handeye_tri.adjustment import adjust
from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.evaluate import (
    bootstrap,
    compare_with_truth,
    cross_validate,
    evaluate_track,
    parametric_bootstrap,
    track_budget,
    track_part,
)
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.records import Repeatability
from handeye_tri.synthesize import reference_geometry, synthesize

# Half-turns and what they turn about.
SETTINGS = ((6, "normal"), (11, "normal"), (11, "AB"), (22, "normal"))


def one(seed: int, half_turns: int, axis: str, replicates: int) -> dict[str, float]:
    rng = np.random.default_rng
    session, truth = synthesize(
        reference_geometry(
            rng([seed, 0]), half_turns=half_turns, evaluation_stations=6, axis=axis
        ),
        rng([seed, 1]),
        sigma_px=0.02,
        repeatability=Repeatability(3e-5, np.radians(0.005)),
        marker_radii=(0.008, 0.008, 0.008),
    )
    start = calibrate_hand_eye(session, calibrate_session_cameras(session))
    whole = adjust(session, start, on_axis_correlation=0.0)

    def again(part, _index):
        return adjust(part, whole, on_axis_correlation=0.0)

    started = time.process_time()
    drawn = bootstrap(session, whole, again, rng([seed, 2]), replicates=replicates)
    noise = parametric_bootstrap(
        session, whole, again, rng([seed, 3]), replicates=replicates
    )
    validation = cross_validate(session, again).track
    seconds = time.process_time() - started
    rows = compare_with_truth(whole, truth)
    sigma = np.array([row.sigma for row in rows])
    labels = [row.quantity for row in rows]
    track = evaluate_track(whole, session)
    stated = track_budget(whole, session).calibration
    return {
        "true": np.mean((np.array([row.error for row in rows]) / sigma) ** 2),
        "drawn": np.mean(
            np.array([drawn.covariance.std(n) for n in labels]) ** 2 / sigma**2
        ),
        "noise": np.mean(
            np.array([noise.covariance.std(n) for n in labels]) ** 2 / sigma**2
        ),
        "track part": (track_part(whole, session, drawn) / stated) ** 2,
        "validated": (validation.rms / validation.predicted_rms) ** 2,
        "held out": (track.rms / track.predicted_rms) ** 2,
        "seconds": seconds,
        "failed": float(drawn.failed + noise.failed),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--replicates", type=int, default=60)
    options = parser.parse_args()
    print(
        "                    sigma over the covariance's    one set's  track   "
        "track rms / predicted  failed  seconds\n"
        "half-turns  axis    true   half-turns    noise     varies by  part    "
        "cross-val.  held out           (median)"
    )
    for half_turns, axis in SETTINGS:
        rows = [
            one(seed, half_turns, axis, options.replicates)
            for seed in range(options.trials)
        ]
        mean = {k: np.sqrt(np.mean([row[k] for row in rows])) for k in rows[0]}
        spread = np.std(np.sqrt([row["drawn"] for row in rows]))
        print(
            f"{half_turns:10d}  {axis:<7}{mean['true']:5.2f}{mean['drawn']:10.2f}"
            f"{mean['noise']:12.2f}{100 * spread:11.0f} %{mean['track part']:8.2f}"
            f"{mean['validated']:10.2f}{mean['held out']:11.2f}"
            f"{sum(row['failed'] for row in rows):11.0f}"
            f"{np.median([row['seconds'] for row in rows]):8.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
