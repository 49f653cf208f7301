"""Measure this project against its peers side by side: one command, one table.

    python scripts/bench.py [--rows 1,2,8] [--rounds 5] [--peer-python PYTHON]

One thread; in each round ours and the peer take turns, and the ratio is the median of
the rounds' ratios. It counts only where the result is as good as the row demands.
Row 11 repeats our side of the other rows with default threads against one thread.
Peers that clash with this project's environment run in that of --peer-python:

    uv venv PEERS; uv pip install --python PEERS/bin/python \
        opencv-python-headless==4.14.* gtsam vision-calibration pin-pink mink quadprog

Exits with 1 where a bar is missed or a peer is not installed. Rows, their data and
gates are in `bench_<part>.py`, what a row is in `bench_rows.py`.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from bench_rows import Gate, Measured, MissingPeer, Peers, Row, here

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
DEFAULT_THREADS = {k: v for k, v in os.environ.items() if k not in THREAD_VARIABLES}
# Numpy is imported with the modules of rows, and reads these then.
os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
MODULES = ("bench_cameras", "bench_adjust", "bench_hand_eye", "bench_kinematics")
THREADS_ROW, THREADS_BAR = 11, 1.1
# The least time that one measurement of one side spends, repeating short calls.
LEAST_SECONDS = 0.3
WIDTHS = (3, 46, 26, 10, 10, 9, 9, 9)
HEAD = ("row", "work", "peer", "peer's", "ours", "ratio", "bar", "verdict")


@dataclass(frozen=True)
class Outcome:
    """One line of the table."""

    row: Row
    verdict: str
    gate: str
    ours: float = float("nan")
    theirs: float = float("nan")
    ratio: float = float("nan")


def described() -> list[tuple[str, Row]]:
    """Every row with its module."""
    found = []
    for name in MODULES:
        if Path(__file__).with_name(f"{name}.py").exists():
            rows = getattr(importlib.import_module(name), "rows", list)()
            found += [(name, row) for row in rows]
    return sorted(found, key=lambda pair: pair[1].number)


def compare(row: Row, ours: Measured, theirs: Measured, rounds: int) -> Outcome:
    """Take turns, then judge."""
    # Warm up: imports, caches, and the results that the gate compares.
    _, our_result = ours(0.0)
    _, their_result = theirs(0.0)
    gate = row.gate(our_result, their_result)
    pairs = []
    for _ in range(rounds):
        mine = ours(LEAST_SECONDS)[0] / row.units[0]
        pairs.append((mine, theirs(LEAST_SECONDS)[0] / row.units[1]))
    ratio = median(a / b if row.at_most else b / a for a, b in pairs)
    reached = ratio <= row.bar if row.at_most else ratio >= row.bar
    verdict = "no result" if not gate.holds else "met" if reached else "missed"
    mine, their = (median(side) for side in zip(*pairs, strict=True))
    return Outcome(row, verdict, gate.says, mine, their, ratio)


def against_peer(row: Row, peers: Peers, rounds: int) -> Outcome:
    """One row."""
    try:
        theirs = row.theirs(peers)
        return compare(row, here(row.ours(), row.measure), theirs, rounds)
    except MissingPeer as missing:
        return Outcome(row, "no peer", str(missing))
    finally:
        peers.stop()


def against_one_thread(module: str, row: Row, peers: Peers, rounds: int) -> Outcome:
    """Row 11 for one of the others: default threads against one."""
    one = DEFAULT_THREADS | dict.fromkeys(THREAD_VARIABLES, "1")
    sides = (
        peers.elsewhere(
            "bench_rows",
            "ours_of",
            (module, row.work),
            python=Path(sys.executable),
            environment=environment,
        )
        for environment in (DEFAULT_THREADS, one)
    )
    repeated = replace(
        row,
        number=THREADS_ROW,
        peer="itself with one thread",
        bar=THREADS_BAR,
        at_most=True,
        units=(1, 1),
        gate=lambda _ours, _theirs: Gate(True, "default threads"),
    )
    try:
        return compare(repeated, *sides, rounds)
    finally:
        peers.stop()


def short(value: float, measure: str) -> str:
    """A duration or a size with its unit."""
    if measure == "bytes":
        for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
            if value >= size:
                return f"{value / size:.3g} {unit}"
        return f"{value:.3g} B"
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value * 1e6:.3g} us"


def line(outcome: Outcome) -> str:
    """One line of the table."""
    row = outcome.row
    sign = "<=" if row.at_most else ">="
    cells = [str(row.number), row.work, row.peer]
    if outcome.verdict == "no peer":
        cells += ["-", "-", "-"]
    else:
        cells += [short(v, row.measure) for v in (outcome.theirs, outcome.ours)]
        cells.append(f"{outcome.ratio:.3g}x")
    cells += [f"{sign} {row.bar:g}x", outcome.verdict]
    padded = (f"{cell:<{width}}" for cell, width in zip(cells, WIDTHS, strict=True))
    return "  ".join([*padded, outcome.gate])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rows", help="numbers, as 1,2,8; all by default")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--peer-python",
        type=Path,
        default=Path(sys.executable),
        help="interpreter of the environment in which the peers are installed",
    )
    arguments = parser.parse_args()
    rows = described()
    known = {row.number for _, row in rows} | {THREADS_ROW}
    wanted = known
    if arguments.rows is not None:
        wanted = {int(number) for number in arguments.rows.split(",")}
        if not wanted <= known:
            parser.error(f"there are rows {', '.join(map(str, sorted(known)))}")
    peers = Peers(arguments.peer_python)
    outcomes = []
    print("  ".join(f"{h:<{w}}" for h, w in zip(HEAD, WIDTHS, strict=True)) + "  gate")

    def report(outcome: Outcome) -> None:
        outcomes.append(outcome)
        print(line(outcome), flush=True)

    for _, row in rows:
        if row.number in wanted:
            report(against_peer(row, peers, arguments.rounds))
    if THREADS_ROW in wanted:
        for module, row in rows:
            if row.threads:
                report(against_one_thread(module, row, peers, arguments.rounds))
    short_of = sum(outcome.verdict != "met" for outcome in outcomes)
    print(f"{len(outcomes) - short_of} of {len(outcomes)} bars met")
    sys.exit(1 if short_of else 0)


if __name__ == "__main__":
    main()
