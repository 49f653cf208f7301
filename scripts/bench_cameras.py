"""Rows 1, 2, 3, 5 and 8 of `bench.py`: calibrating cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from bench_rows import Gate, Measured, Peers, Row, here
from scipy.optimize import least_squares

from handeye_tri.calibrate_cameras import calibrate_target_views, calibrate_trials
from handeye_tri.calibrate_cameras.target_model import TargetModel, TargetState
from handeye_tri.calibrate_cameras.target_starts import closed_forms
from handeye_tri.camera import Intrinsics, Lens, PinholeCamera, StereoRig
from handeye_tri.se3 import SE3, rotation_from_quaternion_wxyz, so3_exp
from handeye_tri.threads import one_thread
from handeye_tri.triangle import TriangleRig

IMAGE_SIZE = (1024, 768)
OPENCV = "opencv-python-headless==4.14.*"

# Rows 1, 2, 3 and 5: a flat target of 5 x 4 points.
POINTS = np.array(
    [[0.03 * i - 0.06, 0.03 * j - 0.045, 0.0] for j in range(4) for i in range(5)]
)
LENS = Lens("radtan", np.array([-0.1, 0.05, 5e-4, -3e-4, 0.0]))
TARGET_SIGMA_PX = 0.1
# What the peers may be better by: they stop where the cost changes by less.
SAME_RMS = 1 + 1e-5

# Row 8: views of a Monte-Carlo study.
TRIANGLE = TriangleRig(0.13, 0.12, float(np.radians(65.0)))
FOOT = (0.05, 0.035)
HALF_TURNS = 11
TRIALS = 1000
# The peers are slow and alike in all trials: they do as many as this.
PEER_TRIALS = 20
SIGMA_PX = 0.2


def rotations(rng: np.random.Generator, n: int) -> Any:
    """Targets that lean 20 to 55 degrees to any side, turned by any angle."""
    azimuth = rng.uniform(0, 2 * np.pi, n)
    lean = np.radians(rng.uniform(20, 55, n))
    axis = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(n)], axis=1)
    spin = np.zeros((n, 3))
    spin[:, 2] = rng.uniform(0, 2 * np.pi, n)
    return so3_exp(axis * lean[:, None]) @ so3_exp(spin)


@cache
def half_turns() -> tuple[Any, Any]:
    """Pixels (trials, half-turns, before and after, 3, 2) and the true poses."""
    rng = np.random.default_rng([8, 0])
    camera = PinholeCamera(
        "camera", Intrinsics(1720.0, 1715.0, 0.0, 519.3, 377.8), IMAGE_SIZE
    )
    turn = TRIANGLE.half_turn("normal", FOOT)
    points = np.stack([TRIANGLE.points, turn.apply(TRIANGLE.points)])
    poses, exact = [], []
    while len(poses) < HALF_TURNS:
        rotation = rotations(rng, 1)[0]
        centre = np.array([*rng.uniform(-0.08, 0.08, 2), rng.uniform(0.8, 1.0)])
        translation = centre - rotation @ np.append(FOOT, 0.0)
        pixels = camera.project(points @ rotation.T + translation)
        if (pixels > 5).all() and (pixels < np.array(IMAGE_SIZE) - 6).all():
            exact.append(pixels)
            poses.append((rotation, translation))
    noise = rng.standard_normal((TRIALS, HALF_TURNS, 2, 3, 2))
    return np.array(exact) + SIGMA_PX * noise, poses


def monte_carlo() -> Callable[[], Any]:
    pixels, _ = half_turns()
    return partial(
        calibrate_trials,
        pixels[:, :, 0],
        pixels[:, :, 1],
        TRIANGLE,
        image_size=IMAGE_SIZE,
        sigma_px=SIGMA_PX,
    )


def opencv_trials(peers: Peers) -> Measured:
    """The same six points a half-turn as flat targets, O known, no skew, no lens."""
    pixels, _ = half_turns()
    turn = TRIANGLE.half_turn("normal", FOOT)
    points = np.concatenate([TRIANGLE.points, turn.apply(TRIANGLE.points)])
    views = pixels[:PEER_TRIALS].reshape(PEER_TRIALS, HALF_TURNS, 6, 2)
    arguments = (points, views, IMAGE_SIZE)
    return peers.elsewhere(
        "bench_peers", "opencv_pinhole_trials", arguments, needs=OPENCV
    )


def scipy_trials(_peers: Peers) -> Measured:
    """The same unknowns and residuals, derivatives by differences, from the truth."""
    pixels, poses = half_turns()
    start = np.concatenate(
        [
            [1720.0, 1715.0, 0.0, 519.3, 377.8, *FOOT],
            *(np.concatenate([np.zeros(3), t]) for _, t in poses),
        ]
    )
    rotation = np.array([r for r, _ in poses])
    scale = np.array([10.0, 10.0, 1.0, 10.0, 10.0, 1e-3, 1e-3])
    scale = np.concatenate([scale, np.full(6 * HALF_TURNS, 1e-2)])
    plane = TRIANGLE.points[:, :2]

    def residuals(unknowns: Any, observed: Any) -> Any:
        fx, fy, skew, cx, cy = unknowns[:5]
        own = unknowns[7:].reshape(HALF_TURNS, 6)
        turned = so3_exp(own[:, :3]) @ rotation
        points = np.concatenate([plane, 2 * unknowns[5:7] - plane])
        local = points @ np.swapaxes(turned[:, :, :2], 1, 2) + own[:, None, 3:]
        x, y = local[..., 0] / local[..., 2], local[..., 1] / local[..., 2]
        predicted = np.stack([fx * x + skew * y + cx, fy * y + cy], axis=-1)
        return ((predicted - observed) / SIGMA_PX).ravel()

    observed = pixels[:PEER_TRIALS].reshape(PEER_TRIALS, HALF_TURNS, 6, 2)

    def solve() -> Any:
        return np.array(
            [
                2.0
                * least_squares(
                    residuals, start, x_scale=scale, xtol=1e-10, args=(one,)
                ).cost
                for one in observed
            ]
        )

    return here(solve)


@cache
def rig() -> StereoRig:
    """Two cameras, 0.2 m apart, that look at the same place."""
    left, right = (
        PinholeCamera(name, Intrinsics(fx, fy, 0.0, cx, cy), IMAGE_SIZE, LENS)
        for name, fx, fy, cx, cy in (
            ("left", 1720.0, 1715.0, 519.3, 377.8),
            ("right", 1740.0, 1730.0, 505.1, 390.2),
        )
    )
    place = SE3.from_parts(so3_exp([0.01, -0.2, 0.02]), [0.2, 0.005, 0.02])
    return StereoRig(left, right, place)


@cache
def target_pixels(n: int) -> tuple[Any, Any, Any]:
    """Pixels before both cameras, noisy and exact, (2, n, p, 2); poses (n, 4, 4)."""
    rng = np.random.default_rng([1, n])
    stereo = rig()
    right = stereo.left_from_right.inverse()
    exact, poses = [], []
    while len(poses) < n:
        rotation = rotations(rng, 1)[0]
        shift = np.array([*rng.uniform(-0.08, 0.12, 2), rng.uniform(0.7, 1.0)])
        local = POINTS @ rotation.T + shift
        seen = [stereo.left.project(local), stereo.right.project(right.apply(local))]
        if all(((s > 3) & (s < np.array(IMAGE_SIZE) - 4)).all() for s in seen):
            exact.append(seen)
            poses.append(SE3.from_parts(rotation, shift).matrix)
    pixels = np.array(exact).swapaxes(0, 1)
    noisy = pixels + TARGET_SIGMA_PX * rng.standard_normal(pixels.shape)
    # OpenCV works on single precision: both sides get the same numbers.
    return noisy.astype(np.float32).astype(float), pixels, np.array(poses)


def target_views(n: int, cameras: int, distortion: Any = "radtan") -> Callable[[], Any]:
    return partial(
        calibrate_target_views,
        POINTS,
        target_pixels(n)[0][:cameras],
        image_sizes=IMAGE_SIZE,
        distortion=distortion,
    )


def opencv(factory: str, n: int, peers: Peers) -> Measured:
    pixels = target_pixels(n)[0]
    if factory == "opencv_camera":
        pixels = pixels[0]
    arguments = (POINTS, pixels, IMAGE_SIZE)
    return peers.elsewhere("bench_peers", factory, arguments, needs=OPENCV)


def gtsam(n: int, peers: Peers) -> Measured:
    """From the closed form that we start from, too, without its cost."""
    pixels = target_pixels(n)[0][:1]
    model = TargetModel(
        np.ascontiguousarray(POINTS[:, :2].T),
        np.ascontiguousarray(np.moveaxis(pixels, -1, 1)),
        np.ones(pixels.shape[:3], dtype=bool),
        (0, 1, 3, 4),
        (0, 1, 2, 3),
    )
    found = closed_forms(model, [IMAGE_SIZE], ["camera"])
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = found.rotation, found.translation
    start = (found.intrinsics[0, [0, 1, 3, 4]], poses)
    arguments = (POINTS, pixels[0], start)
    return peers.elsewhere("bench_peers", "gtsam_camera", arguments, needs="gtsam")


def vision_calibration(n: int, peers: Peers) -> Measured:
    return peers.elsewhere(
        "bench_peers",
        "vision_calibration_rig",
        (POINTS, target_pixels(n)[0]),
        needs="vision-calibration",
    )


def as_small_rms(ours: Any, theirs: Any) -> Gate:
    mine = ours.details["rms_px"]
    peer = float(theirs[0] if isinstance(theirs, tuple) else theirs)
    return Gate(mine <= peer * SAME_RMS, f"RMS {mine:.6f} px, peer {peer:.6f}")


def as_near_the_truth(n: int, ours: Any, theirs: Any) -> Gate:
    """Root mean square error of exactly seen points, triangulated by either rig."""
    _, exact, poses = target_pixels(n)
    mine = StereoRig(*ours.cameras, ours.reference_from_camera[1])
    cameras = [
        PinholeCamera(
            name,
            Intrinsics(k[0], k[1], 0.0, k[2], k[3]),
            IMAGE_SIZE,
            Lens("radtan", np.array([*lens, 0.0])),
        )
        for name, (k, lens, _, _) in zip(("left", "right"), theirs, strict=True)
    ]
    x, y, z, w = theirs[1][2]
    turn = rotation_from_quaternion_wxyz(np.array([w, x, y, z]))
    peer = StereoRig(*cameras, SE3.from_parts(turn, theirs[1][3]).inverse())
    points = POINTS @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    pixels = exact.reshape(2, -1, 2)
    covariance = np.broadcast_to(np.eye(2), (*pixels.shape, 2))
    errors = []
    for stereo in (mine, peer):
        found, _ = stereo.triangulate(pixels, covariance)
        off = np.linalg.norm(found - points.reshape(-1, 3), axis=1)
        errors.append(1e3 * float(np.sqrt(np.mean(off**2))))
    says = f"points off by {errors[0]:.3f} mm RMS, peer {errors[1]:.3f}"
    return Gate(errors[0] <= errors[1], says)


def one_pass(m: int, n: int) -> Callable[[], Any]:
    """Derivatives and one step of all unknowns of m cameras before n poses."""
    rng = np.random.default_rng([5, m])
    turns = so3_exp(0.1 * rng.standard_normal((m, 3)))
    shifts = 0.1 * rng.standard_normal((m, 3))
    turns[0], shifts[0] = np.eye(3), 0.0
    _, _, poses = target_pixels(n)
    state = TargetState(
        np.tile(rig().left.intrinsics.vector, (m, 1)),
        (LENS.coefficients,) * m,
        turns,
        shifts,
        poses[:, :3, :3],
        poses[:, :3, 3],
    )
    seen = np.ones((m, n, len(POINTS)), dtype=bool)
    blank = np.zeros((m, 2, n, len(POINTS)))
    plane = np.ascontiguousarray(POINTS[:, :2].T)
    model = TargetModel(plane, blank, seen, (0, 1, 3, 4), (0, 1, 2, 3, 4))
    off = TARGET_SIGMA_PX * rng.standard_normal(blank.shape)
    model = replace(model, pixels=off - np.moveaxis(model.residuals(state), -1, 1))

    def work() -> Any:
        with one_thread():
            rows = model.evaluate(state)
            assert rows is not None
            return rows.equations().step(1e-4)

    return work


def all_converged(ours: Any, _theirs: Any) -> Gate:
    share = float(ours.converged.mean())
    return Gate(share == 1.0, f"{100 * share:.1f} % of our trials converge")


def same_costs(ours: Any, theirs: Any) -> Gate:
    worst = float(np.abs(ours.chi2[:PEER_TRIALS] / theirs - 1).max())
    return Gate(worst <= 1e-6, f"costs agree with scipy's to {worst:.1e}")


def rows() -> list[Row]:
    found = [
        Row(
            number=1,
            work=f"stereo, {n} views x {len(POINTS)} points",
            peer=f"cv2 4.14, {how}",
            bar=bar,
            ours=partial(target_views, n, 2),
            theirs=partial(opencv, factory, n),
            gate=as_small_rms,
            threads=how == "K fixed",
        )
        for n, bar in ((22, 8.0), (100, 45.0))
        for how, factory in (
            ("K fixed", "opencv_stereo_fixed"),
            ("all free", "opencv_stereo"),
        )
    ]
    found += [
        Row(
            number=2,
            work=f"one camera, {n} views",
            peer="cv2 4.14",
            bar=bar,
            ours=partial(target_views, n, 1),
            theirs=partial(opencv, "opencv_camera", n),
            gate=as_small_rms,
        )
        for n, bar in ((22, 2.6), (100, 4.9), (1000, 8.0))
    ]
    found.append(
        Row(
            number=2,
            work="one camera, 1000 views, no k3",
            peer="gtsam",
            bar=7.0,
            ours=partial(target_views, 1000, 1, ("k1", "k2", "p1", "p2")),
            theirs=partial(gtsam, 1000),
            gate=as_small_rms,
            threads=False,
        )
    )
    found += [
        Row(
            number=3,
            work=f"stereo rig, {n} views, no k3",
            peer="vision-calibration",
            bar=bar,
            ours=partial(target_views, n, 2, ("k1", "k2", "p1", "p2")),
            theirs=partial(vision_calibration, n),
            gate=partial(as_near_the_truth, n),
            threads=n == 1000,
        )
        for n, bar in ((22, 40.0), (1000, 65.0))
    ]
    found += [
        Row(
            number=5,
            work="64 cameras x 1000 views, one pass",
            peer="one camera's pass",
            bar=100.0,
            ours=partial(one_pass, 64, 1000),
            theirs=lambda _peers: here(one_pass(1, 1000)),
            at_most=True,
        ),
        *(
            Row(
                number=5,
                work=f"one camera, 10000 views, {what}",
                peer="1000 views",
                bar=12.0,
                ours=partial(target_views, 10_000, 1),
                theirs=lambda _peers, measure=measure: here(
                    target_views(1000, 1), measure
                ),
                at_most=True,
                measure=measure,
                threads=False,
            )
            for what, measure in (("time", "seconds"), ("memory", "bytes"))
        ),
    ]
    study = f"Monte-Carlo, {TRIALS} trials of {2 * HALF_TURNS} views"
    return [
        *found,
        Row(
            number=8,
            work=study,
            peer="cv2 4.14, O known",
            bar=33.0,
            ours=monte_carlo,
            theirs=opencv_trials,
            gate=all_converged,
            units=(TRIALS, PEER_TRIALS),
        ),
        Row(
            number=8,
            work=study,
            peer="scipy, by differences",
            bar=150.0,
            ours=monte_carlo,
            theirs=scipy_trials,
            gate=same_costs,
            units=(TRIALS, PEER_TRIALS),
            threads=False,
        ),
    ]
