"""A session judged again from its files, none of which is changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from handeye_tri.errors import StorageError
from handeye_tri.pipeline.evaluation import (
    judge_session,
    judged_track,
    track_json,
    verdict_json,
)
from handeye_tri.pipeline.execution import Stage, inputs_of
from handeye_tri.pipeline.run import Run

# What the verdict is drawn from.
_NEEDED = ("plan", "detect", "cameras", "hand_eye")


def check_session(run: Run, stages: Mapping[str, Stage]) -> dict[str, Any]:
    """Verify every recorded file and judge the session again.

    Args:
        run: The session.
        stages: All stages, in order.

    Returns:
        The keys of evaluation.json that the verdict consists of ("verdict",
        "sentence", "nearest", "simulated", "gates", "findings", "track"), and
        "files_verified", how many files have the SHA-256 that was recorded; "stale",
        stages whose inputs changed since, each with why and the command;
        "recorded_verdict", that of evaluation.json, None where there is none.

    Raises:
        StorageError: files are missing or were changed (names all of them), or the
            session is not calibrated.
        HandEyeError: the files cannot be judged.
    """
    header = run.folder.header
    absent = [name for name in _NEEDED if name not in header["stages"]]
    if absent:
        verb = stages[absent[0]].verb
        raise StorageError(
            f"{run.folder.path}: the stage {absent[0]!r} is needed first; run: "
            f"handeye-tri {verb} {run.folder.path}"
        )
    done = [stage for stage in stages.values() if stage.name in header["stages"]]
    damaged, verified = [], 0
    for stage in done:
        for name, why in run.folder.verified(stage.name):
            verified += 1
            if why:
                damaged.append(f"{name} {why} (handeye-tri {stage.verb})")
    if damaged:
        raise StorageError(
            f"{run.folder.path}: {len(damaged)} of {verified} files are not as "
            f"recorded: {'; '.join(damaged)}. Run the named command to have them again"
        )
    session, hand_eye = run.session(), run.hand_eye()
    judged = judged_track(run, session, hand_eye, run.progress.advance)
    recorded = run.evaluation() if "evaluate" in header["stages"] else None
    return {
        **verdict_json(judge_session(run, judged)),
        "simulated": session.simulated,
        "track": track_json(judged),
        "files_verified": verified,
        "stale": _stale(run, done),
        "recorded_verdict": None if recorded is None else recorded["verdict"],
    }


def _stale(run: Run, done: list[Stage]) -> list[dict[str, str]]:
    """Stages that would come out otherwise now, as far as their inputs say."""
    found = []
    for stage in done:
        try:
            state, why = run.folder.state(stage.name, inputs_of(run, stage))
        except StorageError as error:
            state, why = "stale", str(error)
        if state == "stale":
            command = f"handeye-tri {stage.verb} {run.folder.path}"
            found.append({"stage": stage.name, "why": why, "command": command})
    return found
