"""AX = ZB where the rig changes its mount: an X for each mount, one Z.

Motions in the base between two stations with the same mount, ``a_j a_i^-1`` and
``b_j b_i^-1``, satisfy AX = XB with Z for X whatever the mount is. Those of all mounts
together tell Z, and each X follows from its own stations.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.hand_eye.absolute import solve_axzb
from handeye_tri.hand_eye.motions import relative_motions
from handeye_tri.hand_eye.relative import solve_axxb
from handeye_tri.se3 import SE3, se3_inverse

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

# Up to here all pairs of stations with one mount are used, beyond it successive ones:
# their number grows with the square.
_ALL_PAIRS = 100


def motions_by_mount(a: Floats, b: Floats, mounts: Indices) -> tuple[Floats, Floats]:
    """Motions in the base between stations with the same mount, as each side has it.

    Args:
        a: Poses, shape (n, 4, 4), metres.
        b: Poses, shape (n, 4, 4), metres.
        mounts: Of each station, shape (n,).

    Returns:
        Shape (number of pairs, 4, 4) each.
    """
    parts = [np.flatnonzero(mounts == mount) for mount in np.unique(mounts)]
    left, right = (
        np.concatenate(
            [
                relative_motions(
                    poses[part],
                    pairs="all" if len(part) <= _ALL_PAIRS else "successive",
                )
                for part in parts
                if len(part) > 1
            ]
        )
        for poses in (a, b)
    )
    return left, right


def solve_mounts(a: Floats, b: Floats, mounts: Indices) -> tuple[dict[int, SE3], SE3]:
    """Solve ``a_i X = Z b_i``, X that of the station's mount, in closed form.

    One mount: Shah 2013. More: Z by Park and Martin 1994 from the motions of all
    mounts, each X the mean of what its stations say.

    Args:
        a: Poses, shape (n, 4, 4), metres.
        b: Poses, shape (n, 4, 4), metres.
        mounts: Of each station, shape (n,).

    Returns:
        X by mount, and Z.

    Raises:
        InputError: fewer than three poses with one mount, or two motions with more.
        DegenerateMotionError: the motions of all mounts together have parallel axes,
            or are ambiguous half-turns.
    """
    present = np.unique(mounts).tolist()
    if len(present) == 1:
        x, z = solve_axzb(a, b)
        return {present[0]: x}, z
    z = solve_axxb(*motions_by_mount(a, b, mounts))
    xs = se3_inverse(a) @ z.matrix @ b
    return {
        mount: SE3.mean([SE3(x) for x in xs[mounts == mount]]) for mount in present
    }, z
