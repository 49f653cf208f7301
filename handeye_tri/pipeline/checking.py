"""A session judged again from its files, none of which is changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from handeye_tri.errors import InputError, StorageError
from handeye_tri.pipeline.evaluation import (
    judge_session,
    judged_track,
    track_json,
    verdict_json,
)
from handeye_tri.pipeline.execution import Stage, inputs_of
from handeye_tri.pipeline.failing import findings_of, why_calibration_fails
from handeye_tri.pipeline.run import Run

if TYPE_CHECKING:
    from handeye_tri.diagnose import Verdict

# What the verdict is drawn from; without the last two there may be a reason.
_OBSERVED = ("plan", "detect")
_CALIBRATED = ("cameras", "hand_eye")


def check_session(run: Run, stages: Mapping[str, Stage]) -> dict[str, Any]:
    """Verify every recorded file and judge the session again.

    Args:
        run: The session.
        stages: All stages, in order.

    Where it is not calibrated, because calibration gives up on what was observed, the
    verdict says why.

    Returns:
        The keys of evaluation.json that the verdict consists of ("verdict",
        "sentence", "nearest", "simulated", "gates", "findings", "track"; the
        last is None where it is not calibrated), and
        "files_verified", how many files have the SHA-256 that was recorded; "stale",
        stages whose inputs changed since, each with why and the command;
        "recorded_verdict", that of evaluation.json, None where there is none.

    Raises:
        StorageError: files are missing or were changed (names all of them), or nobody
            has calibrated the session yet.
        InputError: it cannot be calibrated, and no fault in it explains that.
        HandEyeError: the files cannot be judged.
    """
    header = run.folder.header
    absent = [
        name for name in (*_OBSERVED, *_CALIBRATED) if name not in header["stages"]
    ]
    if absent and absent[0] in _OBSERVED:
        raise _needed_first(run, stages[absent[0]])
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
    if absent:
        verdict, track = _uncalibrated(run, stages[absent[0]]), None
    else:
        session, hand_eye = run.session(), run.hand_eye()
        judged = judged_track(run, session, hand_eye, run.progress.advance)
        verdict, track = judge_session(run, judged), track_json(judged)
    recorded = run.evaluation() if "evaluate" in header["stages"] else None
    return {
        **verdict_json(verdict),
        "simulated": bool(header["simulated"]),
        "track": track,
        "files_verified": verified,
        "stale": _stale(run, done),
        "recorded_verdict": None if recorded is None else recorded["verdict"],
    }


def _needed_first(run: Run, stage: Stage) -> StorageError:
    return StorageError(
        f"{run.folder.path}: the stage {stage.name!r} is needed first; run: "
        f"handeye-tri {stage.verb} {run.folder.path}"
    )


def _uncalibrated(run: Run, stage: Stage) -> Verdict:
    """Why calibration gives up; where it does not, it is needed first."""
    from handeye_tri.diagnose import uncalibrated_verdict

    error = why_calibration_fails(run)
    if error is None:
        raise _needed_first(run, stage)
    findings = findings_of(run)
    if not findings and isinstance(error, InputError):
        raise error
    return uncalibrated_verdict(error, findings)


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
