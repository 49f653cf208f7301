"""Which of the five intrinsics are estimated, and what is known of the others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri import arguments
from handeye_tri.calibrate_cameras.homography import ImageScale
from handeye_tri.camera import INTRINSIC_NAMES, LENS_COEFFICIENTS, LensModel
from handeye_tri.errors import InputError

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class IntrinsicChoice:
    """Estimated and known intrinsics.

    Attributes:
        names: Of the k that are estimated. With a known aspect ratio fy is not one of
            them: it follows from fx.
        basis: Derivative of (fx, fy, skew, cx, cy) by those, shape (5, k).
        known: Shape (5,), pixels, NaN where estimated.
        aspect: fy / fx where that is known and fx is not; else None.
    """

    names: tuple[str, ...]
    basis: Floats
    known: Floats
    aspect: float | None

    @classmethod
    def of(
        cls,
        skew: bool,
        fixed: Mapping[str, float] | None = None,
        aspect: float | None = None,
    ) -> IntrinsicChoice:
        """Read the choices of the caller.

        Args:
            skew: Whether the skew factor is estimated where it is not fixed.
            fixed: Known intrinsics by name, pixels.
            aspect: Known fy / fx.

        Raises:
            InputError: a value is not usable, or nothing is left to estimate.
        """
        known = np.full(5, np.nan)
        if not skew:
            known[2] = 0.0
        for name, value in (fixed or {}).items():
            known[INTRINSIC_NAMES.index(name)] = value
        if not (np.nan_to_num(known[:2], nan=1.0) > 0).all():
            raise InputError(f"fixed focal lengths must be positive, got {fixed}")
        if aspect is not None:
            aspect = arguments.positive("aspect (fy / fx)", aspect)
            if np.isfinite(known[:2]).all():
                raise InputError(
                    "aspect, fixed fx and fixed fy are one too many; leave one out"
                )
            if np.isfinite(known[0]):
                known[1] = aspect * known[0]
            elif np.isfinite(known[1]):
                known[0] = known[1] / aspect
        tied = aspect is not None and bool(np.isnan(known[:2]).all())
        free = [i for i in range(5) if np.isnan(known[i]) and not (tied and i == 1)]
        if not free:
            raise InputError(
                "every intrinsic is fixed: there is nothing left to estimate"
            )
        basis = np.eye(5)[:, free]
        if tied:
            assert aspect is not None
            basis[1, 0] = aspect
        names = tuple(INTRINSIC_NAMES[i] for i in free)
        return cls(names, basis, known, aspect if tied else None)

    def impose(self, vector: Floats) -> Floats:
        """The nearest (fx, fy, skew, cx, cy) with what is known, shape (5,)."""
        result = np.where(np.isnan(self.known), vector, self.known)
        if self.aspect is not None:
            result[0] = 0.5 * (result[0] + result[1] / self.aspect)
            result[1] = self.aspect * result[0]
        return np.asarray(result)

    def conic_basis(self, image: ImageScale) -> Floats:
        """The b = (w11 ... w33) that agree with what is linear in it, shape (6, k).

        In the coordinates of ``image``. Zero skew is w12 = 0; then a known aspect
        ratio a is w11 = a^2 w22, and a known principal point (u, v) is w13 = -u w11,
        w23 = -v w22. With skew the point must be known whole: w (u, v, 1) ~ (0, 0, 1).
        Focal lengths and a skew that is not zero are not linear in b.

        Args:
            image: The coordinates.
        """
        rows = []
        straight = self.known[2] == 0.0
        u, v = image.normalised(self.known[3:])
        if straight:
            rows.append([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
            if self.aspect is not None:
                rows.append([1.0, 0.0, -(self.aspect**2), 0.0, 0.0, 0.0])
        if np.isfinite(u) and (straight or np.isfinite(v)):
            rows.append([u, 0.0 if straight else v, 0.0, 1.0, 0.0, 0.0])
        if np.isfinite(v) and (straight or np.isfinite(u)):
            rows.append([0.0, 0.0 if straight else u, v, 0.0, 1.0, 0.0])
        if not rows:
            return np.eye(6)
        return np.asarray(np.linalg.svd(np.array(rows))[2][len(rows) :].T)


def split_fixed(
    fixed: Mapping[str, float] | None, model: LensModel, estimated: tuple[int, ...]
) -> tuple[dict[str, float], Floats]:
    """Part the caller's known quantities into intrinsics and lens coefficients.

    Args:
        fixed: By name.
        model: The lens model.
        estimated: Indices of the lens coefficients that are estimated.

    Returns:
        Intrinsics by name; all lens coefficients, shape (5,) or (8,), 0 where unknown.

    Raises:
        InputError: a name is unknown or estimated too, or a value is not finite.
    """
    if fixed is not None and not isinstance(fixed, Mapping):
        raise InputError(
            f"fixed must be names with their values, as {{'cx': 511.5}}; got {fixed!r}"
        )
    names = LENS_COEFFICIENTS[model]
    lens = np.zeros(len(names))
    inner: dict[str, float] = {}
    for name, value in (fixed or {}).items():
        if name not in INTRINSIC_NAMES and name not in names:
            raise InputError(
                f"fixed[{name!r}] is none of {', '.join((*INTRINSIC_NAMES, *names))}"
            )
        if not np.isfinite(arguments.number(f"fixed[{name!r}]", value)):
            raise InputError(f"fixed[{name!r}] must be a finite number, got {value}")
        if name in INTRINSIC_NAMES:
            inner[name] = float(value)
        elif names.index(name) in estimated:
            raise InputError(f"{name} is both fixed and named in distortion; keep one")
        else:
            lens[names.index(name)] = value
    return inner, lens
