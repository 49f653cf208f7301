"""The command line ``handeye-tri``: parsing and calls, no formula."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import click

# Each of these adds its verbs to the group.
from handeye_tri.cli import (
    compare,
    doctor,
    exchange,
    experiment,
    explain,
    importing,
    programme,
    session,
    solve,
)
from handeye_tri.cli.group import EXIT_CODES, commands
from handeye_tri.errors import DegenerateMotionError, HandEyeError

__all__ = [
    "commands",
    "compare",
    "doctor",
    "exchange",
    "experiment",
    "explain",
    "importing",
    "main",
    "programme",
    "session",
    "solve",
]


def _log_bug() -> Path:
    """Write the traceback of the exception being handled to a file of its own."""
    import tempfile
    import traceback

    handle, name = tempfile.mkstemp(prefix="handeye-tri-", suffix=".log")
    with os.fdopen(handle, "w") as stream:
        stream.write(f"handeye-tri {' '.join(sys.argv[1:])}\n{traceback.format_exc()}")
    return Path(name)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and leave with its exit code; never a traceback.

    Exit codes: 0 PASS or done, 1 a bug of ours, 2 input not usable, 3 FAIL,
    4 CANNOT TELL, 130 interrupted.
    """
    try:
        sys.exit(commands.main(arguments, standalone_mode=False) or 0)
    except DegenerateMotionError as error:
        click.echo(f"cannot tell: {error}", err=True)
        sys.exit(EXIT_CODES["CANNOT TELL"])
    except HandEyeError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(2)
    except click.ClickException as error:
        error.show()
        sys.exit(2)
    except (KeyboardInterrupt, click.Abort):
        click.echo("interrupted; the same command goes on where it was", err=True)
        sys.exit(130)
    except BrokenPipeError:
        # The reader of our output left (| head): silence the shutdown flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except Exception as error:
        click.echo(
            f"internal error: {type(error).__name__}: {error}; this is a bug of "
            f"handeye-tri, not of your input; the details are in {_log_bug()}",
            err=True,
        )
        sys.exit(1)
