"""Flags, names, choices and counts of the wrong kind: one sentence, never a guess."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handeye_tri import arguments
from handeye_tri.camera import Intrinsics, Lens, PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.records import CameraInfo, PoseNoise

WORDS = ("huber", "cauchy")
READERS: dict[str, Callable[[Any], Any]] = {
    "True or False": lambda value: arguments.flag("x", value),
    "a name": lambda value: arguments.title("x", value),
    "a sequence of 2 names|2 different|a name": (
        lambda value: arguments.titles("x", value, 2)
    ),
    'one of "huber", "cauchy"': lambda value: arguments.check_one_of("x", value, WORDS),
    "a Lens": lambda value: arguments.record("x", value, Lens),
    "a number": lambda value: arguments.number("x", value),
    "a positive number": lambda value: arguments.positive("x", value),
    "a whole number of 0 or more": lambda value: arguments.seed("x", value),
    r"\(width, height\) in whole pixels": (
        lambda value: arguments.image_size("x", value)
    ),
    r"\(width, height\) in whole pixels, one or 2": (
        lambda value: arguments.image_sizes("x", value, 2)
    ),
}
STRANGE = (
    None,
    b"x",
    {},
    object(),
    [None],
    [[3]],
    [(1, 2), (1, 2, 3)],
    1j,
    float("nan"),
    np.array([1.5, 2.5]),
    "two\nlines" * 30 + "\x00",
)
ANYTHING = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-3, 2000)
    | st.floats()
    | st.complex_numbers()
    | st.text(max_size=5)
    | st.binary(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.tuples(inner, inner),
    max_leaves=6,
)


@pytest.mark.parametrize("message", READERS)
@pytest.mark.parametrize("value", STRANGE, ids=range(len(STRANGE)))
def test_what_is_of_the_wrong_kind_is_named_on_one_line(message, value) -> None:
    if message == "a name" and isinstance(value, str):
        value = " \n"
    with pytest.raises(InputError, match=rf"^x.* must be ({message})") as caught:
        READERS[message](value)
    assert len(str(caught.value)) < 200
    assert "\n" not in str(caught.value)


@given(value=ANYTHING)
def test_a_value_is_taken_as_it_is_or_refused(value) -> None:
    for message, read in READERS.items():
        try:
            found = read(value)
        except InputError:
            continue
        if found is not None and "one or 2" not in message:
            assert np.array_equal(found, value), message


def test_what_fits_is_read() -> None:
    assert arguments.flag("x", np.False_) is False
    assert arguments.titles("x", ("a", "b"), 2) == ["a", "b"]
    assert arguments.number("x", np.float32(-np.inf)) == -np.inf
    assert arguments.positive("x", np.array(0.5)) == 0.5
    assert arguments.seed("x", np.int64(7)) == 7
    assert arguments.image_size("x", np.array([1024.0, 768.0])) == (1024, 768)
    assert arguments.image_sizes("x", (4, 3), 2) == [(4, 3), (4, 3)]
    assert arguments.image_sizes("x", [(4, 3), (8, 6)], 2) == [(4, 3), (8, 6)]


K = Intrinsics(1720.0, 1715.0, 0.0, 519.3, 377.8)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PinholeCamera(3, K, (1024, 768)), "name must be"),
        (lambda: PinholeCamera("left", K, (1024.5, 768)), "'left': image_size must"),
        (lambda: PinholeCamera("left", K, None), "'left': image_size must"),
        (
            lambda: Intrinsics("1720", 1715.0, 0.0, 519.3, 377.8),
            "intrinsics must be num",
        ),
        (
            lambda: Intrinsics(1720.0, 1715.0, None, 519.3, 377.8),
            "intrinsics must be num",
        ),
        (lambda: Lens(["radtan"]), r"lens model \['radtan'\] is not known"),
        (lambda: Lens("radtan", "k1"), "coefficients of a lens must be"),
        (lambda: CameraInfo(None, (1024, 768)), "name of a camera must be"),
        (lambda: CameraInfo("left", (1024, 768.5)), "'left': image_size must"),
        (lambda: CameraInfo("left", (1024, 768), "yes"), "'left': skew must be True"),
        (lambda: PoseNoise("a", 1.0, 1.0, 1.0, 1.0), "noise.robot_translation must be"),
    ],
)
def test_records_refuse_the_wrong_kind(make, message) -> None:
    with pytest.raises(InputError, match=message):
        make()
