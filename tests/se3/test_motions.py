"""Rigid motions: group axioms, derivatives, the mean, and what is refused."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from handeye_tri.errors import ConvergenceError, InputError
from handeye_tri.se3 import (
    SE3,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_left_jacobian,
    se3_left_jacobian_inverse,
    se3_log,
    so3_exp,
    so3_log,
)

Floats = NDArray[np.float64]
ANGLES = [
    *(0.0, 1e-160, 1e-16, 1e-9, 1e-4, 0.1, 0.3999999, 0.4, 1.0, 2.0, 3.0),
    *(np.pi - 1e-8, np.pi - 4e-16, np.pi),
]
unit = st.floats(-1, 1).map(lambda x: 0.0 if abs(x) < 1e-12 else x)
axes = (
    st.tuples(unit, unit, unit)
    .filter(lambda v: np.linalg.norm(v) > 1e-3)
    .map(lambda v: np.array(v) / np.linalg.norm(v))
)
angles = st.one_of(st.floats(0, np.pi), st.sampled_from(ANGLES))
translations = st.tuples(*[st.floats(-2, 2)] * 3).map(np.array)
motions = st.builds(
    lambda axis, angle, t: SE3.from_parts(so3_exp(angle * axis), t),
    axes,
    angles,
    translations,
)


def close(a: SE3, b: SE3, tolerance: float = 5e-14) -> bool:
    return bool(np.abs(a.matrix - b.matrix).max() < tolerance)


@given(motions, motions, motions)
def test_associative(a: SE3, b: SE3, c: SE3) -> None:
    assert close((a @ b) @ c, a @ (b @ c))


@given(motions)
def test_identity_and_inverse(a: SE3) -> None:
    identity = SE3.identity()
    assert close(a @ identity, a)
    assert close(identity @ a, a)
    assert close(a @ a.inverse(), identity)
    assert close(a.inverse() @ a, identity)
    assert close(a.inverse().inverse(), a)


@given(motions, motions, translations)
def test_chains_act_on_points_in_order(a: SE3, b: SE3, point: Floats) -> None:
    assert np.abs((a @ b).apply(point) - a.apply(b.apply(point))).max() < 5e-14
    homogeneous = a.matrix @ np.append(point, 1.0)
    assert np.abs(a.apply(point) - homogeneous[:3]).max() < 1e-14


@given(motions)
def test_exp_inverts_log_even_at_pi(a: SE3) -> None:
    assert close(SE3.exp(a.log()), a, 5e-14)
    assert a.angle <= np.pi + 1e-14


@given(axes, st.floats(0, np.pi - 1e-9), translations)
def test_log_inverts_exp_below_pi(axis: Floats, angle: float, v: Floats) -> None:
    """Up to 1e-9 below pi the sign of the axis is certain; no digits are lost."""
    tangent = np.concatenate([v, angle * axis])
    assert np.abs(SE3.exp(tangent).log() - tangent).max() < 1e-13


@given(axes, st.floats(-1e-12, 1e-12), translations)
def test_log_around_pi_is_one_of_the_two(
    axis: Floats, beyond: float, v: Floats
) -> None:
    a = SE3.exp(np.concatenate([v, (np.pi + beyond) * axis]))
    assert a.angle == pytest.approx(np.pi, abs=2e-12)
    assert close(SE3.exp(a.log()), a, 5e-14)


def test_exp_is_the_screw_motion() -> None:
    """A quarter turn about z while driving along x ends at (1, 1) 2 / pi."""
    a = SE3.exp([1, 0, 0, 0, 0, np.pi / 2])
    assert a.translation == pytest.approx([2 / np.pi, 2 / np.pi, 0])
    assert SE3.exp([1, 2, 3, 0, 0, 0]).translation == pytest.approx([1, 2, 3])


@given(motions, axes, st.floats(0, 1), translations)
def test_adjoint_moves_tangents(a: SE3, w: Floats, scale: float, v: Floats) -> None:
    tangent = np.concatenate([v, scale * w])
    left = a @ SE3.exp(tangent) @ a.inverse()
    assert close(left, SE3.exp(a.adjoint() @ tangent), 1e-13)


@given(motions, motions)
def test_adjoint_is_a_homomorphism(a: SE3, b: SE3) -> None:
    assert np.abs((a @ b).adjoint() - a.adjoint() @ b.adjoint()).max() < 1e-13
    assert np.abs(a.inverse().adjoint() @ a.adjoint() - np.eye(6)).max() < 1e-13


@pytest.mark.parametrize("angle", [a for a in ANGLES if a < np.pi - 1e-4])
def test_left_jacobian_inverse_is_the_derivative_of_log(angle: float) -> None:
    """log(exp(h e) exp(x)) to central differences: h^2 = 1e-10, eps / h = 1e-11."""
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    x = np.concatenate([[0.7, -0.4, 1.1], angle * axis])
    h = 1e-5
    numeric = np.empty((6, 6))
    for i, step in enumerate(h * np.eye(6)):
        plus = se3_log(se3_exp(step) @ se3_exp(x))
        minus = se3_log(se3_exp(-step) @ se3_exp(x))
        numeric[:, i] = (plus - minus) / (2 * h)
    assert np.abs(numeric - se3_left_jacobian_inverse(x)).max() < 2e-9


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.39, 0.41, 2.0, 3.1])
def test_left_jacobian_undoes_its_inverse(angle: float) -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    x = np.concatenate([[0.3, -0.2, 0.5], angle * axis])
    product = se3_left_jacobian(x) @ se3_left_jacobian_inverse(x)
    assert np.abs(product - np.eye(6)).max() < 1e-12


def test_left_jacobian_inverse_at_pi_continues_the_one_below() -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    v = np.array([0.7, -0.4, 1.1])
    at, below = (
        se3_left_jacobian_inverse(np.concatenate([v, angle * axis]))
        for angle in (np.pi, np.pi - 1e-9)
    )
    assert np.abs(at - below).max() < 1e-8


def test_left_jacobian_inverse_formulas_meet_at_their_switch() -> None:
    """Below 0.4 a series, above it closed forms that lose 6 / 0.4^4 of eps."""
    v = np.array([0.7, -0.4, 1.1])
    below, above = (
        se3_left_jacobian_inverse(np.concatenate([v, [angle, 0, 0]]))
        for angle in (0.4 - 1e-15, 0.4)
    )
    assert np.abs(below - above).max() < 1e-12


def test_batches_of_any_shape_equal_single_calls() -> None:
    rng = np.random.default_rng(3)
    tangents = rng.normal(size=(2, 3, 6))
    tangents[0, 0] = 0.0
    matrices = se3_exp(tangents)
    assert matrices.shape == (2, 3, 4, 4)
    for index in np.ndindex(2, 3):
        one = SE3(matrices[index])
        assert np.array_equal(se3_exp(tangents[index]), matrices[index])
        assert np.array_equal(se3_log(matrices)[index], one.log())
        assert np.array_equal(se3_inverse(matrices)[index], one.inverse().matrix)
        assert np.array_equal(se3_adjoint(matrices)[index], one.adjoint())


def test_mean_of_symmetric_deviations_is_their_centre() -> None:
    rng = np.random.default_rng(4)
    centre = SE3.exp([0.3, -0.2, 1.0, 2.0, -1.0, 1.5])
    steps = rng.normal(scale=0.3, size=(20, 6))
    spread = [
        SE3.from_parts(
            centre.rotation @ so3_exp(sign * step[3:]),
            centre.translation + sign * step[:3],
        )
        for step in steps
        for sign in (1, -1)
    ]
    assert close(SE3.mean(spread), centre, 5e-14)


def test_mean_rotation_vector_about_the_mean_is_zero() -> None:
    """Wide and lopsided: the definition, to the tolerance of the iteration."""
    rng = np.random.default_rng(5)
    many = [SE3.exp(t) for t in rng.uniform(-0.2, 1.2, size=(30, 6))]
    mean = SE3.mean(many)
    vectors = so3_log(mean.rotation.T @ np.array([a.rotation for a in many]))
    assert np.abs(vectors.mean(axis=0)).max() < 5e-14
    assert mean.translation == pytest.approx(
        np.mean([a.translation for a in many], axis=0)
    )


def test_mean_commutes_with_a_change_of_frame_on_the_left() -> None:
    rng = np.random.default_rng(6)
    many = [SE3.exp(t) for t in rng.normal(scale=0.4, size=(9, 6))]
    frame = SE3.exp([1, 2, 3, 2.0, 1.0, -1.0])
    moved = SE3.mean([frame @ a for a in many])
    assert close(moved, frame @ SE3.mean(many), 1e-13)


def test_mean_of_half_turns_about_one_axis_is_that_half_turn() -> None:
    half = SE3.exp([0.1, 0.2, 0.3, 0, 0, np.pi])
    assert close(SE3.mean([half] * 3), half, 1e-14)
    tilted = [half @ SE3.exp([0, 0, 0, s, 0, 0]) for s in (0.1, -0.1)]
    assert close(SE3.mean(tilted), half, 1e-14)


def test_mean_refuses_nothing_and_what_has_no_mean() -> None:
    with pytest.raises(InputError, match="at least one"):
        SE3.mean([])
    rng = np.random.default_rng(1)
    anywhere = [SE3.exp(t) for t in rng.uniform(-3, 3, size=(40, 6))]
    with pytest.raises(ConvergenceError, match="40 rotations.*spread too far"):
        SE3.mean(anywhere, iterations=5)


def test_long_chains_stay_rigid() -> None:
    a = SE3.exp([0.1, 0.2, 0.3, 0.5, 0.7, -0.2])
    chain = SE3.identity()
    for _ in range(2000):
        chain = chain @ a
    defect = chain.rotation @ chain.rotation.T - np.eye(3)
    assert np.abs(defect).max() < 1e-14


def test_immutable() -> None:
    a = SE3.identity()
    with pytest.raises(AttributeError, match="immutable"):
        a.matrix = np.eye(4)
    with pytest.raises(ValueError, match="read-only"):
        a.matrix[0, 0] = 2.0
    with pytest.raises(ValueError, match="read-only"):
        a.translation[0] = 2.0


def test_the_given_matrix_is_copied() -> None:
    given = np.eye(4)
    a = SE3(given)
    given[0, 3] = 5.0
    assert a.translation[0] == 0.0


def test_pickles_and_copies() -> None:
    a = SE3.exp([0.1, 0.2, 0.3, 0.5, 0.7, -0.2])
    for other in (pickle.loads(pickle.dumps(a)), copy.deepcopy(a)):
        assert np.array_equal(other.matrix, a.matrix)
        assert not other.matrix.flags.writeable


def test_repr_is_in_millimetres_and_degrees() -> None:
    text = repr(SE3.exp([0.0125, 0, 0, 0, 0, 0]) @ SE3.exp([0, 0, 0, 0, 0, np.pi]))
    assert text == (
        "SE3(translation_mm=[12.500, 0.000, 0.000], "
        "rotation_deg=[0.0000, 0.0000, 180.0000])"
    )


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), r"shape \(4, 4\), got \(3, 3\)"),
        (np.full((4, 4), np.nan), "finite"),
        (np.diag([1.0, 1, 1, 2]), "last row"),
        (np.diag([1.0, 1, -1, 1]), r"determinant -1"),
        (np.diag([1.001, 1, 1, 1]), r"differs from I by 0.002.*nearest_rotation"),
        (np.diag([1e3, 1e3, 1e3, 1]), "not a rotation"),
    ],
)
def test_what_is_no_motion_is_refused(matrix: Floats, message: str) -> None:
    with pytest.raises(InputError, match=message):
        SE3(matrix)


@pytest.mark.parametrize(
    ("rotation", "translation"),
    [
        (np.eye(3), 0.0),
        (np.eye(3), [0.0]),
        (1.0, [0.0, 0, 0]),
        (np.eye(3), np.zeros((3, 1))),
    ],
)
def test_parts_are_not_broadcast(rotation: object, translation: object) -> None:
    with pytest.raises(InputError, match=r"rotation of shape \(3, 3\)"):
        SE3.from_parts(rotation, translation)  # type: ignore[arg-type]


def test_a_motion_multiplies_motions_only() -> None:
    with pytest.raises(TypeError):
        SE3.identity() @ 3.0  # type: ignore[operator]
