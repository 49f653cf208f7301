"""Faults put into a rendered cell, and what the diagnosis names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from handeye_tri import simulate, storage
from handeye_tri.adjustment import RobotParameters, adjust, joint_offsets
from handeye_tri.arm import Arm
from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.diagnose import (
    Evidence,
    Verdict,
    assess,
    session_causes,
    uncalibrated_verdict,
    why_uncalibrated,
    with_causes,
)
from handeye_tri.errors import HandEyeError, InputError
from handeye_tri.evaluate import evaluate_track
from handeye_tri.experiments.faulty_cell import INJECTIONS
from handeye_tri.experiments.rendered_cell import Observed, RenderedCell
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.plan import plan_motions
from handeye_tri.simulate import compile_mechanism

SCHEMA = "handeye_tri.faults/1"
# Name of the random stream that draws a fault.
_FAULT_STREAM = 301


@dataclass(frozen=True, slots=True)
class Fault:
    """A kind of fault.

    Attributes:
        name: What it is called; one of INJECTIONS.
        code: The finding that must be named first.
        ranges: What is drawn, by its name with its unit.
        mounts: With how many mounts a cell can have it.
    """

    name: str
    code: str
    ranges: Mapping[str, tuple[float, float]]
    mounts: tuple[int, ...] = (1, 2)


def read_faults(path: Path) -> tuple[str, tuple[Fault, ...]]:
    """The cell, and the faults, that a file describes.

    Raises:
        StorageError: the file is missing or not readable.
        InputError: it is of another schema, or names a fault that there is not.
    """
    data = storage.read_structured(path)
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise InputError(f"{path}: schema must be {SCHEMA}")
    unknown = sorted(set(data["faults"]) - set(INJECTIONS))
    if unknown:
        raise InputError(
            f"{path}: there is no fault {unknown[0]!r}; there are "
            f"{', '.join(INJECTIONS)}"
        )
    faults = tuple(
        Fault(
            name,
            str(entry["code"]),
            {
                key: (float(ends[0]), float(ends[1]))
                for key, ends in entry["ranges"].items()
            },
            tuple(entry.get("mounts", (1, 2))),
        )
        for name, entry in data["faults"].items()
        for ranges in (entry["ranges"],)
    )
    return str(data["cell"]), faults


def rendered_cell(cell_name: str, seed: int) -> RenderedCell:
    """A healthy cell: planned, executed, photographed."""
    path = storage.find_cell(cell_name)
    cell = storage.read_cell(path)
    model_path = storage.find_model(cell, path)
    arms = [Arm(compile_mechanism(one, model_path)) for one in cell.mounted]
    plan = plan_motions(cell, arms, seed, half_turns=cell.plan.half_turns)
    joints = simulate.execute(arms[0], plan, cell.repeatability, seed)
    rendered = RenderedCell(cell, model_path, arms[0], plan, joints, seed)
    rendered.photograph()
    return rendered


def judged(cell: RenderedCell, observed: Observed) -> dict[str, Any]:
    """Calibrate and judge as the stages do: outcome, codes, track over prediction.

    Returns:
        "outcome"; "codes" and "text" of the findings in order; "causes", the codes of
        those that follow from no other one; "ratio" of the held-out track to its
        prediction, None where calibration gave up.
    """
    session, limits = observed.session, cell.cell
    spread = float(np.radians(limits.plan.min_plane_spread_deg))
    joints = _joints(cell, session.stations)
    try:
        cameras = calibrate_session_cameras(session)
        dropped = cameras.details["dropped"]
        used = session.without(dropped)
        hand_eye = adjust(used, calibrate_hand_eye(used, cameras))
        track = evaluate_track(hand_eye, used)
        verdict = assess(
            used,
            cameras,
            hand_eye,
            track,
            track_limit=1e-3 * limits.track_limit_mm,
            min_plane_spread=spread,
        )
        evidence = Evidence(session, hand_eye, dropped, joints, observed.edges)
        verdict = with_causes(verdict, session_causes(evidence))
    except HandEyeError as error:
        findings = why_uncalibrated(
            session, min_plane_spread=spread, joints=joints, edges=observed.edges
        )
        return {**_told(uncalibrated_verdict(error, findings)), "ratio": None}
    return {**_told(verdict), "ratio": track.rms / track.predicted_rms}


def _told(verdict: Verdict) -> dict[str, Any]:
    return {
        "outcome": verdict.outcome,
        "codes": [one.code for one in verdict.findings],
        "causes": [one.code for one in verdict.findings if not one.follows],
        "text": [f"{one.cause}; {one.evidence}" for one in verdict.findings]
        or [verdict.sentence],
    }


def _joints(cell: RenderedCell, stations: Sequence[Any]) -> RobotParameters:
    joints = np.array([station.joints for station in stations])
    return joint_offsets(cell.arm.joint_names, cell.arm.jacobian(joints))


def trial(seed: int, cell_name: str, faults: Sequence[Fault]) -> dict[str, Any]:
    """One seed: the healthy cell, and the same cell with each fault.

    Returns:
        What :func:`judged` says, by the fault's name; "healthy" for none. Faults
        that the cell cannot have are left out.
    """
    cell = rendered_cell(cell_name, seed)
    found = {"healthy": judged(cell, cell.observed())}
    for fault in faults:
        if len(cell.cell.mounted) not in fault.mounts:
            continue
        rng = np.random.default_rng(
            [seed, _FAULT_STREAM, list(INJECTIONS).index(fault.name)]
        )
        observed = INJECTIONS[fault.name](cell, fault.ranges, rng)
        found[fault.name] = judged(cell, observed)
    return found
