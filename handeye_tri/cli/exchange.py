"""The verb that carries results out to other tools."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from handeye_tri.cli.group import EXIT_CODES, SESSION, commands, example
from handeye_tri.cli.progress import cap_threads

if TYPE_CHECKING:
    from handeye_tri.exchange import CameraFrame

_FORMATS = (
    *("camera_info", "opencv", "kalibr", "easy_handeye2", "ros2_static_tf", "urdf"),
    *("tum", "mcap", "json"),
)


@commands.command(epilog=example("handeye-tri export out urdf -o cameras.urdf"))
@SESSION
@click.argument("layout", metavar="FORMAT", type=click.Choice(_FORMATS))
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path),
    help="The file; of several, each gets a name before the suffix.",
)
@click.option("--base-frame", default="base", show_default=True, help="Robot's base.")
@click.option("--flange-frame", default="flange", show_default=True, help="Its flange.")
@click.option(
    "--optical-frame",
    default="{camera}_optical_frame",
    show_default=True,
    help="Of a camera.",
)
@click.option(
    "--camera-frame",
    type=click.Choice(["mounting", "optical"]),
    default="mounting",
    show_default=True,
    help="Where the URDF's joint from the base ends.",
)
@click.option("--even-if-failed", is_flag=True, help="Whatever the verdict; stamped.")
def export(
    session: Path,
    layout: str,
    output: Path,
    base_frame: str,
    flange_frame: str,
    optical_frame: str,
    camera_frame: CameraFrame,
    even_if_failed: bool,
) -> None:
    """Write a session's results for another tool.

    FORMAT: camera_info, opencv, kalibr, easy_handeye2, ros2_static_tf, urdf, tum,
    mcap (the whole session), json.
    """
    from handeye_tri.exchange import FrameNames, static_tf_commands
    from handeye_tri.pipeline import NullProgress, Run
    from handeye_tri.pipeline.export import export as write
    from handeye_tri.pipeline.export import verdict_of
    from handeye_tri.storage import SessionFolder

    cap_threads()
    run = Run(SessionFolder.open(session), NullProgress())
    verdict = verdict_of(run)
    if verdict != "PASS" and not even_if_failed:
        click.echo(
            f"error: {session}: the verdict is {verdict}, so nothing is exported; see "
            f"handeye-tri evaluate {session}, or add --even-if-failed, which stamps "
            "the file",
            err=True,
        )
        sys.exit(EXIT_CODES[verdict])
    frames = FrameNames(base_frame, flange_frame, optical_frame)
    written, results = write(
        run, layout, output, frames=frames, camera_frame=camera_frame
    )
    click.echo(f"VERDICT  {results.verdict}")
    for path in written:
        click.echo(f"wrote {path}")
    if layout == "ros2_static_tf":
        click.echo("\n".join(static_tf_commands(results)))
