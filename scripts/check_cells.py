"""Run the shipped cells over several seeds, and compare with what they must reach.

    python scripts/check_cells.py --seeds 1-10 [CELL ...]

Each run is a whole ``handeye-tri run`` in its own process, on rendered images. The same
images are calibrated step by step too, and the joint result is tested on noiseless
held-out stations, which leaves the calibration's own part of the track error. A second
run of each seed has a robot that executes exactly what it reports. A gate that is
missed is named, and the exit code is 1.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from handeye_tri import storage
from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
from handeye_tri.evaluate import evaluate_track
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.pipeline import NullProgress, Run
from handeye_tri.records import GroundTruth, HandEyeCalibration, Session
from handeye_tri.se3 import SE3
from handeye_tri.storage import SessionFolder

# Mean track error, the same with an exact robot, the calibration's part alone; mm.
LIMITS = {
    "hp3_stereo": (0.078, 0.045, 0.030),
    "hp3_stereo_edge": (0.082, 0.052, 0.036),
    "hp3_stereo_both": (0.082, 0.052, 0.036),
    "hp3_stereo_lens": (0.082, 0.047, 0.032),
    "hp3_stereo_mono": (None, None, None),
    "hp3_single": (None, None, None),
}
RATIO = (0.90, 1.10)
CHI2 = (0.85, 1.10)


def command(*arguments: object) -> int:
    done = subprocess.run(
        [sys.executable, "-m", "handeye_tri.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode not in (0, 3, 4):
        raise SystemExit(f"{' '.join(map(str, arguments))}: {done.stderr}")
    return done.returncode


def noiseless(session: Session, truth: GroundTruth) -> Session:
    """The same stations with true poses and true centres of outlines."""
    poses = truth.base_from_flange
    held = np.array([truth.markers, *(mount.markers for mount in truth.other_mounts)])
    points = held[session.mounts] @ poses[:, :3, :3].mT + poses[:, None, :3, 3]
    pixels = []
    for camera, place in zip(truth.cameras, truth.base_from_camera, strict=True):
        local = place.inverse().apply(points)
        shift = sphere_shift(camera, local, session.marker_radii)
        pixels.append(camera.project(local) + shift)
    stations = tuple(
        replace(station, base_from_flange=SE3(pose))
        for station, pose in zip(session.stations, poses, strict=True)
    )
    seen = np.isfinite(session.pixels)
    return replace(session, stations=stations, pixels=np.where(seen, pixels, np.nan))


def calibrated(folder: Path) -> tuple[Run, Session, HandEyeCalibration]:
    run = Run(SessionFolder.open(folder), NullProgress())
    return run, run.session(), run.hand_eye()


def one(cell: str, seed: int, folder: Path) -> dict[str, float]:
    """Figures of a seed; images that are in the folder already are taken."""
    session_folder = folder / f"{cell}_{seed}"
    started, seconds = time.perf_counter(), np.nan
    if (session_folder / "observations.npz").is_file():
        command("detect", session_folder, "--again")
        command("calibrate", session_folder, "--again")
    else:
        command("run", cell, "-o", session_folder, "--seed", seed)
        seconds = time.perf_counter() - started
    passed = command("check", session_folder) == 0
    run, session, joint = calibrated(session_folder)
    cameras = run.cameras()
    track = evaluate_track(joint, session)
    separate = evaluate_track(calibrate_hand_eye(session, cameras), session)
    known = run.truth()
    assert known is not None
    truth = known[0]
    fx = [
        (found.intrinsics.fx - true.intrinsics.fx)
        / joint.covariance.std(f"{found.name}.fx")
        for found, true in zip(joint.cameras, truth.cameras, strict=True)
    ]
    return {
        "separate": 1e3 * separate.mean,
        "joint": 1e3 * track.mean,
        "rms": 1e3 * track.rms,
        "predicted": 1e3 * track.predicted_rms,
        "part": 1e3 * evaluate_track(joint, noiseless(session, truth)).mean,
        "chi2 cameras": cameras.chi2 / cameras.dof,
        "chi2": joint.chi2 / joint.dof,
        "fx": float(np.abs(fx).max()),
        "passed": float(passed),
        "seconds": seconds,
    }


def exact(cell: str, seed: int, folder: Path) -> dict[str, float]:
    """The same with a robot that goes exactly where it says."""
    session_folder = folder / f"{cell}_exact_{seed}"
    if not (session_folder / "observations.npz").is_file():
        path = storage.find_cell(cell)
        lines = path.read_text().splitlines()
        for k, line in enumerate(lines):
            if line.lstrip().startswith("repeatability_"):
                lines[k] = line.split(":")[0] + ": 0.0"
        copy = folder / f"{cell}_exact.yaml"
        storage.write_bytes(copy, "\n".join(lines).encode())
        command("plan", session_folder, "--cell", copy, "--seed", seed)
        command("simulate", session_folder)
    command("detect", session_folder, "--again")
    command("calibrate", session_folder, "--again")
    _, session, joint = calibrated(session_folder)
    track = evaluate_track(joint, session)
    return {
        "exact": 1e3 * track.mean,
        "exact rms": 1e3 * track.rms,
        "exact predicted": 1e3 * track.predicted_rms,
        "exact chi2": joint.chi2 / joint.dof,
    }


def missed(name: str, found: float, low: float, high: float | None) -> list[str]:
    if high is None or low <= found <= high:
        return []
    return [f"{name} {found:.3f}, must be {low:g} to {high:g}"]


def report(cell: str, rows: list[dict[str, float]]) -> list[str]:
    """Print a cell's line; what it misses."""
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    mean = {name: float(values.mean()) for name, values in columns.items()}

    def ratio(found: str, predicted: str) -> float:
        squares = (columns[found] ** 2).mean() / (columns[predicted] ** 2).mean()
        return float(np.sqrt(squares))

    n, of = len(rows), ratio("rms", "predicted")
    line = (
        f"{cell:<16}{mean['separate']:9.3f}{mean['joint']:7.3f}"
        f"{columns['joint'].max():7.3f}{mean['part']:8.3f}{of:8.2f}"
        f"{mean['chi2 cameras']:8.2f}{mean['chi2']:7.2f}"
        f"{int((columns['fx'] < 4).sum()):6}/{n}{int(mean['passed'] * n + 0.5):4}/{n}"
    )
    track_limit, exact_limit, part_limit = LIMITS.get(cell, (None, None, None))
    problems = [
        *missed("mean track error, mm", mean["joint"], 0.0, track_limit),
        *missed("calibration's part, mm", mean["part"], 0.0, part_limit),
        *missed("track over prediction", of, *RATIO),
        *missed("chi2/dof", mean["chi2"], *CHI2),
        *missed("runs that PASS", mean["passed"], 1.0, 1.0),
    ]
    if "exact" in columns:
        line += (
            f"{mean['exact']:9.3f}{ratio('exact rms', 'exact predicted'):8.2f}"
            f"{mean['exact chi2']:7.2f}"
        )
        problems += missed("with an exact robot, mm", mean["exact"], 0.0, exact_limit)
        problems += missed("chi2/dof, exact robot", mean["exact chi2"], *CHI2)
    if np.isfinite(columns["seconds"]).any():
        line += f"{np.nanmedian(columns['seconds']):9.1f}"
    print(line, flush=True)
    return [f"{cell}: {problem}" for problem in problems]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cells", nargs="*", default=tuple(LIMITS))
    parser.add_argument("--seeds", default="1-10", help="first-last")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--keep",
        type=Path,
        help="keep the sessions in this folder, and take the images that are in it",
    )
    parser.add_argument(
        "--no-exact", action="store_true", help="leave out the exact robot"
    )
    options = parser.parse_args()
    first, last = (int(part) for part in options.seeds.split("-"))
    seeds = range(first, last + 1)
    print(
        f"seeds {options.seeds:<10}    mean track, mm      calibr.    rms/"
        "   chi2/dof     |fx| <  PASS   exact robot            run\n"
        "cell            separate  joint  worst    part predict cameras  joint"
        "   4 s            mm predict  chi2   median s",
        flush=True,
    )

    def figures(cell: str, seed: int, folder: Path) -> dict[str, float]:
        found = one(cell, seed, folder)
        return found if options.no_exact else found | exact(cell, seed, folder)

    problems = []
    with (
        tempfile.TemporaryDirectory() as scratch,
        ThreadPoolExecutor(options.jobs) as pool,
    ):
        folder = options.keep or Path(scratch)
        for cell in options.cells:
            rows = pool.map(lambda seed, c=cell: figures(c, seed, folder), seeds)
            problems += report(cell, list(rows))
    for problem in problems:
        print(f"MISSED  {problem}")
    sys.exit(1 if problems else 0)


if __name__ == "__main__":
    main()
