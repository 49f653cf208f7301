"""Rows 1, 2, 3, 5 and 8 of `bench.py`: calibrating cameras."""

from __future__ import annotations

from bench_rows import Row


def rows() -> list[Row]:
    return []
