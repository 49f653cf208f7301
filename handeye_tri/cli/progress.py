"""What the command line shows on stderr while it works."""

from __future__ import annotations

import sys
import time
from typing import Any

import click


class StderrProgress:
    """Stage lines and a bar on stderr; plain lines where it is no terminal."""

    def __init__(self) -> None:
        from rich.console import Console

        self._console = Console(stderr=True, highlight=False)
        self._bar: Any = None
        self._head = ""

    def begin(self, number: int, total: int, stage: str) -> None:
        """A stage starts."""
        self._head = f" {number}/{total}  {stage.replace('_', '-'):<9}"

    def advance(self, done: int, total: int) -> None:
        """So much of the stage is done."""
        if not self._console.is_terminal:
            return
        if self._bar is None:
            from rich.progress import (
                BarColumn,
                MofNCompleteColumn,
                Progress,
                TextColumn,
                TimeRemainingColumn,
            )

            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
                console=self._console,
                transient=True,
            )
            self._bar.start()
            self._bar.add_task(self._head, total=total)
        self._bar.update(self._bar.task_ids[0], completed=done, total=total)

    def end(self, line: str, seconds: float | None) -> None:
        """The stage ended; None: it was up to date."""
        self.close()
        took = "up to date" if seconds is None else f"{seconds:.1f} s"
        self._console.print(
            f"{self._head} {line}  [{took}]", markup=False, soft_wrap=True
        )

    def close(self) -> None:
        """Take the bar off the screen."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


class TimeLeft:
    """Trials done and time left on stderr: one line, or one in ten seconds."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._next = 0.0

    def __call__(self, done: int, total: int, seconds: float) -> None:
        """So many trials are done, and the rest takes so many seconds."""
        now = time.monotonic()
        if now < self._next and done < total:
            return
        self._next = now + (0.2 if self._terminal else 10.0)
        line = f"{done}/{total}, {int(seconds) // 60} min {int(seconds) % 60:2d} s left"
        if self._terminal:
            click.echo(f"\r{line:<40}" + "\n" * (done == total), err=True, nl=False)
        else:
            click.echo(line, err=True)


def cap_threads() -> None:
    """Small problems run slower on many BLAS threads than on one."""
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
