"""The cell as one MuJoCo model: any arm, the rig, cameras and surroundings.

MuJoCo is the only engine that reads model files; kinematics and collision use the
:class:`~handeye_tri.mechanism.Mechanism` that :func:`compile_mechanism` returns.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from handeye_tri.errors import InputError
from handeye_tri.mechanism import Mechanism
from handeye_tri.se3 import quaternion_wxyz
from handeye_tri.simulate.arrays import (
    ARM_PREFIX,
    RIG,
    STAND,
    ArmFrames,
    find_frames,
    mechanism_of,
)
from handeye_tri.simulate.engine import import_mujoco, one_line
from handeye_tri.simulate.props import Prop, add_prop
from handeye_tri.simulate.rods import rig_board, rig_rods
from handeye_tri.simulate.urdf import check_urdf

if TYPE_CHECKING:
    from handeye_tri.config import Cell

CELL = "cell"
# What the cell decides, not the arm's file; MuJoCo warns where they differ.
_SETTINGS = ("option", "visual", "stat", "memory", "nkey")
# Solid and drawn.
_SOLID = {"contype": 1, "conaffinity": 1, "group": 0}
_GREYS = {"rod": 0.25, "surroundings": 0.48, "housing": 0.16, "board": 0.78}
# Optical frames look along z with y down, MuJoCo's along -z with y up.
_OPTICAL_FROM_MUJOCO = np.diag([1.0, -1.0, -1.0])


def compile_mechanism(cell: Cell, model_path: Path) -> Mechanism:
    """Compile the cell: arm, rig, surroundings and camera housings.

    Args:
        cell: Where everything stands, which frames the robot reports, and the rig.
        model_path: MJCF or URDF of the arm.

    Returns:
        The cell as plain arrays. The rig's body coincides with the flange.

    Raises:
        InputError: the file cannot be read, a frame that the cell names is not in
            it (lists those that are), or it has joints that are not supported, or a
            joint of the arm lacks what a URDF must state.
        MissingDependencyError: MuJoCo's OpenGL library is missing.
    """
    return compile_cell(cell, model_path)[1]


def compile_cell(
    cell: Cell, model_path: Path, props: Sequence[Prop] = ()
) -> tuple[Any, Mechanism]:
    """:func:`compile_mechanism`, and the ``mujoco.MjModel`` that it copies.

    Args:
        cell: As there.
        model_path: As there.
        props: What stands in the cell for some views.
    """
    mujoco = import_mujoco()
    check_urdf(model_path, cell.arm.flange)
    arm = _load(mujoco, model_path)
    frames = find_frames(cell, model_path, _compile_spec(arm, model_path))
    spec = mujoco.MjSpec()
    _accept_any_mass(spec)
    _set_scene(mujoco, spec)
    for setting in (*_SETTINGS, *(name for name in dir(spec) if "nuser_" in name)):
        setattr(arm, setting, getattr(spec, setting))
    # The arm's own world becomes this body, so that it moves as one.
    stand = spec.worldbody.add_body(
        name=STAND, pos=np.array(cell.arm.position_m) - frames.base_position
    )
    try:
        spec.attach(arm, prefix=ARM_PREFIX, frame=stand.add_frame())
    except ValueError as error:
        raise InputError(f"{model_path}: {one_line(error)}") from None
    _add_surroundings(mujoco, spec, cell)
    _add_cameras(mujoco, spec, cell)
    _add_rig(mujoco, spec, cell, frames)
    for prop in props:
        add_prop(mujoco, spec, prop)
    model = _compile_spec(spec, model_path)
    return model, mechanism_of(cell, model_path, model, frames)


def _load(mujoco: Any, path: Path) -> Any:
    """Read a model file; lights go, fixed links and drawings stay."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, OSError) as error:
        raise InputError(
            f"{path}: MuJoCo cannot read this as MJCF or URDF: {one_line(error)}"
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
            f"{path}: MuJoCo cannot compile this model: {one_line(error)}"
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
        name=f"{CELL}/light",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[1.0, 1.0, 3.0],
        dir=[-0.4, -0.45, -0.8],
        ambient=[0.0, 0.0, 0.0],
        diffuse=[0.45, 0.45, 0.45],
        specular=[0.2, 0.2, 0.2],
        castshadow=False,
    )
    spec.add_texture(
        name=f"{CELL}/sky",
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
            name=f"{CELL}/{box.name}",
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
            name=f"{CELL}/{camera.name}",
            pos=world_from_camera.translation,
            quat=quaternion_wxyz(world_from_camera.rotation @ _OPTICAL_FROM_MUJOCO),
        )
        parts = (
            ("lens", mujoco.mjtGeom.mjGEOM_CYLINDER, [0.016, 0.015, 0.0], -0.02),
            ("body", mujoco.mjtGeom.mjGEOM_BOX, [0.022, 0.022, 0.03], -0.065),
        )
        for part, shape, size, depth in parts:
            spec.worldbody.add_geom(
                name=f"{CELL}/camera {camera.name} {part}",
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
    board = rig_board(cell.rig)
    if board is not None:
        card = spec.add_material(name=f"{RIG}/card", rgba=_grey(_GREYS["board"]))
        mesh = spec.add_mesh(name=f"{RIG}/board", uservert=board.ravel())
        rig.add_geom(
            name=f"{RIG}/board",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh.name,
            material=card.name,
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
