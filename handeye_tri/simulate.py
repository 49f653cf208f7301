"""The cell in MuJoCo: compiled from any arm's model, and rendered.

MuJoCo is the only engine that reads model files here; kinematics and collision use
the :class:`~handeye_tri.mechanism.Mechanism` that :func:`compile_mechanism` returns.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import InputError, MissingDependencyError
from handeye_tri.mechanism import Body, Geometry, Joint, JointKind, Mechanism, Shape
from handeye_tri.rig import rig_rods
from handeye_tri.se3 import SE3, quaternion_wxyz, rotation_from_quaternion_wxyz

if TYPE_CHECKING:
    from handeye_tri.config import Cell

if sys.platform == "linux":
    # Read by mujoco when it is imported: render without a display.
    os.environ.setdefault("MUJOCO_GL", "egl")

Floats = NDArray[np.float64]

_MISSING_GL = (
    "MuJoCo finds no OpenGL to render with ({}); on Debian and Ubuntu install it by "
    "`apt-get install libegl1 libgl1 libgl1-mesa-dri`"
)
_STAND = "cell/stand"
# What the cell adds can not clash with a name in the arm's model.
_ARM = "arm/"
_RIG = "rig"
# Solid and drawn.
_SOLID = {"contype": 1, "conaffinity": 1, "group": 0}
_GREYS = {"rod": 0.30, "surroundings": 0.38, "housing": 0.16}


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
    return _compile(cell, model_path).mechanism


@dataclass(frozen=True, slots=True, eq=False)
class _Compiled:
    model: Any
    mechanism: Mechanism


@dataclass(frozen=True, slots=True)
class _Frames:
    """Frames found in the arm's own model; base "" is that model's world."""

    base: str
    base_position: Floats
    flange_body: str
    body_from_flange: SE3
    speeds: dict[str, float]


def _compile(cell: Cell, model_path: Path) -> _Compiled:
    mujoco = _mujoco()
    arm = _load(mujoco, model_path)
    frames = _find_frames(cell, model_path, _compile_spec(arm, model_path))
    spec = mujoco.MjSpec()
    _set_scene(mujoco, spec)
    # The arm's own world becomes this body, so that it moves as one.
    stand = spec.worldbody.add_body(
        name=_STAND, pos=np.array(cell.arm.position_m) - frames.base_position
    )
    try:
        spec.attach(arm, prefix=_ARM, frame=stand.add_frame())
    except ValueError as error:
        raise InputError(f"{model_path}: {_one_line(error)}") from None
    _add_surroundings(mujoco, spec, cell)
    _add_cameras(mujoco, spec, cell)
    _add_rig(mujoco, spec, cell, frames)
    model = _compile_spec(spec, model_path)
    return _Compiled(model, _mechanism(cell, model_path, model, frames))


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
    for light in list(spec.lights):
        spec.delete(light)
    return spec


def _compile_spec(spec: Any, path: Path) -> Any:
    try:
        return spec.compile()
    except (ValueError, OSError) as error:
        raise InputError(
            f"{path}: MuJoCo cannot compile this model: {_one_line(error)}"
        ) from None


def _pose(position: Any, quaternion: Any) -> SE3:
    return SE3.from_parts(rotation_from_quaternion_wxyz(quaternion), position)


def _find_frames(cell: Cell, path: Path, model: Any) -> _Frames:
    bodies = [model.body(k).name for k in range(model.nbody)]
    sites = [model.site(k).name for k in range(model.nsite)]
    for k in range(model.njnt):
        if int(model.jnt_type[k]) in (0, 1):
            kind = ("free", "ball")[int(model.jnt_type[k])]
            raise InputError(
                f"{path}: joint {model.joint(k).name or k!r} is a {kind} joint; only "
                "hinge and slide joints are supported, remove it from the model"
            )
    flange = cell.arm.flange
    if flange in sites:
        site = model.site(flange)
        flange_body = int(site.bodyid[0])
        body_from_flange = _pose(site.pos, site.quat)
    elif flange in bodies[1:]:
        flange_body = bodies.index(flange)
        body_from_flange = SE3.identity()
    else:
        raise InputError(
            f"{path}: arm.flange: no body or site {flange!r}; the model has "
            f"bodies {_listed(bodies[1:])} and sites {_listed(sites)}"
        )
    if not bodies[flange_body]:
        raise InputError(
            f"{path}: arm.flange: the body that carries {flange!r} has no name; "
            "give it one in the model"
        )
    chain = [flange_body]
    while chain[-1] != 0:
        chain.append(int(model.body_parentid[chain[-1]]))
    chain.reverse()
    base = cell.arm.base
    if base is None:
        # The first link, if it is fixed; a first link that moves stands on the world.
        first = chain[1] if len(chain) > 1 else 0
        base_body = 0 if model.body_jntnum[first] else first
    elif base in bodies:
        base_body = bodies.index(base)
    else:
        raise InputError(
            f"{path}: arm.base: no body {base!r}; the model has {_listed(bodies)}"
        )
    if base_body not in chain:
        raise InputError(
            f"{path}: arm.base: {base!r} does not carry the flange {flange!r}; "
            f"bodies from the world to the flange are "
            f"{_listed([bodies[k] for k in chain])}"
        )
    below = chain[: chain.index(base_body) + 1]
    moving = [bodies[k] for k in below if model.body_jntnum[k]]
    if moving:
        raise InputError(
            f"{path}: arm.base: {base!r} moves, since {_listed(moving)} has a joint; "
            "name a body that stands still"
        )
    if not bodies[base_body]:
        raise InputError(
            f"{path}: arm.base: the arm's first body has no name; give it one in "
            "the model"
        )
    pose = SE3.identity()
    for k in below[1:]:
        pose = pose @ _pose(model.body_pos[k], model.body_quat[k])
    return _Frames(
        bodies[base_body] if base_body else "",
        pose.translation,
        bodies[flange_body],
        body_from_flange,
        _speeds(path, model),
    )


def _listed(names: list[str]) -> str:
    return ", ".join(name for name in names if name) or "none with a name"


def _speeds(path: Path, model: Any) -> dict[str, float]:
    """Joint speeds: MJCF ``<numeric name="speed:JOINT">``, URDF ``velocity``."""
    speeds = {
        model.numeric(k).name.removeprefix("speed:"): float(model.numeric(k).data[0])
        for k in range(model.nnumeric)
        if model.numeric(k).name.startswith("speed:")
    }
    root = ElementTree.parse(path).getroot()
    if root.tag == "robot":
        for joint in root.iter("joint"):
            limit = joint.find("limit")
            if limit is not None and "velocity" in limit.attrib:
                speeds[joint.get("name", "")] = float(limit.attrib["velocity"])
    return speeds


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
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.30, 0.30, 0.30]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    spec.worldbody.add_light(
        name="cell/light",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[1.0, 1.0, 3.0],
        dir=[-0.4, -0.45, -0.8],
        ambient=[0.0, 0.0, 0.0],
        diffuse=[0.55, 0.55, 0.55],
        specular=[0.2, 0.2, 0.2],
        castshadow=False,
    )
    spec.add_texture(
        name="cell/sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.62, 0.62, 0.62],
        rgb2=[0.30, 0.30, 0.30],
        width=128,
        height=768,
    )


def _grey(value: float) -> list[float]:
    return [value, value, value, 1.0]


def _add_surroundings(mujoco: Any, spec: Any, cell: Cell) -> None:
    for box in cell.surroundings:
        spec.worldbody.add_geom(
            name=f"cell/{box.name}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=0.5e-3 * np.array(box.size_mm),
            pos=box.position_m,
            rgba=_grey(_GREYS["surroundings"]),
            **_SOLID,
        )


def _add_cameras(mujoco: Any, spec: Any, cell: Cell) -> None:
    """Housings stand behind the optical centre, out of their own view."""
    for camera in cell.cameras:
        world_from_camera = camera.world_from_camera
        parts = (
            ("lens", mujoco.mjtGeom.mjGEOM_CYLINDER, [0.016, 0.015, 0.0], -0.02),
            ("body", mujoco.mjtGeom.mjGEOM_BOX, [0.022, 0.022, 0.03], -0.065),
        )
        for part, shape, size, depth in parts:
            spec.worldbody.add_geom(
                name=f"cell/camera {camera.name} {part}",
                type=shape,
                size=size,
                pos=world_from_camera.apply([0.0, 0.0, depth]),
                quat=quaternion_wxyz(world_from_camera.rotation),
                rgba=_grey(_GREYS["housing"]),
                **_SOLID,
            )


def _add_rig(mujoco: Any, spec: Any, cell: Cell, frames: _Frames) -> None:
    """Attach the markers and the rods that hold them, in the flange frame."""
    rig = spec.body(_ARM + frames.flange_body).add_body(
        name=_RIG,
        pos=frames.body_from_flange.translation,
        quat=quaternion_wxyz(frames.body_from_flange.rotation),
    )
    steel = spec.add_material(name=f"{_RIG}/rod", rgba=_grey(_GREYS["rod"]))
    for rod in rig_rods(cell.rig):
        rig.add_geom(
            name=f"{_RIG}/{rod.name}",
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
            name=f"{_RIG}/paint {letter}",
            rgba=[*cell.rig.marker_colours[k], 1.0],
            emission=1.0,
            specular=0.0,
            shininess=0.0,
        )
        rig.add_geom(
            name=f"{_RIG}/marker {letter}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[1e-3 * cell.rig.marker_radii_mm[k], 0.0, 0.0],
            pos=markers[k],
            material=paint.name,
            **_SOLID,
        )


_SHAPES: dict[int, Shape] = {
    0: "plane",
    2: "sphere",
    3: "capsule",
    4: "ellipsoid",
    5: "cylinder",
    6: "box",
    7: "mesh",
    8: "mesh",
}
_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "ellipsoid": 3}
_KINDS: dict[int, JointKind] = {2: "slide", 3: "hinge"}


def _mechanism(cell: Cell, path: Path, model: Any, frames: _Frames) -> Mechanism:
    """Copy the compiled arrays: all numbers stay float64, nothing is re-parsed."""
    bodies = tuple(
        Body(
            _name(model.body(k), "body"),
            int(model.body_parentid[k]),
            _pose(model.body_pos[k], model.body_quat[k]),
        )
        for k in range(model.nbody)
    )
    base = _ARM + frames.base if frames.base else _STAND
    excluded = ((int(s) >> 16, int(s) & 0xFFFF) for s in model.exclude_signature)
    return Mechanism(
        bodies=bodies,
        joints=tuple(_joint(model, k, frames.speeds) for k in range(model.njnt)),
        geometries=tuple(_geometry(path, model, k) for k in range(model.ngeom)),
        base=frames.base or "world",
        flange=cell.arm.flange,
        base_body=model.body(base).id,
        flange_body=model.body(_ARM + frames.flange_body).id,
        body_from_flange=frames.body_from_flange,
        marker_body=model.body(_RIG).id,
        markers=cell.rig.flange_from_triangle.apply(cell.rig.triangle.points),
        touching=frozenset((min(pair), max(pair)) for pair in excluded),
    )


def _name(item: Any, kind: str) -> str:
    """Name in the arm's own model, or one made up from the index."""
    name: str = item.name.removeprefix(_ARM)
    return name or f"{kind} {item.id}"


def _joint(model: Any, k: int, speeds: dict[str, float]) -> Joint:
    name = _name(model.joint(k), "joint")
    limited = bool(model.jnt_limited[k])
    lower, upper = model.jnt_range[k] if limited else (-np.inf, np.inf)
    return Joint(
        name=name,
        body=int(model.jnt_bodyid[k]),
        kind=_KINDS[int(model.jnt_type[k])],
        anchor=np.array(model.jnt_pos[k]),
        axis=np.array(model.jnt_axis[k]),
        lower=float(lower),
        upper=float(upper),
        reference=float(model.qpos0[model.jnt_qposadr[k]]),
        speed=speeds.get(name, np.inf),
    )


def _geometry(path: Path, model: Any, k: int) -> Geometry:
    body = int(model.geom_bodyid[k])
    name = _name(model.geom(k), f"{_name(model.body(body), 'body')}/solid")
    shape = _SHAPES.get(int(model.geom_type[k]))
    if shape is None:
        raise InputError(
            f"{path}: geom {name!r} is a height field, which is not supported; "
            "use boxes or a mesh"
        )
    vertices, faces = np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
    if shape == "mesh":
        mesh = int(model.geom_dataid[k])
        start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        vertices = np.array(model.mesh_vert[start : start + count], dtype=float)
        start, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        faces = np.array(model.mesh_face[start : start + count], dtype=np.int64)
    material = int(model.geom_matid[k])
    rgba = model.geom_rgba[k] if material < 0 else model.mat_rgba[material]
    return Geometry(
        name=name,
        body=body,
        shape=shape,
        size=np.array(model.geom_size[k][: _SIZES.get(shape, 0)]),
        body_from_geometry=_pose(model.geom_pos[k], model.geom_quat[k]),
        vertices=vertices,
        faces=faces,
        rgba=np.array(rgba, dtype=float),
        collides=bool(model.geom_contype[k] or model.geom_conaffinity[k]),
    )
