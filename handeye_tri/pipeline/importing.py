"""A real robot's data as a session that the later stages take."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from handeye_tri import storage
from handeye_tri.config import Cell, CellToCalibrate
from handeye_tri.counting import counted
from handeye_tri.diagnose.pose_pairs import PLAUSIBLE_SPREAD
from handeye_tri.errors import InputError
from handeye_tri.exchange.capture import Capture
from handeye_tri.exchange.half_turns import (
    FoundTurns,
    Turn,
    TurnTolerance,
    find_half_turns,
    named_turns,
    parse_pairs,
    parse_stations,
)
from handeye_tri.pipeline.execution import inputs_of
from handeye_tri.pipeline.run import METHODS, PLAN_SCHEMA, Progress, Run, software
from handeye_tri.pipeline.stages import stages_of
from handeye_tri.records import Floats, HalfTurn, Plan, Station, ToolChange
from handeye_tri.storage import SessionFolder, codec

# Fewer half-turns determine no camera (Zhao, Liu and Zhang 2008, Sec. III-A).
_LEAST_TURNS = 2


@dataclass(frozen=True, slots=True)
class Source:
    """Where a session comes from.

    Attributes:
        format: Name of the importer.
        path: What was read.
        command: The command that reads it again.
    """

    format: str
    path: str
    command: str


@dataclass(frozen=True, slots=True, eq=False)
class Corrections:
    """What the user says of the stations.

    Attributes:
        half_turns: Pairs instead of those found, such as "0-1,2-3"; None to find them.
        held_out: Stations for the test, such as "12-17"; None: those of no half-turn.
        tolerance: What counts as a half-turn where they are found.
        tool_change: The first station with the cell's second mount; None: there is
            none.
    """

    half_turns: str | None
    held_out: str | None
    tolerance: TurnTolerance
    tool_change: int | None = None


def import_session(
    out: Path,
    cell: CellToCalibrate,
    capture: Capture,
    corrections: Corrections,
    source: Source,
    progress: Progress,
    *,
    cell_file: str,
    model_file: str,
    others: Callable[[], Iterable[tuple[str, Floats]]] = tuple,
) -> list[str]:
    """Write a session; poses and half-turns are checked before the first file.

    Args:
        out: A new or empty folder, or that of an import that did not end.
        cell: What is calibrated.
        capture: The stations with their images.
        corrections: What the user says of them.
        source: Where they come from.
        progress: Told of every image.
        cell_file: Path of the cell's description, or what held it.
        model_file: Path of the robot's model; "" where there is none.
        others: What else the poses' numbers could mean, see
            :class:`handeye_tri.pipeline.sources.Found`.

    Returns:
        What was found, in lines for the user.

    Raises:
        InputError: too few half-turns, poses that no robot makes, an image of the
            wrong size, or a tool change that is not stated or not possible.
        StorageError: the folder holds something else, or an image is damaged.
    """
    base_from_flange = np.array([s.base_from_flange.matrix for s in capture.shots])
    mounts = _mounts(cell, corrections.tool_change, len(base_from_flange))
    turns, lines = _half_turns(base_from_flange, mounts, cell, corrections, others)
    _check_spread(base_from_flange)
    held_out = _held_out(turns, len(base_from_flange), corrections.held_out)
    plan = _plan(capture, mounts, turns, held_out, cell)
    folder = _folder(out, cell, source, cell_file, model_file, len(turns))
    run = Run(folder, progress)
    with folder.locked():
        folder.save()
        storage.write_json(
            folder.file("plan.json"),
            {"schema": PLAN_SCHEMA, **codec.plan_to_json(plan)},
        )
        images = _write_images(run, cell, capture)
        stages = stages_of(run)
        for name, outputs in (("plan", ["plan.json"]), ("simulate", images)):
            line = f"imported from {source.path}"
            folder.record(name, inputs_of(run, stages[name]), outputs, line)
    lines += [f"note: {remark}" for remark in capture.remarks]
    test = ", ".join(map(str, held_out)) or "none: half-turns are held out in turn"
    return [
        f"{counted(len(capture.shots), 'station')}, {counted(len(images), 'image')}",
        *lines,
        f"held out for the test: {test} (--held-out)",
    ]


def _check_spread(base_from_flange: Floats) -> None:
    """Raise InputError where no robot can have made the poses."""
    spread = float(np.linalg.norm(np.ptp(base_from_flange[:, :3, 3], axis=0)))
    least, most = PLAUSIBLE_SPREAD
    if not least <= spread <= most:
        raise InputError(
            f"the flange's positions spread over {spread:.4g} m, where robots that "
            f"calibrate move by {least:g} to {most:g} m: is the unit of length, m or "
            "mm, the one that the robot's numbers are in?"
        )


def _mounts(cell: CellToCalibrate, tool_change: int | None, count: int) -> list[range]:
    """The stations of each mount."""
    if cell.second_mount is None:
        if tool_change is not None:
            raise InputError(
                f"--tool-change {tool_change}: cell {cell.name} has one mount; leave "
                "it out, or state second_mount in the cell"
            )
        return [range(count)]
    if tool_change is None:
        raise InputError(
            f"cell {cell.name} has two mounts; say which station, counted from 0, is "
            "the first with the second one: --tool-change STATION"
        )
    if not 0 < tool_change < count:
        raise InputError(
            f"--tool-change {tool_change}: it must be one of the stations 1 to "
            f"{count - 1}, so that each mount has some"
        )
    return [range(tool_change), range(tool_change, count)]


def _other_reading(
    others: Callable[[], Iterable[tuple[str, Floats]]],
    mounts: Sequence[range],
    tolerance: TurnTolerance,
) -> str:
    """By which other reading there would be half-turns, or what else to do."""
    least, most = PLAUSIBLE_SPREAD
    best, words = _LEAST_TURNS - 1, ""
    for options, poses in others():
        spread = float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)))
        if not least <= spread <= most:
            continue
        count = sum(
            len(find_half_turns(poses, tolerance, stations).turns)
            for stations in mounts
        )
        if count > best:
            best, words = count, options
    if words:
        return f"read by {words} there would be {best}: is that what the numbers mean?"
    return (
        "name them with --half-turns, widen --turn-tolerance, or see whether the poses "
        "are in the format, unit and direction that were stated"
    )


def _half_turns(
    base_from_flange: Floats,
    mounts: Sequence[range],
    cell: CellToCalibrate,
    corrections: Corrections,
    others: Callable[[], Iterable[tuple[str, Floats]]],
) -> tuple[tuple[Turn, ...], list[str]]:
    """The half-turns, and what to tell of them."""
    tolerance = corrections.tolerance
    named = None
    if corrections.half_turns is not None:
        pairs = parse_pairs(corrections.half_turns, "--half-turns")
        named = named_turns(base_from_flange, pairs, "--half-turns")
        _check_mounts(named, mounts)
    turns: list[Turn] = []
    rejected: list[str] = []
    lines: list[str] = []
    for number, (stations, axis) in enumerate(zip(mounts, cell.axes, strict=True), 1):
        if named is None:
            found = find_half_turns(base_from_flange, tolerance, stations)
        else:
            own = tuple(turn for turn in named if turn.before in stations)
            found = FoundTurns(own, (), np.zeros(3), np.zeros(3))
        turns += found.turns
        rejected += found.others
        where = f"mount {number}: " if len(mounts) > 1 else ""
        lines.append(
            f"{where}{counted(len(found.turns), 'half-turn')} about {axis} "
            f"{'found in the poses' if named is None else 'as named'} (--half-turns):"
        )
        lines += _turn_lines(found, cell, tolerance, named=named is not None)
    if len(turns) < _LEAST_TURNS:
        raise InputError(
            f"{counted(len(turns), 'half-turn')} among "
            f"{counted(len(base_from_flange), 'station')}, at least "
            f"{_LEAST_TURNS} are needed; "
            + ("; ".join(rejected[:3]) + "; " if rejected else "")
            + _other_reading(others, mounts, tolerance)
        )
    return tuple(turns), lines


def _check_mounts(turns: Sequence[Turn], mounts: Sequence[range]) -> None:
    """Raise InputError where a half-turn goes on over the tool change."""
    for turn in turns:
        if not any(turn.before in own and turn.after in own for own in mounts):
            raise InputError(
                f"--half-turns: {turn.before}-{turn.after} goes on over the tool "
                f"change before station {mounts[-1].start}; a half-turn is made with "
                "one mount"
            )


def _turn_lines(
    found: FoundTurns, cell: CellToCalibrate, tolerance: TurnTolerance, *, named: bool
) -> list[str]:
    """The half-turns of a mount, what is none, and their axis where they were found."""
    lines = [
        f"  {turn.before}-{turn.after}: {180 - np.degrees(turn.miss):.3f} deg, "
        f"{1e3 * turn.pitch:+.3f} mm along the axis"
        for turn in found.turns
    ]
    lines += [f"  not {text}" for text in found.others]
    if named or not found.turns:
        return lines
    axis = " ".join(f"{value:+.3f}" for value in found.axis)
    foot = " ".join(f"{value:+.2f}" for value in 1e3 * found.foot)
    lines.append(f"  their axis in the flange: {axis} through {foot} mm")
    off = float(np.degrees(np.arccos(min(1.0, abs(found.axis[2])))))
    if isinstance(cell, Cell) and off > np.degrees(tolerance.angle):
        lines.append(
            f"  note: the cell has the rig's axis along the flange's z, this is "
            f"{off:.1f} deg off it"
        )
    return lines


def _held_out(turns: Sequence[Turn], count: int, text: str | None) -> list[int]:
    paired = {station for turn in turns for station in (turn.before, turn.after)}
    if text is None:
        return [j for j in range(count) if j not in paired]
    held_out = parse_stations(text, count, "--held-out")
    both = sorted(paired & set(held_out))
    if both:
        raise InputError(
            f"--held-out: station {both[0]} belongs to a half-turn; leave it in, or "
            "name the half-turns without it (--half-turns)"
        )
    return held_out


def _plan(
    capture: Capture,
    mounts: Sequence[range],
    turns: Sequence[Turn],
    held_out: list[int],
    cell: CellToCalibrate,
) -> Plan:
    carried = [k for k, stations in enumerate(mounts) for _ in stations]
    nowhere = np.zeros(0)
    return Plan(
        stations=tuple(
            Station(
                j,
                "evaluation" if j in held_out else "calibration",
                shot.joints,
                shot.base_from_flange,
                carried[j],
            )
            for j, shot in enumerate(capture.shots)
        ),
        half_turns=tuple(
            HalfTurn(turn.before, turn.after, cell.axes[carried[turn.before]])
            for turn in turns
        ),
        rejected={},
        certificate={},
        seed=0,
        outcome="CANNOT TELL",
        findings=("the stations were imported, nothing was planned for them",),
        # Where the robot waited is not in the data.
        tool_change=ToolChange(mounts[1].start, nowhere, np.zeros((0, 0)))
        if len(mounts) > 1
        else None,
    )


def _folder(
    out: Path,
    cell: CellToCalibrate,
    source: Source,
    cell_file: str,
    model_file: str,
    half_turns: int,
) -> SessionFolder:
    header: dict[str, Any] = {
        "schema": storage.SESSION_SCHEMA,
        "software": software(),
        "cell": cell.model_dump(mode="json", by_alias=True),
        "cell_file": cell_file,
        "model_file": model_file,
        "seed": 0,
        "half_turns": half_turns,
        "method": METHODS[0],
        "simulated": False,
        "source": {
            "format": source.format,
            "path": source.path,
            "command": source.command,
        },
        "stages": {},
    }
    started = (out / "session.json").is_file()
    if started:
        old = SessionFolder.open(out)
        if "source" not in old.header or "simulate" in old.header["stages"]:
            raise InputError(
                f"{out}: this folder holds a session already; choose a new or empty "
                "one with -o"
            )
        return SessionFolder(out, header)
    return SessionFolder.prepare(out, header)


def _write_images(run: Run, cell: CellToCalibrate, capture: Capture) -> list[str]:
    sizes = {camera.name: camera.image_size_px for camera in cell.cameras}
    total = sum(len(shot.pictures) for shot in capture.shots)
    names: list[str] = []
    for j, shot in enumerate(capture.shots):
        for camera, read in shot.pictures.items():
            image = read()
            if image.shape[1::-1] != sizes[camera]:
                raise InputError(
                    f"camera {camera}, station {j} ({shot.origin}): the image is "
                    f"{image.shape[1]} x {image.shape[0]} pixels, the cell says "
                    f"{sizes[camera][0]} x {sizes[camera][1]}"
                )
            name = run.image_name(camera, j)
            storage.write_image(run.folder.file(name), image)
            names.append(name)
            run.progress.advance(len(names), total)
    return names
