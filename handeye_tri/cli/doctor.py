"""The verb that examines the machine."""

from __future__ import annotations

import sys

import click

from handeye_tri.cli.group import commands, example


@commands.command(epilog=example("handeye-tri doctor"))
def doctor() -> None:
    """Say what this machine has and lacks, and how to get it."""
    from handeye_tri.doctor import examine

    checks = examine()
    for check in checks:
        mark = "ok     " if check.ok else "MISSING"
        click.echo(f"{mark}  {check.name:<18} {check.found}")
        if not check.ok:
            click.echo(f"         {check.remedy}")
    sys.exit(0 if all(check.ok or check.optional for check in checks) else 2)
