"""The group that all verbs join, and what they share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

EXIT_CODES = {"PASS": 0, "FAIL": 3, "CANNOT TELL": 4}
SESSION = click.argument("session", type=click.Path(path_type=Path))
AGAIN = click.option("--again", is_flag=True, help="Redo it even where up to date.")


def seed_option(text: str, default: int = 1) -> Callable[[Any], Any]:
    """The option --seed of a verb.

    Args:
        text: Its help.
        default: The seed where none is given.
    """
    return click.option(
        "--seed",
        type=click.IntRange(min=0),
        default=default,
        show_default=True,
        help=text,
    )


def example(*lines: str) -> str:
    """Epilog of a verb's help; the first character keeps click from refilling it."""
    return "\b\nExample:\n" + "\n".join(f"  {line}" for line in lines)


@click.group(
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=example(
        "handeye-tri run hp3_stereo -o out --seed 1", "handeye-tri replay out"
    ),
)
@click.version_option(package_name="handeye-tri")
def commands() -> None:
    """Calibrate cameras and an arm with three markers that turn by 180 degrees."""
