from __future__ import annotations

import pytest

from handeye_tri.counting import counted


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (0, "0 half-turns"),
        (1, "1 half-turn"),
        (2, "2 half-turns"),
        (11, "11 half-turns"),
    ],
)
def test_one_is_singular(number, words):
    assert counted(number, "half-turn") == words
