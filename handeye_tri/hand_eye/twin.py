"""The second solution that few half-turns leave.

Rotations ``A X = X B`` are fitted by X D as well as by X wherever D commutes with every
B. Beside turns about one axis (which leave more open) these are half-turns about axes
in one plane, alone or with turns about the plane's normal, and half-turns about axes at
right angles: D is then the half-turn about that normal, or about one of the axes.
Positions may settle it, as they do where the flange moves about.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import ConvergenceError, DegenerateMotionError
from handeye_tri.hand_eye.pose_fit import fit_poses, squared_distances
from handeye_tri.hand_eye.pose_model import PoseFit, PoseInput
from handeye_tri.se3 import nearest_rotation, se3_inverse, so3_log

Floats = NDArray[np.float64]

# A twin is ruled out where chi2 tells it from the solution by five sigma.
_TOLD = 25.0

# Rotations that fit a twin to within this many times the solution's own misfit, or to
# within this angle, say nothing against it.
_MOST_TIMES = 4.0
_MOST_ANGLE = float(np.radians(0.5))
# A solution that leaves more than this contradicts its poses: no twin is looked for.
_CONTRADICTED = float(np.radians(5.0))


def require_no_twin(data: PoseInput, fit: PoseFit, used: NDArray[np.bool_]) -> None:
    """Refuse poses that two different motions fit alike.

    Args:
        data: All poses.
        fit: Of those used.
        used: Which ones, shape (n,).

    Raises:
        DegenerateMotionError: there is a twin; the message says what to add.
    """
    taken = data.take(used)
    a, _ = taken.robot(fit.offset)
    b = np.array(taken.b)
    b[:, :3, 3] *= fit.scale
    twin = find_twin(a, b, fit.x, fit.z)
    if twin is None:
        return
    try:
        other = fit_poses(
            taken, *twin, scale=fit.scale, offset=fit.offset, noise=fit.noise
        )
    except ConvergenceError:
        # Positions contradict it so much that there is no optimum near.
        return
    worse = float(
        squared_distances(taken, other).sum() - squared_distances(taken, fit).sum()
    )
    apart = 1e3 * float(np.linalg.norm(other.x[:3, 3] - fit.x[:3, 3]))
    turned = np.degrees(np.linalg.norm(so3_log(other.x[:3, :3].T @ fit.x[:3, :3])))
    if worse < _TOLD and turned > 90:
        raise DegenerateMotionError(
            f"two solutions fit the {len(a)} poses alike (chi2 differs by "
            f"{max(worse, 0.0):.2g}), {apart:.1f} mm and {turned:.0f} degrees apart: "
            "their motions are half-turns, and turns about one axis, whose axes have "
            "two signs; add a pose that turns by 20 to 160 degrees about an axis "
            "which is neither in the half-turns' plane nor at right angles to it"
        )


def find_twin(
    a: Floats, b: Floats, x: Floats, z: Floats
) -> tuple[Floats, Floats] | None:
    """Another solution that fits the rotations of ``a_i X = Z b_i``, if there is one.

    Args:
        a: Shape (n, 4, 4), metres.
        b: Shape (n, 4, 4), metres.
        x: A solution, shape (4, 4).
        z: Shape (4, 4).

    Returns:
        X and Z, shape (4, 4) each, positions by least squares; None also where the
        solution itself does not fit.
    """
    turns = so3_log((se3_inverse(b[0]) @ b)[:, :3, :3])
    axes = np.linalg.eigh(turns.T @ turns)[1].T
    own = _misfit(a, b, x[:3, :3], z[:3, :3])
    if own > _CONTRADICTED:
        return None
    best: tuple[float, Floats, Floats] | None = None
    for axis in axes:
        rx = x[:3, :3] @ (2 * np.outer(axis, axis) - np.eye(3))
        products = a[:, :3, :3] @ rx @ np.swapaxes(b[:, :3, :3], 1, 2)
        rz = nearest_rotation(products.mean(axis=0))
        misfit = _misfit(a, b, rx, rz)
        if best is None or misfit < best[0]:
            best = misfit, rx, rz
    assert best is not None
    misfit, rx, rz = best
    if misfit > max(_MOST_TIMES * own, _MOST_ANGLE):
        return None
    rows = np.concatenate(
        [a[:, :3, :3], np.broadcast_to(-np.eye(3), (len(a), 3, 3))], axis=2
    )
    right = (b[:, :3, 3] @ rz.T - a[:, :3, 3]).ravel()
    shifts = np.linalg.lstsq(rows.reshape(-1, 6), right, rcond=1e-6)[0]
    other_x, other_z = np.tile(np.eye(4), (2, 1, 1))
    other_x[:3, :3], other_x[:3, 3] = rx, shifts[:3]
    other_z[:3, :3], other_z[:3, 3] = rz, shifts[3:]
    return other_x, other_z


def _misfit(a: Floats, b: Floats, rx: Floats, rz: Floats) -> float:
    """Root mean square angle that the rotations leave, radians."""
    left = a[:, :3, :3] @ rx
    off = so3_log(np.swapaxes(left, 1, 2) @ (rz @ b[:, :3, :3]))
    return float(np.sqrt((off**2).sum(axis=1).mean()))
