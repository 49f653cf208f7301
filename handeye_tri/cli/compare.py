"""The verb that sets one session against another."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from handeye_tri.cli.group import EXIT_CODES, SESSION, commands, example
from handeye_tri.cli.progress import cap_threads
from handeye_tri.counting import counted


@commands.command(epilog=example("handeye-tri compare january july", "echo $?"))
@SESSION
@click.argument("other", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print JSON only.")
def compare(session: Path, other: Path, as_json: bool) -> None:
    """Set OTHER, the later one, against SESSION: what moved?

    The exit code is 0 where nothing changed beyond the noise of both calibrations,
    3 where something did, 4 where the two cannot tell, 2 where they are not
    sessions of one cell.
    """
    import json

    from handeye_tri.pipeline import NullProgress, Run
    from handeye_tri.pipeline.comparing import compare_sessions
    from handeye_tri.storage import SessionFolder

    cap_threads()
    before, after = (
        Run(SessionFolder.open(path), NullProgress()) for path in (session, other)
    )
    compared = compare_sessions(before, after)
    click.echo(
        json.dumps(compared, indent=1, ensure_ascii=False)
        if as_json
        else _text(compared)
    )
    sys.exit(EXIT_CODES[compared["verdict"]])


def _text(compared: Mapping[str, Any]) -> str:
    """The comparison for a person: verdict first."""
    from textwrap import wrap

    from handeye_tri.summary import digits

    before, after, placed = (compared[key] for key in ("before", "after", "placement"))
    told = {"PASS": "unchanged", "FAIL": "changed"}.get(compared["verdict"], "")
    source = "SIMULATED" if compared["simulated"] else "REAL"
    lines = [
        f"VERDICT  {compared['verdict']}      {told}".rstrip(),
        f"  cell {compared['cell']}, {source}",
        f"  before: {before['session']} ({before['verdict']})",
        f"  after:  {after['session']} ({after['verdict']})",
        *wrap(
            f"{compared['sentence']}.",
            88,
            initial_indent="  ",
            subsequent_indent="  ",
            break_on_hyphens=False,
        ),
        f"  The calibration of before places "
        f"{counted(placed['points'], 'marker')} seen after "
        f"{placed['rms_mm']:.3f} mm rms off,",
        f"  {placed['max_mm']:.3f} at worst; noise alone gives "
        f"{placed['expected_rms_mm']:.3f} rms; the cell allows "
        f"{placed['limit_mm']:.2f}.",
        "",
        f"{'WHAT MOVED':<30}{'by':<26}{'chi2/dof':>9}{'by chance':>11}  verdict",
    ]
    for change in compared["changes"]:
        amounts = []
        if change["moved_mm"]:
            amounts.append(f"{change['moved_mm']:.3f} mm")
        if change["turned_deg"]:
            amounts.append(f"{change['turned_deg']:.4f} deg")
        ratio = change["chi2"] / change["dof"] if change["dof"] else 0.0
        lines.append(
            f"  {change['part']:<28}{', '.join(amounts) or '-':<26}{ratio:>9.2f}"
            f"{change['p_value']:>11.1g}  {'CHANGED' if change['changed'] else 'same'}"
        )
    lines += [
        "",
        f"{'QUANTITY':<30}{'before':>13}{'after':>13}{'after - before':>16}"
        f"{'+- (1 sd)':>11}{'sigmas':>8}",
    ]
    for row in compared["quantities"]:
        places = digits(row["sigma"])
        name = f"{row['name']}, {row['unit']}" if row["unit"] else row["name"]
        sigmas = "-" if row["sigmas"] is None else f"{row['sigmas']:+.1f}"
        lines.append(
            f"  {name:<28}{row['before']:>13.{places}f}{row['after']:>13.{places}f}"
            f"{row['difference']:>+16.{places}f}{row['sigma']:>11.{places}f}{sigmas:>8}"
        )
    return "\n".join(lines)
