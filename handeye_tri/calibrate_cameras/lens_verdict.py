"""Which lens coefficients the data determine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import PinholeCamera, distort_jacobians

Floats = NDArray[np.float64]


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
