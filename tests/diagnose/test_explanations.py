"""Every code that a finding can have is explained."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import handeye_tri.diagnose
from handeye_tri import cli
from handeye_tri.diagnose.explanations import EXPLANATIONS, explain
from handeye_tri.errors import InputError

FOLDER = Path(handeye_tri.diagnose.__file__).parent


def is_code(node):
    return (
        isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and node.value.replace("_", "").isalpha()
        and node.value.isupper()
    )


def codes():
    """First words of ``Finding(...)`` and of (code, cause, remedy) in the source."""
    found = set()
    for path in FOLDER.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            first = None
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "Finding":
                first = node.args[0] if node.args else None
            elif isinstance(node, ast.Tuple) and len(node.elts) == 3:
                first = None if is_code(node.elts[1]) else node.elts[0]
            if is_code(first):
                found.add(first.value)
    return found


def test_every_code_is_explained_and_nothing_else_is():
    assert {"HALF_TURN", "DROPPED", "CLOCKS"} <= codes()
    assert codes() == set(EXPLANATIONS)


@pytest.mark.parametrize("code", sorted(EXPLANATIONS))
def test_an_explanation_says_it_all_in_lines_that_fit(capsys, code):
    with pytest.raises(SystemExit) as left:
        cli.main(["explain", code.lower().replace("_", "-")])
    assert not left.value.code
    out = capsys.readouterr().out
    assert out.startswith(f"{code}\n")
    for title in ("LIKELY CAUSES", "NUMBERS", "INVALIDATES", "DO"):
        assert f"\n{title}\n  " in out
    assert max(map(len, out.splitlines())) <= 88
    assert len(explain(code).remedy) >= 1


def test_an_unknown_code_names_those_there_are(capsys):
    with pytest.raises(InputError, match="did you mean SCALE"):
        explain("scales")
    with pytest.raises(SystemExit) as left:
        cli.main(["explain", "x\ny"])
    assert left.value.code == 2
    err = capsys.readouterr().err
    assert "There are BLUR, CAMERA_MOVED, CLOCKS" in err
    assert len(err.splitlines()) == 1
