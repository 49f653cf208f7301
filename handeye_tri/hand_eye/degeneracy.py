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

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import DegenerateMotionError
from handeye_tri.se3 import so3_log

Floats = NDArray[np.float64]

# The next best solution must fit worse than this angle, and than this many times
# the best one. Measured on 16 poses with 0.1 degrees of noise: half-turns about
# coplanar axes stay below a ratio of 2, motions that determine R are above 50.
_MIN_ANGLE = np.radians(0.5)
_MIN_RATIO = 4.0
_HALF_TURN = np.radians(175.0)


def residual_angle(agreement: float) -> float:
    """RMS rotation residual, radians, of a solution of the linear equations.

    A unit vector v of R's nine entries leaves ``mean |A V - V B|^2 / 2 = 1 - g``
    with agreement g; a rotation has norm sqrt(3) and ``|exp(w) - I|^2 = 2 |w|^2``
    for small w, so the RMS angle is sqrt(3 (1 - g)).
    """
    return float(np.sqrt(3.0 * max(1.0 - agreement, 0.0)))


def require_determined(best: float, next_best: float, motions: Floats) -> None:
    """Refuse motions that do not determine the rotation.

    Args:
        best: Agreement of the best solution, at most 1.
        next_best: Agreement of the next best.
        motions: Some of the relative motions, shape (n, 4, 4), for the message.

    Raises:
        DegenerateMotionError: see the module; the message has the numbers.
    """
    reached, other = residual_angle(best), residual_angle(next_best)
    if other > max(_MIN_ANGLE, _MIN_RATIO * reached):
        return
    vectors = so3_log(motions[:, :3, :3])
    angles = np.linalg.norm(vectors, axis=1)
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
    turning = angles > 0.1 * angles.max()
    axes = vectors[turning] / angles[turning, None]
    _, directions = np.linalg.eigh(axes.T @ axes)
    spread = np.degrees(np.arccos(np.minimum(np.abs(axes @ directions[:, 2]), 1.0)))
    if spread.max() > 5.0 and angles[turning].min() > _HALF_TURN:
        raise DegenerateMotionError(
            f"all {len(axes)} motions are half-turns (at least "
            f"{np.degrees(angles[turning].min()):.2f} degrees) whose axes lie in one "
            f"plane or at right angles ({numbers}): each axis has two signs, so the "
            "solution is ambiguous; add one motion that is not a half-turn, or "
            "half-turns whose axes leave the plane"
        )
    axis = ", ".join(f"{x:+.3f}" for x in directions[:, 2])
    raise DegenerateMotionError(
        f"all rotation axes are parallel within {spread.max():.3g} degrees (axis "
        f"({axis}) in a's frame; {numbers}): the turn about that axis and the shift "
        "along it are undetermined; add stations that turn by 20 degrees or more "
        "about another axis"
    )
