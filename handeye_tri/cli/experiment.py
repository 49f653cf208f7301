"""The verb that does the paper's experiments again."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from handeye_tri import experiments
from handeye_tri.cli.group import EXIT_CODES, commands, example
from handeye_tri.cli.progress import TimeLeft, cap_threads


@commands.command(
    epilog=example("handeye-tri experiment fig05 -o out --trials 200 --jobs 2")
)
@click.argument("name", type=click.Choice([*experiments.NAMES, "paper"]))
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder of tables, plots and verdicts.",
)
@click.option("--trials", default=100, show_default=True, help="Trials per setting.")
@click.option("--jobs", default=1, show_default=True, help="Processes; -1: all cores.")
@click.option("--dask", metavar="ADDRESS", help="Dask scheduler to run on instead.")
@click.option(
    "--images",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Chessboard views left01.jpg, right01.jpg ..., also for table1 and fig09.",
)
def experiment(
    name: str,
    output: Path,
    trials: int,
    jobs: int,
    dask: str | None,
    images: Path | None,
) -> None:
    """Do an experiment of the paper again.

    Each leaves a table (CSV), a plot (SVG, PNG) and a line of verdict.

    NAME is a figure or table, or "paper" for all of them on one page. Trials that are
    in the folder are not done again.
    """
    from handeye_tri.experiments.outcome import Options, Outcome

    def tell(outcome: Outcome) -> None:
        click.echo(outcome.line)
        click.echo(f"  wrote {' '.join(str(path) for path in outcome.files)}")

    cap_threads()
    options = Options(output, trials, jobs, dask, images, TimeLeft())
    if name == "paper":
        outcomes = experiments.run_paper(options, tell)
        click.echo(f"wrote {output / 'index.html'}")
    else:
        outcomes = [experiments.run_experiment(name, options)]
        tell(outcomes[0])
    verdicts = [outcome.verdict for outcome in outcomes]
    sys.exit(
        next(
            (EXIT_CODES[v] for v in ("FAIL", "CANNOT TELL") if v in verdicts),
            EXIT_CODES["PASS"],
        )
    )
