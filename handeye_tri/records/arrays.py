"""How every record holds its arrays: copied, checked, locked."""

from __future__ import annotations

from collections.abc import Sequence

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
        InputError: it is something else: text, lists of unequal length, complex.
    """
    try:
        array = np.array(value)
        if array.dtype.kind in "biuf":
            return array.astype(float)
        if array.dtype.kind != "O":
            raise TypeError
        return array.astype(float)
    except (TypeError, ValueError):
        raise InputError(
            f"{name} must be real numbers, in lists of equal length; got {shown(value)}"
        ) from None


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
