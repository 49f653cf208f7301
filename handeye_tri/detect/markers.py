"""What is looked for in an image, and what was found."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from handeye_tri.errors import InputError
from handeye_tri.records import Floats, locked

if TYPE_CHECKING:
    from handeye_tri.config import TriangleConfig

Identity = Literal["colour", "radius"]
Reason = Literal[
    "no_candidate",
    "at_border",
    "occluded",
    "not_round",
    "no_fit",
    "ambiguous",
    "aslant",
]

# Colours nearer to grey than this, or to each other in hue, are not told apart.
_MIN_CHROMA = 0.2
_MAX_HUE_COSINE = 0.9
# Radii nearer than this are not told apart at unequal depths.
_MIN_RADIUS_STEP = 0.1


def chroma(colours: Floats) -> Floats:
    """What is left of colours, shape (..., 3), without their grey part."""
    return np.asarray(colours - colours.mean(axis=-1, keepdims=True))


@dataclass(frozen=True, slots=True, eq=False)
class MarkerSpec:
    """The three balls A, B, C, and what tells them apart.

    Attributes:
        identity: "colour" (RGB images) or "radius" (grey images).
        colours: Red, green, blue of A, B, C, 0-1, shape (3, 3).
        radii: Radii of A, B, C, metres, shape (3,).
        points: Their centres in the triangle's plane, metres, shape (3, 2), by which
            other things of their looks are told from them; None where not known.
    """

    identity: Identity
    colours: Floats
    radii: Floats
    points: Floats | None = None

    def __post_init__(self) -> None:
        """Lock the arrays.

        Raises:
            InputError: a shape or value does not fit, or two markers look the same.
        """
        if self.identity not in get_args(Identity):
            raise InputError(
                f'identity must be "colour" or "radius", got {self.identity!r}'
            )
        colours = locked("marker colours", self.colours, (3, 3))
        radii = locked("marker radii", self.radii, (3,))
        if colours.min() < 0 or colours.max() > 1:
            raise InputError(
                f"marker colours are red, green, blue of 0-1, got {colours.tolist()}"
            )
        if radii.min() <= 0:
            raise InputError(
                f"marker radii must be positive metres, got {radii.tolist()}"
            )
        if self.points is not None:
            points = locked("marker points", self.points, (3, 2))
            object.__setattr__(self, "points", points)
        object.__setattr__(self, "colours", colours)
        object.__setattr__(self, "radii", radii)
        if self.identity == "colour":
            self._check_colours()
        else:
            self._check_radii()

    def _check_colours(self) -> None:
        hues = chroma(self.colours)
        strength = np.linalg.norm(hues, axis=1)
        if strength.min() < _MIN_CHROMA:
            raise InputError(
                f"marker {'ABC'[int(strength.argmin())]} is nearly grey: identity by "
                "colour needs three saturated colours, got "
                f"{self.colours[int(strength.argmin())].tolist()}"
            )
        cosines = (hues @ hues.T) / np.outer(strength, strength) - 2.0 * np.eye(3)
        if cosines.max() > _MAX_HUE_COSINE:
            first, second = sorted(np.unravel_index(cosines.argmax(), (3, 3)))
            raise InputError(
                f"markers {'ABC'[first]} and {'ABC'[second]} have nearly the same hue: "
                "identity by colour needs three different hues, got "
                f"{self.colours[[first, second]].tolist()}"
            )

    def _check_radii(self) -> None:
        steps = np.sort(self.radii)
        if (steps[1:] / steps[:-1]).min() < 1.0 + _MIN_RADIUS_STEP:
            raise InputError(
                "identity by radius needs radii at least 10 % apart, got "
                f"{(1e3 * self.radii).tolist()} mm"
            )

    @classmethod
    def from_rig(cls, rig: TriangleConfig) -> MarkerSpec:
        """The markers of a cell's rig.

        Raises:
            InputError: the markers cannot be told apart.
        """
        return cls(
            rig.identity,
            np.array(rig.marker_colours),
            1e-3 * np.array(rig.marker_radii_mm),
            rig.triangle.points[:, :2],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """The three markers as one image shows them.

    Attributes:
        pixels: Centres of the outlines of A, B, C, shape (3, 2); NaN = not found.
        covariance: Of each centre, shape (3, 2, 2), px^2; NaN = not found.
        radii_px: Mean radii of the outlines, shape (3,), px; NaN = not found.
        reasons: Why a marker was not found; None where it was. "no_candidate":
            nothing of its kind is in the image; "at_border": the image cuts it off;
            "occluded": too little of its outline shows; "not_round": the outline is
            no ellipse; "no_fit": the fit did not settle; "ambiguous": more than one
            thing could be it; "aslant": the triangle is seen nearly from its edge.
        edges: How wide the edge is across direction t: its variance is mean + cos(2t)
            c + sin(2t) s; (mean, c, s) of A, B, C, shape (3, 3), px^2; NaN = not found.
    """

    pixels: Floats
    covariance: Floats
    radii_px: Floats
    reasons: tuple[Reason | None, ...]
    edges: Floats = field(default_factory=lambda: np.full((3, 3), np.nan))

    def __post_init__(self) -> None:
        """Lock the arrays.

        Raises:
            InputError: a shape does not fit, or a reason contradicts the pixels.
        """
        pixels = locked("pixels", self.pixels, (3, 2), finite=False)
        covariance = locked("covariance", self.covariance, (3, 2, 2), finite=False)
        radii = locked("radii_px", self.radii_px, (3,), finite=False)
        found = tuple(bool(np.isfinite(pixel).all()) for pixel in pixels)
        if found != tuple(reason is None for reason in self.reasons):
            raise InputError(
                f"reasons {self.reasons} must name every marker that has no pixels "
                f"and no other, found {found}"
            )
        object.__setattr__(self, "pixels", pixels)
        object.__setattr__(self, "covariance", covariance)
        edges = locked("edges", self.edges, (3, 3), finite=False)
        object.__setattr__(self, "edges", edges)
        object.__setattr__(self, "radii_px", radii)

    @property
    def complete(self) -> bool:
        """Whether all three markers were found."""
        return all(reason is None for reason in self.reasons)
