"""Times one call in its own interpreter, for `bench.py`; not for use by hand.

Reads pickled requests on standard input and answers on standard output. It needs
nothing but the standard library, so that it runs where this project is not installed.
A request is ("load", module, factory, arguments), after which the factory's call is
what is timed, or ("measure", seconds, memory).
"""

from __future__ import annotations

import gc
import importlib
import os
import pickle
import sys
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any


def seconds(call: Callable[[], Any], least: float) -> tuple[float, Any]:
    """Mean wall time of one call over about ``least`` seconds, and its result.

    The mean, not the best: a busy machine delays long calls and short ones alike, and
    the best of many short ones would hide that.
    """
    spent, calls, result = 0.0, 0, None
    while calls == 0 or spent < least:
        result = None
        started = time.perf_counter()
        result = call()
        spent += time.perf_counter() - started
        calls += 1
    return spent / calls, result


def peak_bytes(call: Callable[[], Any]) -> tuple[float, Any]:
    """Peak of what one call allocates, by tracemalloc (numpy reports to it)."""
    gc.collect()
    tracemalloc.start()
    try:
        result = call()
        return float(tracemalloc.get_traced_memory()[1]), result
    finally:
        tracemalloc.stop()


def main() -> None:
    # What a library prints must not mix with the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    sys.path.insert(0, str(Path(__file__).parent))
    call: Callable[[], Any] = lambda: None  # noqa: E731
    while True:
        try:
            request = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        try:
            if request[0] == "load":
                _, module, factory, arguments = request
                call = getattr(importlib.import_module(module), factory)(*arguments)
                answer: Any = None
            else:
                _, least, memory = request
                answer = peak_bytes(call) if memory else seconds(call, least)
        except Exception as error:
            answer = RuntimeError(f"{type(error).__name__}: {error}")
        pickle.dump(answer, answers)
        answers.flush()


if __name__ == "__main__":
    main()
