"""Run the shipped cells over several seeds and print how accurate they are.

    python scripts/check_cells.py --seeds 1-10 [CELL ...]

Each run is a whole ``handeye-tri run`` in its own process, on rendered images; then
the same images are calibrated step by step.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

CELLS = ("hp3_stereo", "hp3_stereo_edge", "hp3_stereo_lens", "hp3_stereo_mono")
METHODS = ("separate", "joint")


def command(*arguments: object) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "handeye_tri.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode not in (0, 3, 4):
        raise SystemExit(f"{' '.join(map(str, arguments))}: {done.stderr}")


def score(folder: Path) -> dict[str, float]:
    result = json.loads((folder / "evaluation.json").read_text())
    track, truth = result["track"], result["truth"]
    return {
        "track": track["mean_mm"],
        "ratio": track["rms_mm"] / track["predicted_rms_mm"],
        "chi2": result["cameras_chi2_per_dof"],
        "loop": result["hand_eye_chi2_per_dof"],
        "left": truth["left.fx"]["error"] / truth["left.fx"]["sigma"],
        "right": truth["right.fx"]["error"] / truth["right.fx"]["sigma"],
        "passed": float(result["verdict"] == "PASS"),
    }


def one(cell: str, seed: int, folder: Path) -> dict[str, dict[str, float]]:
    session = folder / f"{cell}_{seed}"
    started = time.perf_counter()
    command("run", cell, "-o", session, "--seed", seed)
    seconds = time.perf_counter() - started
    scores = {"joint": score(session)}
    command("calibrate", session, "--method", "separate")
    command("evaluate", session)
    scores["separate"] = score(session)
    for row in scores.values():
        row["seconds"] = seconds
    return scores


def line(cell: str, method: str, rows: list[dict[str, float]]) -> str:
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    within = [int((np.abs(columns[side]) < 4).sum()) for side in ("left", "right")]
    n = len(rows)
    return (
        f"{cell:<16} {method:<8}{columns['track'].mean():7.3f}"
        f"{columns['track'].max():7.3f}"
        f"{np.sqrt((columns['ratio'] ** 2).mean()):8.2f}"
        f"{columns['chi2'].mean():8.2f}{columns['loop'].mean():7.2f}"
        f"{within[0]:6d}/{n}{within[1]:4d}/{n}{int(columns['passed'].sum()):5d}/{n}"
        f"{np.median(columns['seconds']):8.1f}{columns['seconds'].max():6.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cells", nargs="*", default=CELLS)
    parser.add_argument("--seeds", default="1-10", help="first-last")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="keep the sessions in this folder")
    options = parser.parse_args()
    first, last = (int(part) for part in options.seeds.split("-"))
    seeds = range(first, last + 1)
    print(
        f"seeds {options.seeds:<11}           track mm     rms/    chi2/dof"
        "     |fx error| < 4 s  PASS  run, seconds\n"
        "cell             method     mean  worst  predic.  cameras  all"
        "     left  right         median   max",
        flush=True,
    )
    with (
        tempfile.TemporaryDirectory() as scratch,
        ThreadPoolExecutor(options.jobs) as pool,
    ):
        folder = options.keep or Path(scratch)
        for cell in options.cells:
            runs = list(pool.map(lambda s, c=cell: one(c, s, folder), seeds))
            for method in METHODS:
                print(line(cell, method, [run[method] for run in runs]), flush=True)


if __name__ == "__main__":
    main()
