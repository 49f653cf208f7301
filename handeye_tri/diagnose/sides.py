"""The markers' sides as the robot's motions give them, against the stated ones."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from handeye_tri.diagnose.causes import CHANCE
from handeye_tri.diagnose.gates import Finding
from handeye_tri.diagnose.loop import Fit
from handeye_tri.records import Session
from handeye_tri.triangle import EDGES

Floats = NDArray[np.float64]

# Sides that differ by less than this are measured as well as anyone does.
_TOLERANCE = 1e-3
# Beyond this no ruler is at fault but a unit.
_UNIT = 0.1
_UNITS = (
    (1e-3, "metres for millimetres"),
    (1e-2, "metres for centimetres"),
    (0.1, "centimetres for millimetres"),
    (0.0254, "metres for inches"),
    (1 / 25.4, "inches for millimetres"),
    (0.3048, "metres for feet"),
)
_UNIT_TOLERANCE = 0.05
# A measure is told that differs by so many sigmas between two mounts.
_DIFFERENT_SIGMAS = 3.0
# What is measured of a triangle, its unit, and that unit in metres or radians.
_NAMES = (
    ("side AB", "mm", 1e3),
    ("side AC", "mm", 1e3),
    ("the angle at A", "deg", float(np.degrees(1.0))),
)


def side_finding(session: Session, fit: Fit) -> Finding | None:
    """Which side was measured wrongly, or in which unit; None where all fit.

    The robot's motions fix the metre and need no measured side. Explained are the
    three lengths by the fewest wrong of AB, AC and the angle between them, or by one
    factor on all lengths. All mounts hold the same triangle; where they do not, that is
    the answer.

    Args:
        session: What was stated.
        fit: The cell with everything else that is wrong taken out.
    """
    each, slopes = zip(*(_measures(markers) for markers in fit.markers), strict=True)
    stated = np.array(
        [session.triangle.side_ab, session.triangle.side_ac, session.triangle.angle]
    )
    noise = max(1.0, fit.chi2 / max(fit.dof, 1))
    slope = block_diag(*slopes)
    found, covariance, apart = _in_common(
        np.concatenate(each), noise * slope @ fit.markers_covariance @ slope.T
    )
    if apart is not None:
        return _different_finding(session, np.array(each), apart)
    missed = found - stated
    square = float(missed @ np.linalg.solve(covariance, missed))
    # scipy.stats has the same tail but takes a second to import.
    from scipy.special import chdtrc

    relative = np.abs(missed / [stated[0], stated[1], 1.0])
    if chdtrc(3, square) > CHANCE or relative.max() < _TOLERANCE:
        return None
    factor, sigma = _common_factor(found, stated, covariance)
    if abs(factor - 1) > _UNIT:
        return Finding(
            "UNIT",
            f"the triangle and the robot are in different units{unit_words(factor)}",
            f"by the robot's motions the sides are {factor:.5g} +- {sigma:.2g} times "
            "as long as stated",
            "error",
            "check the unit of rig.side_ab_mm and side_ac_mm, and that of the robot's "
            "poses; nothing is converted on a guess",
        )
    wrong = _fewest(missed, covariance)
    told = [
        f"{name} is {unit * found[k]:.3f} +- {unit * np.sqrt(covariance[k, k]):.3f} "
        f"{word} by the robot's motions, {unit * stated[k]:.3f} stated"
        for k, (name, word, unit) in enumerate(_NAMES)
        if k in wrong
    ]
    common = len(wrong) > 1 and _fits(
        found - factor * stated * [1, 1, 0] - stated * [0, 0, 1], covariance, 2
    )
    cause = (
        f"all sides are {factor:.5f} times as long as stated, or the robot's lengths "
        "are off by that factor"
        if common
        else f"{' and '.join(_NAMES[k][0] for k in wrong)} of the triangle "
        f"{'was' if len(wrong) == 1 else 'were'} measured wrongly"
    )
    return Finding(
        "SIDES",
        cause,
        "; ".join(told),
        "warning",
        "measure again between the marker centres; calibrated jointly, the result "
        "takes its metre from the robot, not from these sides",
    )


def _in_common(
    each: Floats, covariance: Floats
) -> tuple[Floats, Floats, Floats | None]:
    """What mounts say together of the one triangle that they hold.

    Given that all are alike: the first's, corrected by what the others differ from it.

    Args:
        each: Measures by mount, one after the other, shape (3 k,).
        covariance: Of all of them, (3 k, 3 k).

    Returns:
        Measures (3,), their covariance (3, 3); None, or, where the mounts differ by
        more than chance and tolerance, the sigmas of what they differ by, (k - 1, 3).
    """
    others = len(each) // 3 - 1
    difference = np.hstack([np.tile(-np.eye(3), (others, 1)), np.eye(3 * others)])
    between = difference @ covariance @ difference.T
    missed = difference @ each
    gain = np.linalg.solve(between, difference @ covariance[:, :3]).T
    apart = None
    relative = np.abs(missed) / np.tile([each[0], each[1], 1.0], others)
    # scipy.stats has the same tail but takes a second to import.
    from scipy.special import chdtrc

    square = float(missed @ np.linalg.solve(between, missed))
    beyond = relative.max(initial=0.0) >= _TOLERANCE
    if beyond and chdtrc(3 * others, square) <= CHANCE:
        apart = np.sqrt(np.diagonal(between)).reshape(others, 3)
    found = each[:3] - gain @ missed
    return found, covariance[:3, :3] - gain @ difference @ covariance[:, :3], apart


def _different_finding(session: Session, each: Floats, apart: Floats) -> Finding:
    """The triangle is another one on another mount.

    Args:
        session: Names the mounts.
        each: Measures by mount, (k, 3).
        apart: Sigmas of those after the first less the first, (k - 1, 3).
    """
    told = [
        f"{name} is {unit * each[0, k]:.3f} {word} on {session.mount_name(0)}, "
        f"{unit * each[mount, k]:.3f} (+- {unit * apart[mount - 1, k]:.3f}) on "
        f"{session.mount_name(mount)}"
        for mount in range(1, len(each))
        for k, (name, word, unit) in enumerate(_NAMES)
        if abs(each[mount, k] - each[0, k]) > _DIFFERENT_SIGMAS * apart[mount - 1, k]
    ]
    return Finding(
        "SIDES",
        "the mounts do not hold the same triangle",
        f"{'; '.join(told)}, by the robot's motions",
        "warning",
        "look whether a marker moved at the tool change; put the same triangle on both "
        "mounts and record again",
    )


def _measures(markers: Floats) -> tuple[Floats, Floats]:
    """|AB|, |AC|, the angle at A, and their derivative by the markers, (3, 9)."""
    ab, ac = (
        markers[EDGES[name][1]] - markers[EDGES[name][0]] for name in ("AB", "CA")
    )
    ac = -ac
    lengths = np.linalg.norm(ab), np.linalg.norm(ac)
    u, v = ab / lengths[0], ac / lengths[1]
    cosine = float(u @ v)
    sine = np.sqrt(1.0 - cosine**2)
    by_b = -(v - cosine * u) / (lengths[0] * sine)
    by_c = -(u - cosine * v) / (lengths[1] * sine)
    slope = np.array(
        [
            np.concatenate([-u, u, np.zeros(3)]),
            np.concatenate([-v, np.zeros(3), v]),
            np.concatenate([-by_b - by_c, by_b, by_c]),
        ]
    )
    return np.array([*lengths, np.arccos(cosine)]), slope


def _common_factor(
    found: Floats, stated: Floats, covariance: Floats
) -> tuple[float, float]:
    """By least squares on both sides, and its standard deviation."""
    sides = stated[:2]
    weighed = np.linalg.solve(covariance[:2, :2], sides)
    information = float(sides @ weighed)
    return float(found[:2] @ weighed / information), float(information**-0.5)


def unit_words(factor: float) -> str:
    """Which units could have been confused, to be added to a sentence; "" for none."""
    for value, words in _UNITS:
        for ratio, said in ((value, words), (1 / value, words)):
            if abs(factor / ratio - 1) < _UNIT_TOLERANCE:
                return f", as {said} or the reverse"
    return ""


def _fits(missed: Floats, covariance: Floats, freedom: int) -> bool:
    from scipy.special import chdtrc

    return bool(
        chdtrc(freedom, float(missed @ np.linalg.solve(covariance, missed))) > CHANCE
    )


def _fewest(missed: Floats, covariance: Floats) -> tuple[int, ...]:
    """The fewest of the three that, left free, explain the misfit."""
    for count in (1, 2):
        for free in combinations(range(3), count):
            kept = [k for k in range(3) if k not in free]
            if _fits(missed[kept], covariance[np.ix_(kept, kept)], len(kept)):
                return free
    return (0, 1, 2)
