"""Running stages in order, leaving out those that are up to date."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from handeye_tri import storage
from handeye_tri.errors import StorageError
from handeye_tri.pipeline.run import SCHEMAS, Run


@dataclass(frozen=True, slots=True)
class Stage:
    """One step of the pipeline.

    Attributes:
        name: What it is called; also the verb that runs it.
        verb: The command that runs it.
        cell_keys: Parts of the cell that it depends on.
        after: Stages whose files it reads.
        run: Does the work; returns the names of the files and the quality line.
        header_keys: What else of session.json it depends on, beyond the seed.
        preflight: Raises where the machine cannot do it; called before any work.
    """

    name: str
    verb: str
    cell_keys: tuple[str, ...]
    after: tuple[str, ...]
    run: Callable[[Run], tuple[list[str], str]]
    header_keys: tuple[str, ...] = ()
    preflight: Callable[[], None] | None = None


def inputs_of(run: Run, stage: Stage) -> str:
    """Fingerprint of everything that a stage's result depends on."""
    header = run.folder.header
    return storage.fingerprint(
        {
            "stage": stage.name,
            "version": header["software"].get("handeye-tri"),
            "schema": SCHEMAS.get(stage.name),
            "seed": header["seed"],
            "half_turns": header["half_turns"],
            "cell": {key: header["cell"].get(key) for key in stage.cell_keys},
            **{key: header.get(key) for key in stage.header_keys},
            "model": storage.sha256(run.model_path)
            if stage.name == "plan" and header["model_file"]
            else "",
            "after": {name: run.folder.outputs(name) for name in stage.after},
        }
    )


def execute(
    run: Run, stages: Mapping[str, Stage], verbs: Collection[str], *, again: bool
) -> None:
    """Run the stages of some verbs in order.

    Args:
        run: The session.
        stages: All stages, in order.
        verbs: Whose stages to run; the stages that they need must be done.
        again: Redo them even where they are up to date.

    Raises:
        StorageError: an earlier stage's files are missing or damaged.
        HandEyeError: what the stage itself raises.
    """
    absent = [verb for verb in verbs if all(s.verb != verb for s in stages.values())]
    if absent:
        raise StorageError(
            f"{run.folder.path}: this session was imported, there is nothing to "
            f"{absent[0]}; go on with: handeye-tri detect {run.folder.path}"
        )
    for stage in stages.values():
        if stage.verb in verbs and stage.preflight is not None:
            state, _ = run.folder.state(stage.name, inputs_of(run, stage))
            if state != "done" or again:
                stage.preflight()
    for number, stage in enumerate(stages.values(), 1):
        if stage.verb not in verbs:
            continue
        for name in stage.after:
            if stages[name].verb not in verbs:
                require(run, stages, stages[name])
        run.progress.begin(number, len(stages), stage.name)
        inputs = inputs_of(run, stage)
        state, _ = run.folder.state(stage.name, inputs)
        if state == "done" and not again:
            run.progress.end(run.folder.header["stages"][stage.name]["line"], None)
            continue
        started = time.perf_counter()
        outputs, line = stage.run(run)
        run.folder.record(stage.name, inputs, outputs, line)
        run.progress.end(line, time.perf_counter() - started)


def require(run: Run, stages: Mapping[str, Stage], stage: Stage) -> None:
    """See that a stage, and all that it builds on, is done, whole and up to date.

    Raises:
        StorageError: it is not; names the first stage to run.
    """
    for name in stage.after:
        require(run, stages, stages[name])
    state, why = run.folder.state(stage.name, inputs_of(run, stage))
    if state != "done":
        if stage.verb == "import":
            raise StorageError(
                f"{run.folder.path}: what was imported is needed first: {why}; import "
                f"it again into another folder, as before: {run.imported_by}"
            )
        raise StorageError(
            f"{run.folder.path}: the stage {stage.name!r} is needed first: {why}; "
            f"run: handeye-tri {stage.verb} {run.folder.path}"
        )
