"""Many seeds of one task: on this machine, or on a Dask cluster by its address.

What is done is on disk, one line per seed: a worker that is killed, an interrupted
run or a lost machine costs the seeds that were being worked on, which are done again.
"""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any

from handeye_tri.errors import (
    InputError,
    MissingDependencyError,
    StorageError,
    WorkerLostError,
)

Result = dict[str, Any]
Task = Callable[[int], Mapping[str, Any]]
Progress = Callable[[int, int, float], None]

SCHEMA = "handeye_tri.sweep/1"
# Times that the workers may die, with nothing finished in between, before we give up.
_FUTILE = 3
# Seeds that a worker gets at once: a lost worker costs no more than these.
_LARGEST_CHUNK = 16
_DASK_TIMEOUT_S = 10.0


def sweep(
    task: Task,
    seeds: Sequence[int],
    *,
    checkpoint: Path,
    identity: Mapping[str, Any],
    jobs: int = 1,
    dask: str | None = None,
    progress: Progress | None = None,
) -> list[Result]:
    """Run a task once per seed, or read back what an earlier run has done.

    Args:
        task: Maps a seed to a mapping that JSON can hold (None for no number, never
            NaN). It must depend on the seed only, and be picklable.
        seeds: Distinct; none needs doing twice.
        checkpoint: File of one JSON line per seed; made where it is absent.
        identity: What the task is, so that results of another are not taken for its:
            its name and parameters.
        jobs: Processes on this machine; -1 for one per core, 1 stays in this process.
        dask: Address of a Dask scheduler, ``tcp://host:8786``, instead of ``jobs``.
        progress: Called with seeds done, seeds in all, seconds left.

    Returns:
        One result per seed, in the order of the seeds, the same whatever ran them.

    Raises:
        InputError: an argument cannot be used, or nothing answers at the address.
        StorageError: the checkpoint is of another task, in use, or not writable.
        MissingDependencyError: ``dask`` without the optional packages.
        WorkerLostError: workers died again and again with nothing finished.
    """
    if len(set(seeds)) < len(seeds):
        raise InputError("seeds must differ: a seed done twice counts twice")
    if jobs == 0 or jobs < -1:
        raise InputError(f"jobs must be at least 1, or -1 for all cores, got {jobs}")
    with _opened(checkpoint, dict(identity)) as (stream, done), ExitStack() as stack:
        todo = [seed for seed in seeds if seed not in done]
        clock = _Clock(len(seeds) - len(todo), len(seeds), progress)
        if todo:
            workers = _Workers.of(jobs, dask, stack)
        futile = 0
        while todo:
            before = len(done)
            try:
                for finished in workers.run(task, todo):
                    _append(stream, checkpoint, finished)
                    done.update(finished)
                    clock.advance(len(finished))
            except workers.losses as error:
                futile = 0 if len(done) > before else futile + 1
                if futile == _FUTILE:
                    raise WorkerLostError(
                        f"the workers died {_FUTILE} times with nothing finished "
                        f"({type(error).__name__}); {len(seeds) - len(todo)} of "
                        f"{len(seeds)} seeds are in {checkpoint}, the first that is "
                        f"not is {todo[0]}; look for a lack of memory, then run the "
                        "same again: it goes on from there"
                    ) from error
            todo = [seed for seed in todo if seed not in done]
        return [done[seed] for seed in seeds]


def run_chunk(task: Task, seeds: Sequence[int]) -> dict[int, str]:
    """What a worker does: the results of some seeds, as JSON."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        return {seed: json.dumps(task(seed), allow_nan=False) for seed in seeds}


class _Workers:
    """Processes that run chunks of seeds, here or on a cluster."""

    def __init__(
        self,
        count: int,
        losses: tuple[type[BaseException], ...],
        backend: Mapping[str, Any],
    ) -> None:
        self._count = count
        self.losses = losses
        self._backend = backend

    @classmethod
    def of(cls, jobs: int, dask: str | None, stack: ExitStack) -> _Workers:
        from joblib import cpu_count
        from joblib.externals.loky.process_executor import TerminatedWorkerError

        if dask is None:
            count = cpu_count() if jobs == -1 else jobs
            local = {"backend": "loky", "inner_max_num_threads": 1}
            return cls(count, (TerminatedWorkerError,), local)
        try:
            import distributed
        except ImportError:
            raise MissingDependencyError(
                "running on a Dask cluster needs optional packages; install them "
                "with: pip install 'handeye-tri[dask]'"
            ) from None
        try:
            client = stack.enter_context(
                distributed.Client(dask, timeout=_DASK_TIMEOUT_S, set_as_default=False)
            )
        except (OSError, ValueError) as error:
            raise InputError(
                f"no Dask scheduler answers at {dask!r} ({error}); start one with "
                "`dask scheduler`, and give its address, tcp://HOST:PORT"
            ) from None
        count = sum(client.nthreads().values())
        if count == 0:
            raise InputError(
                f"the Dask scheduler at {dask} has no workers; start some with "
                f"`dask worker {dask}`"
            )
        return cls(
            count, (distributed.KilledWorker,), {"backend": "dask", "client": client}
        )

    def run(self, task: Task, seeds: Sequence[int]) -> Iterator[dict[int, Result]]:
        """Results by seed, chunk by chunk as they come."""
        size = -(-len(seeds) // (8 * self._count))
        size = 1 if self._count == 1 else min(size, _LARGEST_CHUNK)
        chunks = [seeds[at : at + size] for at in range(0, len(seeds), size)]
        for lines in self._finished(task, chunks):
            yield {seed: json.loads(line) for seed, line in lines.items()}

    def _finished(
        self, task: Task, chunks: Sequence[Sequence[int]]
    ) -> Iterator[dict[int, str]]:
        import joblib

        if self._count == 1 and self._backend["backend"] == "loky":
            yield from (run_chunk(task, chunk) for chunk in chunks)
            return
        with joblib.parallel_config(**self._backend):
            parallel = joblib.Parallel(
                n_jobs=self._count, batch_size=1, return_as="generator_unordered"
            )
            yield from parallel(joblib.delayed(run_chunk)(task, c) for c in chunks)


class _Clock:
    def __init__(self, ready: int, total: int, progress: Progress | None) -> None:
        self._started = time.monotonic()
        self._now, self._total, self._here = ready, total, 0
        self._progress = progress

    def advance(self, count: int) -> None:
        self._now += count
        self._here += count
        if self._progress is not None:
            each = (time.monotonic() - self._started) / self._here
            self._progress(self._now, self._total, each * (self._total - self._now))


@contextmanager
def _opened(
    path: Path, identity: Result
) -> Iterator[tuple[IO[bytes], dict[int, Result]]]:
    """A checkpoint to append to, for us alone, and what it holds by seed."""
    # Not at the top: workers import this module, and need none of that.
    from handeye_tri.storage import write_bytes

    head = json.loads(json.dumps({"schema": SCHEMA, "identity": identity}))
    if not path.exists():
        write_bytes(path, _line(head))
    try:
        stream = path.open("r+b")
    except OSError as error:
        raise StorageError(f"{path}: cannot be opened ({error.strerror})") from None
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise StorageError(
                f"{path}: another run is writing it; wait for it, or choose another "
                "folder with -o"
            ) from None
        done: dict[int, Result] = {}
        lines = stream.read().splitlines(keepends=True)
        if not lines or _parsed(lines[0]) != head:
            raise StorageError(
                f"{path}: it holds results of another experiment or of other "
                "parameters; choose another folder with -o, or delete it"
            )
        whole = len(lines[0])
        for line in lines[1:]:
            record = _parsed(line)
            if record is None or not line.endswith(b"\n"):
                break
            done[int(record["seed"])] = record["result"]
            whole += len(line)
        # What a crash cut short is done again.
        stream.truncate(whole)
        stream.seek(whole)
        yield stream, done


def _append(stream: IO[bytes], path: Path, results: Mapping[int, Result]) -> None:
    try:
        for seed, result in results.items():
            stream.write(_line({"seed": seed, "result": result}))
        stream.flush()
        os.fsync(stream.fileno())
    except OSError as error:
        raise StorageError(
            f"{path}: cannot be written ({error.strerror}); free the disk and run the "
            "same again: it goes on from what is there"
        ) from None


def _line(record: Mapping[str, Any]) -> bytes:
    return (json.dumps(record, allow_nan=False) + "\n").encode()


def _parsed(line: bytes) -> Any:
    try:
        return json.loads(line)
    except ValueError:
        return None
