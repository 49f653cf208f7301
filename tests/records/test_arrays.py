"""Locking: a copy, the shape asked for, no NaN unless allowed."""

from __future__ import annotations

import numpy as np
import pytest

from handeye_tri.errors import InputError
from handeye_tri.records import locked


def test_it_is_a_locked_copy_of_floats() -> None:
    given = np.arange(6).reshape(2, 3)
    held = locked("grid", given, (2, None))
    given[0, 0] = 9
    assert held[0, 0] == 0.0
    assert held.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        held[0, 0] = 1.0


@pytest.mark.parametrize(
    ("value", "shape", "message"),
    [
        (np.zeros((2, 3)), (3, 2), r"grid must have shape \(3, 2\), got \(2, 3\)"),
        (np.zeros(3), (None, 3), r"grid must have shape \(any, 3\), got \(3,\)"),
        ([0.0, np.nan], (2,), "grid must be finite"),
        ([0.0, np.inf], (2,), "grid must be finite"),
        (np.array([True, False]), (2,), "grid must be real numbers, not True and Fa"),
        ([1.5, True], (2,), "grid must be real numbers, not True and False"),
        ([np.zeros(2), [0.5, np.True_]], (2, 2), "grid must be real numbers, not True"),
        (np.array([1, True], dtype=object), (2,), "grid must be real numbers, not Tru"),
        (["1", True], (2,), "grid must be real numbers, in lists"),
    ],
)
def test_what_is_refused(value: object, shape: tuple, message: str) -> None:  # type: ignore[type-arg]
    with pytest.raises(InputError, match=message):
        locked("grid", value, shape)  # type: ignore[arg-type]


def test_nan_where_allowed() -> None:
    assert np.isnan(locked("pixels", [np.nan, 1.0], (2,), finite=False)[0])
