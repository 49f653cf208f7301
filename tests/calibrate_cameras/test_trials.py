"""Many calibrations at once: each is the single calibration of its own data."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from half_turn_scene import (
    FOOT,
    IMAGE_SIZE,
    TRIANGLE,
    camera,
    make_scene,
)

from handeye_tri import calibrate_camera, calibrate_trials
from handeye_tri.calibrate_cameras.trial_model import TrialModel, TrialState
from handeye_tri.camera import Lens
from handeye_tri.errors import DegenerateMotionError, InputError

MIXED = ("normal", "CA") * 5 + ("AB",)
LENS = Lens("radtan", np.array([-0.1, 0.05, 1e-3, -1e-3, 0.0]))


def draw(
    seed: int, trials: int, axes: Any = "normal", sigma: float = 0.2, **options: Any
) -> tuple[Any, Any, Any]:
    rng = np.random.default_rng([80, seed])
    scene = make_scene(rng, 11, axes, **options)
    shape = (trials, *scene.before.shape)
    return (
        scene,
        scene.before + sigma * rng.standard_normal(shape),
        scene.after + sigma * rng.standard_normal(shape),
    )


@pytest.mark.parametrize(
    ("axes", "options"),
    [
        ("normal", {"sigma_px": 0.2}),
        ("normal", {}),
        ("normal", {"o": "free", "sigma_px": 0.2}),
        ("normal", {"o": FOOT, "skew": False, "sigma_px": 0.2}),
        ("CA", {"sigma_px": 0.2}),
        (MIXED, {"sigma_px": 0.2}),
        (MIXED, {"o": "free", "skew": False}),
        ("normal", {"distortion": ("k1", "k2"), "sigma_px": 0.2}),
        ("BC", {"distortion": ("k1", "p1", "k4"), "skew": False, "sigma_px": 0.2}),
    ],
)
def test_each_trial_is_the_single_calibration(axes: Any, options: Any) -> None:
    lens = {"view": camera(lens=LENS)} if "distortion" in options else {}
    _, before, after = draw(1, 5, axes, **lens)
    options = {"image_size": IMAGE_SIZE, "axis": axes, **options}
    found = calibrate_trials(before, after, TRIANGLE, **options)
    assert found.converged.all()
    for i in range(len(found)):
        one = calibrate_camera(before[i], after[i], TRIANGLE, **options)
        # Both stop where the next step would move a quantity by 1e-4 sigma.
        values = [one.camera.parameter(name) for name in found.labels]
        mine = np.array([*found.intrinsics[i], *found.lens[i]])
        names = ["fx", "fy", "skew", "cx", "cy", *one.camera.lens.names]
        mine = mine[[names.index(name) for name in found.labels]]
        assert np.abs((mine - values) / found.sigma[i]).max() < 1e-3
        assert found.chi2[i] == pytest.approx(one.chi2, rel=1e-5 if lens else 1e-9)
        assert found.dof[i] == one.dof
        sigma = [one.covariance.std(f"camera.{name}") for name in found.labels]
        np.testing.assert_allclose(found.sigma[i], sigma, rtol=1e-3)
        poses = one.details["camera_from_triangle"]
        np.testing.assert_allclose(found.poses[i], poses, atol=1e-6)
        if "normal" in axes:
            np.testing.assert_allclose(found.o[i], one.details["o"], atol=1e-7)


@pytest.mark.parametrize("axes", ["normal", "AB", "BC", "CA", MIXED])
def test_exact_data_give_the_exact_camera(axes: Any) -> None:
    scene, before, after = draw(2, 3, axes, 0.0)
    found = calibrate_trials(
        before, after, TRIANGLE, image_size=IMAGE_SIZE, axis=axes, sigma_px=0.1
    )
    assert found.converged.all()
    truth = scene.camera.intrinsics.vector
    np.testing.assert_allclose(
        found.intrinsics, truth[None] + np.zeros((3, 1)), atol=1e-7
    )


@pytest.mark.parametrize("o_mode", ["known", "shared", "free"])
@pytest.mark.parametrize("lens", [(), (0, 2, 4, 5)])
def test_derivatives_are_those_of_the_cost(o_mode: str, lens: tuple[int, ...]) -> None:
    rng = np.random.default_rng(81)
    n, c = 4, 2
    scene = make_scene(rng, n, ("normal", "AB", "normal", "CA"))
    pixels = np.concatenate([scene.before, scene.after], axis=1)
    plane = np.empty((2, 6, n, 1))
    plane[:, :3] = TRIANGLE.points[:, :2].T[:, :, None, None]
    for i, axis in enumerate(scene.axes):
        turn = TRIANGLE.half_turn(axis, np.zeros(2))
        plane[:, 3:, i, 0] = turn.apply(TRIANGLE.points)[:, :2].T
    reach = np.zeros((6, n, 1))
    reach[3:, [0, 2]] = 2.0
    model = TrialModel(
        np.repeat(pixels.transpose(2, 1, 0)[..., None], c, axis=3),
        np.ones((n, c)),
        plane,
        reach,
        (0, 1, 2, 3, 4),
        lens,
        o_mode,
    )
    coefficients = np.array([-0.1, 0.05, 1e-3, -1e-3, 0.02, 0.01, 0.0, 0.0])
    feet = np.array(FOOT)[:, None, None] + 1e-3 * rng.standard_normal((2, n, c))
    state = TrialState(
        scene.camera.intrinsics.vector[:, None] + rng.standard_normal((5, c)),
        coefficients[:, None] * (1.0 + 0.1 * rng.standard_normal((8, c))),
        np.repeat(scene.poses[:, :3, :3].transpose(1, 2, 0)[..., None], c, axis=3),
        np.repeat(scene.poses[:, :3, 3].T[..., None], c, axis=2),
        feet if o_mode == "free" else feet[:, :1],
    )
    if o_mode == "known":
        model = replace(
            model, plane=plane + reach * np.array(FOOT)[:, None, None, None]
        )
    equations = model.evaluate(state)
    own = np.zeros((model.own_unknowns, n, c))
    shared = np.zeros((model.shared_unknowns, c))

    def slope(step: Any, size: float) -> Any:
        """Of half the cost, by a central difference."""
        costs = []
        for sign in (1.0, -1.0):
            step[...] = sign * size
            costs.append(
                model.evaluate(model.retract(state, own, shared), 1).cost.copy()
            )
        step[...] = 0.0
        return (costs[0] - costs[1]) / (4.0 * size)

    # The cost is 1e4 to 1e6 px^2; a step that moves pixels by about 1e-2 keeps eight
    # digits of its slope, and the parts of third order are as small.
    for k in range(model.own_unknowns):
        for i in range(n):
            if k >= 6 and i in (1, 3):
                continue
            wanted = equations.own[k, -1, i]
            assert slope(own[k, i], 1e-6) == pytest.approx(wanted, rel=1e-5, abs=1.0)
    sizes = np.empty(model.shared_unknowns)
    sizes[model.places[:5]] = 1e-3
    sizes[model.places[5:]] = 1e-6
    for k, size in enumerate(sizes):
        wanted = equations.shared[k, -1]
        assert slope(shared[k], size) == pytest.approx(wanted, rel=1e-5, abs=1e-2)


def test_a_bad_trial_is_flagged_and_leaves_the_others_alone() -> None:
    scene, before, after = draw(3, 8)
    options: Any = {"image_size": IMAGE_SIZE, "sigma_px": 0.2}
    clean = calibrate_trials(before, after, TRIANGLE, **options)
    before, after = before.copy(), after.copy()
    before[1] = np.nan
    after[2, 4, 0, 0] = 5000.0
    # One plane seen eleven times: K is not determined.
    before[3] = before[3, :1] + 0.2 * (before[3] - scene.before)
    after[3] = after[3, :1] + 0.2 * (after[3] - scene.after)
    # Labels exchanged everywhere: no half-turn of this triangle.
    before[4] = before[4][:, [1, 2, 0]]
    # One half-turn missing: the others still do.
    after[5, 7, 2] = np.nan
    found = calibrate_trials(before, after, TRIANGLE, **options)
    bad = [1, 2, 3]
    good = [0, 5, 6, 7]
    assert not found.converged[bad].any()
    assert found.converged[good].all()
    assert "complete" in found.failures[1]
    assert "outside" in found.failures[2]
    assert found.failures[3] != ""
    assert np.isnan(found.intrinsics[bad]).all()
    assert np.isnan(found.covariance[bad]).all()
    # What cannot be a triangle's turn either fails or says so by chi2.
    assert not found.converged[4] or found.chi2[4] > 100 * found.dof[4]
    same = [0, 6, 7]
    np.testing.assert_allclose(
        found.intrinsics[same], clean.intrinsics[same], rtol=1e-9
    )
    one = calibrate_camera(before[5], after[5], TRIANGLE, **options)
    assert found.dof[5] == one.dof
    assert found.chi2[5] == pytest.approx(one.chi2, rel=1e-9)
    assert np.isnan(found.poses[5, 7]).all()


def test_covariance_is_the_spread_of_the_estimates() -> None:
    scene, before, after = draw(4, 600, sigma=0.1)
    found = calibrate_trials(
        before, after, TRIANGLE, image_size=IMAGE_SIZE, sigma_px=0.1
    )
    assert found.converged.all()
    error = found.intrinsics - scene.camera.intrinsics.vector
    nees = np.einsum(
        "ti,tij,tj->t", error, np.linalg.inv(found.covariance), error
    ).mean()
    # Five degrees of freedom: the mean of 600 has a sigma of 0.13.
    assert 4.5 < nees < 5.6
    assert found.chi2.mean() / found.dof[0] == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"before": np.zeros((2, 11, 2, 2))}, r"before must have shape"),
        ({"after": np.zeros((2, 10, 3, 2))}, r"pair up"),
        ({"axis": "AC"}, r"axis must be one of"),
        ({"axis": ["normal"] * 3}, r"got 3 for 11"),
        ({"sigma_px": -1.0}, r"sigma_px must be a positive number, got -1.0"),
        ({"image_size": (0, 5)}, r"image_size"),
        ({"distortion": "fisheye"}, r"fisheye"),
        ({"o": "somewhere"}, r"somewhere"),
    ],
)
def test_wrong_input_is_named(change: Any, message: str) -> None:
    _, before, after = draw(5, 2)
    options = {"before": before, "after": after, "image_size": IMAGE_SIZE, **change}
    with pytest.raises(InputError, match=message):
        calibrate_trials(triangle=TRIANGLE, **options)


def test_too_few_half_turns_for_the_unknowns() -> None:
    _, before, after = draw(6, 2)
    with pytest.raises(DegenerateMotionError, match="2 half-turns are too few"):
        calibrate_trials(before[:, :2], after[:, :2], TRIANGLE, image_size=IMAGE_SIZE)
