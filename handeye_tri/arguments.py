"""Reads flags, names, choices and sizes that a caller gave, each by its own name.

Nothing is guessed: what is no flag is not taken for its truth value, and half a pixel
is not cut off an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import Any, TypeVar

import numpy as np

from handeye_tri.errors import InputError

_SHOWN = 60
Kind = TypeVar("Kind")


def shown(value: object) -> str:
    """A value as messages show it: on one line and not too long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


def flag(name: str, value: object) -> bool:
    """A flag.

    Raises:
        InputError: neither True nor False.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def title(name: str, value: object) -> str:
    """What something is to be called.

    Raises:
        InputError: no text, or none in it.
    """
    if not isinstance(value, str) or not value.strip():
        raise InputError(f"{name} must be a name in quotes, got {shown(value)}")
    return value


def titles(name: str, value: object, count: int) -> list[str]:
    """What several things are to be called, each otherwise.

    Raises:
        InputError: not as many, not texts, or two alike.
    """
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise InputError(
            f"{name} must be a sequence of {count} names, got {shown(value)}"
        )
    named = [title(f"{name}[{i}]", one) for i, one in enumerate(value)]
    if len(named) != count or len(set(named)) < count:
        raise InputError(f"{name} must be {count} different ones, got {named}")
    return named


def check_one_of(name: str, value: object, known: Sequence[str]) -> None:
    """Refuse what is no choice by name.

    Raises:
        InputError: it is none of those known.
    """
    if not isinstance(value, str) or value not in known:
        words = ", ".join(f'"{word}"' for word in known)
        raise InputError(f"{name} must be one of {words}; got {shown(value)}")


def record(name: str, value: object, kind: type[Kind]) -> Kind:
    """One of this package's records.

    Raises:
        InputError: something else.
    """
    if not isinstance(value, kind):
        raise InputError(f"{name} must be a {kind.__name__}, got {shown(value)}")
    return value


def number(name: str, value: object) -> float:
    """A number, which may be infinite.

    Raises:
        InputError: no number, a flag, or NaN.
    """
    if isinstance(value, np.ndarray) and value.shape == ():
        value = value[()]
    if isinstance(value, bool) or not isinstance(value, Real) or np.isnan(float(value)):
        raise InputError(f"{name} must be a number, got {shown(value)}")
    return float(value)


def positive(name: str, value: object) -> float:
    """A finite number above zero.

    Raises:
        InputError: anything else.
    """
    try:
        result = number(name, value)
    except InputError:
        result = np.nan
    if not (np.isfinite(result) and result > 0):
        raise InputError(f"{name} must be a positive number, got {shown(value)}")
    return result


def seed(name: str, value: object) -> int:
    """A seed of random numbers.

    Raises:
        InputError: no whole number, or a negative one.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
        raise InputError(
            f"{name} must be a whole number of 0 or more, got {shown(value)}"
        )
    return int(value)


def image_size(name: str, value: object) -> tuple[int, int]:
    """Width and height of an image, pixels.

    Raises:
        InputError: not two whole numbers of 1 or more.
    """
    size = _sizes(value)
    if size is None or size.shape != (2,):
        raise InputError(
            f"{name} must be (width, height) in whole pixels, got {shown(value)}"
        )
    return int(size[0]), int(size[1])


def image_sizes(name: str, value: object, count: int) -> list[tuple[int, int]]:
    """Width and height of several images, pixels.

    Args:
        name: Of the argument.
        value: One size for all, or one each.
        count: How many there are.

    Raises:
        InputError: anything else.
    """
    size = _sizes(value)
    if size is None or size.shape not in ((2,), (count, 2)):
        raise InputError(
            f"{name} must be (width, height) in whole pixels, one or {count} of them; "
            f"got {shown(value)}"
        )
    return [(int(w), int(h)) for w, h in np.broadcast_to(size, (count, 2))]


def _sizes(value: object) -> np.ndarray[Any, np.dtype[np.float64]] | None:
    """Whole numbers of 1 or more as an array of any shape; None where they are not."""
    try:
        array = np.array(value)
    except ValueError:
        return None
    if array.dtype.kind not in "iuf" or not array.size:
        return None
    whole = np.isfinite(array) & (array == np.floor(array)) & (array >= 1)
    return array.astype(float) if whole.all() else None
