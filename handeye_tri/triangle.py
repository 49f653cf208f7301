"""The three-point rig: a triangle given by two sides and the angle between.

Frame: A is the origin, B lies on +x, C in the half-plane y > 0, z is the normal.
Source of the description: Zhao, Liu and Zhang 2008, Sec. II-B
(doi:10.1109/TIP.2008.2005562).
"""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.errors import InputError
from handeye_tri.se3 import SE3, hat

Floats = NDArray[np.float64]
Axis = Literal["normal", "AB", "BC", "CA"]
AXES: tuple[Axis, ...] = get_args(Axis)
VERTICES = ("A", "B", "C")
# The two vertices on each edge, as rows of TriangleRig.points.
EDGES: dict[str, tuple[int, int]] = {"AB": (0, 1), "BC": (1, 2), "CA": (2, 0)}
# The least cosine of the angle by which the triangle is seen aslant, for its markers to
# be told from other things: 66 degrees.
MIN_FACING = 0.4
# Flatter than this, the three points are as good as collinear.
_MIN_ANGLE = np.radians(1.0)


@dataclass(frozen=True, slots=True)
class TriangleRig:
    """Three noncollinear points A, B, C.

    Attributes:
        side_ab: |AB|, metres.
        side_ac: |AC|, metres.
        angle: Angle at A, radians, in (0, pi).
    """

    side_ab: float
    side_ac: float
    angle: float

    def __post_init__(self) -> None:
        """Raise InputError unless this is a proper triangle."""
        for name in ("side_ab", "side_ac", "angle"):
            value = getattr(self, name)
            if not isinstance(value, Real):
                raise InputError(f"{name} must be a number, got {value!r}")
        for name in ("side_ab", "side_ac"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} must be a positive length, got {value} m")
        if not np.isfinite(self.angle) or not 0 < self.angle < np.pi:
            raise InputError(
                f"angle must lie between 0 and pi radians, got {self.angle}; "
                "degrees must be converted first"
            )
        flattest = min(self.angles)
        if flattest < _MIN_ANGLE:
            raise InputError(
                f"A, B and C are nearly collinear: the smallest angle is "
                f"{np.degrees(flattest):.3f} degrees (needs at least 1); "
                "move one marker off the line"
            )

    @classmethod
    def from_points(cls, points: ArrayLike) -> TriangleRig:
        """Triangle through measured A, B, C, shape (3, 3) or (3, 2), metres.

        Raises:
            InputError: no numbers, wrong shape, NaN, or the points are nearly
                collinear.
        """
        try:
            p = np.asarray(points, dtype=float)
        except (TypeError, ValueError):
            raise InputError(
                f"A, B and C must be real numbers, got {points!r}"
            ) from None
        if p.shape not in ((3, 3), (3, 2)):
            raise InputError(
                f"A, B and C are points of shape (3, 3) or (3, 2), got {p.shape}"
            )
        ab, ac = p[1] - p[0], p[2] - p[0]
        lengths = float(np.linalg.norm(ab)), float(np.linalg.norm(ac))
        if min(lengths) == 0 or not np.any(p[1] - p[2]):
            raise InputError("two of A, B and C coincide; give three distinct points")
        # Half-angle form (Kahan): keeps its digits at every angle.
        u, v = ab / lengths[0], ac / lengths[1]
        angle = 2 * np.arctan2(np.linalg.norm(u - v), np.linalg.norm(u + v))
        if angle in (0, np.pi):
            raise InputError("A, B and C are collinear; move one marker off the line")
        return cls(*lengths, float(angle))

    @property
    def points(self) -> Floats:
        """A, B, C in the triangle's frame, shape (3, 3), metres."""
        return np.array(
            [
                [0.0, 0.0, 0.0],
                [self.side_ab, 0.0, 0.0],
                [
                    self.side_ac * np.cos(self.angle),
                    self.side_ac * np.sin(self.angle),
                    0.0,
                ],
            ]
        )

    @property
    def side_bc(self) -> float:
        """|BC|, metres, by the law of cosines."""
        square = (
            self.side_ab**2
            + self.side_ac**2
            - 2 * self.side_ab * self.side_ac * np.cos(self.angle)
        )
        return float(np.sqrt(max(square, 0.0)))

    @property
    def angles(self) -> tuple[float, float, float]:
        """Angles at A, B and C, radians."""
        at_b = float(
            np.arctan2(
                self.side_ac * np.sin(self.angle),
                self.side_ab - self.side_ac * np.cos(self.angle),
            )
        )
        return self.angle, at_b, np.pi - self.angle - at_b

    @property
    def circumcentre(self) -> Floats:
        """Point at equal distance from A, B and C, shape (2,), metres."""
        _, b, c = self.points[:, :2]
        solution = np.linalg.solve(np.array([b, c]), 0.5 * np.array([b @ b, c @ c]))
        return np.asarray(solution)

    def half_turn(self, axis: Axis, o: ArrayLike | None = None) -> SE3:
        """The 180-degree rotation about an axis, in the triangle's frame.

        Args:
            axis: "normal", or the edge "AB", "BC" or "CA".
            o: For "normal": where the axis meets the plane, shape (2,), metres.

        Returns:
            ``before_from_after``: the triangle's frame after the turn, seen in its
            frame before the turn. A half-turn is its own inverse.

        Raises:
            InputError: the axis is unknown, or "normal" comes without ``o``.
        """
        if axis == "normal":
            if o is None:
                raise InputError('half_turn("normal") needs o, the foot of the axis')
            direction = np.array([0.0, 0.0, 1.0])
            through = np.append(np.asarray(o, dtype=float), 0.0)
        elif axis in EDGES:
            start, end = self.points[list(EDGES[axis])]
            direction = (end - start) / np.linalg.norm(end - start)
            through = start
        else:
            raise InputError(f"axis must be one of {', '.join(AXES)}, got {axis!r}")
        rotation = 2.0 * np.outer(direction, direction) - np.eye(3)
        return SE3.from_parts(rotation, through - rotation @ through)

    def foot(self, axis: Axis) -> Floats:
        """Where the third vertex' perpendicular meets an edge axis, shape (2,).

        This is the paper's D (Sec. III-B) for B and axis AC, in metres.
        """
        if axis not in EDGES:
            raise InputError(f"foot needs an edge, got {axis!r}")
        first, second = EDGES[axis]
        third = 3 - first - second
        start, end, apex = self.points[[first, second, third], :2]
        along = (end - start) / np.linalg.norm(end - start)
        return np.asarray(start + along * ((apex - start) @ along))


def triangle_frame(markers: Floats) -> SE3:
    """flange_from_triangle of markers A, B, C in the flange, shape (3, 3), metres."""
    along, toward = markers[1] - markers[0], markers[2] - markers[0]
    x = along / np.linalg.norm(along)
    z = np.cross(x, toward)
    z /= np.linalg.norm(z)
    return SE3.from_parts(np.stack([x, np.cross(z, x), z], axis=1), markers[0])


def frame_by_markers(markers: Floats) -> Floats:
    """Derivative of the right tangent of the triangle's frame by A, B, C, (6, 9).

    A marker P in the triangle's frame moves in the flange by R (dt + dr x P + dP),
    where dP is along x for B, in the plane for C: nine numbers for nine.
    """
    frame = triangle_frame(markers)
    points = frame.inverse().apply(markers)
    by_frame = np.zeros((3, 3, 9))
    by_frame[..., :3], by_frame[..., 3:6] = np.eye(3), -hat(points)
    by_frame[1, 0, 6] = by_frame[2, 0, 7] = by_frame[2, 1, 8] = 1.0
    by_shape = (frame.rotation @ by_frame).reshape(9, 9)
    return np.asarray(np.linalg.inv(by_shape)[:6])


def apparent_scales(pixels: Floats, sides: Floats) -> Floats:
    """How large a triangle appears, the longer way and the shorter (weak perspective).

    Args:
        pixels: Of A, B, C, shape (..., 3, 2).
        sides: AB and AC in the triangle's plane, shape (..., 2, 2), metres.

    Returns:
        Shape (..., 2), px per metre; the second over the first is the cosine of the
        angle by which the triangle is seen aslant.
    """
    seen = pixels[..., 1:, :] - pixels[..., :1, :]
    return np.asarray(
        np.linalg.svd(np.linalg.solve(sides, seen), compute_uv=False), dtype=float
    )
