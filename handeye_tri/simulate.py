"""The cell in MuJoCo: compiled from any arm's model, and rendered.

MuJoCo is the only engine that reads model files here; kinematics and collision use
the :class:`~handeye_tri.mechanism.Mechanism` that :func:`compile_mechanism` returns.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.errors import InputError, MissingDependencyError
from handeye_tri.imaging import Image, Optics, Pinhole, develop
from handeye_tri.mechanism import Mechanism
from handeye_tri.model_arrays import (
    ARM_PREFIX,
    RIG,
    STAND,
    ArmFrames,
    find_frames,
    mechanism_of,
)
from handeye_tri.records import GroundTruth, Plan, Repeatability
from handeye_tri.rig import rig_rods
from handeye_tri.se3 import quaternion_wxyz

if TYPE_CHECKING:
    from handeye_tri.arm import Arm
    from handeye_tri.config import Cell

if sys.platform == "linux":
    # Read by mujoco when it is imported: render without a display.
    os.environ.setdefault("MUJOCO_GL", "egl")

Floats = NDArray[np.float64]

_MISSING_GL = (
    "MuJoCo finds no OpenGL to render with ({}); on Debian and Ubuntu install it by "
    "`apt-get install libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri`"
)
# Names of random streams, so that none is used twice.
_ROBOT_STREAM, _SENSOR_STREAM = 101, 102
_SETTINGS = ("option", "visual", "stat", "memory", "nkey")
# Solid and drawn.
_SOLID = {"contype": 1, "conaffinity": 1, "group": 0}
_CELL = "cell"
_GREYS = {"rod": 0.25, "surroundings": 0.48, "housing": 0.16}
# Optical frames look along z with y down, MuJoCo's along -z with y up.
_OPTICAL_FROM_MUJOCO = np.diag([1.0, -1.0, -1.0])


def _mujoco() -> Any:
    """Import MuJoCo; the import itself loads OpenGL.

    Raises:
        MissingDependencyError: there is no OpenGL; names the Debian packages.
    """
    try:
        import mujoco
    except (ImportError, AttributeError, OSError) as error:
        raise MissingDependencyError(_MISSING_GL.format(error)) from None
    return mujoco


def compile_mechanism(cell: Cell, model_path: Path) -> Mechanism:
    """Compile the cell: arm, rig, surroundings and camera housings.

    Args:
        cell: Where everything stands, which frames the robot reports, and the rig.
        model_path: MJCF or URDF of the arm.

    Returns:
        The cell as plain arrays. The rig's body coincides with the flange.

    Raises:
        InputError: the file cannot be read, a frame that the cell names is not in
            it (lists those that are), or it has joints that are not supported.
        MissingDependencyError: MuJoCo's OpenGL library is missing.
    """
    return _compile(cell, model_path)[1]


def _compile(cell: Cell, model_path: Path) -> tuple[Any, Mechanism]:
    mujoco = _mujoco()
    arm = _load(mujoco, model_path)
    frames = find_frames(cell, model_path, _compile_spec(arm, model_path))
    spec = mujoco.MjSpec()
    _accept_any_mass(spec)
    _set_scene(mujoco, spec)
    # The cell's settings of physics and drawing hold; MuJoCo warns where they differ.
    for setting in (*_SETTINGS, *(name for name in dir(spec) if "nuser_" in name)):
        setattr(arm, setting, getattr(spec, setting))
    # The arm's own world becomes this body, so that it moves as one.
    stand = spec.worldbody.add_body(
        name=STAND, pos=np.array(cell.arm.position_m) - frames.base_position
    )
    try:
        spec.attach(arm, prefix=ARM_PREFIX, frame=stand.add_frame())
    except ValueError as error:
        raise InputError(f"{model_path}: {_one_line(error)}") from None
    _add_surroundings(mujoco, spec, cell)
    _add_cameras(mujoco, spec, cell)
    _add_rig(mujoco, spec, cell, frames)
    model = _compile_spec(spec, model_path)
    return model, mechanism_of(cell, model_path, model, frames)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _load(mujoco: Any, path: Path) -> Any:
    """Read a model file; lights go, fixed links and drawings stay."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, OSError) as error:
        raise InputError(
            f"{path}: MuJoCo cannot read this as MJCF or URDF: {_one_line(error)}"
        ) from None
    spec.compiler.fusestatic = False
    spec.compiler.discardvisual = False
    _accept_any_mass(spec)
    for light in list(spec.lights):
        spec.delete(light)
    return spec


def _accept_any_mass(spec: Any) -> None:
    """Masses play no part here; models that lack them are welcome."""
    spec.compiler.boundmass = 1e-6
    spec.compiler.boundinertia = 1e-9
    spec.compiler.balanceinertia = True


def _compile_spec(spec: Any, path: Path) -> Any:
    try:
        return spec.compile()
    except (ValueError, OSError) as error:
        raise InputError(
            f"{path}: MuJoCo cannot compile this model: {_one_line(error)}"
        ) from None


def _set_scene(mujoco: Any, spec: Any) -> None:
    """Neutral grey light, the same for every arm; clip planes in metres."""
    spec.modelname = "handeye_tri cell"
    # Lengths of the clip planes are in units of this extent.
    spec.stat.extent = 1.0
    spec.stat.center = [0.0, 0.0, 0.0]
    spec.visual.map.znear = 0.02
    spec.visual.map.zfar = 20.0
    # Multisampling costs more than supersampling by two and measures worse.
    spec.visual.quality.offsamples = 0
    spec.visual.quality.numslices = 32
    spec.visual.quality.numstacks = 24
    spec.visual.headlight.ambient = [0.40, 0.40, 0.40]
    spec.visual.headlight.diffuse = [0.35, 0.35, 0.35]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    spec.worldbody.add_light(
        name=f"{_CELL}/light",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[1.0, 1.0, 3.0],
        dir=[-0.4, -0.45, -0.8],
        ambient=[0.0, 0.0, 0.0],
        diffuse=[0.45, 0.45, 0.45],
        specular=[0.2, 0.2, 0.2],
        castshadow=False,
    )
    spec.add_texture(
        name=f"{_CELL}/sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.68, 0.68, 0.68],
        rgb2=[0.46, 0.46, 0.46],
        width=128,
        height=768,
    )


def _grey(value: float) -> list[float]:
    return [value, value, value, 1.0]


def _add_surroundings(mujoco: Any, spec: Any, cell: Cell) -> None:
    for box in cell.surroundings:
        spec.worldbody.add_geom(
            name=f"{_CELL}/{box.name}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=0.5e-3 * np.array(box.size_mm),
            pos=box.position_m,
            rgba=_grey(_GREYS["surroundings"]),
            **_SOLID,
        )


def _add_cameras(mujoco: Any, spec: Any, cell: Cell) -> None:
    """Cameras, and housings behind the optical centre."""
    for camera in cell.cameras:
        world_from_camera = camera.world_from_camera
        spec.worldbody.add_camera(
            name=f"{_CELL}/{camera.name}",
            pos=world_from_camera.translation,
            quat=quaternion_wxyz(world_from_camera.rotation @ _OPTICAL_FROM_MUJOCO),
        )
        parts = (
            ("lens", mujoco.mjtGeom.mjGEOM_CYLINDER, [0.016, 0.015, 0.0], -0.02),
            ("body", mujoco.mjtGeom.mjGEOM_BOX, [0.022, 0.022, 0.03], -0.065),
        )
        for part, shape, size, depth in parts:
            spec.worldbody.add_geom(
                name=f"{_CELL}/camera {camera.name} {part}",
                type=shape,
                size=size,
                pos=world_from_camera.apply([0.0, 0.0, depth]),
                quat=quaternion_wxyz(world_from_camera.rotation),
                rgba=_grey(_GREYS["housing"]),
                **_SOLID,
            )


def _add_rig(mujoco: Any, spec: Any, cell: Cell, frames: ArmFrames) -> None:
    """Attach the markers and the rods that hold them, in the flange frame."""
    rig = spec.body(ARM_PREFIX + frames.flange_body).add_body(
        name=RIG,
        pos=frames.body_from_flange.translation,
        quat=quaternion_wxyz(frames.body_from_flange.rotation),
    )
    steel = spec.add_material(name=f"{RIG}/rod", rgba=_grey(_GREYS["rod"]))
    for rod in rig_rods(cell.rig):
        rig.add_geom(
            name=f"{RIG}/{rod.name}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[rod.radius, 0.0, 0.0],
            fromto=[*rod.start, *rod.end],
            material=steel.name,
            **_SOLID,
        )
    markers = cell.rig.flange_from_triangle.apply(cell.rig.triangle.points)
    for k, letter in enumerate("ABC"):
        # Light of its own and no highlight: lit spheres have biased centres.
        paint = spec.add_material(
            name=f"{RIG}/paint {letter}",
            rgba=[*cell.rig.marker_colours[k], 1.0],
            emission=1.0,
            specular=0.0,
            shininess=0.0,
        )
        rig.add_geom(
            name=f"{RIG}/marker {letter}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[1e-3 * cell.rig.marker_radii_mm[k], 0.0, 0.0],
            pos=markers[k],
            material=paint.name,
            **_SOLID,
        )


def execute(arm: Arm, plan: Plan, repeatability: Repeatability, seed: int) -> Floats:
    """Where the robot truly goes when it is told to follow a plan.

    The robot reports the commanded pose; it stands at commanded @ exp(xi), xi
    normal with the repeatability as its standard deviation, one draw per station.

    Returns:
        Joints, shape (stations, q), rad or m.

    Raises:
        InputError: the plan's stations carry no joints of this arm.
    """
    sigma = np.repeat([repeatability.translation, repeatability.rotation], 3)
    tangents = []
    for station in plan.stations:
        if station.joints.shape != arm.home.shape:
            raise InputError(
                f"station {station.index} of the plan has {station.joints.size} "
                f"joints, the arm has {arm.home.size}; plan again for this arm"
            )
        rng = np.random.default_rng([seed, _ROBOT_STREAM, station.index])
        tangents.append(sigma * rng.standard_normal(6))
    commanded = np.array([station.joints for station in plan.stations])
    return arm.perturbed(commanded, tangents)


def ground_truth(cell: Cell, arm: Arm, joints: ArrayLike) -> GroundTruth:
    """The truth of a simulated cell in the robot's base frame.

    Args:
        cell: True cameras, where they stand, and the rig.
        arm: The robot.
        joints: Executed joints, shape (n, q), rad or m.
    """
    return GroundTruth(
        cameras=tuple(camera.camera for camera in cell.cameras),
        base_from_camera=tuple(
            arm.base_from_world @ camera.world_from_camera for camera in cell.cameras
        ),
        flange_from_triangle=cell.rig.flange_from_triangle,
        base_from_flange=arm.forward(joints),
    )


def check_rendering() -> None:
    """Draw a few pixels.

    Raises:
        MissingDependencyError: that fails; names the Debian packages.
    """
    mujoco = _mujoco()
    spec = mujoco.MjSpec()
    _set_scene(mujoco, spec)
    with _canvas(mujoco, spec.compile(), 8, 8):
        pass


@contextmanager
def _canvas(
    mujoco: Any, model: Any, width: int, height: int
) -> Iterator[tuple[Any, Any]]:
    """An off-screen picture; yields its OpenGL context and MuJoCo's.

    Raises:
        MissingDependencyError: OpenGL is absent or fails.
    """
    model.vis.global_.offwidth = width
    model.vis.global_.offheight = height
    try:
        context = mujoco.GLContext(width, height)
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        raise MissingDependencyError(_MISSING_GL.format(_one_line(error))) from None
    try:
        context.make_current()
        try:
            painter = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except mujoco.FatalError as error:
            raise MissingDependencyError(_MISSING_GL.format(_one_line(error))) from None
        try:
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, painter)
            yield context, painter
        finally:
            context.make_current()
            painter.free()
    finally:
        context.free()


def _eye(mujoco: Any, model: Any, name: str, pinhole: Pinhole) -> Any:
    """Give a camera of the model its intrinsics; returns what draws through it."""
    index = model.camera(f"{_CELL}/{name}").id
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
) -> Iterator[tuple[int, int, Image]]:
    """Photograph the arm at its stations.

    Args:
        cell: The cell.
        model_path: MJCF or URDF of the arm.
        joints: True joints at the n stations, shape (n, q), rad or m.
        seed: Of the sensor noise; each view has its own stream.
        wanted: Pairs (camera index, station index).

    Yields:
        Camera index, station index, and the image: RGB, shape (h, w, 3), or (h, w)
        in a grey cell; in the order of ``wanted``.

    Raises:
        InputError: as :func:`compile_mechanism`; the joints do not fit the arm; or
            a lens cannot be inverted inside its image.
        MissingDependencyError: OpenGL is missing.
    """
    mujoco = _mujoco()
    model, mechanism = _compile(cell, model_path)
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
        _canvas(mujoco, model, *(int(x) for x in sizes.max(axis=0))) as (
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
