"""Lens distortion against OpenCV, its derivatives and its inverse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from handeye_tri.camera import LENS_COEFFICIENTS, Lens, distort, distort_jacobians
from handeye_tri.errors import InputError

Floats = NDArray[np.float64]
RADTAN = np.array([-0.21, 0.09, 0.0008, -0.0011, 0.013])
RATIONAL = np.array([-0.21, 0.09, 0.0008, -0.0011, 0.013, 0.11, -0.04, 0.006])
GRID = np.stack(
    np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.4, 0.4, 7)), axis=-1
)


def central_difference(function, x: Floats, step: float) -> Floats:  # type: ignore[no-untyped-def]
    """Derivative of a function of a vector; its last axis is the vector's."""
    columns = []
    for i in range(len(x)):
        delta = np.zeros_like(x)
        delta[i] = step
        columns.append((function(x + delta) - function(x - delta)) / (2 * step))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("coefficients", [RADTAN, RATIONAL])
def test_distortion_is_opencvs(coefficients: Floats) -> None:
    cv2 = pytest.importorskip("cv2")
    points = np.dstack([GRID, np.ones(GRID.shape[:2])]).reshape(-1, 3)
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), np.eye(3), coefficients
    )
    ours = distort(coefficients, points[:, :2])
    assert np.abs(ours - expected[:, 0]).max() < 1e-15


@pytest.mark.parametrize("coefficients", [RADTAN, RATIONAL, np.zeros(5), np.zeros(8)])
def test_derivatives(coefficients: Floats) -> None:
    """Central differences of step h err by h^2 f'''/6 (1e-11) and eps/h (1e-11)."""
    distorted, by_point, by_lens = distort_jacobians(coefficients, GRID)
    assert np.array_equal(distorted, distort(coefficients, GRID))
    for index in np.ndindex(GRID.shape[:2]):
        numeric = central_difference(
            lambda xy: distort(coefficients, xy), GRID[index], 3e-6
        )
        assert np.abs(numeric - by_point[index]).max() < 1e-9
        numeric = central_difference(
            lambda c, at=GRID[index]: distort(c, at), coefficients, 3e-6
        )
        assert np.abs(numeric - by_lens[index]).max() < 1e-9


@pytest.mark.parametrize(
    "lens", [Lens("radtan", RADTAN), Lens("rational", RATIONAL), Lens()]
)
def test_undistort_inverts_to_rounding(lens: Lens) -> None:
    assert np.abs(lens.undistort(lens.distort(GRID)) - GRID).max() < 5e-15


@given(
    st.tuples(*[st.floats(-0.3, 0.3)] * 2, *[st.floats(-0.01, 0.01)] * 2),
    st.floats(-0.4, 0.4),
    st.floats(-0.3, 0.3),
)
def test_undistort_inverts_any_mild_lens(
    coefficients: tuple[float, ...], x: float, y: float
) -> None:
    """At radius 0.5 these coefficients bend by less than 12 %: no fold inside."""
    lens = Lens("radtan", np.array([*coefficients, 0.0]))
    ideal = np.array([x, y])
    assert np.abs(lens.undistort(lens.distort(ideal)) - ideal).max() < 1e-13


def test_undistort_keeps_nan_and_shape_and_its_input() -> None:
    lens = Lens("radtan", RADTAN)
    points = GRID.copy()
    points[0, 0] = np.nan
    before = points.copy()
    result = lens.undistort(points)
    assert result.shape == GRID.shape
    assert np.isnan(result[0, 0]).all()
    assert np.isfinite(result[0, 1:]).all()
    assert np.array_equal(points, before, equal_nan=True)
    assert np.isnan(lens.undistort(np.full((2, 2), np.nan))).all()
    assert lens.undistort(np.empty((0, 2))).shape == (0, 2)


def test_undistort_refuses_what_lies_beyond_the_fold() -> None:
    """r (1 - r^2) is at most 0.385, at r = 0.577."""
    lens = Lens("radtan", np.array([-1.0, 0, 0, 0, 0]))
    assert lens.undistort([0.38, 0.0])[0] < 0.5774
    with pytest.raises(
        InputError, match=r"k1=-1.*no inverse at normalised radius 0.39"
    ):
        lens.undistort([[0.1, 0.1], [0.39, 0.0]])


def test_undistort_never_returns_the_far_side_of_a_fold() -> None:
    """Every radius that has an inverse has it before the fold, at r = 0.577."""
    lens = Lens("radtan", np.array([-1.0, 0, 0, 0, 0]))
    reachable = np.linspace(0.0, 0.3848, 300)
    ideal = lens.undistort(np.stack([reachable, np.zeros(300)], axis=-1))[:, 0]
    assert (np.diff(ideal) > 0).all()
    assert ideal.max() < 0.5774


def test_lens_names_and_identity() -> None:
    assert Lens().is_identity
    assert not Lens("radtan", RADTAN).is_identity
    assert Lens("rational", RATIONAL).names == LENS_COEFFICIENTS["rational"]


def test_lens_is_locked_and_its_own_copy() -> None:
    values = RADTAN.copy()
    lens = Lens("radtan", values)
    values[0] = 7.0
    assert lens.coefficients[0] == RADTAN[0]
    with pytest.raises(ValueError, match="read-only"):
        lens.coefficients[0] = 0.0


@pytest.mark.parametrize(
    ("model", "coefficients", "message"),
    [
        ("fisheye", RADTAN, "'fisheye' is not known; use one of radtan, rational"),
        ("radtan", RATIONAL, r"takes 5 finite coefficients \(k1 k2 p1 p2 k3\)"),
        ("rational", RADTAN, "takes 8 finite coefficients"),
        ("radtan", RADTAN * np.nan, "finite"),
    ],
)
def test_lens_refuses(model: str, coefficients: Floats, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Lens(model, coefficients)  # type: ignore[arg-type]
