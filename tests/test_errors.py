"""The typed errors: one family, catchable as what they are, safe to send."""

from __future__ import annotations

import inspect
import pickle

import pytest

from handeye_tri import errors
from handeye_tri.errors import HandEyeError, InputError, NoPlanError

ALL = [
    cls
    for _, cls in inspect.getmembers(errors, inspect.isclass)
    if issubclass(cls, Exception)
]


def make(cls: type[HandEyeError]) -> HandEyeError:
    if cls is NoPlanError:
        return NoPlanError("no plan: 7 of 9 collide", {"collision": 7, "sight": 2})
    return cls("what, where, what to do")


@pytest.mark.parametrize("cls", ALL)
def test_one_base_catches_all_and_str_is_the_message(cls: type[HandEyeError]) -> None:
    with pytest.raises(HandEyeError) as raised:
        raise make(cls)
    assert str(raised.value) in ("what, where, what to do", "no plan: 7 of 9 collide")


@pytest.mark.parametrize("cls", ALL)
def test_errors_come_back_from_another_process(cls: type[HandEyeError]) -> None:
    error = make(cls)
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is cls
    assert str(back) == str(error)
    assert vars(back) == vars(error)


def test_children_are_also_what_python_calls_them() -> None:
    assert issubclass(InputError, ValueError)
    assert issubclass(errors.MissingDependencyError, ImportError)


def test_no_plan_keeps_its_own_copy_of_the_rejections() -> None:
    rejected = {"collision": 7}
    error = NoPlanError("no plan", rejected)
    rejected["collision"] = 0
    assert error.rejected == {"collision": 7}
