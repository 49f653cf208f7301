"""Run the shipped cells over several seeds and print how accurate they are.

    python scripts/check_cells.py --seeds 1-10 [CELL ...]

Each run is a whole ``handeye-tri run`` in its own process, on rendered images.
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


def one(cell: str, seed: int, folder: Path) -> dict[str, float]:
    started = time.perf_counter()
    done = subprocess.run(
        [
            *(sys.executable, "-m", "handeye_tri.cli", "run", cell),
            *("-o", str(folder / f"{cell}_{seed}"), "--seed", str(seed)),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode not in (0, 3, 4):
        raise SystemExit(f"{cell} seed {seed}: {done.stderr}")
    path = folder / f"{cell}_{seed}" / "evaluation.json"
    result = json.loads(path.read_text())
    track, truth = result["track"], result["truth"]
    return {
        "track": track["mean_mm"],
        "ratio": track["rms_mm"] / track["predicted_rms_mm"],
        "chi2": result["cameras_chi2_per_dof"],
        "loop": result["hand_eye_chi2_per_dof"],
        "left": truth["left.fx"]["error"] / truth["left.fx"]["sigma"],
        "right": truth["right.fx"]["error"] / truth["right.fx"]["sigma"],
        "passed": float(result["verdict"] == "PASS"),
        "seconds": time.perf_counter() - started,
    }


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
        f"seeds {options.seeds}      track mm     rms/      chi2/dof      |fx error| "
        "< 4 sigma   PASS   seconds\n"
        "cell                  mean  worst  predicted  cams  loop     left   right"
        "              median  max"
    )
    with (
        tempfile.TemporaryDirectory() as scratch,
        ThreadPoolExecutor(options.jobs) as pool,
    ):
        folder = options.keep or Path(scratch)
        for cell in options.cells:
            rows = list(pool.map(lambda s, c=cell: one(c, s, folder), seeds))
            columns = {k: np.array([row[k] for row in rows]) for k in rows[0]}
            within = [int((np.abs(columns[k]) < 4).sum()) for k in ("left", "right")]
            print(
                f"{cell:<20}{columns['track'].mean():6.3f} {columns['track'].max():6.3f}"
                f"{np.sqrt((columns['ratio'] ** 2).mean()):11.2f}"
                f"{columns['chi2'].mean():6.2f}{columns['loop'].mean():6.2f}"
                f"{within[0]:6d}/{len(rows)}{within[1]:5d}/{len(rows)}"
                f"{int(columns['passed'].sum()):8d}/{len(rows)}"
                f"{np.median(columns['seconds']):8.1f}{columns['seconds'].max():6.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
