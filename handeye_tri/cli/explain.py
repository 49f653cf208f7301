"""The verb that explains a finding."""

from __future__ import annotations

import click

from handeye_tri.cli.group import commands, example


@commands.command(epilog=example("handeye-tri explain HALF_TURN"))
@click.argument("code")
def explain(code: str) -> None:
    """Say what stands behind a finding: causes, numbers, what to do.

    CODE is the word at the start of a finding, such as LOOP or SCALE.
    """
    from functools import partial
    from textwrap import fill as fill_text

    from handeye_tri.diagnose.explanations import explain as explanation_of

    text = explanation_of(code)
    # Options must not be broken at their hyphens.
    fill = partial(fill_text, width=88, break_on_hyphens=False)

    def listed(items: tuple[str, ...], marks: list[str]) -> str:
        return "\n".join(
            fill(item, initial_indent=f"  {mark} ", subsequent_indent="    ")
            for mark, item in zip(marks, items, strict=True)
        )

    causes = listed(text.causes, ["-"] * len(text.causes))
    steps = listed(text.remedy, [str(k + 1) for k in range(len(text.remedy))])
    click.echo(f"{code.strip().upper().replace('-', '_')}")
    click.echo(fill(text.says))
    click.echo(f"\nLIKELY CAUSES\n{causes}")
    for title, body in (("NUMBERS", text.numbers), ("INVALIDATES", text.invalidates)):
        indented = fill(body, initial_indent="  ", subsequent_indent="  ")
        click.echo(f"\n{title}\n{indented}")
    click.echo(f"\nDO\n{steps}")
