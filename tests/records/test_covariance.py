"""Named covariances: lookup, blocks, correlation, what is no covariance."""

from __future__ import annotations

import numpy as np
import pytest

from handeye_tri.errors import InputError
from handeye_tri.records import (
    MARKER_LABELS,
    Covariance,
    marker_labels,
    motion_labels,
    triangle_name,
)

ROOT = np.array([[2.0, 0, 0], [1, 3, 0], [-1, 0.5, 0.1]])
MATRIX = ROOT @ ROOT.T
NAMED = Covariance(("left.fx", "left.fy", "right.fx"), MATRIX)


def test_std_is_the_root_of_the_diagonal() -> None:
    assert NAMED.std("left.fy") == pytest.approx(np.sqrt(10))


def test_block_in_the_order_asked() -> None:
    block = NAMED.block(["right.fx", "left.fx"])
    assert block == pytest.approx(MATRIX[np.ix_([2, 0], [2, 0])])
    block[0, 0] = 7.0  # a copy, not a view of the record
    assert NAMED.matrix[2, 2] == MATRIX[2, 2]


def test_correlation() -> None:
    std = np.sqrt(np.diag(MATRIX))
    assert NAMED.correlation() == pytest.approx(MATRIX / np.outer(std, std))
    fixed = Covariance(("a", "b"), np.diag([4.0, 0.0]))
    assert fixed.correlation() == pytest.approx(np.eye(2))


def test_unknown_label_lists_the_known() -> None:
    with pytest.raises(InputError, match=r"'left.fz'.*it has left.fx, left.fy, right"):
        NAMED.std("left.fz")


@pytest.mark.parametrize(
    ("labels", "matrix", "message"),
    [
        (("a",), np.eye(2), r"shape \(1, 1\), got \(2, 2\)"),
        (("a", "a"), np.eye(2), "differ from each other"),
        (("a", "b"), np.diag([1.0, np.nan]), "finite"),
        (("a", "b"), np.diag([1.0, -1e-9]), "variance of 'b' is negative: -1e-09"),
        (("a", "b"), np.array([[1.0, 0.5], [0.4, 1.0]]), "symmetric"),
    ],
)
def test_what_is_no_covariance(
    labels: tuple[str, ...], matrix: np.ndarray, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Covariance(labels, matrix)


def test_rounding_is_no_asymmetry() -> None:
    Covariance(("a", "b"), np.array([[1.0, 0.5], [0.5 + 1e-12, 1.0]]))


def test_labels_of_a_motion_follow_its_tangent() -> None:
    assert motion_labels("base_from_left") == tuple(
        f"base_from_left.{quantity}" for quantity in ("x", "y", "z", "rx", "ry", "rz")
    )


def test_a_second_mount_has_names_of_its_own() -> None:
    assert marker_labels() == MARKER_LABELS
    assert marker_labels(1)[:4] == (
        *("marker_A_2.x", "marker_A_2.y", "marker_A_2.z"),
        "marker_B_2.x",
    )
    assert (triangle_name(), triangle_name(1)) == (
        "flange_from_triangle",
        "flange_from_triangle_2",
    )
