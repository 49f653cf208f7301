"""Compare `solve_pose_pairs` with KinHEC's reference solvers and with OpenCV's.

    python scripts/check_kinhec.py DATA [--seed N ...] [--limit N] [--cv-poses N]

DATA is a folder of KinHEC data (`kinhec generate --tier small --out DATA`); where it
is absent, the `small` tier is made there, with its own seed or with --seed. With
several seeds each has a folder of its own in DATA and their sequences are taken
together: a median of the 24 of one track is known to a fifth only. Needs the packages
kinhec and, for OpenCV's solvers, a cv2 that has calibrateHandEye (4.14 has, 5.0 has
not). Ours gets every measured pair and, for a monocular camera, that the scale is
unknown; the references get KinHEC's own protocol (keyframes), those on absolute poses
also all frames, OpenCV all pairs of the keyframes. Clock offsets are the true ones.
Results are kept in check.jsonl beside the data, so that an interrupted run goes on.
Exits with 1 where a bar is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

BAR = 1.05
OUTLIERS_MM = 2.0


def make(folder: Path, seed: int | None, tracks: list[str] | None) -> None:
    import kinhec
    from kinhec.pipeline import generate_dataset

    tier = Path(kinhec.__file__).parent / "configs" / "small.yaml"
    if seed is not None:
        lines = tier.read_text().splitlines()
        text = "\n".join(
            f"global_seed: {seed}" if line.startswith("global_seed:") else line
            for line in lines
        )
        folder.mkdir(parents=True, exist_ok=True)
        tier = folder / "small.yaml"
        tier.write_text(text + "\n")
    generate_dataset(
        str(tier),
        folder,
        workers=1,
        tracks=tracks,
        work_dir=folder / "work",
        write_card=False,
    )


def ours(sequence: Any) -> tuple[Any, Any]:
    from handeye_tri.hand_eye import solve_pose_pairs
    from handeye_tri.records import PosePairs

    offset = None if sequence.synchronous else sequence.time_offset
    robot, observed, valid = sequence.paired_measurements(offset)
    found = solve_pose_pairs(
        PosePairs(
            robot[valid],
            observed[valid],
            "eye_in_hand" if sequence.eye_in_hand else "eye_to_hand",
            "flange_in_base",
            "target_in_camera",
            metric=not sequence.config.scale.get("enabled"),
        )
    )
    return found.x.matrix, found.z.matrix


def references(slow: bool) -> dict[str, Callable[[Any], tuple[Any, Any]]]:
    """KinHEC's own solvers in its own protocol, and some on all frames."""
    from kinhec.benchmark import SOLVERS, _keyframe_data

    def run(name: str) -> Callable[[Any], tuple[Any, Any]]:
        def solve(sequence: Any) -> tuple[Any, Any]:
            offset = None if sequence.synchronous else sequence.time_offset
            data = _keyframe_data(sequence, offset)
            if data is None:
                raise ValueError("too few frames")
            found = SOLVERS[name](data, np.random.default_rng(0))
            return found["X"], found.get("Y")

        return solve

    def run_all(name: str) -> Callable[[Any], tuple[Any, Any]]:
        def solve(sequence: Any) -> tuple[Any, Any]:
            offset = None if sequence.synchronous else sequence.time_offset
            a, b = sequence.axyb_poses(offset)
            found = SOLVERS[name]((a, b, None, None), np.random.default_rng(0))
            return found["X"], found["Y"]

        return solve

    everywhere = ["shah", *(["shah+lm"] if slow else [])]
    return {f"kinhec {name}": run(name) for name in SOLVERS} | {
        f"kinhec {name}, all frames": run_all(name) for name in everywhere
    }


def opencv(most: int) -> dict[str, Callable[[Any], tuple[Any, Any]]]:
    """OpenCV's solvers on at most so many keyframes, all pairs of them."""
    try:
        import cv2
    except ImportError:
        return {}
    if not hasattr(cv2, "calibrateHandEye"):
        return {}
    from kinhec import motions, se3

    def poses(sequence: Any) -> tuple[Any, Any]:
        offset = None if sequence.synchronous else sequence.time_offset
        a, b = sequence.axyb_poses(offset)
        keys = motions.select_keyframes(a, max_keyframes=most)
        keys = keys if len(keys) >= 3 else np.arange(len(a))
        return a[keys], se3.inverse(b[keys])

    def hand_eye(method: int) -> Callable[[Any], tuple[Any, Any]]:
        def solve(sequence: Any) -> tuple[Any, Any]:
            a, target = poses(sequence)
            rotation, translation = cv2.calibrateHandEye(
                list(a[:, :3, :3]),
                list(a[:, :3, 3]),
                list(target[:, :3, :3]),
                list(target[:, :3, 3]),
                method=method,
            )
            return se3.make_transform(rotation, translation.ravel()), None

        return solve

    def robot_world(method: int) -> Callable[[Any], tuple[Any, Any]]:
        def solve(sequence: Any) -> tuple[Any, Any]:
            a, target = poses(sequence)
            base = se3.inverse(a)
            # world2cam, base2gripper -> base2world, gripper2cam.
            rw, tw, rg, tg = cv2.calibrateRobotWorldHandEye(
                list(target[:, :3, :3]),
                list(target[:, :3, 3]),
                list(base[:, :3, :3]),
                list(base[:, :3, 3]),
                method=method,
            )
            return (
                se3.inverse(se3.make_transform(rg, tg.ravel())),
                se3.inverse(se3.make_transform(rw, tw.ravel())),
            )

        return solve

    names = {
        "Tsai": cv2.CALIB_HAND_EYE_TSAI,
        "Park": cv2.CALIB_HAND_EYE_PARK,
        "Horaud": cv2.CALIB_HAND_EYE_HORAUD,
        "Andreff": cv2.CALIB_HAND_EYE_ANDREFF,
        "Daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
    }
    worlds = {
        "Shah": cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH,
        "Li": cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI,
    }
    return {
        **{f"cv2 {name}": hand_eye(method) for name, method in names.items()},
        **{f"cv2 {name}": robot_world(method) for name, method in worlds.items()},
    }


def evaluate(
    folder: Path,
    limit: int | None,
    most: int,
    only: str | None,
    tracks: list[str] | None,
    slow: bool,
) -> None:
    """Append one line per sequence and solver to DATA/check.jsonl."""
    from kinhec import iter_sequences, load_manifest
    from kinhec.metrics import calibration_errors

    log = folder / "check.jsonl"
    done = set()
    if log.exists():
        for line in log.read_text().splitlines():
            row = json.loads(line)
            done.add((row["sequence"], row["solver"]))
    solvers = {"ours": ours, **references(slow), **opencv(most)}
    if only:
        solvers = {name: solvers[name] for name in solvers if only in name}
    manifest = load_manifest(folder, tracks)
    if limit:
        manifest = manifest.groupby("track").head(limit)
    with log.open("a") as stream:
        for sequence in iter_sequences(folder, manifest):
            for name, solve in solvers.items():
                if (sequence.id, name) in done:
                    continue
                started = time.process_time()
                row = {
                    "sequence": sequence.id,
                    "track": sequence.manifest["track"],
                    "solver": name,
                    "error": "",
                }
                try:
                    with warnings.catch_warnings():
                        warnings.simplefilter("ignore" if name != "ours" else "error")
                        x, _ = solve(sequence)
                    row |= calibration_errors(x, sequence.X)
                # A peer may raise anything; it is counted as its failure.
                except Exception as error:
                    row["error"] = f"{type(error).__name__}: {error}"
                row["seconds"] = time.process_time() - started
                stream.write(json.dumps(row) + "\n")
                stream.flush()


def table(folders: list[Path], tracks: list[str] | None) -> bool:
    """Print medians per track, means beside them; whether every bar is met.

    A solver is compared on a track where it was run on all sequences that ours was.
    """
    errors: dict[str, dict[str, dict[str, tuple[float, float]]]] = defaultdict(
        lambda: defaultdict(dict)
    )
    failures: dict[str, int] = defaultdict(int)
    for folder in folders:
        for line in (folder / "check.jsonl").read_text().splitlines():
            row = json.loads(line)
            if tracks and row["track"] not in tracks:
                continue
            failed = bool(row["error"])
            failures[row["solver"]] += failed
            errors[row["track"]][row["solver"]][f"{folder.name} {row['sequence']}"] = (
                (np.inf, np.inf)
                if failed
                else (row["X_rot_err_deg"], row["X_trans_err_mm"])
            )
    if not errors:
        print(f"no result of the tracks {', '.join(tracks or [])}; see --tracks")
        return False
    print(f"{'track':<12}{'n':>4}  {'ours':>21}   best of the others (rotation; place)")
    good, shares = True, []
    for track, solvers in sorted(errors.items()):
        sequences = sorted(solvers.get("ours", {}))
        medians = {
            name: np.median([rows[one] for one in sequences], axis=0)
            for name, rows in solvers.items()
            if sequences and set(sequences) <= set(rows)
        }
        if len(medians) < 2:
            print(f"{track:<12}{len(sequences):>4}  nothing to compare with")
            good = False
            continue
        # Of logarithms: where a motion is all but degenerate, one error in degrees
        # outweighs every other sequence.
        means = {
            name: np.exp(
                np.mean(np.log([solvers[name][one] for one in sequences]), axis=0)
            )
            for name in medians
        }
        own, own_mean = medians.pop("ours"), means.pop("ours")
        best = [min(medians, key=lambda name: medians[name][k]) for k in (0, 1)]
        ratios = [own[k] / medians[best[k]][k] for k in (0, 1)]
        met = max(ratios) <= BAR and (track != "outliers" or own[1] < OUTLIERS_MM)
        good &= met
        shares.append(ratios)
        rotation, translation = (medians[best[k]][k] for k in (0, 1))
        print(
            f"{track:<12}{len(sequences):>4}  {own[0]:8.4f} deg {own[1]:7.3f} mm   "
            f"{len(medians)} others: {rotation:.4f} deg ({best[0]}), "
            f"{translation:.3f} mm ({best[1]}); ratios {ratios[0]:.3f}, "
            f"{ratios[1]:.3f}  {'ok' if met else 'MISSED'}; of geometric means "
            + ", ".join(
                f"{own_mean[k] / min(mean[k] for mean in means.values()):.3f}"
                for k in (0, 1)
            )
        )
    if not shares:
        return False
    overall = np.exp(np.mean(np.log(shares), axis=0))
    print(
        f"overall (geometric mean of ratios): {overall[0]:.3f} rotation, "
        f"{overall[1]:.3f} translation; our exceptions: {failures['ours']}"
    )
    return bool(good and overall.max() < 1 and not failures["ours"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument(
        "--seed", type=int, nargs="*", default=[], help="of data that is made"
    )
    parser.add_argument("--limit", type=int, help="sequences per track")
    parser.add_argument("--cv-poses", type=int, default=100, help="OpenCV's most poses")
    parser.add_argument("--only", help="solvers whose name contains this")
    parser.add_argument("--tracks", nargs="*", help="these tracks alone")
    parser.add_argument(
        "--slow", action="store_true", help="also shah+lm on all frames (10 s each)"
    )
    arguments = parser.parse_args()
    seeds = arguments.seed or [None]
    several = len(seeds) > 1
    folders = [
        arguments.data / f"{one}" if several else arguments.data for one in seeds
    ]
    for folder, seed in zip(folders, seeds, strict=True):
        if not (folder / "sequences.csv").exists():
            # It is the last file made: what was interrupted goes on.
            make(folder, seed, arguments.tracks)
        evaluate(
            folder,
            arguments.limit,
            arguments.cv_poses,
            arguments.only,
            arguments.tracks,
            arguments.slow,
        )
    sys.exit(0 if table(folders, arguments.tracks) else 1)


if __name__ == "__main__":
    main()
