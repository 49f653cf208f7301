"""Maximum-likelihood AX = ZB of bare poses: noise, scale and clock unknown or stated.

Unknown are X and Z, on request a factor on B's translations and the offset of two
clocks, and, unless stated, the five variances of
:mod:`handeye_tri.hand_eye.pose_noise` and the tail of the residuals' distribution
(Student's, by iterative reweighting: Lange, Little and Taylor 1989,
doi:10.1080/01621459.1989.10478852). Errors of successive poses may correlate, as those
of a drifting visual odometry: then each pose counts by what is new in it (Prais and
Winsten 1954). Directions that the poses do not determine are
found from the information matrix, left where the start has them, and named.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import ConvergenceError
from handeye_tri.hand_eye.pose_iteration import ROUNDING, PoseIteration
from handeye_tri.hand_eye.pose_model import PoseFit, PoseInput
from handeye_tri.hand_eye.pose_noise import noise_shapes
from handeye_tri.records import PoseNoise
from handeye_tri.se3 import se3_inverse, se3_log

Floats = NDArray[np.float64]

_MAX_ITERATIONS = 40
# Of longer streams an evenly spread part tells the noise.
_ENOUGH_FOR_NOISE = 400
# Steps in standard deviations.
_CONVERGED = 1e-6
# Heavy tails and the kinks of an interpolated track can leave steps that do not die
# out; up to this many standard deviations they do not matter.
_UNSETTLED = 0.3


def fit_poses(
    data: PoseInput,
    x: Floats,
    z: Floats,
    *,
    scale: float = 1.0,
    offset: float = 0.0,
    noise: PoseNoise | None = None,
) -> PoseFit:
    """Fit by Gauss-Newton, noise and tail by the way; cost linear in the poses.

    Args:
        data: The poses.
        x: Start, shape (4, 4).
        z: Start, shape (4, 4).
        scale: Start; kept unless ``data.free_scale``.
        offset: Start; kept unless there is a track.
        noise: Stated; None estimates it.

    Raises:
        ConvergenceError: the iteration did not settle.
    """
    state = PoseIteration(data, x, z, scale, offset, noise)
    n = len(data.camera_from_target)
    if noise is None and n > _ENOUGH_FOR_NOISE:
        some = np.zeros(n, bool)
        some[np.linspace(0, n - 1, _ENOUGH_FOR_NOISE).astype(int)] = True
        part = PoseIteration(data.take(some), x, z, scale, offset, None)
        part.settle_noise()
        state.adopt(part)
    elif noise is None:
        state.settle_noise()
    for _ in range(_MAX_ITERATIONS):
        step, std = state.move()
        if (np.abs(step) < np.maximum(_CONVERGED * std, ROUNDING)).all():
            break
    if (np.abs(step) > _UNSETTLED * std + ROUNDING).any():
        raise ConvergenceError(
            f"the fit of {n} poses did not settle in "
            f"{_MAX_ITERATIONS} iterations (last step {np.abs(step / std).max():.2g} "
            "standard deviations); check that robot and observed poses belong together"
        )
    return state.result()


def squared_distances(data: PoseInput, fit: PoseFit) -> Floats:
    """Squared whitened residuals of all poses, used for a fit or not, shape (n,)."""
    a, _ = data.robot(fit.offset)
    camera = np.array(data.camera_from_target)
    camera[:, :3, 3] *= fit.scale
    b = se3_inverse(camera) if data.eye_in_hand else camera
    e = se3_log(se3_inverse(a @ fit.x) @ (fit.z @ b))
    # Rounding of exact data has no noise to be measured by.
    e[:, :3][np.abs(e[:, :3]) < 1e-11 * fit.length] = 0.0
    e[:, 3:][np.abs(e[:, 3:]) < 1e-11] = 0.0
    shapes = noise_shapes(camera, fit.x, eye_in_hand=data.eye_in_hand)
    variances = np.array([value**2 for _, value in fit.noise.items()])
    covariance = np.einsum("k,knij->nij", variances, shapes)
    scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    whitened = np.linalg.inv(covariance / (scale[:, :, None] * scale[:, None, :]))
    e = e / scale
    return np.asarray(np.einsum("ni,nij,nj->n", e, whitened, e))
