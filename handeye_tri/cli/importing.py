"""The verb that brings a real robot's data in."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import click

from handeye_tri.cli.group import commands, example
from handeye_tri.cli.progress import StderrProgress, cap_threads
from handeye_tri.errors import InputError


def _named(pairs: tuple[str, ...]) -> dict[str, str]:
    found: dict[str, str] = {}
    for pair in pairs:
        camera, mark, rest = pair.partition("=")
        if not (camera and mark and rest) or camera in found:
            raise InputError(
                f"--image must be CAMERA=WHERE, once for each camera, got {pair!r}"
            )
        found[camera] = rest
    return found


def _numbers(text: str, count: int, option: str, what: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(0 < value < 1e6 for value in values):
        raise InputError(f"{option} must be {what}, got {text!r}")
    return values


@commands.command(
    "import",
    epilog=example("handeye-tri import bag cell.mcap -o out --cell my_cell.yaml"),
)
@click.argument(
    "layout",
    metavar="FORMAT",
    type=click.Choice(["images", "euroc", "bag", "moveit"]),
)
@click.argument("source", type=click.Path(path_type=Path))
@click.option(
    *("-o", "--output"),
    required=True,
    type=click.Path(path_type=Path),
    help="The new session.",
)
@click.option("--cell", metavar="CELL", help="What is calibrated (YAML).")
@click.option(
    *("--poses", "poses"),
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="The robot's poses.",
)
@click.option(
    "--poses-kind",
    metavar="KIND",
    type=click.Choice(["csv", "tum", "euroc", "yaml"]),
    help="csv, tum, euroc, yaml (JSON).",
)
@click.option("--pose-format", metavar="WORD", help="Such as rotation-vector:mm,rad.")
@click.option(
    "--direction",
    metavar="WORD",
    type=click.Choice(["flange_in_base", "base_in_flange"]),
    help="flange_in_base or base_in_flange.",
)
@click.option(
    *("--image", "images"),
    metavar="CAMERA=X",
    multiple=True,
    help="Pattern, folder or topic.",
)
@click.option(
    "--image-times",
    metavar="UNIT",
    type=click.Choice(["s", "ns"]),
    help="Images are named by time: s, ns.",
)
@click.option("--robot", metavar="X", help="joints:TOPIC, tf:BASE,FLANGE, pose:TOPIC.")
@click.option("--joints", metavar="NAMES", help="The bag's names, in the arm's order.")
@click.option("--half-turns", metavar="PAIRS", help="Not as found: 0-1,2-3.")
@click.option("--held-out", metavar="STATIONS", help="For the test: 12-17, or none.")
@click.option(
    "--tool-change",
    metavar="STATION",
    type=click.IntRange(min=0),
    help="The first station with the second mount.",
)
@click.option(
    "--turn-tolerance",
    metavar="DEG,MM",
    default="1,1",
    show_default=True,
    help="Of half-turns.",
)
@click.option(
    "--still",
    metavar="MM,DEG,S",
    default="0.1,0.02,0.3",
    show_default=True,
    help="A stand.",
)
@click.option("--orthonormalise", is_flag=True, help="Take rotations that are rounded.")
def import_(
    layout: str,
    source: Path,
    output: Path,
    cell: str | None,
    poses: Path | None,
    poses_kind: str | None,
    pose_format: str | None,
    direction: str | None,
    images: tuple[str, ...],
    image_times: str | None,
    robot: str | None,
    joints: str | None,
    half_turns: str | None,
    held_out: str | None,
    tool_change: int | None,
    turn_tolerance: str,
    still: str,
    orthonormalise: bool,
) -> None:
    """Bring a real robot's data in: images, euroc, bag or moveit.

    Half-turns are found in the poses and listed; units are never guessed.
    """
    import math

    from handeye_tri.exchange.capture import Stillness
    from handeye_tri.exchange.half_turns import TurnTolerance
    from handeye_tri.pipeline.importing import Corrections, Source, import_session
    from handeye_tri.pipeline.sources import Named, read_source

    cap_threads()
    degrees, mm = _numbers(
        turn_tolerance, 2, "--turn-tolerance", "degrees and mm such as 1,1"
    )
    move, turn, stand = _numbers(
        still, 3, "--still", "mm, degrees and seconds such as 0.1,0.02,0.3"
    )
    named = Named(
        cell=cell,
        poses=poses,
        poses_kind=poses_kind,  # type: ignore[arg-type]
        pose_format=pose_format,
        direction=direction,  # type: ignore[arg-type]
        images=_named(images),
        image_times=image_times,  # type: ignore[arg-type]
        robot=robot,
        joints=tuple(name.strip() for name in joints.split(",")) if joints else (),
        still=Stillness(1e-3 * move, math.radians(turn), stand),
        orthonormalise=orthonormalise,
        tool_change=tool_change,
    )
    found = read_source(layout, source, named)
    for proposal in found.proposals:
        click.echo(f"proposed and taken: {proposal}")
    progress = StderrProgress()
    try:
        lines = import_session(
            output,
            found.cell,
            found.capture,
            Corrections(
                half_turns,
                held_out,
                TurnTolerance(math.radians(degrees), 1e-3 * mm),
                found.tool_change,
            ),
            Source(layout, str(source), shlex.join(["handeye-tri", *sys.argv[1:]])),
            progress,
            cell_file=found.cell_file,
            model_file=found.model_file,
            others=found.others,
        )
    finally:
        progress.close()
    click.echo("\n".join(lines))
    click.echo(f"NEXT  handeye-tri detect {output}")
