"""The verb that writes a plan as a programme for the robot."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from handeye_tri.cli.group import EXIT_CODES, SESSION, commands, example
from handeye_tri.cli.progress import cap_threads

_LAYOUTS = ("csv", "json", "joint_trajectory", "urscript")


@commands.command(
    epilog=example("handeye-tri programme out urscript -o calibrate.script")
)
@SESSION
@click.argument("layout", metavar="FORMAT", type=click.Choice(_LAYOUTS))
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    help="The file.",
)
@click.option(
    "--dwell",
    default=1.0,
    show_default=True,
    help="Seconds that the robot stands at a station.",
)
@click.option(
    "--then",
    type=click.Path(path_type=Path),
    help="Another planned session, driven after a tool change.",
)
@click.option("--even-if-failed", is_flag=True, help="Whatever the plan's verdict.")
def programme(
    session: Path,
    layout: str,
    output: Path,
    dwell: float,
    then: Path | None,
    even_if_failed: bool,
) -> None:
    """Write a session's plan as a programme that a robot can run.

    FORMAT: csv (joints by station), json, joint_trajectory (ROS 2), urscript. A plan
    with two mounts states its tool change. With --then, two different triangles are
    driven in one programme.
    """
    from handeye_tri.pipeline import NullProgress, Run
    from handeye_tri.pipeline.programme import planned_outcome, write_programme
    from handeye_tri.pipeline.tool_change import seconds_of_moves
    from handeye_tri.storage import SessionFolder

    cap_threads()
    runs = []
    for folder in (session, *([] if then is None else [then])):
        run = Run(SessionFolder.open(folder), NullProgress())
        outcome = planned_outcome(run)
        if outcome != "PASS" and not even_if_failed:
            click.echo(
                f"error: {folder}: the plan's verdict is {outcome}, so no programme is "
                f"written; see handeye-tri plan {folder}, or add --even-if-failed",
                err=True,
            )
            sys.exit(EXIT_CODES[outcome])
        runs.append((run, outcome))
    written = write_programme(
        runs[0][0], layout, output, dwell, runs[1][0] if then else None
    )
    for run, outcome in runs:
        whose = f" of {run.cell.name}" if then else ""
        click.echo(f"VERDICT{whose}  {outcome} (expected, before the robot moves)")
    if written.change is not None:
        click.echo(
            f"{written.change.of_programme(len(written.stops))}; "
            f"{seconds_of_moves(written):.1f} s of moves"
        )
    click.echo(f"wrote {output}")
