"""Motions that leave the hand-eye motion undetermined.

Relative rotations ``A_k R = R B_k`` determine R only if their axes are not all
parallel (Tsai and Lenz 1989, Sec. II, doi:10.1109/70.34770). Half-turns need more:
``A = 2 a a' - I`` does not change with the sign of the axis a, so R is only known
to map each line b_k to a line a_k. With axes in one plane, R and R followed by a
half-turn about the plane's normal serve equally well: a two-fold ambiguity, which
two half-turns always have. Axes that span space (and are not at right angles), or
one motion that is no half-turn, settle it.

Both show in the same number. The linear rotation equations have a best solution
and a next best one, orthogonal to it; the next best one's rotation residual is how
much the motions speak against it. Where that is not well above the residual of the
best one, the data do not decide.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import DegenerateMotionError
from handeye_tri.se3 import so3_log

Floats = NDArray[np.float64]

# The next best solution must fit worse than this angle, and than this many times
# the best one. Measured over 200 draws of eight motions with 0.1 degrees of noise:
# half-turns about coplanar axes and turns about parallel ones have a next best one
# at 0.2 degrees and ratios of at most 2; general turns by 5 degrees have ratios of at
# least 15, half-turns about axes that span space of at least 180.
_MIN_ANGLE = float(np.radians(0.5))
_MIN_RATIO = 4.0
# Two half-turns can fit by chance so well that the ratio says nothing: motions that
# are all half-turns within the first angle must have axes out of plane by the second.
_HALF_TURN = np.radians(179.0)
_OUT_OF_PLANE = np.radians(2.0)
# Axes that spread by this are not parallel: then the two sides contradict each other.
_SPREAD = np.radians(20.0)
# The trace of a rotation is 1 + 2 cos(angle): turns from 18 degrees to almost a
# half-turn have traces within the second number of the first.
_GOOD_TRACE = float(1.0 + np.cos(np.radians(18.0)) + np.cos(_HALF_TURN))
_GOOD_TRACES = float(np.cos(np.radians(18.0)) - np.cos(_HALF_TURN))


def residual_angle(agreement: float) -> float:
    """RMS rotation residual, radians, of a solution of the linear equations.

    A unit vector v of R's nine entries leaves ``mean |A V - V B|^2 / 2 = 1 - g``
    with agreement g; a rotation has norm sqrt(3) and ``|exp(w) - I|^2 = 2 |w|^2``
    for small w, so the RMS angle is sqrt(3 (1 - g)).
    """
    return sqrt(3.0 * max(1.0 - agreement, 0.0))


def require_determined(
    best: float, next_best: float, first: Floats, second: Floats
) -> None:
    """Refuse motions that do not determine the rotation.

    Args:
        best: Agreement of the best solution, at most 1.
        next_best: Agreement of the next best.
        first: Rotations before each motion, shape (n, 3, 3) or (1, 3, 3).
        second: Rotations after it, shape (n, 3, 3). Successive poses will do, since
            their motions generate all others.

    Raises:
        DegenerateMotionError: see the module; the message has the numbers.
    """
    reached, other = residual_angle(best), residual_angle(next_best)
    distinct = other > max(_MIN_ANGLE, _MIN_RATIO * reached)
    # Cheaper than angles, and one such turn is enough.
    trace = np.einsum("nab,nab->n", first, second)
    if distinct and np.abs(trace - _GOOD_TRACE).min() < _GOOD_TRACES:
        return
    vectors = so3_log(second @ np.swapaxes(first, 1, 2))
    angles = np.linalg.norm(vectors, axis=1)
    turning = angles >= 0.1 * angles.max()
    axes = vectors[turning] / np.maximum(angles[turning, None], 1e-300)
    spread, directions = np.linalg.eigh(axes.T @ axes / turning.sum())
    # RMS sines of the axes' angles out of their common plane and off their mean line.
    out_of_plane, off_line = np.sqrt(np.maximum([spread[0], spread[:2].sum()], 0.0))
    half_turns = bool(angles[turning].min() > _HALF_TURN)
    flat = half_turns and out_of_plane < np.sin(_OUT_OF_PLANE)
    if distinct and not flat:
        return
    numbers = (
        f"the best solution leaves {np.degrees(reached):.3g} degrees RMS and a "
        f"different one {np.degrees(other):.3g}"
    )
    if angles.max() < 2 * _MIN_ANGLE:
        raise DegenerateMotionError(
            f"the poses turn by at most {np.degrees(angles.max()):.3g} degrees "
            f"({numbers}): the hand-eye rotation is undetermined; "
            "add stations turned by 20 degrees or more about two different axes"
        )
    if half_turns and off_line > np.sin(_OUT_OF_PLANE):
        raise DegenerateMotionError(
            f"all {len(axes)} motions are half-turns (at least "
            f"{np.degrees(angles[turning].min()):.2f} degrees) whose axes lie in one "
            f"plane within {np.degrees(np.arcsin(min(out_of_plane, 1.0))):.3g} degrees "
            f"or at right angles ({numbers}): each axis has two signs, so the solution "
            "is ambiguous; add one motion that is not a half-turn, or half-turns whose "
            "axes leave the plane"
        )
    if off_line > np.sin(_SPREAD):
        raise DegenerateMotionError(
            f"no rotation fits: {numbers}, although the axes spread by "
            f"{np.degrees(np.arcsin(min(off_line, 1.0))):.3g} degrees RMS; a and b "
            "contradict each other: check that a[i] and b[i] belong together, which "
            "way each maps, and leave wrong poses out (robust=True)"
        )
    axis = ", ".join(f"{x:+.3f}" for x in directions[:, 2])
    raise DegenerateMotionError(
        f"the rotation axes are parallel within "
        f"{np.degrees(np.arcsin(min(off_line, 1.0))):.3g} degrees RMS (axis "
        f"({axis}) in a's frame; {numbers}): the turn about that axis and the shift "
        "along it are undetermined; add stations that turn by 20 degrees or more "
        "about another axis"
    )
