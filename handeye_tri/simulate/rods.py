"""What holds the three markers on the flange: rods, hands, a board."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.errors import InputError

if TYPE_CHECKING:
    from handeye_tri.config import RigConfig

Floats = NDArray[np.float64]

# How far behind the markers the rods run across, so that they hide none at a tilt.
_STANDOFF = 0.045
# An edge rig is seen from both faces and along its plane: thin rods.
_ROD_RADIUS = 0.0025
_HUB_RADIUS = 0.009
_BOARD_THICKNESS = 0.003
# A board ends so many radii before a marker: seen at 55 degrees from its normal, it
# would hide outlines from 1.75 on.
_CORNER_RADII = 2.3


@dataclass(frozen=True, slots=True, eq=False)
class Rod:
    """A straight round rod.

    Attributes:
        name: What it holds.
        radius: Metres.
        start: Centre of one end in the flange frame, shape (3,), metres.
        end: Centre of the other end, likewise.
    """

    name: str
    radius: float
    start: Floats
    end: Floats


def rig_rods(rig: RigConfig) -> tuple[Rod, ...]:
    """Rods of a rig, in the flange frame.

    A normal rig is a star behind the triangle's plane with a standoff to every
    marker; as a clock, its arms are hands that the markers sit on. An edge rig is a
    flat fork in that plane whose tines reach every marker from the flange's side, so
    that a marker shows from both faces; a board between them has a spar of its own.

    Raises:
        InputError: an edge rig's third marker lies behind the fork's cross bar.
    """
    markers = rig.flange_from_triangle.apply(rig.triangle.points)
    if rig.holder == "hands":
        return _hands(rig, markers)
    bar = max(1e-3 * rig.ahead_mm - _STANDOFF, 0.5e-3 * rig.ahead_mm)
    centre = np.array([0.0, 0.0, bar])
    hub = Rod("hub", _HUB_RADIUS, np.zeros(3), centre)
    if rig.axis == "normal":
        return (hub, *_star(markers, centre))
    start = {"AB": 0, "BC": 1, "CA": 2}[rig.axis]
    order = [(start + k) % 3 for k in range(3)]
    side = markers[order[2]]
    if side[2] < bar + 2e-3 * max(rig.marker_radii_mm):
        raise InputError(
            f"rig.ahead_mm: marker {'ABC'[order[2]]} would lie behind the fork that "
            f"holds it, {1e3 * side[2]:.0f} mm from the flange; choose another edge "
            f"as the axis or an angle below 90 degrees, got ahead_mm {rig.ahead_mm:g}"
        )
    clear = 1e-3 * rig.marker_radii_mm[order[0]] + 0.012
    fork = _fork(markers[order], order, centre, clear)
    if rig.holder == "board":
        middle = markers.mean(axis=0)
        foot = middle + (0.0, 0.0, bar - middle[2])
        fork.append(Rod("spar", _ROD_RADIUS, foot, middle))
    return (hub, *fork)


def rig_board(rig: RigConfig) -> Floats | None:
    """Corners of the board between the markers of an edge rig, in the flange frame.

    The triangle without its corners, which would hide the markers' outlines.

    Returns:
        Shape (12, 3), metres: six corners of one face, then those of the other; None
        where the rig has no board.
    """
    if rig.holder != "board":
        return None
    points = rig.triangle.points
    clear = _CORNER_RADII * 1e-3 * max(rig.marker_radii_mm)
    corners = []
    for k, angle in enumerate(rig.triangle.angles):
        # The cut is across the bisector, so far from the marker.
        along = clear / np.cos(0.5 * angle)
        for other in ((k + 2) % 3, (k + 1) % 3):
            edge = points[other] - points[k]
            corners.append(points[k] + along * edge / np.linalg.norm(edge))
    face = np.array(corners)
    half = np.array([0.0, 0.0, 0.5 * _BOARD_THICKNESS])
    return rig.flange_from_triangle.apply(np.concatenate([face + half, face - half]))


def _hands(rig: RigConfig, markers: Floats) -> tuple[Rod, ...]:
    """A shaft and a hand below each marker, which is sunk in it a little."""
    radius = 1.6 * _ROD_RADIUS
    sunk = 0.05 * radius
    height = 1e-3 * (rig.ahead_mm - max(rig.marker_radii_mm)) - radius + sunk
    top = np.array([0.0, 0.0, height])
    hands = [
        Rod(f"hand {name}", radius, top, np.append(marker[:2], height))
        for name, marker in zip("ABC", markers, strict=True)
    ]
    return (Rod("shaft", _HUB_RADIUS, np.zeros(3), top), *hands)


def _star(markers: Floats, centre: Floats) -> list[Rod]:
    rods = []
    for name, marker in zip("ABC", markers, strict=True):
        foot = np.array([marker[0], marker[1], centre[2]])
        rods.append(Rod(f"arm {name}", 1.6 * _ROD_RADIUS, centre, foot))
        rods.append(Rod(f"standoff {name}", 1.2 * _ROD_RADIUS, foot, marker))
    return rods


def _fork(markers: Floats, order: list[int], centre: Floats, clear: float) -> list[Rod]:
    """Rods to the near and the far marker of the axis and to the one beside it."""
    near, far, side = markers
    across = np.array([side[0], side[1], 0.0])
    across /= np.linalg.norm(across)

    def at(lateral: float, height: float) -> Floats:
        return np.asarray(lateral * across + (0.0, 0.0, height))

    # The far marker's tine turns in as soon as it is beside the near marker: at a
    # small angle to the axis it comes from behind the marker before and after a turn.
    bend = at(-clear, near[2])
    ends: list[tuple[str, ArrayLike, ArrayLike]] = [
        ("bar", at(-clear, centre[2]), at(side @ across, centre[2])),
        (f"tine {'ABC'[order[0]]}", centre, near),
        (f"tine {'ABC'[order[1]]}", at(-clear, centre[2]), bend),
        (f"tip {'ABC'[order[1]]}", bend, far),
        (f"tine {'ABC'[order[2]]}", at(side @ across, centre[2]), side),
    ]
    return [
        Rod(name, _ROD_RADIUS, np.asarray(start), np.asarray(end))
        for name, start, end in ends
    ]
