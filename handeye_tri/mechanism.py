"""A compiled robot cell as plain arrays, the same for every engine.

The simulator compiles the cell once; kinematics, collision and the recording are
built from these arrays, so that all of them agree for any model.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import InputError
from handeye_tri.records import locked
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]
JointKind = Literal["hinge", "slide"]
Shape = Literal["box", "sphere", "capsule", "cylinder", "ellipsoid", "plane", "mesh"]
# How many numbers say the size of each shape.
_SIZES = {
    "box": 3,
    "sphere": 1,
    "capsule": 2,
    "cylinder": 2,
    "ellipsoid": 3,
    "plane": 0,
    "mesh": 0,
}


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """One degree of freedom between a body and its parent.

    Attributes:
        name: Name in the model.
        body: Index of the body that it moves.
        kind: "hinge" (rad) or "slide" (m).
        anchor: A point on the axis in the body's frame, shape (3,), metres.
        axis: Unit axis in the body's frame, shape (3,).
        lower: Lower limit, rad or m; -inf where there is none.
        upper: Upper limit, rad or m; +inf where there is none.
        reference: Value at which the body has its ``parent_from_body``.
        speed: Speed limit, rad/s or m/s; inf where the model states none.
    """

    name: str
    body: int
    kind: JointKind
    anchor: Floats
    axis: Floats
    lower: float
    upper: float
    reference: float
    speed: float

    def __post_init__(self) -> None:
        """Lock; raise InputError where the axis or the limits are impossible."""
        for key in ("anchor", "axis"):
            name = f"joint {self.name!r}: {key}"
            object.__setattr__(self, key, locked(name, getattr(self, key), (3,)))
        if abs(np.linalg.norm(self.axis) - 1) > 1e-9:
            raise InputError(
                f"joint {self.name!r}: the axis must have length 1, "
                f"got {self.axis.tolist()}"
            )
        if not self.lower <= self.upper:
            raise InputError(
                f"joint {self.name!r}: the lower limit {self.lower:g} exceeds the "
                f"upper limit {self.upper:g}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """One rigid body.

    Attributes:
        name: Name in the model ("world" for body 0).
        parent: Index of the parent; 0 is the world, which is its own parent.
        parent_from_body: Pose with all joints at their references.
    """

    name: str
    parent: int
    parent_from_body: SE3


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """One solid, fixed to a body.

    Attributes:
        name: Name in the model; made up from the body where it has none.
        body: Index of the body.
        shape: What it is.
        size: box: half sides (3); sphere: radius; capsule and cylinder: radius,
            half length along z; ellipsoid: half axes (3); plane and mesh: empty. m.
        body_from_geometry: Pose in the body's frame.
        vertices: Mesh vertices, shape (v, 3), metres; empty otherwise.
        faces: Mesh triangles, shape (f, 3); empty otherwise.
        rgba: Colour, 0-1, shape (4,).
        collides: Whether it can touch; False for what is only drawn.
    """

    name: str
    body: int
    shape: Shape
    size: Floats
    body_from_geometry: SE3
    vertices: Floats
    faces: NDArray[np.int64]
    rgba: Floats
    collides: bool

    def __post_init__(self) -> None:
        """Lock; raise InputError where a shape or a mesh index does not fit."""
        label = f"geometry {self.name!r}"
        for key, shape in (
            ("size", (_SIZES[self.shape],)),
            ("vertices", (None, 3)),
            ("rgba", (4,)),
        ):
            array = locked(f"{label}: {key}", getattr(self, key), shape)
            object.__setattr__(self, key, array)
        faces = np.array(self.faces, dtype=np.int64).reshape(-1, 3)
        if faces.size and not 0 <= faces.min() <= faces.max() < len(self.vertices):
            raise InputError(
                f"{label}: a face names a vertex beyond the {len(self.vertices)} "
                "there are"
            )
        faces.setflags(write=False)
        object.__setattr__(self, "faces", faces)


@dataclass(frozen=True, slots=True, eq=False)
class Mechanism:
    """The compiled cell: a tree of bodies with joints, solids and named frames.

    Attributes:
        bodies: Body 0 is the world; a parent comes before its children.
        joints: In the order of the configuration vector.
        geometries: All solids.
        base: Name of the body that the robot's poses refer to.
        flange: Name of the frame that the robot reports.
        base_body: Index of the base's body.
        flange_body: Index of the body that carries the flange.
        body_from_flange: The flange in that body's frame.
        marker_body: Index of the body that carries the markers.
        markers: A, B, C in that body's frame, shape (3, 3), metres.
        touching: Pairs of body indices whose contact is excluded by the model.
    """

    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    geometries: tuple[Geometry, ...]
    base: str
    flange: str
    base_body: int
    flange_body: int
    body_from_flange: SE3
    marker_body: int
    markers: Floats
    touching: frozenset[tuple[int, int]]

    def __post_init__(self) -> None:
        """Lock; raise InputError unless the bodies are a tree in parents' order."""
        object.__setattr__(self, "markers", locked("markers", self.markers, (3, 3)))
        n = len(self.bodies)
        for index, body in enumerate(self.bodies):
            if not 0 <= body.parent < max(index, 1):
                raise InputError(
                    f"body {body.name!r} comes before its parent; list parents first"
                )
        used = [self.base_body, self.flange_body, self.marker_body]
        used += [joint.body for joint in self.joints]
        used += [geometry.body for geometry in self.geometries]
        if not all(0 <= body < n for body in used):
            raise InputError(f"a body index lies beyond the {n} bodies there are")

    def chain(self, body: int) -> tuple[int, ...]:
        """Bodies from the world's child down to ``body``, in that order."""
        path: list[int] = []
        while body != 0:
            path.append(body)
            body = self.bodies[body].parent
        return tuple(reversed(path))

    @property
    def arm_joints(self) -> tuple[int, ...]:
        """Indices of the joints between base and flange, from the base outward.

        Raises:
            InputError: no joint lies between base and flange.
        """
        above_base = set(self.chain(self.base_body))
        path = [b for b in self.chain(self.flange_body) if b not in above_base]
        order = {body: rank for rank, body in enumerate(path)}
        moving = [
            (order[joint.body], index)
            for index, joint in enumerate(self.joints)
            if joint.body in order
        ]
        if not moving:
            raise InputError(
                f"no joint lies between base {self.base!r} and flange "
                f"{self.flange!r}; name the last link's frame as the flange"
            )
        return tuple(index for _, index in sorted(moving))
