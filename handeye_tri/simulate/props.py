"""What stands in the cell for some views only: a chessboard, a cup."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import InputError
from handeye_tri.mechanism import Geometry
from handeye_tri.records import locked
from handeye_tri.se3 import quaternion_wxyz

Floats = NDArray[np.float64]

# Where a prop waits while it is not in the cell, metres: no camera sees so far.
_AWAY = (0.0, 0.0, -1000.0)
# Part of a prop's colour that is light of its own: its far side is not black.
_GLOW = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Prop:
    """Meshes that are drawn in one place at each station, and touch nothing.

    Attributes:
        name: Unique in the cell.
        solids: Meshes; their body is not read, their poses are in the prop's frame.
        world_from_prop: Where it is at the n stations, shape (n, 4, 4), metres; NaN
            where it is not in the cell.
    """

    name: str
    solids: tuple[Geometry, ...]
    world_from_prop: Floats

    def __post_init__(self) -> None:
        """Lock; raise InputError where a solid is no mesh or a shape does not fit."""
        places = locked(
            f"prop {self.name!r}: world_from_prop",
            self.world_from_prop,
            (None, 4, 4),
            finite=False,
        )
        object.__setattr__(self, "world_from_prop", places)
        other = [solid.name for solid in self.solids if solid.shape != "mesh"]
        if other:
            raise InputError(
                f"prop {self.name!r}: {', '.join(other)} must be given as meshes"
            )


def add_prop(mujoco: Any, spec: Any, prop: Prop) -> None:
    """Add a prop's body to a cell that is being compiled."""
    body = spec.worldbody.add_body(name=body_name(prop), pos=_AWAY)
    for solid in prop.solids:
        name = f"{body_name(prop)}/{solid.name}"
        paint = spec.add_material(
            name=name, rgba=solid.rgba, emission=_GLOW, specular=0.0, shininess=0.0
        )
        mesh = spec.add_mesh(
            name=name,
            uservert=solid.vertices.ravel(),
            userface=solid.faces.ravel(),
            # Surfaces need not be closed.
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
            # Flat faces stay flat: no shading across their edges.
            smoothnormal=False,
        )
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh.name,
            material=paint.name,
            contype=0,
            conaffinity=0,
            group=0,
        )


def place_prop(model: Any, prop: Prop, station: int) -> None:
    """Put a prop where it is at a station."""
    pose = prop.world_from_prop[station]
    here = bool(np.isfinite(pose).all())
    body = model.body(body_name(prop))
    body.pos = pose[:3, 3] if here else _AWAY
    if here:
        body.quat = quaternion_wxyz(pose[:3, :3])


def body_name(prop: Prop) -> str:
    """Name of a prop's body in the model."""
    return f"prop/{prop.name}"
