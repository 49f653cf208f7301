"""What a row of `bench.py` is, and how both of its sides are measured.

A module of rows, `bench_<part>.py`, has one function `rows() -> list[Row]`, which only
describes; data are made when a row is measured. An example:

    def rows() -> list[Row]:
        return [
            Row(
                number=6,
                work="hand-eye, 22 poses",
                peer="cv2 Park",
                bar=10.0,
                ours=lambda: partial(solve_axzb, *draw(22)),
                theirs=lambda peers: peers.elsewhere(
                    "bench_peers", "park", draw(22), needs="opencv-python-headless"
                ),
                gate=lambda ours, theirs: Gate(
                    error(ours) <= 1.01 * error(theirs), "rotation <= 1.01 x Park's"
                ),
            )
        ]
"""

from __future__ import annotations

import importlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from bench_server import peak_bytes, seconds

# Measures one side once: takes the least number of seconds to spend and returns the
# seconds (or peak bytes) of one call, and what that call returned.
Measured = Callable[[float], tuple[float, Any]]
Measure = Literal["seconds", "bytes"]


class MissingPeer(Exception):
    """A peer is not installed; says how to install it."""


@dataclass(frozen=True)
class Gate:
    """Whether the results are as good as they must be for a ratio to count.

    Attributes:
        holds: Whether they are.
        says: What was compared, with the numbers.
    """

    holds: bool
    says: str


@dataclass(frozen=True)
class Row:
    """One comparison.

    Attributes:
        number: Of the kind of work; `--rows` selects by it, and several rows share it.
        work: What is done, and how much of it.
        peer: Who else does it.
        bar: Of the ratio. By default that is peer over ours, per unit, and must be at
            least the bar.
        ours: Makes the data and returns the call that is measured, without arguments.
            It must be deterministic: row 11 repeats it in other processes.
        theirs: The peer: ``peers.elsewhere(...)``, or ``here(call)`` in this process.
        gate: Takes what our call and the peer's returned.
        at_most: The ratio is ours over peer, and must not exceed the bar.
        units: How many pieces of work one call of ours and of the peer does.
        measure: "seconds" of wall time, or "bytes" allocated at the peak.
        threads: Whether row 11 repeats it with default threads.
    """

    number: int
    work: str
    peer: str
    bar: float
    ours: Callable[[], Callable[[], Any]]
    theirs: Callable[[Peers], Measured]
    gate: Callable[[Any, Any], Gate] = lambda _ours, _theirs: Gate(True, "-")
    at_most: bool = False
    units: tuple[int, int] = (1, 1)
    measure: Measure = "seconds"
    threads: bool = True


def ours_of(module: str, work: str) -> Callable[[], Any]:
    """Our call of the row that does this work; a process of row 11 loads it."""
    rows: list[Row] = importlib.import_module(module).rows()
    return next(row for row in rows if row.work == work).ours()


def here(call: Callable[[], Any], measure: Measure = "seconds") -> Measured:
    """Measure a call in this process."""
    if measure == "bytes":
        return lambda _least: peak_bytes(call)
    return lambda least: seconds(call, least)


@dataclass
class Peers:
    """Runs peers in other interpreters, each in a process that times itself.

    Attributes:
        python: The interpreter in whose environment the peers are installed.
    """

    python: Path = field(default_factory=lambda: Path(sys.executable))
    _running: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def elsewhere(
        self,
        module: str,
        factory: str,
        arguments: tuple[Any, ...],
        *,
        needs: str = "",
        python: Path | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> Measured:
        """Measure what a factory returns, in a new process.

        Args:
            module: In this folder; imported there. It must not import what only this
                project's environment has.
            factory: Takes the arguments and returns the call that is measured, so that
                nothing but the peer's own work is.
            arguments: Numpy arrays and plain values.
            needs: The package to install where the module's imports fail.
            python: Another interpreter than the peers'.
            environment: Of the process; None for this one's.

        Raises:
            MissingPeer: an import fails there.
        """
        interpreter = self.python if python is None else python
        process = subprocess.Popen(
            [str(interpreter), str(Path(__file__).with_name("bench_server.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=dict(os.environ if environment is None else environment),
        )
        self._running.append(process)

        def ask(request: tuple[Any, ...]) -> Any:
            assert process.stdin is not None
            assert process.stdout is not None
            pickle.dump(request, process.stdin)
            process.stdin.flush()
            answer = pickle.load(process.stdout)
            if isinstance(answer, Exception):
                text = str(answer)
                if "ModuleNotFoundError" in text or "ImportError" in text:
                    raise MissingPeer(
                        f"{text}; uv pip install --python {interpreter} {needs}"
                    )
                raise answer
            return answer

        ask(("load", module, factory, arguments))
        return lambda least: ask(("measure", least, False))

    def stop(self) -> None:
        """End the processes that were started."""
        for process in self._running:
            assert process.stdin is not None
            process.stdin.close()
            process.wait()
        self._running.clear()
