import functools
import json
import os
import signal
import sys
import warnings

import numpy as np
import pytest
from listening import listening

from handeye_tri.errors import (
    InputError,
    MissingDependencyError,
    StorageError,
    WorkerLostError,
)
from handeye_tri.sweep import sweep

SEEDS = list(range(100, 124))
IDENTITY = {"name": "draw", "count": 3}


def draw(seed):
    return {"values": np.random.default_rng(seed).normal(size=3).tolist()}


def draw_and_kill_once(folder, seed):
    """Kills its own process, hard, the first time that it gets the eighth seed."""
    flag = folder / "killed"
    if seed == SEEDS[7] and not flag.exists():
        flag.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return draw(seed)


def die(seed):
    os.kill(os.getpid(), signal.SIGKILL)
    return draw(seed)


def draw_or_stop(stop_at, seed):
    if seed == stop_at:
        raise KeyboardInterrupt
    return draw(seed)


def run(task, path, **options):
    return sweep(task, SEEDS, checkpoint=path, identity=IDENTITY, **options)


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    return run(draw, tmp_path_factory.mktemp("serial") / "draws.jsonl")


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            silence_logs=60,
        ) as cluster,
    ):
        yield cluster.scheduler_address


def test_results_are_the_tasks_in_the_order_of_the_seeds(serial):
    assert serial == [draw(seed) for seed in SEEDS]


@pytest.mark.filterwarnings("ignore:A worker stopped while some jobs were given")
def test_a_killed_process_loses_nothing(tmp_path, serial):
    task = functools.partial(draw_and_kill_once, tmp_path)
    assert run(task, tmp_path / "draws.jsonl", jobs=2) == serial
    assert (tmp_path / "killed").exists()


def test_a_killed_dask_worker_loses_nothing(tmp_path, serial, cluster):
    # Nobody outside this machine can give the workers something to run.
    assert {address for address, _ in listening(os.getpid())} == {"127.0.0.1"}
    task = functools.partial(draw_and_kill_once, tmp_path)
    assert run(task, tmp_path / "draws.jsonl", dask=cluster) == serial
    assert (tmp_path / "killed").exists()


def test_a_task_that_always_kills_its_worker_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr("handeye_tri.sweep._FUTILE", 1)
    with pytest.raises(WorkerLostError, match=r"0 of 24 seeds .* is 100"):
        run(die, tmp_path / "draws.jsonl", jobs=2)


def test_an_interrupted_run_goes_on_where_it_was(tmp_path, serial):
    path = tmp_path / "draws.jsonl"
    with pytest.raises(KeyboardInterrupt):
        run(functools.partial(draw_or_stop, SEEDS[10]), path)
    assert len(path.read_text().splitlines()) == 1 + 10
    calls, told = [], []

    def task(seed):
        calls.append(seed)
        return draw(seed)

    assert run(task, path, progress=lambda *now: told.append(now)) == serial
    assert calls == SEEDS[10:]
    assert [now[:2] for now in told] == [(n, 24) for n in range(11, 25)]
    assert told[-1][2] == 0
    assert all(now[2] > 0 for now in told[:-1])


@pytest.mark.parametrize("cut", [1, 30, 200])
def test_a_line_cut_short_is_done_again(tmp_path, serial, cut):
    path = tmp_path / "draws.jsonl"
    run(draw, path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-cut])
    assert run(draw, path) == serial
    assert path.read_bytes() == whole


def test_a_line_is_a_seed_with_its_result(tmp_path, serial):
    path = tmp_path / "draws.jsonl"
    run(draw, path)
    head, *lines = (json.loads(line) for line in path.read_text().splitlines())
    assert head == {"schema": "handeye_tri.sweep/1", "identity": IDENTITY}
    assert lines == [
        {"seed": seed, "result": result}
        for seed, result in zip(SEEDS, serial, strict=True)
    ]


def test_results_of_another_task_are_not_taken(tmp_path):
    path = tmp_path / "draws.jsonl"
    run(draw, path)
    with pytest.raises(StorageError, match="other parameters"):
        sweep(draw, SEEDS, checkpoint=path, identity={"name": "draw", "count": 4})


def test_two_runs_do_not_share_a_checkpoint(tmp_path):
    path = tmp_path / "draws.jsonl"

    def nested(seed):
        run(draw, path)
        return draw(seed)

    with pytest.raises(StorageError, match="another run is writing it"):
        run(nested, path)


def test_what_json_cannot_hold_is_no_result(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        run(lambda seed: {"value": float("nan")}, tmp_path / "draws.jsonl")


@pytest.mark.parametrize(
    ("seeds", "options", "message"),
    [
        ([1, 2, 1], {}, "seeds must differ"),
        ([1, 2], {"jobs": 0}, "jobs must be at least 1"),
        ([1, 2], {"jobs": -2}, "got -2"),
    ],
)
def test_bad_arguments_are_named(tmp_path, seeds, options, message):
    path = tmp_path / "draws.jsonl"
    with pytest.raises(InputError, match=message):
        sweep(draw, seeds, checkpoint=path, identity=IDENTITY, **options)
    assert not path.exists()


def test_without_dask_the_install_command_is_given(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'handeye-tri\[dask"):
        run(draw, tmp_path / "draws.jsonl", dask="tcp://127.0.0.1:8786")


def test_an_address_without_a_scheduler_is_named(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("handeye_tri.sweep._DASK_TIMEOUT_S", 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(InputError, match="no Dask scheduler answers"):
            run(draw, tmp_path / "draws.jsonl", dask="tcp://127.0.0.1:9")
