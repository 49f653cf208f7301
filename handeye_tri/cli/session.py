"""Verbs on a session: all its stages, or one of them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from handeye_tri.cli.group import (
    AGAIN,
    EXIT_CODES,
    SESSION,
    commands,
    example,
    seed_option,
)
from handeye_tri.cli.progress import StderrProgress, cap_threads
from handeye_tri.counting import counted

if TYPE_CHECKING:
    from handeye_tri.pipeline import Run
    from handeye_tri.storage import SessionFolder


def _work(folder: SessionFolder, verbs: tuple[str, ...], *, again: bool) -> Run:
    from handeye_tri.pipeline import Run, execute, stages_of

    cap_threads()
    progress = StderrProgress()
    run = Run(folder, progress)
    try:
        with folder.locked():
            execute(run, stages_of(run), verbs, again=again)
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


@commands.command(epilog=example("handeye-tri run hp3_stereo -o out --seed 1"))
@click.argument("cell", default="hp3_stereo")
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(path_type=Path),
    help="The session's folder; made where it is absent.",
)
@seed_option("Seed of all randomness.")
@click.option(
    "--half-turns",
    type=click.IntRange(min=2),
    help="How many half-turns to plan.  [default: as the cell says]",
)
@click.option("--json", "as_json", is_flag=True, help="Print evaluation.json only.")
def run(
    cell: str, output: Path, seed: int, half_turns: int | None, as_json: bool
) -> None:
    """Do everything, from plan to report, on rendered images.

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


@commands.command(epilog=example("handeye-tri plan out --cell hp3_stereo --seed 1"))
@SESSION
@click.option("--cell", help="Start a new session for this cell.")
@seed_option("Seed of a new session.")
@click.option(
    "--half-turns", type=click.IntRange(min=2), help="Half-turns of a new session."
)
@click.option(
    "--certify",
    type=click.Path(path_type=Path),
    help="Judge the stations of this CSV file (columns such as s_deg) instead.",
)
@click.option(
    "--next",
    "more",
    type=click.IntRange(min=1),
    help="Plan so many half-turns more, for what was detected so far: next.csv.",
)
@click.option("--json", "as_json", is_flag=True, help="Print plan.json only.")
@AGAIN
def plan(
    session: Path,
    cell: str | None,
    seed: int,
    half_turns: int | None,
    certify: Path | None,
    more: int | None,
    as_json: bool,
    again: bool,
) -> None:
    """Plan the robot's stations, and say what they promise.

    Before it moves: reachable, visible, free of collision, and chosen for the least
    track error. plan.rrd shows the arm on its way, and what the cameras will see.
    """
    import json

    from handeye_tri import storage
    from handeye_tri.pipeline import PLAN_SCHEMA, start
    from handeye_tri.pipeline.preview import write_plan_recording
    from handeye_tri.summary import plan_text

    if certify is not None and cell is None:
        raise click.UsageError("--certify needs --cell: which arm, rig and cameras?")
    if more is not None:
        _plan_more(session, more)
    folder = (
        storage.SessionFolder.open(session)
        if cell is None
        else start(cell, session, seed, half_turns, certify)
    )
    finished = _work(folder, ("plan",), again=again)
    made = finished.plan()
    if as_json:
        data = storage.read_json(finished.folder.file("plan.json"), PLAN_SCHEMA)
        click.echo(json.dumps(data, indent=1, ensure_ascii=False))
    else:
        click.echo(plan_text(made, finished.cell))
    if finished.is_designed and finished.has_robot:
        path, missing = write_plan_recording(finished)
        click.echo(f"wrote {path}: handeye-tri replay {session} --plan", err=True)
        if missing:
            click.echo(f"its views are outlines: {missing}", err=True)
    sys.exit(EXIT_CODES[made.outcome])


def _plan_more(session: Path, more: int) -> None:
    """Print what half-turns to add, and leave with the verdict's exit code."""
    from handeye_tri.pipeline import Run
    from handeye_tri.pipeline.programme import plan_more
    from handeye_tri.storage import SessionFolder
    from handeye_tri.summary import plan_text

    cap_threads()
    progress = StderrProgress()
    run = Run(SessionFolder.open(session), progress)
    try:
        with run.folder.locked():
            progress.begin(1, 1, "plan")
            made, path = plan_more(run, more)
    finally:
        progress.close()
    click.echo(plan_text(made, run.cell))
    click.echo(f"\nWROTE  {path}  {counted(len(made.stations), 'station')}")
    sys.exit(EXIT_CODES[made.outcome])


def _verb(name: str, text: str) -> None:
    """Add a verb that runs one stage of an existing session."""

    @commands.command(name, help=text, epilog=example(f"handeye-tri {name} out"))
    @SESSION
    @AGAIN
    def command(session: Path, again: bool) -> None:
        from handeye_tri.storage import SessionFolder

        finished = _work(SessionFolder.open(session), (name,), again=again)
        if name == "evaluate":
            _conclude(finished, as_json=False)


_verb("simulate", "Execute the plan in the simulator and render every view.")
_verb("evaluate", "Compare the robot's track with the cameras', held out.")
_verb("report", "Write the recording (replay.rrd) and report.html.")


@commands.command(epilog=example("handeye-tri detect out --debug sheets"))
@SESSION
@click.option(
    "--debug",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Write there, view by view, a picture of what was taken for what.",
)
@AGAIN
def detect(session: Path, debug: Path | None, again: bool) -> None:
    """Find the three markers in every image, with their covariance."""
    from handeye_tri.storage import SessionFolder

    finished = _work(SessionFolder.open(session), ("detect",), again=again)
    if debug is not None:
        from handeye_tri.pipeline.sheets import write_sheets

        progress = StderrProgress()
        progress.begin(1, 1, "sheets")
        try:
            count = write_sheets(finished, debug, progress.advance)
        finally:
            progress.close()
        click.echo(f"wrote {count} sheets to {debug}")


def _robot_errors(
    _context: click.Context, _option: click.Parameter, value: str | None
) -> tuple[str, ...]:
    """Read the value of --robot."""
    from handeye_tri.pipeline.run import ROBOT_ERRORS

    asked = tuple(value.split(",")) if value else ()
    if "clock-offset" in asked:
        raise click.BadParameter(
            "no session tells clock-offset: the robot stands still at its stations, so "
            "that a late image shows the same; record both streams while the robot "
            "moves and give every pose its time_s for handeye-tri solve, which finds "
            "the offset (in Python adjust takes clock_offset(velocities), too)"
        )
    unknown = [name for name in asked if name not in ROBOT_ERRORS]
    if unknown:
        raise click.BadParameter(
            f"{', '.join(unknown)}: give {' or '.join(ROBOT_ERRORS)}, or both"
        )
    return asked


@commands.command(epilog=example("handeye-tri calibrate out --method separate"))
@SESSION
@click.option(
    "--method",
    type=click.Choice(["joint", "separate"]),
    default="joint",
    show_default=True,
    help="Adjust cameras, markers and robot together, or step by step as the paper.",
)
@click.option(
    "--robot",
    "robot_errors",
    callback=_robot_errors,
    metavar="ERRORS",
    help="Estimate systematic errors of the robot too, where the data determine them: "
    "joint-offsets, link-corrections, or both with a comma.",
)
@AGAIN
def calibrate(
    session: Path, method: str, robot_errors: tuple[str, ...], again: bool
) -> None:
    """Calibrate the cameras, their places and the markers'."""
    from handeye_tri.storage import SessionFolder

    folder = SessionFolder.open(session)
    folder.header["method"] = method
    folder.header.pop("robot_errors", None)
    if robot_errors:
        folder.header["robot_errors"] = list(robot_errors)
    _work(folder, ("calibrate",), again=again)


@commands.command(epilog=example("handeye-tri check out", "echo $?"))
@SESSION
@click.option("--json", "as_json", is_flag=True, help="Print JSON only.")
def check(session: Path, as_json: bool) -> None:
    """Verify a session's files and judge it again; changes nothing.

    The exit code is the verdict's: 0 PASS, 3 FAIL, 4 CANNOT TELL; 2 where a file is
    missing or is not the one that was recorded.
    """
    import json

    from handeye_tri.pipeline import Run, stages_of
    from handeye_tri.pipeline.checking import check_session
    from handeye_tri.storage import SessionFolder
    from handeye_tri.summary import check_text

    cap_threads()
    progress = StderrProgress()
    progress.begin(1, 1, "check")
    try:
        run = Run(SessionFolder.open(session), progress)
        checked = check_session(run, stages_of(run))
    finally:
        progress.close()
    click.echo(
        json.dumps(checked, indent=1, ensure_ascii=False)
        if as_json
        else check_text(checked)
    )
    sys.exit(EXIT_CODES[checked["verdict"]])


@commands.command(epilog=example("handeye-tri replay out --screenshot out.png"))
@SESSION
@click.option("--plan", is_flag=True, help="Show the plan instead: the arm moving.")
@click.option("--serve", is_flag=True, help="Serve it to a browser, on loopback only.")
@click.option(
    "--screenshot",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write a picture of it instead; needs no display.",
)
@click.option(
    "--station", type=int, help="Station to show instead of the one named below."
)
@click.option("--step", type=int, help="Solver step to show instead, from 0.")
@click.option(
    "--blueprint",
    type=click.Choice(["overview", "cameras", "track"]),
    help="Which tab to show.",
)
def replay(
    session: Path,
    plan: bool,
    serve: bool,
    screenshot: Path | None,
    station: int | None,
    step: int | None,
    blueprint: str | None,
) -> None:
    """Show a session's recording.

    It begins at a station that the first finding is about, else at the worst used.
    """
    if serve and (station, step, blueprint) != (None, None, None):
        raise click.UsageError(
            "--station, --step and --blueprint are chosen in the page with --serve"
        )
    from handeye_tri import replay as recording
    from handeye_tri.errors import StorageError
    from handeye_tri.storage import SessionFolder

    folder = SessionFolder.open(session)
    if plan:
        path = folder.file("plan.rrd")
        if not path.is_file():
            raise StorageError(
                f"{path}: this file is missing; run: handeye-tri plan {session}"
            )
    else:
        folder.require("report")
        path = folder.file("replay.rrd")
    if screenshot is not None:
        problems = recording.screenshot(
            path,
            screenshot,
            station=station,
            step=step,
            blueprint=blueprint or recording.BLUEPRINTS[0],
        )
        for problem in problems:
            click.echo(f"view error: {problem}", err=True)
        click.echo(f"wrote {screenshot}")
    elif serve:
        recording.serve(path)
    else:
        recording.open_viewer(path, station, blueprint or recording.BLUEPRINTS[0], step)
