"""Which lens coefficients the data determine, and whether their covariance holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import PinholeCamera, distort_jacobians

Floats = NDArray[np.float64]

# Sigma of the principal point over the radius of what was seen from which on the
# covariance, linear as it is, is too small along its short axes.
_CURVED = 1.0 / 25.0


@dataclass(frozen=True, slots=True)
class LensVerdict:
    """What an estimated lens coefficient does, and how well it is known.

    Attributes:
        name: Of the coefficient.
        value: As estimated.
        sigma: Its standard deviation, all else being estimated too.
        effect_px: How far the coefficient moves the markers, root mean square over
            all that were seen, pixels.
        sigma_px: How far one sigma of it moves them.
        determined: Whether its effect exceeds its sigma.
    """

    name: str
    value: float
    sigma: float
    effect_px: float
    sigma_px: float
    determined: bool

    def __str__(self) -> str:
        """One sentence, with the remedy where there is need of one."""
        text = (
            f"{self.name} = {self.value:.4g} +- {self.sigma:.2g} moves the markers by "
            f"{self.effect_px:.3g} px RMS, its sigma by {self.sigma_px:.3g} px"
        )
        if self.determined:
            return text
        return (
            f"{text}: not determined; leave it out of distortion (it is 0 then), give "
            f"its value in fixed, or add views with the triangle in the image's corners"
        )


def judge_lens(
    camera: PinholeCamera, covariance: Floats, names: Sequence[str], points: Floats
) -> tuple[LensVerdict, ...]:
    """Judge each estimated lens coefficient.

    Leave out one that is not determined at a time, the one with the least effect
    over sigma first: the others are often determined without it.

    Args:
        camera: The camera as estimated.
        covariance: Of the coefficients in ``names``, shape (k, k).
        names: Of the k coefficients that were estimated.
        points: The markers that were seen, camera frame, shape (..., 3), metres.

    Returns:
        One verdict per coefficient, in the order of ``names``.
    """
    xy = points[..., :2] / points[..., 2:]
    _, _, by_lens = distort_jacobians(camera.lens.coefficients, xy)
    by_pixel = camera.intrinsics.matrix[:2, :2] @ by_lens
    moved = np.sqrt((by_pixel**2).sum(axis=-2).reshape(-1, by_lens.shape[-1]).mean(0))
    result = []
    for row, name in enumerate(names):
        index = camera.lens.names.index(name)
        value = float(camera.lens.coefficients[index])
        sigma = float(np.sqrt(covariance[row, row]))
        effect = float(moved[index])
        result.append(
            LensVerdict(
                name,
                value,
                sigma,
                abs(value) * effect,
                sigma * effect,
                abs(value) > sigma,
            )
        )
    return tuple(result)


def centre_weakness(
    camera: PinholeCamera, covariance: Floats, names: Sequence[str], points: Floats
) -> str | None:
    """Say where the lens bends too much about its centre for a linear covariance.

    Distortion is about the principal point. As that moves, lens and poses follow on a
    curve, not on a line: each sigma by itself stays about right, but combinations of
    intrinsics and lens that are stated as well known miss by more than is stated.

    Args:
        camera: The camera as estimated.
        covariance: Of the quantities in ``names``, shape (p, p).
        names: Of the intrinsics and lens coefficients that were estimated.
        points: The markers that were seen, camera frame, shape (..., 3), metres.

    Returns:
        A sentence with the numbers and the remedy; None where there is no need.
    """
    sigma = {
        name: float(np.sqrt(covariance[names.index(name), names.index(name)]))
        for name in ("cx", "cy")
        if name in names
    }
    centre = camera.intrinsics.vector[3:]
    offset = camera.project(points.reshape(-1, 3)) - centre
    radius = float(np.linalg.norm(offset, axis=-1).max())
    if max(sigma.values(), default=0.0) <= _CURVED * radius:
        return None
    values = dict(zip(("cx", "cy"), centre, strict=True))
    listed = ", ".join(
        f"{name} {values[name]:.1f} +- {of:.2g} px" for name, of in sigma.items()
    )
    return (
        f"{listed}: the lens is centred there and the markers reach {radius:.0f} px "
        "from it, so that the covariance of intrinsics and lens together is only a "
        "linear one, and too small; give cx and cy in fixed where they are known, "
        "average images, or add half-turns"
    )
