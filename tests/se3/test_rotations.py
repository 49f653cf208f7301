"""Rotations: exact inverses near 0 and up to pi, derivatives, known values."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from handeye_tri.errors import InputError
from handeye_tri.se3 import (
    hat,
    nearest_rotation,
    quaternion_wxyz,
    rotation_from_quaternion_wxyz,
    so3_exp,
    so3_left_jacobian,
    so3_left_jacobian_inverse,
    so3_log,
)

Floats = NDArray[np.float64]

# Where formulas change or lose digits: 0, the underflow of squares, the switch to
# series at 0.1, both sides of pi.
ANGLES = [
    *(0.0, 1e-300, 1e-160, 1e-16, 1e-9, 1e-8, 1e-4, 0.0999999, 0.1, 0.1000001, 1.0),
    *(np.pi / 2, 3.0, np.pi - 1e-4, np.pi - 1e-8, np.pi - 1e-12, np.pi - 4e-16, np.pi),
]
# A few dozen roundings of numbers near 1.
ROUNDING = 6e-15
components = st.floats(-1, 1).map(lambda x: 0.0 if abs(x) < 1e-12 else x)
axes = (
    st.tuples(components, components, components)
    .filter(lambda v: np.linalg.norm(v) > 1e-3)
    .map(lambda v: np.array(v) / np.linalg.norm(v))
)
angles = st.one_of(st.floats(0, np.pi), st.sampled_from(ANGLES))


def same_rotation_vector(a: Floats, b: Floats, tolerance: float) -> bool:
    """Equal, where at pi both signs are the same rotation."""
    if np.abs(a - b).max() <= tolerance:
        return True
    opposite = b - 2 * np.pi * b / np.linalg.norm(b)
    return bool(np.abs(a - opposite).max() <= tolerance)


def test_hat_is_the_cross_product() -> None:
    a, b = np.random.default_rng(1).normal(size=(2, 7, 3))
    assert np.allclose((hat(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15)


@given(axes, angles)
def test_exp_is_a_rotation_by_the_angle(axis: Floats, angle: float) -> None:
    rotation = so3_exp(angle * axis)
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < ROUNDING
    assert np.linalg.det(rotation) == pytest.approx(1, abs=ROUNDING)
    assert np.abs(rotation @ axis - axis).max() < ROUNDING
    assert np.trace(rotation) == pytest.approx(1 + 2 * np.cos(angle), abs=ROUNDING)


@given(axes, angles)
def test_log_inverts_exp_to_rounding_everywhere(axis: Floats, angle: float) -> None:
    vector = angle * axis
    found = so3_log(so3_exp(vector))
    assert same_rotation_vector(found, vector, ROUNDING)
    assert np.linalg.norm(found) <= np.pi + ROUNDING


@given(axes, st.floats(0, 1e-3))
def test_log_keeps_small_angles_to_relative_precision(
    axis: Floats, angle: float
) -> None:
    """Off-diagonal entries carry a small vector with all its digits."""
    found = so3_log(so3_exp(angle * axis))
    assert np.abs(found - angle * axis).max() <= ROUNDING * angle + 1e-300


@given(axes)
def test_half_turns_have_both_axes_and_all_digits(axis: Floats) -> None:
    """R = 2 a a' - I has w = 0 up to rounding; trace formulas lose 8 digits here."""
    rotation = 2 * np.outer(axis, axis) - np.eye(3)
    found = so3_log(rotation)
    assert np.linalg.norm(found) == pytest.approx(np.pi, abs=ROUNDING)
    assert abs(found @ axis) == pytest.approx(np.pi, abs=ROUNDING)
    assert np.abs(so3_exp(found) - rotation).max() < ROUNDING


@pytest.mark.parametrize("k", [0, 1, 2])
def test_exact_half_turns_about_the_coordinate_axes(k: int) -> None:
    rotation = -np.eye(3)
    rotation[k, k] = 1
    assert so3_log(rotation) == pytest.approx(np.pi * np.eye(3)[k], abs=0)
    assert quaternion_wxyz(rotation) == pytest.approx(np.eye(4)[k + 1], abs=0)


@given(axes, angles)
def test_quaternions_there_and_back(axis: Floats, angle: float) -> None:
    rotation = so3_exp(angle * axis)
    quaternion = quaternion_wxyz(rotation)
    assert quaternion[0] >= 0
    assert np.linalg.norm(quaternion) == pytest.approx(1, abs=ROUNDING)
    assert abs(quaternion[0]) == pytest.approx(np.cos(angle / 2), abs=ROUNDING)
    back = rotation_from_quaternion_wxyz(-3.0 * quaternion)
    assert np.abs(back - rotation).max() < ROUNDING


def test_quaternion_component_order_and_sign() -> None:
    """A quarter turn about z: (w, x, y, z) = (cos 45, 0, 0, sin 45)."""
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    half = np.sqrt(0.5)
    assert quaternion_wxyz(quarter) == pytest.approx([half, 0, 0, half])
    assert quaternion_wxyz(quarter.T) == pytest.approx([half, 0, 0, -half])
    assert so3_exp([0, 0, np.pi / 2]) == pytest.approx(quarter)


@pytest.mark.parametrize("bad", [[0, 0, 0, 0], [1, 0, 0, np.nan], [np.inf, 0, 0, 0]])
def test_impossible_quaternions_are_refused(bad: list[float]) -> None:
    with pytest.raises(InputError, match="finite and not zero"):
        rotation_from_quaternion_wxyz([[1, 0, 0, 0], bad])


@given(axes, st.one_of(st.floats(0, 6.0), st.sampled_from(ANGLES)))
def test_left_jacobian_and_its_inverse(axis: Floats, angle: float) -> None:
    """Its inverse grows like 1 / (2 pi - t): at 6.0 the product loses two digits."""
    vector = angle * axis
    product = so3_left_jacobian(vector) @ so3_left_jacobian_inverse(vector)
    assert np.abs(product - np.eye(3)).max() < 3e-14


@pytest.mark.parametrize("angle", ANGLES)
def test_left_jacobian_is_the_derivative_of_exp(angle: float) -> None:
    """exp(w + h e) exp(-w) = exp(h J e); central differences err by h^2 and eps/h."""
    vector = angle * np.array([2.0, -1.0, 2.0]) / 3.0
    h = 1e-5
    steps = h * np.eye(3)
    plus = so3_log(so3_exp(vector + steps) @ so3_exp(-vector))
    minus = so3_log(so3_exp(vector - steps) @ so3_exp(-vector))
    numeric = ((plus - minus) / (2 * h)).T
    assert np.abs(numeric - so3_left_jacobian(vector)).max() < 1e-10


def test_small_and_large_formulas_meet() -> None:
    """Just below and above the switch the results differ by the angle's change."""
    below, above = np.array([[0.1 - 1e-15, 0, 0], [0.1, 0, 0]])
    for function in (so3_exp, so3_left_jacobian, so3_left_jacobian_inverse):
        assert np.abs(function(below) - function(above)).max() < ROUNDING


@given(st.lists(st.floats(-1, 1), min_size=9, max_size=9), axes, angles)
def test_nearest_rotation_is_nearer_than_others(
    noise: list[float], axis: Floats, angle: float
) -> None:
    matrix = so3_exp(angle * axis) + 0.3 * np.reshape(noise, (3, 3))
    nearest = nearest_rotation(matrix)
    assert np.abs(nearest @ nearest.T - np.eye(3)).max() < 1e-14
    assert np.linalg.det(nearest) > 0
    distance = np.linalg.norm(nearest - matrix)
    for step in 1e-3 * np.vstack([np.eye(3), -np.eye(3)]):
        assert distance <= np.linalg.norm(nearest @ so3_exp(step) - matrix) + 1e-12


def test_nearest_rotation_is_proper_for_a_reflection() -> None:
    nearest = nearest_rotation(np.stack([np.diag([1.0, 1, -1]), np.diag([3.0, 2, 1])]))
    assert np.linalg.det(nearest) == pytest.approx([1, 1])
    assert nearest[1] == pytest.approx(np.eye(3))


def test_batches_of_any_shape_equal_single_calls() -> None:
    rng = np.random.default_rng(2)
    vectors = rng.normal(size=(2, 5, 3))
    vectors[0, 0] = 0.0
    vectors[1, 1] *= np.pi / np.linalg.norm(vectors[1, 1])
    for function in (so3_exp, so3_left_jacobian, so3_left_jacobian_inverse, hat):
        batched = function(vectors)
        assert batched.shape == (2, 5, 3, 3)
        for index in np.ndindex(2, 5):
            assert np.array_equal(batched[index], function(vectors[index]))
    rotations = so3_exp(vectors)
    for back in (so3_log, quaternion_wxyz):
        for index in np.ndindex(2, 5):
            assert np.array_equal(back(rotations)[index], back(rotations[index]))


def test_nan_stays_nan_without_a_warning() -> None:
    assert np.isnan(so3_exp([np.nan, 0, 0])).any()
    assert np.isnan(so3_log(np.full((3, 3), np.nan))).all()
