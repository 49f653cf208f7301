"""Three balls against what a user would pick instead: a ChArUco board and OpenCV.

    python scripts/compare_charuco.py -o out [CELL ...] --seeds 1-5
        [--peer-python PATH]

The same rendered cell, the same arm and cameras, the same robot noise, rendering and
number of images. The board is as large as a sheet of A4 (54 corners, half the width of
an image), its poses are general motions with large rotations, its corners are refined
by cornerSubPix; then calibrateCamera, stereoCalibrate (all refined together) and every
hand-eye solver of OpenCV. Both calibrations are judged by the same images of the same
three balls at the same held-out stations. "placed": how far from the truth a ball that
both cameras see is placed in the robot's base. Most of that is noise of the images
themselves; "own part": the same with exact pixels, which leaves the calibration's part.
"track": how far it is placed from where the robot reports it (the balls' true place on
the flange is used for both). Beside that, errors against the truth: focal lengths,
baseline, and the left camera's position and rotation in the base.

Without names of cells there are three: pinholes, lenses, and those lenses on sensors
with square pixels, since OpenCV has no skew factor and the cell with lenses has one.

OpenCV 5 has no hand-eye solvers in Python: --peer-python names an interpreter with
OpenCV 4. Without it this project's own AX=XB and AX=ZB solvers take their place: Park's
and Daniilidis's give the same to 1e-8 m, the others weigh noise a little differently.
What is in the folder is not done again.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from charuco_rig import FLANGE_FROM_BOARD, board, board_cell, photograph

from handeye_tri import storage
from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.evaluate import evaluate_track
from handeye_tri.hand_eye import calibrate_hand_eye, solve_axxb, solve_axzb
from handeye_tri.hand_eye.motions import relative_motions
from handeye_tri.pipeline import STAGES, NullProgress, Run, execute, start
from handeye_tri.records import (
    MARKER_LABELS,
    Covariance,
    GroundTruth,
    HandEyeCalibration,
    Session,
    motion_labels,
)
from handeye_tri.se3 import SE3, so3_exp

# OpenCV's names, and this project's of the same method.
RELATIVE = {
    "tsai": "tsai_lenz",
    "park": "park_martin",
    "horaud": "horaud_dornaika",
    "andreff": "andreff",
    "daniilidis": "daniilidis",
}
ABSOLUTE = ("shah", "li")
COLUMNS = (
    ("own", "own part, mm"),
    ("place", "placed, mm"),
    ("track", "track, mm"),
    ("fx", "fx, px"),
    ("baseline", "baseline, mm"),
    ("shift", "position, mm"),
    ("turn", "rotation, deg"),
)
# Half the window of cornerSubPix, pixels; of 3, 5, 7, 9 this one is best in both cells.
WINDOW = 5

PEER = """
import sys, cv2, json, numpy as np
data = np.load(sys.argv[1]); a, b = data["a"], data["b"]
inv = np.linalg.inv(a)
found = {}
for name in ("tsai", "park", "horaud", "andreff", "daniilidis"):
    r, t = cv2.calibrateHandEye(list(inv[:, :3, :3]), list(inv[:, :3, 3]),
        list(b[:, :3, :3]), list(b[:, :3, 3]),
        method=getattr(cv2, "CALIB_HAND_EYE_" + name.upper()))
    found[name] = [r.tolist(), t.ravel().tolist()]
for name in ("shah", "li"):
    # The board stands for its "world" and base_from_flange for its base2gripper, or
    # the inverses of both: on noisy poses that is not the same to OpenCV.
    for form, first, second in (("", b, a), (" inverse", np.linalg.inv(b), inv)):
        x = np.eye(4); z = np.eye(4)
        x[:3, :3], tx, z[:3, :3], tz = cv2.calibrateRobotWorldHandEye(
            list(first[:, :3, :3]), list(first[:, :3, 3]),
            list(second[:, :3, :3]), list(second[:, :3, 3]),
            method=getattr(cv2, "CALIB_ROBOT_WORLD_HAND_EYE_" + name.upper()))
        x[:3, 3], z[:3, 3] = tx.ravel(), tz.ravel()
        base_from_left = np.linalg.inv(x if form else z)
        found[name + form] = [
            base_from_left[:3, :3].tolist(), base_from_left[:3, 3].tolist()]
print(json.dumps(found))
"""


def detect(image):
    """Corners (n, 2) and their ids (n,) in one image."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board()).detectBoard(grey)
    if ids is None:
        return np.zeros((0, 2)), np.zeros(0, dtype=int)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    corners = cv2.cornerSubPix(grey, corners, (WINDOW, WINDOW), (-1, -1), stop)
    return corners.reshape(-1, 2).astype(float), ids.ravel()


def board_session(cell, model, folder, stations, seed):
    """Reported flange poses and corners (m, n, k, 2) of a board, NaN where unseen."""
    kept = folder / "corners.npz"
    if kept.is_file():
        data = storage.read_arrays(kept, ("reported", "executed", "corners"))
        return data["reported"], data["executed"], data["corners"]
    with_board, path = board_cell(cell, model, folder)
    plan, executed, views = photograph(with_board, path, stations, seed)
    count = len(board().getChessboardCorners())
    corners = np.full((len(cell.cameras), stations, count, 2), np.nan)
    for i, j, image in views:
        name = f"{cell.cameras[i].name}_{j:03d}.png"
        storage.write_image(folder / "images" / name, image)
        found, ids = detect(image)
        corners[i, j, ids] = found
    reported = np.array([s.base_from_flange.matrix for s in plan.stations])
    storage.write_arrays(
        kept, {"reported": reported, "executed": executed, "corners": corners}
    )
    return reported, executed, corners


def corner_error(truth, executed, corners):
    """Distance of detected corners from their analytic projection, rms px."""
    points = FLANGE_FROM_BOARD.apply(np.asarray(board().getChessboardCorners(), float))
    world = points @ executed[:, :3, :3].swapaxes(1, 2) + executed[:, None, :3, 3]
    exact = np.array(
        [
            camera.project(motion.inverse().apply(world))
            for camera, motion in zip(
                truth.cameras, truth.base_from_camera, strict=True
            )
        ]
    )
    return float(np.sqrt(np.nanmean(((corners - exact) ** 2).sum(axis=-1))))


def opencv_cameras(cell, corners):
    """Two cameras, right_from_left, and the poses of the board at its stations."""
    shape = np.asarray(board().getChessboardCorners(), dtype=np.float32)
    flags = cv2.CALIB_FIX_K3
    if not cell.cameras[0].info.lens:
        # What is known to be no lens is not estimated, as for the balls.
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_ZERO_TANGENT_DIST
    size = tuple(int(n) for n in cell.cameras[0].image_size_px)
    first = []
    for own in corners:
        seen = [np.isfinite(view[:, 0]) for view in own]
        use = [j for j, mask in enumerate(seen) if mask.sum() >= 6]
        _, k, lens, _, _ = cv2.calibrateCamera(
            [shape[seen[j]] for j in use],
            [own[j][seen[j]].astype(np.float32) for j in use],
            size, None, None, flags=flags,
        )  # fmt: skip
        first.append((k, lens))
    both = np.isfinite(corners[..., 0]).all(axis=0)
    use = [j for j, mask in enumerate(both) if mask.sum() >= 6]
    (k1, d1), (k2, d2) = first
    result = cv2.stereoCalibrateExtended(
        [shape[both[j]] for j in use],
        *([own[j][both[j]].astype(np.float32) for j in use] for own in corners),
        k1, d1, k2, d2, size, np.eye(3), np.zeros((3, 1)),
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-9),
    )  # fmt: skip
    _, k1, d1, k2, d2, turn, shift, _, _, turns, shifts, _ = result
    cameras = tuple(
        PinholeCamera(
            info.name,
            Intrinsics.from_matrix(k),
            size,
            Lens("radtan", np.ravel(lens)[:5]),
        )
        for info, k, lens in zip(cell.cameras, (k1, k2), (d1, d2), strict=True)
    )
    poses = [
        SE3.from_parts(so3_exp(np.ravel(r)), np.ravel(t)).matrix
        for r, t in zip(turns, shifts, strict=True)
    ]
    return cameras, SE3.from_parts(turn, np.ravel(shift)), use, np.array(poses)


def hand_eye(peer, base_from_flange, left_from_board):
    """base_from_left by every solver of OpenCV."""
    a, b = base_from_flange, left_from_board
    if peer is None:
        left, right = (relative_motions(x, pairs="all") for x in (a, b))
        found = {
            name: solve_axxb(left, right, method=own) for name, own in RELATIVE.items()
        }
        return found | {name: solve_axzb(a, b, method=name)[1] for name in ABSOLUTE}
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "poses.npz"
        np.savez(path, a=a, b=b)
        done = subprocess.run(
            [peer, "-c", PEER, path], capture_output=True, text=True, check=True
        )
    return {
        name: SE3.from_parts(turn, shift)
        for name, (turn, shift) in json.loads(done.stdout).items()
    }


def as_record(cameras, right_from_left, base_from_left, truth):
    """OpenCV's result in the form that the track test takes."""
    labels = [f"{c.name}.fx" for c in cameras]
    labels += [x for c in cameras for x in motion_labels(f"base_from_{c.name}")]
    labels += [*motion_labels("flange_from_triangle"), *MARKER_LABELS]
    zero = np.zeros((len(labels), len(labels)))
    return HandEyeCalibration(
        cameras,
        (base_from_left, base_from_left @ right_from_left.inverse()),
        truth.flange_from_triangle,
        truth.markers,
        Covariance(tuple(labels), zero),
        0.0,
        1,
        np.zeros((0, 6)),
        "OpenCV",
    )


def score(calibration, session: Session, truth: GroundTruth):
    """Errors of one calibration in the columns' units."""
    known = HandEyeCalibration(
        calibration.cameras,
        calibration.base_from_camera,
        truth.flange_from_triangle,
        truth.markers,
        calibration.covariance,
        1.0,
        1,
        np.zeros((0, 6)),
        calibration.method,
    )
    track = evaluate_track(known, session)
    world = np.einsum("nab,kb->nka", truth.base_from_flange[:, :3, :3], truth.markers)
    world += truth.base_from_flange[:, None, :3, 3]
    true = world[track.stations, track.markers]
    exact_pixels = replace(
        session,
        pixels=np.array(
            [
                camera.project(motion.inverse().apply(world))
                for camera, motion in zip(
                    truth.cameras, truth.base_from_camera, strict=True
                )
            ]
        ),
        pixel_covariance=np.broadcast_to(np.eye(2), (*session.pixels.shape, 2)),
        marker_radii=np.zeros(3),
    )
    undisturbed = evaluate_track(known, exact_pixels)
    missed = undisturbed.observed - world[undisturbed.stations, undisturbed.markers]
    between = [
        motions[0].inverse() @ motions[1]
        for motions in (calibration.base_from_camera, truth.base_from_camera)
    ]
    lengths = [np.linalg.norm(motion.translation) for motion in between]
    left, exact = calibration.base_from_camera[0], truth.base_from_camera[0]
    off = (exact.inverse() @ left).log()
    focal = [
        ours.intrinsics.fx - theirs.intrinsics.fx
        for ours, theirs in zip(calibration.cameras, truth.cameras, strict=True)
    ]
    return {
        "own": 1e3 * float(np.sqrt((missed**2).sum(1).mean())),
        "place": 1e3 * float(np.sqrt(((track.observed - true) ** 2).sum(1).mean())),
        "track": 1e3 * track.rms,
        "fx": float(np.sqrt(np.mean(np.square(focal)))),
        "baseline": 1e3 * abs(float(lengths[0] - lengths[1])),
        "shift": 1e3 * float(np.linalg.norm(off[:3])),
        "turn": float(np.degrees(np.linalg.norm(off[3:]))),
    }


def one(name, seed, folder, peer):
    """All methods on one cell and seed."""
    kept = folder / f"{Path(name).stem}_{seed}" / "scores.json"
    by = "peer" if peer else "own"
    if kept.is_file() and (old := json.loads(kept.read_text()))["solvers"] == by:
        return old
    balls = kept.with_name("balls")
    run = Run(start(name, balls, seed, None), NullProgress())
    with run.folder.locked():
        execute(run, STAGES, ("plan", "simulate", "detect", "calibrate"), again=False)
    session, truth = run.session(), run.truth()[0]
    scores = {
        "three balls, joint": score(run.hand_eye(), session, truth),
        "three balls, separate": score(
            calibrate_hand_eye(session, run.cameras()), session, truth
        ),
    }
    stations = len(session.indices("calibration"))
    reported, executed, corners = board_session(
        run.cell, run.model_path, balls.parent / "board", stations, seed
    )
    cameras, right_from_left, use, poses = opencv_cameras(run.cell, corners)
    for solver, motion in hand_eye(peer, reported[use], poses).items():
        record = as_record(cameras, right_from_left, motion, truth)
        scores[f"ChArUco, OpenCV {solver}"] = score(record, session, truth)
    result = {
        "solvers": by,
        "stations": stations,
        "corner_rms_px": corner_error(truth, executed, corners),
        "corners": float(np.isfinite(corners[..., 0]).sum() / corners[..., 0].size),
        "board_stations": len(use),
        "scores": scores,
    }
    storage.write_json(kept, result)
    return result


def with_square_pixels(folder):
    """The cell with lenses, without the skew that OpenCV's cameras do not have."""
    text = storage.find_cell("hp3_stereo_lens").read_text()
    text = re.sub(r"(?m)^    skew_px:.*\n", "", text)
    path = folder / "hp3_stereo_lens_square.yaml"
    storage.write_bytes(path, text.replace("hp3_stereo_lens", path.stem, 1).encode())
    return str(path)


def table(name, seeds, results):
    """Print one cell's rows; returns them as (method, column) -> rms over seeds."""
    first = results[0]
    rms = np.sqrt(np.mean([r["corner_rms_px"] ** 2 for r in results]))
    print(
        f"\n{name}, seeds {seeds}: {first['stations']} stations x 2 images each way; "
        f"board in {min(r['board_stations'] for r in results)} or more of them, "
        f"{100 * np.mean([r['corners'] for r in results]):.0f} % of its corners found, "
        f"{rms:.3f} px rms from their projection"
    )
    print(f"{'rms over seeds':<28}" + "".join(f"{title:>14}" for _, title in COLUMNS))
    rows = {}
    for method in first["scores"]:
        values = {
            key: np.array([r["scores"][method][key] for r in results])
            for key, _ in COLUMNS
        }
        rows[method] = {k: float(np.sqrt(np.mean(v**2))) for k, v in values.items()}
        print(
            f"{method:<28}" + "".join(f"{rows[method][k]:>14.4f}" for k, _ in COLUMNS)
        )
    return rows


def sentence(name, rows):
    """Who wins where, by the best OpenCV solver in hindsight."""
    ours = rows["three balls, joint"]
    theirs = {m: row for m, row in rows.items() if m.startswith("ChArUco")}
    best = min(theirs, key=lambda m: theirs[m]["own"])
    parts = {True: [], False: []}
    for key, title in COLUMNS:
        ratio = theirs[best][key] / ours[key]
        parts[ratio > 1].append(f"{title.split(',')[0]} ({max(ratio, 1 / ratio):.1f}x)")
    won, lost = (", ".join(parts[k]) or "nothing" for k in (True, False))
    return (
        f"{name}: three balls (joint) are closer to the truth in {won}; the ChArUco "
        f"board with {best.removeprefix('ChArUco, ')}, OpenCV's best in hindsight, in "
        f"{lost}."
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cells", nargs="*", help="names or paths; default: three")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--seeds", default="1-5", help="first-last")
    parser.add_argument("--peer-python", help="an interpreter with OpenCV 4")
    options = parser.parse_args()
    first, last = (int(part) for part in options.seeds.split("-"))
    peer = options.peer_python
    print(
        "hand-eye by "
        + ("OpenCV's own solvers" if peer else "this project's solvers in their place")
    )
    cells = options.cells or [
        "hp3_stereo",
        "hp3_stereo_lens",
        with_square_pixels(options.output),
    ]
    for name in cells:
        results = []
        for seed in range(first, last + 1):
            results.append(one(name, seed, options.output, peer))
            print(f"{name} {seed} done", file=sys.stderr, flush=True)
        rows = table(Path(name).stem, options.seeds, results)
        print(sentence(Path(name).stem, rows), flush=True)


if __name__ == "__main__":
    main()
