"""How many threads the libraries behind numpy use."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


def one_thread() -> AbstractContextManager[object]:
    """Keeps them on one inside a with statement.

    For many products of small matrices, where threads cost more than they bring.
    """
    limit: AbstractContextManager[object] = _blas().limit(limits=1)
    return limit


@cache
def _blas() -> ThreadpoolController:
    """The libraries, found once."""
    return ThreadpoolController().select(user_api="blas")
