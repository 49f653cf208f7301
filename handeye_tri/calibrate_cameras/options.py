"""Reads the choices of :func:`calibrate_camera`: lens, axis foot, inexact turns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri import arguments
from handeye_tri.calibrate_cameras.homography import OMode
from handeye_tri.camera import LENS_COEFFICIENTS, LensModel
from handeye_tri.errors import InputError
from handeye_tri.records import numeric

Floats = NDArray[np.float64]


def lens_choice(
    distortion: LensModel | Sequence[str] | None,
) -> tuple[LensModel, tuple[int, ...]]:
    """Lens model, and which of its coefficients to estimate.

    Args:
        distortion: None, a model (all its coefficients), or names of coefficients
            (of "radtan" where it has them all, else of "rational").

    Raises:
        InputError: a name is unknown or given twice.
    """
    if distortion is None:
        return "radtan", ()
    if isinstance(distortion, str):
        if distortion not in LENS_COEFFICIENTS:
            raise InputError(
                f"distortion must be None, one of {', '.join(LENS_COEFFICIENTS)} or "
                f"names of coefficients, got {distortion!r}"
            )
        wanted = LENS_COEFFICIENTS[distortion]
    elif not isinstance(distortion, Sequence):
        raise InputError(
            "distortion must be None, a lens model or a sequence of coefficients' "
            f"names, got {arguments.shown(distortion)}"
        )
    else:
        wanted = tuple(distortion)
        if not all(isinstance(name, str) for name in wanted):
            raise InputError(
                f"distortion must name coefficients, got {arguments.shown(distortion)}"
            )
    model: LensModel = (
        "radtan" if set(wanted) <= set(LENS_COEFFICIENTS["radtan"]) else "rational"
    )
    known = LENS_COEFFICIENTS[model]
    if not set(wanted) <= set(known) or len(set(wanted)) != len(wanted):
        raise InputError(
            f"distortion names must be distinct and among {', '.join(known)}, "
            f"got {wanted}"
        )
    return model, tuple(sorted(known.index(coefficient) for coefficient in wanted))


def o_choice(o: Literal["shared", "free"] | ArrayLike) -> tuple[OMode, Floats | None]:
    """How the foot O of a normal axis is treated, and where it is if that is known.

    Args:
        o: "shared", "free", or the known foot, shape (2,), metres.

    Raises:
        InputError: neither a known word nor two finite numbers.
    """
    if isinstance(o, str):
        if o == "shared":
            return "shared", None
        if o == "free":
            return "free", None
        raise InputError(f'o must be "shared", "free" or two numbers, got {o!r}')
    known = numeric("o", o)
    if known.shape != (2,) or not np.isfinite(known).all():
        raise InputError(
            "a known o is the foot of the axis in the triangle's frame, shape (2,), "
            f"metres; got {known.tolist()}"
        )
    return "known", known


def turn_covariances(
    value: ArrayLike | None, n: int, used: NDArray[np.intp], noise_known: bool
) -> Floats | None:
    """Covariances of the half-turns used, shape (len(used), 6, 6), m and rad.

    Args:
        value: Shape (6, 6) or (n, 6, 6), or None for exact half-turns.
        n: Half-turns that the caller gave.
        used: Indices of those used.
        noise_known: Whether the pixel noise is known, without which a prior in metres
            has no weight.

    Raises:
        InputError: no covariance of that shape, or the pixel noise is unknown.
    """
    if value is None:
        return None
    if not noise_known:
        raise InputError(
            "turn_covariance needs sigma_px or covariance beside it: metres cannot be "
            "weighed against pixels of unknown noise"
        )
    matrix = numeric("turn_covariance", value)
    if matrix.shape not in ((6, 6), (n, 6, 6)) or not np.isfinite(matrix).all():
        raise InputError(
            f"turn_covariance must be finite with shape (6, 6) or ({n}, 6, 6), "
            f"got {matrix.shape}"
        )
    matrix = np.broadcast_to(matrix, (n, 6, 6))
    # Metres and radians differ in size: judge each entry against its own scale.
    root = np.sqrt(np.abs(np.einsum("nii->ni", matrix)))
    scale = np.where(root > 0, root, 1.0)
    scaled = matrix / (scale[:, :, None] * scale[:, None, :])
    lopsided = np.abs(scaled - np.swapaxes(scaled, -1, -2)).max(initial=0.0)
    if lopsided > 1e-6 or np.linalg.eigvalsh(scaled).min(initial=0.0) < -1e-9:
        raise InputError(
            "turn_covariance must be symmetric and positive semi-definite, in m^2, "
            "m rad and rad^2"
        )
    return matrix[used]
