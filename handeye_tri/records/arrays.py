"""How every record holds its arrays: copied, checked, locked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.errors import InputError

Floats = NDArray[np.float64]


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
    array: Floats = np.array(value, dtype=float)
    fits = array.ndim == len(shape) and all(
        want is None or want == have
        for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = tuple("any" if want is None else want for want in shape)
        raise InputError(f"{name} must have shape {wanted}, got {array.shape}")
    if finite and not np.isfinite(array).all():
        raise InputError(f"{name} must be finite, got NaN or infinity")
    array.setflags(write=False)
    return array
