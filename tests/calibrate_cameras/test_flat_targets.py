"""Cameras from flat targets of many points, one camera or several."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from handeye_tri import calibrate_target_views
from handeye_tri.calibrate_cameras.target_model import TargetModel, TargetState
from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.se3 import SE3, se3_exp, so3_exp

SIZE = (1024, 768)
GRID = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), -1).reshape(-1, 2)
POINTS = np.column_stack([0.03 * (GRID - [2.0, 1.0]), np.zeros(20)])
RATIONAL = np.array([-0.3, 0.1, 0, 0, 0, 0.1, 0, 0])
LENS = np.array([-0.12, 0.08, 5e-4, -3e-4, 0.0])


def rig(m: int, skew: float = 0.0, lens: Any = LENS) -> tuple[list[Any], list[SE3]]:
    cameras = [
        PinholeCamera(
            f"camera{i}",
            Intrinsics(1720.0 + 25 * i, 1715.0 - 10 * i, skew, 519.3, 377.8 + 3 * i),
            SIZE,
            Lens("radtan" if len(lens) == 5 else "rational", lens),
        )
        for i in range(m)
    ]
    places = [
        SE3.from_parts(so3_exp([0.02 * i, -0.2 * i, 0.1 * i]), [0.18 * i, 0.01, 0.02])
        for i in range(m)
    ]
    places[0] = SE3.identity()
    return cameras, places


def views(
    seed: int, n: int, cameras: Any, places: Any, tilt: tuple[float, float] = (15, 50)
) -> tuple[Any, Any]:
    """Exact pixels, (m, n, p, 2), and the target's poses, (n, 4, 4)."""
    rng = np.random.default_rng([85, seed])
    pixels, poses = [], []
    while len(pixels) < n:
        azimuth = rng.uniform(0, 2 * np.pi)
        lean = np.radians(rng.uniform(*tilt))
        turn = so3_exp(lean * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
        turn = turn @ so3_exp([0.0, 0.0, rng.uniform(0, 2 * np.pi)])
        shift = np.array([*rng.uniform(-0.1, 0.15, 2), rng.uniform(0.7, 1.0)])
        seen = [
            camera.project(place.inverse().apply(POINTS @ turn.T + shift))
            for camera, place in zip(cameras, places, strict=True)
        ]
        if all(((s > 3) & (s < np.array(SIZE) - 4)).all() for s in seen):
            pixels.append(seen)
            poses.append(SE3.from_parts(turn, shift).matrix)
    return np.array(pixels).swapaxes(0, 1), np.array(poses)


@pytest.mark.parametrize(
    ("m", "n", "options", "skew", "lens"),
    [
        (1, 12, {}, 0.0, LENS),
        (1, 60, {"skew": True}, 2.0, LENS),
        (2, 40, {}, 0.0, LENS),
        (3, 8, {"distortion": None}, 0.0, np.zeros(5)),
        (
            1,
            40,
            {"distortion": ("k1", "k2", "k4")},
            0.0,
            RATIONAL,
        ),
        # A strong lens: the closed form, which knows of none, starts far away.
        (2, 16, {}, 0.0, np.array([-0.45, 0.25, 1e-3, -1e-3, -0.1])),
    ],
)
def test_exact_views_give_the_exact_cameras(
    m: int, n: int, options: Any, skew: float, lens: Any
) -> None:
    cameras, places = rig(m, skew, np.asarray(lens, dtype=float))
    pixels, poses = views(1, n, cameras, places)
    found = calibrate_target_views(POINTS, pixels, image_sizes=SIZE, **options)
    for mine, true in zip(found.cameras, cameras, strict=True):
        np.testing.assert_allclose(
            mine.intrinsics.vector, true.intrinsics.vector, atol=1e-6
        )
        np.testing.assert_allclose(
            mine.lens.coefficients, true.lens.coefficients, atol=1e-7
        )
    for mine, true in zip(found.reference_from_camera, places, strict=True):
        np.testing.assert_allclose(mine.matrix, true.matrix, atol=1e-9)
    np.testing.assert_allclose(found.details["reference_from_target"], poses, atol=1e-8)


def test_the_minimum_is_opencvs() -> None:
    cameras, places = rig(1)
    pixels, _ = views(2, 15, cameras, places)
    rng = np.random.default_rng(86)
    pixels = (pixels + 0.2 * rng.standard_normal(pixels.shape)).astype(np.float32)
    found = calibrate_target_views(POINTS, pixels, image_sizes=SIZE)
    rms, matrix, lens, *_ = cv2.calibrateCamera(
        [POINTS.astype(np.float32)] * 15, list(pixels[0]), SIZE, None, None
    )
    assert found.details["rms_px"] <= rms * (1 + 1e-6)
    # Ours ends within a hundredth of sigma of the minimum; OpenCV about as near.
    names = ("fx", "fy", "cx", "cy", *found.camera.lens.names)
    sigma = np.array([found.covariance.std(f"camera0.{name}") for name in names])
    mine = np.array([found.camera.parameter(name) for name in names])
    theirs = [*matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *lens.ravel()]
    assert (np.abs(mine - theirs) < 0.02 * sigma).all()


def test_errors_are_as_large_as_stated() -> None:
    cameras, places = rig(2)
    exact, _ = views(3, 15, cameras, places)
    squares, chi2 = [], []
    for trial in range(40):
        rng = np.random.default_rng([87, trial])
        found = calibrate_target_views(
            POINTS,
            exact + 0.1 * rng.standard_normal(exact.shape),
            image_sizes=SIZE,
            sigma_px=0.1,
        )
        error = []
        for mine, true in zip(found.cameras, cameras, strict=True):
            names = ("fx", "fy", "cx", "cy", *true.lens.names)
            error += [true.parameter(k) - mine.parameter(k) for k in names]
        error += (found.reference_from_camera[1].inverse() @ places[1]).log().tolist()
        matrix = found.covariance.matrix
        root = np.sqrt(np.diagonal(matrix))
        scaled = np.array(error) / root
        squares.append(scaled @ np.linalg.solve(matrix / np.outer(root, root), scaled))
        chi2.append(found.chi2 / found.dof)
    # 24 unknowns, 40 trials: sigma of the mean over 24 is 0.046.
    assert np.mean(squares) / 24 == pytest.approx(1.0, abs=0.16)
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.02)


def test_points_and_views_may_be_missing() -> None:
    cameras, places = rig(3)
    pixels, poses = views(4, 30, cameras, places)
    pixels = pixels.copy()
    pixels[1, :8] = np.nan
    pixels[0, 20:] = np.nan
    pixels[2, 3, 4:9, 0] = np.nan
    pixels[:, 12] = np.nan
    # Three points are no view.
    pixels[1, 15, 3:] = np.nan
    found = calibrate_target_views(POINTS, pixels, image_sizes=SIZE)
    for mine, true in zip(found.cameras, cameras, strict=True):
        np.testing.assert_allclose(
            mine.intrinsics.vector, true.intrinsics.vector, atol=1e-6
        )
    for mine, true in zip(found.reference_from_camera, places, strict=True):
        np.testing.assert_allclose(mine.matrix, true.matrix, atol=1e-9)
    seen = np.isfinite(pixels).all(axis=3)
    seen[1, 15] = False
    np.testing.assert_array_equal(np.isfinite(found.residuals).all(axis=3), seen)
    assert np.isnan(found.details["reference_from_target"][12]).all()
    rest = np.delete(np.arange(30), 12)
    np.testing.assert_allclose(
        found.details["reference_from_target"][rest], poses[rest], atol=1e-8
    )


@pytest.mark.parametrize("m", [1, 3])
@pytest.mark.parametrize("lens", [(), (0, 2, 4), (0, 1, 2, 3, 4)])
def test_derivatives_are_those_of_the_cost(m: int, lens: tuple[int, ...]) -> None:
    rng = np.random.default_rng(88)
    cameras, places = rig(m, 1.5)
    pixels, poses = views(5, 4, cameras, places)
    moved = poses @ se3_exp(0.02 * rng.standard_normal((4, 6)))
    inverse = np.array([place.inverse().matrix for place in places])
    seen = np.ones(pixels.shape[:3], dtype=bool)
    seen[0, 1, 3:7] = False
    model = TargetModel(
        POINTS[:, :2].T.copy(),
        np.ascontiguousarray(np.moveaxis(pixels, -1, 1)),
        seen,
        (0, 1, 2, 3, 4),
        lens,
    )
    state = TargetState(
        np.array([camera.intrinsics.vector for camera in cameras])
        + rng.standard_normal((m, 5)),
        tuple(camera.lens.coefficients * 1.1 for camera in cameras),
        inverse[:, :3, :3],
        inverse[:, :3, 3],
        moved[:, :3, :3],
        moved[:, :3, 3],
    )
    if not lens:
        state = replace(state, lenses=(np.zeros(5),) * m)
    rows = model.evaluate(state)
    assert rows is not None
    own, shared = np.zeros((4, 6)), np.zeros(model.shared_unknowns)

    def slope(step: Any, index: Any, size: float) -> float:
        """Of half the cost, by a central difference."""
        costs = []
        for sign in (1.0, -1.0):
            step[index] = sign * size
            tried = model.evaluate(model.retract(state, own, shared))
            assert tried is not None
            costs.append(tried.cost)
        step[index] = 0.0
        return (costs[0] - costs[1]) / (4.0 * size)

    # A step that moves pixels by 1e-3 to 1e-2: rounding leaves seven digits of the
    # slope, what is of third order more.
    equations = rows.equations()
    scale = np.abs(equations.own_gradient).max()
    for index in np.ndindex(4, 6):
        assert slope(own, index, 1e-6) == pytest.approx(
            equations.own_gradient[index], rel=1e-5, abs=1e-7 * scale
        )
    sizes = np.full(model.shared_unknowns, 1e-6)
    for place in model.places:
        sizes[place[:5]] = 1e-3
        sizes[place[5:]] = 1e-5
    for index, size in enumerate(sizes):
        information = equations.shared[index, index]
        assert slope(shared, index, size) == pytest.approx(
            equations.shared_gradient[index], rel=1e-5, abs=1e-4 * np.sqrt(information)
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": POINTS[:3]}, r"points must have shape \(p, 3\)"),
        ({"points": POINTS + [0, 0, 0.1]}, "flat target"),
        ({"points": np.outer(np.arange(20.0), [1.0, 2.0, 0.0])}, "on a line"),
        ({"pixels": np.zeros((1, 5, 7, 2))}, r"pixels must have shape \(m, n, 20, 2\)"),
        ({"image_sizes": (100, 100)}, "outside the 100 x 100 image"),
        ({"image_sizes": [(9, 9)] * 3}, "one or 1 of them"),
        ({"names": ["a", "b"]}, "names must be 1"),
        ({"sigma_px": 0.0}, "sigma_px must be a positive number"),
        ({"distortion": ("k9",)}, "k9"),
    ],
)
def test_wrong_input_is_named(change: Any, message: str) -> None:
    pixels, _ = views(6, 5, *rig(1))
    options = {"points": POINTS, "pixels": pixels, "image_sizes": SIZE, **change}
    with pytest.raises(InputError, match=message):
        calibrate_target_views(**options)


def test_views_that_do_not_determine_the_camera() -> None:
    cameras, places = rig(2)
    rng = np.random.default_rng(89)
    pixels, _ = views(7, 8, cameras, places)
    options: Any = {"image_sizes": SIZE, "sigma_px": 0.1}
    lost, apart = pixels.copy(), pixels.copy()
    lost[1, 2:] = np.nan
    apart[0, :4], apart[1, 4:] = np.nan, np.nan
    with pytest.raises(DegenerateMotionError, match="'camera1' has 2 views"):
        calibrate_target_views(POINTS, lost, **options)
    with pytest.raises(DegenerateMotionError, match="share no"):
        calibrate_target_views(POINTS, apart, **options)
    facing, _ = views(8, 6, cameras[:1], places[:1], (0.0, 0.0))
    facing = facing + 0.1 * rng.standard_normal(facing.shape)
    with pytest.raises(DegenerateMotionError, match="do not determine"):
        calibrate_target_views(POINTS, facing, **options)
