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
from handeye_tri.records import Floats, HalfTurn, Plan, Station
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
    """

    half_turns: str | None
    held_out: str | None
    tolerance: TurnTolerance


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
        InputError: too few half-turns, poses that no robot makes, or an image of the
            wrong size.
        StorageError: the folder holds something else, or an image is damaged.
    """
    base_from_flange = np.array([s.base_from_flange.matrix for s in capture.shots])
    turns, lines = _half_turns(base_from_flange, cell, corrections, others)
    _check_spread(base_from_flange)
    held_out = _held_out(turns, len(base_from_flange), corrections.held_out)
    plan = _plan(capture, turns, held_out, cell)
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


def _other_reading(
    others: Callable[[], Iterable[tuple[str, Floats]]], tolerance: TurnTolerance
) -> str:
    """By which other reading there would be half-turns, or what else to do."""
    least, most = PLAUSIBLE_SPREAD
    best, words = _LEAST_TURNS - 1, ""
    for options, poses in others():
        spread = float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)))
        if not least <= spread <= most:
            continue
        count = len(find_half_turns(poses, tolerance).turns)
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
    cell: CellToCalibrate,
    corrections: Corrections,
    others: Callable[[], Iterable[tuple[str, Floats]]],
) -> tuple[tuple[Turn, ...], list[str]]:
    """The half-turns, and what to tell of them."""
    named = corrections.half_turns is not None
    if corrections.half_turns is not None:
        pairs = parse_pairs(corrections.half_turns, "--half-turns")
        turns = named_turns(base_from_flange, pairs, "--half-turns")
        found = FoundTurns(turns, (), np.zeros(3), np.zeros(3))
    else:
        found = find_half_turns(base_from_flange, corrections.tolerance)
    lines = [
        f"{counted(len(found.turns), 'half-turn')} about {cell.rig.axis} "
        f"{'as named' if named else 'found in the poses'} (--half-turns):"
    ]
    lines += [
        f"  {turn.before}-{turn.after}: {180 - np.degrees(turn.miss):.3f} deg, "
        f"{1e3 * turn.pitch:+.3f} mm along the axis"
        for turn in found.turns
    ]
    lines += [f"  not {text}" for text in found.others]
    if len(found.turns) < _LEAST_TURNS:
        raise InputError(
            f"{counted(len(found.turns), 'half-turn')} among "
            f"{counted(len(base_from_flange), 'station')}, at least "
            f"{_LEAST_TURNS} are needed; "
            + ("; ".join(found.others[:3]) + "; " if found.others else "")
            + _other_reading(others, corrections.tolerance)
        )
    if not named:
        axis = " ".join(f"{value:+.3f}" for value in found.axis)
        foot = " ".join(f"{value:+.2f}" for value in 1e3 * found.foot)
        lines.append(f"  their axis in the flange: {axis} through {foot} mm")
        off = float(np.degrees(np.arccos(min(1.0, abs(found.axis[2])))))
        if isinstance(cell, Cell) and off > np.degrees(corrections.tolerance.angle):
            lines.append(
                f"  note: the cell has the rig's axis along the flange's z, this is "
                f"{off:.1f} deg off it"
            )
    return found.turns, lines


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
    capture: Capture, turns: Sequence[Turn], held_out: list[int], cell: CellToCalibrate
) -> Plan:
    return Plan(
        stations=tuple(
            Station(
                j,
                "evaluation" if j in held_out else "calibration",
                shot.joints,
                shot.base_from_flange,
            )
            for j, shot in enumerate(capture.shots)
        ),
        half_turns=tuple(HalfTurn(t.before, t.after, cell.rig.axis) for t in turns),
        rejected={},
        certificate={},
        seed=0,
        outcome="CANNOT TELL",
        findings=("the stations were imported, nothing was planned for them",),
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
