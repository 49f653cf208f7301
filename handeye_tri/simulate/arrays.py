"""Frames and arrays of a compiled MuJoCo model, without MuJoCo itself.

The numbers are copied, never re-parsed: a model file read by two engines gives two
different arms as soon as it uses a feature that one of them misreads.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import InputError
from handeye_tri.mechanism import Body, Geometry, Joint, JointKind, Mechanism, Shape
from handeye_tri.se3 import SE3, rotation_from_quaternion_wxyz

if TYPE_CHECKING:
    from handeye_tri.config import Cell

Floats = NDArray[np.float64]

# Names that the cell adds; names of the arm's own model get the prefix.
ARM_PREFIX = "arm/"
STAND = "cell/stand"
RIG = "rig"


@dataclass(frozen=True, slots=True, eq=False)
class ArmFrames:
    """What the cell's names mean in the arm's own model.

    Attributes:
        base: Body that poses refer to; "" for the model's world.
        base_position: Of that body in the model's world, shape (3,), metres.
        flange_body: Body that carries the flange.
        body_from_flange: The flange in that body's frame.
        speeds: Speed limits by joint, rad/s or m/s.
    """

    base: str
    base_position: Floats
    flange_body: str
    body_from_flange: SE3
    speeds: dict[str, float]


def pose_of(position: Any, quaternion: Any) -> SE3:
    """Motion of a position, (3,), metres, and a quaternion wxyz, (4,)."""
    return SE3.from_parts(rotation_from_quaternion_wxyz(quaternion), position)


def find_frames(cell: Cell, path: Path, model: Any) -> ArmFrames:
    """Find base and flange in an arm's model.

    Args:
        cell: Says how they are called.
        path: The model's file, for messages.
        model: The compiled ``mujoco.MjModel`` of the arm alone.

    Raises:
        InputError: a name is not in the model (lists those that are), the base
            moves or does not carry the flange, or a joint is neither hinge nor slide.
    """
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
        body_from_flange = pose_of(site.pos, site.quat)
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
        pose = pose @ pose_of(model.body_pos[k], model.body_quat[k])
    return ArmFrames(
        bodies[base_body] if base_body else "",
        pose.translation,
        bodies[flange_body],
        body_from_flange,
        _speeds(path, model),
    )


def _listed(names: list[str]) -> str:
    return ", ".join(name for name in names if name) or "none with a name"


def _speeds(path: Path, model: Any) -> dict[str, float]:
    """Joint speeds: MJCF ``<numeric name="speed:JOINT">``, URDF ``velocity``.

    Raises:
        InputError: a speed is not a positive number.
    """
    stated = {
        model.numeric(k).name.removeprefix("speed:"): str(model.numeric(k).data[0])
        for k in range(model.nnumeric)
        if model.numeric(k).name.startswith("speed:")
    }
    root = ElementTree.parse(path).getroot()
    if root.tag == "robot":
        for joint in root.iter("joint"):
            limit = joint.find("limit")
            if limit is not None and "velocity" in limit.attrib:
                stated[joint.get("name", "")] = limit.attrib["velocity"]
    speeds = {}
    for joint_name, text in stated.items():
        try:
            speeds[joint_name] = float(text)
        except ValueError:
            speeds[joint_name] = np.nan
        if not 0 < speeds[joint_name] < np.inf:
            raise InputError(
                f"{path}: joint {joint_name!r}: its speed must be a positive number, "
                f"rad/s or m/s, got {text!r}; correct it, or leave it out if it is "
                "not known"
            )
    return speeds


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


def mechanism_of(cell: Cell, path: Path, model: Any, frames: ArmFrames) -> Mechanism:
    """Copy the compiled cell's arrays.

    Args:
        cell: Says where the markers are on the flange.
        path: The arm's file, for messages.
        model: The compiled ``mujoco.MjModel`` of the whole cell.
        frames: The arm's base and flange.

    Raises:
        InputError: a solid's shape is not supported.
    """
    bodies = tuple(
        Body(
            _name(model.body(k), "body"),
            int(model.body_parentid[k]),
            pose_of(model.body_pos[k], model.body_quat[k]),
        )
        for k in range(model.nbody)
    )
    base = ARM_PREFIX + frames.base if frames.base else STAND
    excluded = ((int(s) >> 16, int(s) & 0xFFFF) for s in model.exclude_signature)
    return Mechanism(
        bodies=bodies,
        joints=tuple(_joint(model, k, frames.speeds) for k in range(model.njnt)),
        geometries=tuple(_geometry(path, model, k) for k in range(model.ngeom)),
        base=frames.base or "world",
        flange=cell.arm.flange,
        base_body=model.body(base).id,
        flange_body=model.body(ARM_PREFIX + frames.flange_body).id,
        body_from_flange=frames.body_from_flange,
        marker_body=model.body(RIG).id,
        markers=cell.rig.flange_from_triangle.apply(cell.rig.triangle.points),
        touching=frozenset((min(pair), max(pair)) for pair in excluded),
    )


def _name(item: Any, kind: str) -> str:
    """Name in the arm's own model, or one made up from the index."""
    name: str = item.name.removeprefix(ARM_PREFIX)
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
        body_from_geometry=pose_of(model.geom_pos[k], model.geom_quat[k]),
        vertices=vertices,
        faces=faces,
        rgba=np.array(rgba, dtype=float),
        collides=bool(model.geom_contype[k] or model.geom_conaffinity[k]),
    )
