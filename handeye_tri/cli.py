"""The command line ``handeye-tri``: parsing and calls, no formula."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from handeye_tri import experiments
from handeye_tri.errors import DegenerateMotionError, HandEyeError

if TYPE_CHECKING:
    from handeye_tri.pipeline import Run
    from handeye_tri.storage import SessionFolder

EXIT_CODES = {"PASS": 0, "FAIL": 3, "CANNOT TELL": 4}
_SESSION = click.argument("session", type=click.Path(path_type=Path))
_AGAIN = click.option("--again", is_flag=True, help="Redo it even where up to date.")


class _StderrProgress:
    """Stage lines and a bar on stderr; plain lines where it is no terminal."""

    def __init__(self) -> None:
        from rich.console import Console

        self._console = Console(stderr=True, highlight=False)
        self._bar: Any = None
        self._head = ""

    def begin(self, number: int, total: int, stage: str) -> None:
        self._head = f" {number}/{total}  {stage.replace('_', '-'):<9}"

    def advance(self, done: int, total: int) -> None:
        if not self._console.is_terminal:
            return
        if self._bar is None:
            from rich.progress import (
                BarColumn,
                MofNCompleteColumn,
                Progress,
                TextColumn,
                TimeRemainingColumn,
            )

            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
                console=self._console,
                transient=True,
            )
            self._bar.start()
            self._bar.add_task(self._head, total=total)
        self._bar.update(self._bar.task_ids[0], completed=done, total=total)

    def end(self, line: str, seconds: float | None) -> None:
        self.close()
        took = "up to date" if seconds is None else f"{seconds:.1f} s"
        self._console.print(
            f"{self._head} {line}  [{took}]", markup=False, soft_wrap=True
        )

    def close(self) -> None:
        """Take the bar off the screen."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


def _example(*lines: str) -> str:
    """Epilog of a verb's help; the first character keeps click from refilling it."""
    return "\b\nExample:\n" + "\n".join(f"  {line}" for line in lines)


@click.group(
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=_example(
        "handeye-tri run hp3_stereo -o out --seed 1", "handeye-tri replay out"
    ),
)
@click.version_option(package_name="handeye-tri")
def commands() -> None:
    """Calibrate cameras and a robot arm with three markers that turn by 180 degrees."""


def _cap_threads() -> None:
    """Small problems run slower on many BLAS threads than on one."""
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)


def _work(folder: SessionFolder, verbs: tuple[str, ...], *, again: bool) -> Run:
    from handeye_tri.pipeline import STAGES, Run, execute

    _cap_threads()
    progress = _StderrProgress()
    run = Run(folder, progress)
    try:
        with folder.locked():
            execute(run, STAGES, verbs, again=again)
    finally:
        progress.close()
    return run


def _conclude(run: Run, *, as_json: bool) -> None:
    """Print the summary and leave with the verdict's exit code."""
    import json

    from handeye_tri.summary import summary_text

    evaluation = run.evaluation()
    if as_json:
        click.echo(json.dumps(evaluation, indent=1, ensure_ascii=False))
    else:
        click.echo(summary_text(evaluation, run.folder.path, run.written()))
    sys.exit(EXIT_CODES[evaluation["verdict"]])


@commands.command(epilog=_example("handeye-tri run hp3_stereo -o out --seed 1"))
@click.argument("cell", default="hp3_stereo")
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path),
    help="The session's folder; made where it is absent.",
)
@click.option("--seed", default=1, show_default=True, help="Seed of all randomness.")
@click.option(
    "--half-turns",
    type=click.IntRange(min=2),
    help="How many half-turns to plan.  [default: as the cell says]",
)
@click.option("--json", "as_json", is_flag=True, help="Print evaluation.json only.")
def run(
    cell: str, output: Path, seed: int, half_turns: int | None, as_json: bool
) -> None:
    """Plan, simulate, detect, calibrate, evaluate and report, on rendered images.

    CELL is the path of a YAML file or a name in scenes/. What is already done in
    the folder is not done again unless its inputs changed.
    """
    from handeye_tri.pipeline import VERBS, start

    folder = start(cell, output, seed, half_turns)
    click.echo(
        f"handeye-tri {folder.header['software']['handeye-tri']}    "
        f"cell {folder.cell.name}    seed {seed}    "
        "SIMULATED (truth known, used only to score)",
        err=True,
    )
    _conclude(_work(folder, VERBS, again=False), as_json=as_json)


@commands.command(epilog=_example("handeye-tri plan out --cell hp3_stereo --seed 1"))
@_SESSION
@click.option("--cell", help="Start a new session for this cell.")
@click.option("--seed", default=1, show_default=True, help="Seed of a new session.")
@click.option(
    "--half-turns", type=click.IntRange(min=2), help="Half-turns of a new session."
)
@_AGAIN
def plan(
    session: Path, cell: str | None, seed: int, half_turns: int | None, again: bool
) -> None:
    """Plan the robot's stations: reachable, visible, free of collision."""
    from handeye_tri.pipeline import start
    from handeye_tri.storage import SessionFolder

    folder = (
        SessionFolder.open(session)
        if cell is None
        else start(cell, session, seed, half_turns)
    )
    _work(folder, ("plan",), again=again)


def _verb(name: str, text: str) -> None:
    """Add a verb that runs one stage of an existing session."""

    @commands.command(name, help=text, epilog=_example(f"handeye-tri {name} out"))
    @_SESSION
    @_AGAIN
    def command(session: Path, again: bool) -> None:
        from handeye_tri.storage import SessionFolder

        finished = _work(SessionFolder.open(session), (name,), again=again)
        if name == "evaluate":
            _conclude(finished, as_json=False)


_verb("simulate", "Execute the plan in the simulator and render every view.")
_verb("detect", "Find the three markers in every image, with their covariance.")
_verb("evaluate", "Compare the robot's and the cameras' track at held-out stations.")
_verb("report", "Write the recording (replay.rrd) and report.html.")


@commands.command(epilog=_example("handeye-tri calibrate out --method separate"))
@_SESSION
@click.option(
    "--method",
    type=click.Choice(["joint", "separate"]),
    default="joint",
    show_default=True,
    help="Adjust cameras, markers and robot together, or step by step as the paper.",
)
@_AGAIN
def calibrate(session: Path, method: str, again: bool) -> None:
    """Calibrate the cameras and where they and the markers are to the robot."""
    from handeye_tri.storage import SessionFolder

    folder = SessionFolder.open(session)
    folder.header["method"] = method
    _work(folder, ("calibrate",), again=again)


@commands.command(epilog=_example("handeye-tri replay out --screenshot out.png"))
@_SESSION
@click.option("--serve", is_flag=True, help="Serve it to a browser, on loopback only.")
@click.option(
    "--screenshot",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write a picture of it instead; needs no display.",
)
@click.option("--station", type=int, help="Station to show in the picture.")
def replay(
    session: Path, serve: bool, screenshot: Path | None, station: int | None
) -> None:
    """Show a session's recording."""
    from handeye_tri import replay as recording
    from handeye_tri.storage import SessionFolder

    folder = SessionFolder.open(session)
    folder.require("report")
    path = folder.file("replay.rrd")
    if screenshot is not None:
        problems = recording.screenshot(path, screenshot, station=station)
        for problem in problems:
            click.echo(f"view error: {problem}", err=True)
        click.echo(f"wrote {screenshot}")
    elif serve:
        recording.serve(path)
    else:
        recording.open_viewer(path)


@commands.command(epilog=_example("handeye-tri solve poses.json"))
@click.argument("poses", type=click.Path(path_type=Path))
@click.option("--method", default="likelihood", show_default=True, help="Or a solver.")
@click.option(
    "--format",
    "layout",
    type=click.Choice(["poses", "moveit"]),
    default="poses",
    show_default=True,
    help="Of the file; see scripts/README.md.",
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
@click.option("--limit-mm", default=10.0, show_default=True, help="Position residual.")
@click.option("--limit-deg", default=1.0, show_default=True, help="Angle residual.")
@click.option("--seed", default=0, show_default=True, help="Of the random samples.")
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
    """Solve bare pose pairs of any robot and any target, and judge them."""
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
    _cap_threads()
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


class _TimeLeft:
    """Trials done and time left on stderr: one line, or one in ten seconds."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._next = 0.0

    def __call__(self, done: int, total: int, seconds: float) -> None:
        now = time.monotonic()
        if now < self._next and done < total:
            return
        self._next = now + (0.2 if self._terminal else 10.0)
        line = f"{done}/{total}, {int(seconds) // 60} min {int(seconds) % 60:2d} s left"
        if self._terminal:
            click.echo(f"\r{line:<40}" + "\n" * (done == total), err=True, nl=False)
        else:
            click.echo(line, err=True)


@commands.command(
    epilog=_example("handeye-tri experiment fig05 -o out --trials 200 --jobs 2")
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
    help="Chessboard views left01.jpg, right01.jpg ... for table1 and fig09.",
)
def experiment(
    name: str,
    output: Path,
    trials: int,
    jobs: int,
    dask: str | None,
    images: Path | None,
) -> None:
    """Do an experiment of the paper again: a table, a plot and a verdict.

    NAME is a figure or table, or "paper" for all of them on one page. Trials that are
    in the folder are not done again.
    """
    from handeye_tri.experiments.outcome import Options, Outcome

    def tell(outcome: Outcome) -> None:
        click.echo(outcome.line)
        click.echo(f"  wrote {' '.join(str(path) for path in outcome.files)}")

    _cap_threads()
    options = Options(output, trials, jobs, dask, images, _TimeLeft())
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


@commands.command(epilog=_example("handeye-tri doctor"))
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


if __name__ == "__main__":
    main()
