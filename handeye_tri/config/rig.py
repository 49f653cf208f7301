"""The triangle, and how it is held on the flange; units in the keys."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from handeye_tri.config.fields import Model, Number, Positive, Unit
from handeye_tri.errors import InputError
from handeye_tri.se3 import SE3, so3_exp
from handeye_tri.triangle import Axis, TriangleRig


class TriangleConfig(Model):
    """The triangle, the axis it turns about, and how its markers look."""

    axis: Axis
    side_ab_mm: Positive
    side_ac_mm: Positive
    angle_deg: Annotated[Number, Field(gt=0, lt=180)]
    marker_radii_mm: tuple[Positive, Positive, Positive]
    marker_colours: tuple[tuple[Unit, Unit, Unit], ...] = Field(
        min_length=3, max_length=3, description="A, B, C as red green blue, 0-1"
    )
    identity: Literal["colour", "radius"]

    @model_validator(mode="after")
    def _distinguishable(self) -> Self:
        try:
            _ = self.triangle
        except InputError as error:
            raise ValueError(str(error)) from None
        if self.identity == "colour" and len(set(self.marker_colours)) < 3:
            raise ValueError(
                "identity: colour needs three different marker_colours; "
                "use three colours, or identity: radius"
            )
        triangle, balls = self.triangle, self.marker_radii_mm
        sides = 1e3 * np.array([triangle.side_ab, triangle.side_bc, triangle.side_ac])
        if (sides <= np.add(balls, np.roll(balls, -1))).any():
            raise ValueError(
                f"markers of marker_radii_mm {list(balls)} touch each other at "
                f"sides of {', '.join(f'{side:.1f}' for side in sides)} mm; "
                "make the markers smaller or the triangle larger"
            )
        radii = sorted(self.marker_radii_mm)
        if self.identity == "radius" and min(np.diff(radii)) < 0.1 * radii[0]:
            raise ValueError(
                "identity: radius needs marker_radii_mm at least 10 % apart, "
                f"got {list(self.marker_radii_mm)}"
            )
        return self

    @property
    def triangle(self) -> TriangleRig:
        """The rig in metres and radians."""
        return TriangleRig(
            1e-3 * self.side_ab_mm,
            1e-3 * self.side_ac_mm,
            float(np.radians(self.angle_deg)),
        )


class SecondAxis(Model):
    """What is to be known of the mount after a tool change."""

    axis: Axis


class MountConfig(SecondAxis):
    """How a triangle is held on the flange.

    The flange's z axis is the half-turn axis. "normal": it meets the triangle's
    plane in O, by default the circumcentre. An edge: the edge lies on it, its first
    vertex ``ahead_mm`` from the flange.
    """

    ahead_mm: Positive
    turn_deg: Number = 0.0
    o_mm: tuple[Number, Number] | None = Field(
        None, description="O from A, along AB and across it; a normal axis only"
    )
    holder: Literal["rods", "hands", "board"] = Field(
        "rods",
        description="rods; a clock's hands (normal axis); a board (an edge)",
    )

    @model_validator(mode="after")
    def _held(self) -> Self:
        if self.o_mm is not None and self.axis != "normal":
            raise ValueError(
                "o_mm says where a normal axis meets the plane, but axis is "
                f"{self.axis}; leave o_mm out, or use axis: normal"
            )
        fits = {"hands": self.axis == "normal", "board": self.axis != "normal"}
        if not fits.get(self.holder, True):
            raise ValueError(
                f"holder: {self.holder} does not hold an axis {self.axis}: a clock's "
                "hands turn about a normal, a board about an edge; use holder: rods"
            )
        return self


class RigConfig(TriangleConfig, MountConfig):
    """The triangle on the flange, as built."""

    @property
    def flange_from_triangle(self) -> SE3:
        """Where the triangle's frame sits on the flange, as built."""
        triangle = self.triangle
        ahead = np.array([0.0, 0.0, 1e-3 * self.ahead_mm])
        spin = so3_exp([0.0, 0.0, np.radians(self.turn_deg)])
        if self.axis == "normal":
            # The triangle looks ahead, away from the flange.
            foot = triangle.circumcentre
            if self.o_mm is not None:
                foot = 1e-3 * np.array(self.o_mm)
            o = np.append(foot, 0.0)
            return SE3.from_parts(spin, ahead - spin @ o)
        start = {"AB": 0, "BC": 1, "CA": 2}[self.axis]
        points = triangle.points
        along = points[(start + 1) % 3] - points[start]
        along /= np.linalg.norm(along)
        normal = np.array([0.0, 0.0, 1.0])
        # Rows: flange axes in the triangle's frame; z along the edge, y the normal.
        rotation = spin @ np.array([np.cross(normal, along), normal, along])
        return SE3.from_parts(rotation, ahead - rotation @ points[start])
