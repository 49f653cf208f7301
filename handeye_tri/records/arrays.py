"""How every record holds its arrays: copied, checked, locked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.arguments import shown
from handeye_tri.errors import InputError

Floats = NDArray[np.float64]


def numeric(name: str, value: ArrayLike) -> Floats:
    """A copy of what the caller gave, as an array of any shape.

    Args:
        name: What the message calls it.
        value: Anything numpy reads as real numbers.

    Raises:
        InputError: it is something else: text, lists of unequal length, complex, or
            True and False, alone or among numbers.
    """
    try:
        array = np.array(value)
        numbers = None if array.dtype.kind not in "biufO" else array.astype(float)
    except (TypeError, ValueError):
        numbers = None
    if numbers is None:
        raise InputError(
            f"{name} must be real numbers, in lists of equal length; got {shown(value)}"
        )
    if _has_flags(value, array):
        raise InputError(
            f"{name} must be real numbers, not True and False; got {shown(value)}"
        )
    return numbers


def _has_flags(value: ArrayLike, array: NDArray[Any]) -> bool:
    """Whether there is a True or False in a value that numpy has read as an array."""
    if array.dtype.kind == "b":
        return True
    if isinstance(value, np.ndarray) and array.dtype.kind != "O":
        return False
    # Lists of numbers and flags are read as numbers.
    each = np.array(value, dtype=object).flat
    return any(isinstance(one, (bool, np.bool_)) for one in each)


def locked(
    name: str, value: ArrayLike, shape: Sequence[int | None], *, finite: bool = True
) -> Floats:
    """Copy an array, check its shape, and lock it against writing.

    Args:
        name: What the message calls the array.
        value: Anything numpy reads as numbers.
        shape: Expected shape; None stands for any length.
        finite: Whether NaN and infinity are refused.

    Raises:
        InputError: the shape or a value does not fit.
    """
    array = numeric(name, value)
    fits = array.ndim == len(shape) and all(
        want is None or want == have
        for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = ", ".join("any" if want is None else str(want) for want in shape)
        comma = "," if len(shape) == 1 else ""
        raise InputError(f"{name} must have shape ({wanted}{comma}), got {array.shape}")
    if finite and not np.isfinite(array).all():
        raise InputError(f"{name} must be finite, got NaN or infinity")
    array.setflags(write=False)
    return array
