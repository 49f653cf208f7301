"""Published answers of real data beside ours: one table.

    python scripts/check_real_data.py DATA

DATA holds the folders below, each from its public project; absent ones are skipped.

  moveit_pose_samples/pose_samples.json   ros-planning/moveit_calibration, solver's test
  opencv_24871/poses.json                 opencv/opencv, test regression_24871
  rct_10x10/                              Jmeyer1292/robot_cal_tools, test_set_10x10,
                                          with the dots' centres in dots.json
  eth_robot_arm/                          ethz-asl/hand_eye_calibration, datasets

The last one has no published numbers: its clock offset is compared with what angular
speeds alone tell, its residuals are printed. Exits with 1 where an answer is farther
off than its source allows.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from handeye_tri.camera import Intrinsics, PinholeCamera
from handeye_tri.hand_eye import (
    PAIR_METHODS,
    adjust_target_views,
    solve_pose_pairs,
    target_views,
)
from handeye_tri.records import PosePairs
from handeye_tri.se3 import (
    SE3,
    rotation_from_quaternion_wxyz,
    se3_inverse,
    so3_exp,
    so3_log,
)
from handeye_tri.solve import solve_and_judge


@dataclass(frozen=True)
class Line:
    """One published number; without a tolerance it is only printed."""

    what: str
    published: str
    ours: str
    good: bool | None = None


def moveit(folder: Path) -> list[Line]:
    """Eye-to-hand; the test allows 1 % of the camera's place, of its rotation matrix.

    Its numbers have three decimals: t = (0.659, -0.249, 0.830) m, Euler angles about
    the moving x, y, z axes (0.230, -2.540, 1.950).
    """
    poses = np.array(json.loads((folder / "pose_samples.json").read_text()))
    pairs = PosePairs(
        poses[:, 0], poses[:, 1], "eye_to_hand", "flange_in_base", "target_in_camera"
    )
    rotation = so3_exp((0.230, 0, 0)) @ so3_exp((0, -2.540, 0)) @ so3_exp((0, 0, 1.950))
    place = np.array([0.659, -0.249, 0.830])
    lines = []
    for method in PAIR_METHODS:
        z = solve_pose_pairs(pairs, method=method).z
        off = float(np.linalg.norm(z.translation - place))
        turned = float(np.linalg.norm(z.rotation - rotation))
        found = ", ".join(f"{v:.3f}" for v in z.translation)
        lines.append(
            Line(
                f"camera in base by {method}",
                "(0.659, -0.249, 0.830) m, 1 %",
                f"({found}) m; {1e3 * off:.1f} mm, "
                f"{np.degrees(turned / np.sqrt(2)):.2f} deg off",
                off <= 0.01 * np.linalg.norm(place) and turned <= 0.01 * np.sqrt(3),
            )
        )
    solved = solve_and_judge(pairs)
    lines.append(Line("verdict of solve", "-", solved.verdict.outcome))
    return lines


def opencv(folder: Path) -> list[Line]:
    """Exact poses that turn by up to 176 degrees; the test allows 1e-12."""
    data = json.loads((folder / "poses.json").read_text())
    pairs = PosePairs(
        np.array(data["gripper2base"]),
        np.array(data["target2cam"]),
        "eye_in_hand",
        "flange_in_base",
        "target_in_camera",
    )
    true = np.array(data["cam2gripper_true"])
    lines = []
    for method in PAIR_METHODS:
        x = solve_pose_pairs(pairs, method=method).x.matrix
        rotation, place = (
            float(np.linalg.norm((x - true)[:3, part]))
            for part in (slice(0, 3), slice(3, 4))
        )
        lines.append(
            Line(
                f"camera on gripper by {method}",
                "|R - R'|, |t - t'| < 1e-12",
                f"{rotation:.1e}, {place:.1e} m",
                max(rotation, place) < 1e-12,
            )
        )
    return lines


def rct_input(folder: Path) -> tuple[Any, Any, Any]:
    """Dots of the target, their pixels, and base_from_wrist of 15 images."""
    dots = json.loads((folder / "dots.json").read_text())
    pixels = np.array([dots[str(i)] for i in range(len(dots))])
    points = np.array([[i % 10, i // 10, 0] for i in range(100)]) * 0.0254
    poses = []
    for i in range(len(dots)):
        lines = (folder / "poses" / f"{i}.yaml").read_text().splitlines()
        v = {k: float(t) for k, t in (line.split(":") for line in lines if line)}
        rotation = rotation_from_quaternion_wxyz([v[f"q{k}"] for k in "wxyz"])
        poses.append(SE3.from_parts(rotation, [v[k] for k in "xyz"]).matrix)
    return points, pixels, np.array(poses)


def rct(folder: Path) -> list[Line]:
    """A wrist camera before a grid of dots; the test's bounds are for nominal K.

    Root of the cost per observation under 1.5 px (the cost is half the squares of both
    coordinates), and on average under 20 mm and 3 degrees between the target by the
    robot and by each view alone. Both at the optimum of the reprojection, for which a
    robot without noise is stated; then with both noises estimated.
    """
    points, pixels, base_from_wrist = rct_input(folder)
    lines = []
    cameras = {
        "nominal K": Intrinsics(550.0, 550.0, 0.0, 320.0, 240.0),
        "calibrated K": Intrinsics(542.324, 543.515, 0.0, 320.474, 226.039),
    }
    noises = {"robot exact": (1e-5, 1e-5), "both noises": None}
    for name, intrinsics in cameras.items():
        camera = PinholeCamera("wrist", intrinsics, (640, 480))
        views = target_views(camera, points, pixels)
        alone = views.camera_from_target
        for noise_name, noise in noises.items():
            found = adjust_target_views(views, base_from_wrist, "eye_in_hand", noise)
            shown = found.camera_from_target if noise is None else found.predicted
            rms = float(np.sqrt(np.mean(views.residuals(shown) ** 2)))
            turned = so3_log((se3_inverse(alone) @ found.predicted)[:, :3, :3])
            apart = found.predicted[:, :3, 3] - alone[:, :3, 3]
            position = 1e3 * float(np.linalg.norm(apart, axis=1).mean())
            angle = float(np.degrees(np.linalg.norm(turned, axis=1).mean()))
            lines.append(
                Line(
                    f"{name}, {noise_name}",
                    "< 1.5 px, < 20 mm, < 3 deg",
                    f"{rms / 2:.3f} px, {position:.1f} mm, {angle:.2f} deg",
                    bool(rms / 2 < 1.5 and position < 20 and angle < 3)
                    if noise is None or name == "nominal K"
                    else None,
                )
            )
        lines.append(
            Line(
                f"{name}, noise found",
                "-",
                f"robot {1e3 * found.robot_translation:.2f} mm, "
                f"{np.degrees(found.robot_rotation):.2f} deg; dots "
                f"{found.pixel_factor * views.sigma_px:.2f} px",
            )
        )
    return lines


def stream(path: Path) -> tuple[Any, Any]:
    """Times and poses of t, x y z, qx qy qz qw; rows that step back are dropped."""
    rows = np.loadtxt(path, delimiter=",")
    later = rows[1:, 0] > np.maximum.accumulate(rows[:, 0])[:-1]
    rows = rows[np.append(True, later)]
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rotation_from_quaternion_wxyz(rows[:, [7, 4, 5, 6]])
    poses[:, :3, 3] = rows[:, 1:4]
    return rows[:, 0], poses


STREAMS = {
    "real arm": (
        "robot_arm/robot_arm_complete_bag_color_and_ir_base_link_sr300_hinge.csv",
        "robot_arm/robot_arm_complete_bag_color_and_ir_target_ir.csv",
        12.7,
    ),
    "simulated arm": (
        "robot_arm_w_color_camera_sim/robot_arm_sim_hand.csv",
        "robot_arm_w_color_camera_sim/robot_arm_sim_camera.csv",
        -0.3,
    ),
    "motion capture": (
        "prime_sense_1/2017-04-09-18-13-10_vicon_prime_sense.csv",
        "prime_sense_1/2017-04-09-18-13-10_W_camera_rgb_image_raw.csv",
        -29.0,
    ),
}


def eth_pairs(folder: Path, name: str, every: int = 1) -> PosePairs:
    """One of the recordings; every so many pictures."""
    robot, camera, _ = STREAMS[name]
    robot_times, base_from_hand = stream(folder / robot)
    camera_times, target_from_camera = stream(folder / camera)
    start = robot_times[0]
    return PosePairs(
        base_from_hand,
        target_from_camera[::every],
        "eye_in_hand",
        "flange_in_base",
        "camera_in_target",
        robot_times=robot_times - start,
        observed_times=camera_times[::every] - start,
    )


def eth(folder: Path) -> list[Line]:
    """Streams on two clocks; the correlation of angular speeds tells the offset."""
    lines = []
    for name, (_, _, offset) in STREAMS.items():
        solved = solve_and_judge(
            eth_pairs(folder, name, every=4), limit_position=0.05, limit_angle=0.05
        )
        found = solved.solution
        assert found.clock_offset is not None
        sigma = 1e3 * found.covariance.std("clock_offset")
        lines.append(
            Line(
                f"{name}, clock offset",
                f"{offset:.1f} ms by correlation",
                f"{1e3 * found.clock_offset:.1f} +- {sigma:.1f} ms",
                abs(1e3 * found.clock_offset - offset) < 15,
            )
        )
        lines.append(
            Line(
                f"{name}, median residual",
                "-",
                f"{1e3 * np.median(found.residual_positions):.1f} mm, "
                f"{np.degrees(np.median(found.residual_angles)):.2f} deg; "
                f"{len(found.dropped)} of {len(found.poses)} dropped; "
                f"{solved.verdict.outcome}",
            )
        )
    return lines


SETS = {
    "moveit_pose_samples": moveit,
    "opencv_24871": opencv,
    "rct_10x10": rct,
    "eth_robot_arm": eth,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    folder = parser.parse_args().data
    good, seen = True, 0
    for name, read in SETS.items():
        if not (folder / name).is_dir():
            print(f"{name}: not in {folder}, skipped")
            continue
        seen += 1
        print(name)
        for line in read(folder / name):
            verdict = {None: "-", True: "ok", False: "OFF"}[line.good]
            good &= line.good is not False
            print(f"  {line.what:<38}{line.published:<30}{line.ours:<56}{verdict}")
    if not seen:
        print(f"none of {', '.join(SETS)} is in {folder}")
    sys.exit(0 if good and seen else 1)


if __name__ == "__main__":
    main()
