"""One drawn session exported from the command line, for all tests of formats."""

from __future__ import annotations

from pathlib import Path

import pytest
from drawn_session import drawn_session

from handeye_tri import cli
from handeye_tri.pipeline import Run


def call(
    capsys: pytest.CaptureFixture[str], *arguments: object
) -> tuple[int, str, str]:
    """Run the command line in this process: exit code, stdout, stderr."""
    with pytest.raises(SystemExit) as left:
        cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return int(left.value.code or 0), out, err


def exported(
    capsys: pytest.CaptureFixture[str], folder: Path, layout: str, name: str, *more: str
) -> tuple[Run, Path, str]:
    """The session, the file that was asked for, and what was printed."""
    run = drawn_session(folder)
    path = folder / name
    code, out, err = call(capsys, "export", run.folder.path, layout, "-o", path, *more)
    assert (code, err) == (0, "")
    assert out.startswith("VERDICT  PASS\n")
    return run, path, out
