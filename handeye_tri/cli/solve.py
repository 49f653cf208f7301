"""The verb that solves bare pose pairs."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from handeye_tri.cli.group import EXIT_CODES, commands, example, seed_option
from handeye_tri.cli.progress import cap_threads

# Such as 0.5, and neither inf nor nan.
_POSITIVE = click.FloatRange(min=0, max=1e9, min_open=True)


@commands.command(epilog=example("handeye-tri solve poses.json"))
@click.argument("poses", type=click.Path(path_type=Path))
@click.option(
    "--method",
    default="likelihood",
    show_default=True,
    help="Or the name of a closed form, such as shah, li, tsai_lenz or park_martin.",
)
@click.option(
    "--format",
    "layout",
    type=click.Choice(["poses", "moveit"]),
    default="poses",
    show_default=True,
    help="Of the file; scripts/README.md describes both.",
)
@click.option(
    "--mounting",
    type=click.Choice(["eye_in_hand", "eye_to_hand"]),
    help="For MoveIt samples, which do not say it.",
)
@click.option("--orthonormalise", is_flag=True, help="Take rotations that are rounded.")
@click.option(
    "--shift-along-axis-mm",
    type=float,
    help="Measured, where the poses leave it open (4-axis robots).",
)
@click.option(
    "--limit-mm",
    type=_POSITIVE,
    default=10.0,
    show_default=True,
    help="Largest RMS position residual.",
)
@click.option(
    "--limit-deg",
    type=_POSITIVE,
    default=1.0,
    show_default=True,
    help="Largest RMS angle residual.",
)
@seed_option("Of the random samples.", default=0)
@click.option("--json", "as_json", is_flag=True, help="Print JSON only.")
def solve(
    poses: Path,
    method: str,
    layout: str,
    mounting: str | None,
    orthonormalise: bool,
    shift_along_axis_mm: float | None,
    limit_mm: float,
    limit_deg: float,
    seed: int,
    as_json: bool,
) -> None:
    """Solve bare pose pairs of any robot and any target.

    POSES states mounting, directions and units; nothing is guessed (see
    scripts/README.md). Exit code: 0 PASS, 3 FAIL, 4 CANNOT TELL, 2 input not usable.
    """
    import json
    import math

    from handeye_tri.errors import InputError
    from handeye_tri.solve import solve_and_judge, solved_json, solved_text
    from handeye_tri.storage import read_moveit_samples, read_pose_pairs

    if layout == "moveit":
        pairs = read_moveit_samples(poses, mounting, orthonormalise=orthonormalise)
    elif mounting is not None:
        raise InputError("--mounting is for MoveIt samples; other files state it")
    else:
        pairs = read_pose_pairs(poses, orthonormalise=orthonormalise)
    cap_threads()
    solved = solve_and_judge(
        pairs,
        method=method,  # type: ignore[arg-type]
        shift_along_axis=None
        if shift_along_axis_mm is None
        else 1e-3 * shift_along_axis_mm,
        limit_position=1e-3 * limit_mm,
        limit_angle=math.radians(limit_deg),
        seed=seed,
    )
    click.echo(
        json.dumps(solved_json(solved), indent=1) if as_json else solved_text(solved)
    )
    sys.exit(EXIT_CODES[solved.verdict.outcome])
