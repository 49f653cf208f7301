"""Solids against solids: shapes, contact, and cones of sight.

The only module that builds shapes and asks coal about them; arm.py moves them.
"""

from __future__ import annotations

import coal
import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import InputError
from handeye_tri.mechanism import Geometry

Floats = NDArray[np.float64]

# A sight line starts this far ahead of the camera centre: a housing whose front
# face holds the centre is no obstacle.
_START = 0.001
# What holds a marker may hide its outline where it lies less than this part of the
# radius before the outline's plane: 1 % of the radius is covered there.
_HOLDER_DEPTH = 0.15
# A mesh thinner than this in some direction is a sheet, metres.
_THIN = 1e-5
# The side of a cone near its marker, as triangles between two circles.
_SEGMENTS = 24
_ANGLES = 2 * np.pi * np.arange(_SEGMENTS) / _SEGMENTS
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES), np.ones(_SEGMENTS)], axis=1)
_AROUND = np.stack([np.arange(_SEGMENTS), np.roll(np.arange(_SEGMENTS), -1)], axis=1)
_SIDE = np.concatenate(
    [
        np.column_stack([_AROUND, _AROUND[:, 0] + _SEGMENTS]),
        np.column_stack([_AROUND[:, 1], _AROUND[:, ::-1] + _SEGMENTS]),
    ]
)


def coal_shape(geometry: Geometry) -> coal.CollisionGeometry:
    """The solid in coal; a mesh as its convex hull, as simulators take it."""
    size = geometry.size
    match geometry.shape:
        case "box":
            return coal.Box(*(2 * size))
        case "sphere":
            return coal.Sphere(float(size[0]))
        case "capsule":
            return coal.Capsule(float(size[0]), float(2 * size[1]))
        case "cylinder":
            return coal.Cylinder(float(size[0]), float(2 * size[1]))
        case "ellipsoid":
            return coal.Ellipsoid(*(float(s) for s in size))
        case "plane":
            return coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
        case "mesh":
            vertices = _thickened(geometry.vertices)
            mesh = coal.BVHModelOBBRSS()
            mesh.beginModel(len(geometry.faces), len(vertices))
            mesh.addVertices(vertices)
            mesh.addTriangles(geometry.faces)
            mesh.endModel()
            mesh.buildConvexHull(True, "Qt")
            return mesh.convex


def _thickened(vertices: Floats) -> Floats:
    """Vertices (n, 3), a flat sheet's or a line's doubled: coal's hull needs a body."""
    centred = vertices - vertices.mean(axis=0)
    _, extent, directions = np.linalg.svd(centred, full_matrices=len(vertices) < 3)
    extent = np.append(extent, np.zeros(3 - len(extent)))
    for direction in directions[extent < _THIN]:
        step = _THIN * direction
        vertices = np.concatenate([vertices - step, vertices + step])
    return vertices


def bounding_radius(geometry: Geometry) -> float:
    """Radius of the ball around the solid's origin that holds it, metres."""
    size = geometry.size
    match geometry.shape:
        case "sphere":
            return float(size[0])
        case "capsule":
            return float(size[0] + size[1])
        case "cylinder":
            return float(np.hypot(size[0], size[1]))
        case "box":
            return float(np.linalg.norm(size))
        case "ellipsoid":
            return float(size.max())
        case "mesh":
            return float(np.linalg.norm(geometry.vertices, axis=1).max())
        case "plane":
            return float("inf")


def touch(
    first: coal.CollisionGeometry,
    first_pose: coal.Transform3s,
    second: coal.CollisionGeometry,
    second_pose: coal.Transform3s,
) -> bool:
    """Whether two solids share a point."""
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    return bool(coal.collide(first, first_pose, second, second_pose, request, result))


def transform(rotation: Floats, translation: Floats) -> coal.Transform3s:
    """A pose as coal takes it; rotation (3, 3), translation (3,), metres."""
    return coal.Transform3s(np.asarray(rotation), np.asarray(translation))


def frame_along(axis: Floats) -> Floats:
    """A rotation whose z axis is the direction of a vector, shape (3, 3)."""
    z = axis / np.sqrt(axis @ axis)
    x = np.zeros(3)
    x[int(np.argmin(np.abs(z)))] = 1.0
    x -= (x @ z) * z
    x /= np.sqrt(x @ x)
    frame = np.empty((3, 3))
    frame[:, 0], frame[:, 2] = x, z
    # Written out: np.cross costs ten times as much on one vector.
    frame[0, 1] = z[1] * x[2] - z[2] * x[1]
    frame[1, 1] = z[2] * x[0] - z[0] * x[2]
    frame[2, 1] = z[0] * x[1] - z[1] * x[0]
    return frame


class SightCone:
    """All lines of sight from a camera centre to the outline of a sphere.

    The base is the outline, the circle where the tangents touch the sphere
    (distance d, radius r: at depth d - r^2/d, with slope r / sqrt(d^2 - r^2)).
    """

    def __init__(self, apex: Floats, centre: Floats, radius: float) -> None:
        """Set up the cone.

        Args:
            apex: Camera centre, shape (3,), metres.
            centre: Centre of the sphere, shape (3,), metres.
            radius: Of the sphere, metres.

        Raises:
            InputError: the camera is within the sphere.
        """
        distance = float(np.linalg.norm(centre - apex))
        if distance <= radius + _START:
            raise InputError(
                f"a marker is {distance:.3f} m from the camera centre, within its "
                f"radius of {radius:.3f} m; move the camera away"
            )
        self._apex = apex
        self._frame = frame_along(centre - apex)
        self._distance = distance
        self._radius = radius
        self._base = distance - radius**2 / distance
        self._slope = radius / np.sqrt(distance**2 - radius**2)
        self._whole = self._cone(self._base)

    def near(self, centres: Floats, bounds: Floats) -> NDArray[np.intp]:
        """Which balls may enter the cone: centres (g, 3) and radii (g,), metres."""
        local = (centres - self._apex) @ self._frame
        ahead = local[:, 2]
        aside = np.sqrt(local[:, 0] ** 2 + local[:, 1] ** 2)
        close = aside <= bounds + self._slope * np.clip(ahead, 0.0, self._base)
        return np.flatnonzero(close & (ahead > -bounds) & (ahead - bounds < self._base))

    def entered_by(self, shape: coal.CollisionGeometry, pose: coal.Transform3s) -> bool:
        """Whether a solid enters the cone."""
        return touch(*self._whole, shape, pose)

    def entered_by_holder(
        self, shape: coal.CollisionGeometry, pose: coal.Transform3s
    ) -> bool:
        """Whether a solid that reaches into the sphere hides it.

        Looks at the cone before the sphere, and at the cone's side from there
        almost to the outline: what is within the sphere hides nothing.
        """
        front = self._cone(self._distance - self._radius)
        return touch(*front, shape, pose) or touch(*self._side(), shape, pose)

    def _cone(self, length: float) -> tuple[coal.Cone, coal.Transform3s]:
        """The cone down to a depth; coal's has its apex at +z and is centred."""
        height = length - _START
        middle = self._apex + (_START + 0.5 * height) * self._frame[:, 2]
        # The frame turned by half about its x axis: z from the base to the apex.
        toward = self._frame * (1.0, -1.0, -1.0)
        return coal.Cone(self._slope * length, height), transform(toward, middle)

    def _side(self) -> tuple[coal.BVHModelOBBRSS, coal.Transform3s]:
        """The cone's side from the sphere's front almost to its outline."""
        depths = self._distance - self._radius * np.array([1.0, _HOLDER_DEPTH])
        vertices = depths[:, None, None] * (_CIRCLE * (self._slope, self._slope, 1.0))
        side = coal.BVHModelOBBRSS()
        side.beginModel(len(_SIDE), 2 * len(_CIRCLE))
        side.addVertices(vertices.reshape(-1, 3))
        side.addTriangles(_SIDE)
        side.endModel()
        return side, transform(self._frame, self._apex)
