"""The views of a plan, photographed in MuJoCo."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from handeye_tri.errors import InputError
from handeye_tri.simulate.compile import CELL, compile_cell
from handeye_tri.simulate.engine import canvas, import_mujoco
from handeye_tri.simulate.imaging import Image, Optics, Pinhole, develop
from handeye_tri.simulate.props import Prop, place_prop

if TYPE_CHECKING:
    from handeye_tri.config import Cell

# Name of the random stream; that of the robot is another.
_SENSOR_STREAM = 102


def _eye(mujoco: Any, model: Any, name: str, pinhole: Pinhole) -> Any:
    """Give a camera of the model its intrinsics; returns what draws through it."""
    index = model.camera(f"{CELL}/{name}").id
    size = np.array(pinhole.size, dtype=float)
    # A sensor of 1 x 1; the principal point counts from the picture's middle, left
    # and up positive. The picture's edges lie half a pixel beyond pixel centres.
    offset = 0.5 * (size - 1.0) - pinhole.principal_point
    model.cam_resolution[index] = pinhole.size
    model.cam_sensorsize[index] = 1.0
    model.cam_intrinsic[index] = [*(pinhole.focal / size), *(offset / size)]
    eye = mujoco.MjvCamera()
    eye.type = mujoco.mjtCamera.mjCAMERA_FIXED
    eye.fixedcamid = index
    return eye


def render_views(
    cell: Cell,
    model_path: Path,
    joints: ArrayLike,
    seed: int,
    wanted: Iterable[tuple[int, int]],
    props: Sequence[Prop] = (),
    *,
    mounts: Sequence[int] | None = None,
) -> Iterator[tuple[int, int, Image]]:
    """Photograph the arm at its stations.

    Args:
        cell: The cell.
        model_path: MJCF or URDF of the arm.
        joints: True joints at the n stations, shape (n, q), rad or m.
        seed: Of the sensor noise; each view has its own stream.
        wanted: Pairs (camera index, station index).
        props: What stands in the cell at some stations.
        mounts: Which of the cell's mounts holds the triangle at each station; None:
            the first everywhere.

    Yields:
        Camera index, station index, and the image: RGB, shape (h, w, 3), or (h, w)
        in a grey cell; mount by mount, in the order of ``wanted``.

    Raises:
        InputError: as :func:`compile_mechanism`; the joints do not fit the arm; the
            cell has no such mount; or a lens cannot be inverted inside its image.
        MissingDependencyError: OpenGL is missing.
    """
    if mounts is None:
        mounts = np.zeros(len(np.asarray(joints)), dtype=np.intp).tolist()
    if max(mounts, default=0) >= len(cell.mounted):
        raise InputError(
            f"mounts must be below {len(cell.mounted)}, since cell {cell.name} has so "
            f"many, got {max(mounts)}; plan again for this cell"
        )
    views = list(wanted)
    for mount, alone in enumerate(cell.mounted):
        chosen = [view for view in views if mounts[view[1]] == mount]
        if chosen:
            yield from _render(alone, model_path, joints, seed, chosen, props)


def _render(
    cell: Cell,
    model_path: Path,
    joints: ArrayLike,
    seed: int,
    wanted: Sequence[tuple[int, int]],
    props: Sequence[Prop],
) -> Iterator[tuple[int, int, Image]]:
    """The views with one mount, as :func:`render_views`."""
    mujoco = import_mujoco()
    model, mechanism = compile_cell(cell, model_path, props)
    order = [int(model.jnt_qposadr[k]) for k in mechanism.arm_joints]
    q = np.asarray(joints, dtype=float)
    if q.ndim != 2 or q.shape[1] != len(order):
        raise InputError(
            f"joints must have shape (stations, {len(order)}) for this arm, "
            f"got {q.shape}"
        )
    scale = cell.imaging.supersample
    optics = [Optics.of(camera.camera, scale) for camera in cell.cameras]
    eyes = [
        _eye(mujoco, model, camera.name, view.pinhole)
        for camera, view in zip(cell.cameras, optics, strict=True)
    ]
    sizes = scale * np.array([view.pinhole.size for view in optics])
    data = mujoco.MjData(model)
    scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 100)
    options = mujoco.MjvOption()
    options.sitegroup[:] = 0
    for flag in ("SHADOW", "REFLECTION"):
        scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = 0

    def draw(view: tuple[int, int]) -> Image:
        i, j = view
        for prop in props:
            place_prop(model, prop, j)
        data.qpos[:] = model.qpos0
        data.qpos[order] = q[j]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        mujoco.mjv_updateScene(
            model, data, options, None, eyes[i], mujoco.mjtCatBit.mjCAT_ALL, scene
        )
        width, height = (int(x) for x in sizes[i])
        area = mujoco.MjrRect(0, 0, width, height)
        picture = np.empty((height, width, 3), dtype=np.uint8)
        # Whoever takes the images may draw with OpenGL in between.
        context.make_current()
        mujoco.mjr_render(area, scene, painter)
        mujoco.mjr_readPixels(picture, None, area, painter)
        # OpenGL's first row is the lowest.
        return picture[::-1]

    def finish(view: tuple[int, int], picture: Image) -> tuple[int, int, Image]:
        i, j = view
        rng = np.random.default_rng([seed, _SENSOR_STREAM, i, j])
        return i, j, develop(optics[i], cell.imaging, picture, rng)

    # One view is finished while the next is drawn.
    with (
        canvas(mujoco, model, *(int(x) for x in sizes.max(axis=0))) as (
            context,
            painter,
        ),
        ThreadPoolExecutor(1) as worker,
    ):
        pending: Future[tuple[int, int, Image]] | None = None
        for view in wanted:
            picture = draw(view)
            if pending is not None:
                yield pending.result()
            pending = worker.submit(finish, view, picture)
        if pending is not None:
            yield pending.result()
