"""A finished session of the HP3-like cell on drawn images: no renderer needed."""

from __future__ import annotations

import atexit
import shutil
from contextlib import AbstractContextManager
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from handeye_tri import storage
from handeye_tri.camera import PinholeCamera
from handeye_tri.pipeline import STAGES, NullProgress, Run, evaluation, execute, start
from handeye_tri.pipeline.execution import inputs_of
from handeye_tri.pipeline.run import TRUTH_SCHEMA
from handeye_tri.simulate import execute as execute_plan
from handeye_tri.simulate import ground_truth
from handeye_tri.storage import codec

_FINE = 6


def draw(
    camera: PinholeCamera,
    centres: NDArray[np.float64],
    radii: NDArray[np.float64],
    colours: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """Balls at centres in the camera frame, shape (3, 3), on grey, by area.

    A pixel's ray meets a ball of radius r at c where (d.c)^2 >= |d|^2 (|c|^2 - r^2).
    """
    width, height = camera.image_size
    levels = np.full((height, width, 3), 120.0)
    for centre, radius, colour in zip(centres, radii, colours, strict=True):
        u, v = camera.project(centre)
        reach = 2 + 1.2 * camera.intrinsics.fx * radius / centre[2]
        left, top = int(u - reach), int(v - reach)
        size = int(2 * reach) + 2
        part = (np.arange(_FINE) + 0.5) / _FINE - 0.5
        steps = (np.arange(size)[:, None] + part).ravel()
        x, y = np.meshgrid(left + steps, top + steps)
        rays = np.append(
            camera.normalised(np.stack([x, y], axis=-1)),
            np.ones((*x.shape, 1)),
            axis=-1,
        )
        inside = (rays @ centre) ** 2 >= (rays**2).sum(axis=-1) * (
            centre @ centre - radius**2
        )
        cover = inside.reshape(size, _FINE, size, _FINE).mean(axis=(1, 3))[..., None]
        area = levels[top : top + size, left : left + size]
        area += cover * (255 * colour - area)
    return np.rint(levels).astype(np.uint8)


def _simulate(run: Run) -> list[str]:
    """What the stage "simulate" writes, drawn instead of rendered."""
    joints = execute_plan(run.arm, run.plan(), run.cell.repeatability, run.seed)
    truth = ground_truth(run.cell, run.arm, joints)
    storage.write_json(
        run.folder.file("truth.json"),
        {"schema": TRUTH_SCHEMA, **codec.truth_to_json(truth, joints)},
    )
    rig, outputs = run.cell.rig, ["truth.json"]
    held = [truth.markers, *(mount.markers for mount in truth.other_mounts)]
    markers = [held[station.mount] for station in run.plan().stations]
    for camera, base_from_camera in zip(
        truth.cameras, truth.base_from_camera, strict=True
    ):
        for j, base_from_flange in enumerate(truth.base_from_flange):
            points = markers[j] @ base_from_flange[:3, :3].T
            points = base_from_camera.inverse().apply(points + base_from_flange[:3, 3])
            image = draw(
                camera,
                points,
                1e-3 * np.array(rig.marker_radii_mm),
                np.array(rig.marker_colours),
            )
            name = run.image_name(camera.name, j)
            storage.write_image(run.folder.file(name), image)
            outputs.append(name)
    return outputs


def few_replicates() -> AbstractContextManager[object]:
    """Evaluate with few recalibrations: how they spread is tested elsewhere."""
    return patch.object(
        evaluation, "_REPLICATES", {"joint": (4, 4), "separate": (4, 4)}
    )


@cache
def _made(cell: str, seed: int) -> Path:
    parent = Path(mkdtemp(prefix="drawn-"))
    atexit.register(shutil.rmtree, parent, ignore_errors=True)
    folder = parent / "session"
    run = Run(start(cell, folder, seed, 6), NullProgress())
    execute(run, STAGES, ("plan",), again=False)
    stage = STAGES["simulate"]
    run.folder.record("simulate", inputs_of(run, stage), _simulate(run), "drawn")
    with few_replicates():
        execute(run, STAGES, ("detect", "calibrate", "evaluate"), again=False)
    return folder


def drawn_session(
    parent: Path, *, cell: str = "hp3_stereo", seed: int = 3, name: str = "session"
) -> Run:
    """A copy of a session of 6 half-turns and 6 held-out stations, evaluated."""
    shutil.copytree(_made(cell, seed), parent / name)
    return Run(storage.SessionFolder.open(parent / name), NullProgress())


def with_outcome(run: Run, outcome: str) -> Run:
    """The same session with another verdict, its hashes in order."""
    path = run.folder.file("evaluation.json")
    data = run.evaluation() | {"verdict": outcome}
    storage.write_json(path, data)
    entry = run.folder.header["stages"]["evaluate"]
    outputs = list(run.folder.outputs("evaluate"))
    run.folder.record("evaluate", entry["inputs"], outputs, entry["line"])
    return run
