"""Views that another reading explains: markers exchanged, an old image, a mount."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from handeye_tri.records import Session
from handeye_tri.triangle import VERTICES

Floats = NDArray[np.float64]

# Another reading must leave less than this share of a view's residual, and not much
# more than views usually leave.
_SHARE = 0.2
_USUAL = 5.0
# Residuals below this need no explanation of this kind, px.
_LEAST = 2.0
# Two images are the same where no marker moved by more sigmas than this.
_SAME = 6.0


@dataclass(frozen=True, slots=True)
class OddView:
    """A view that shows something else than it should.

    Attributes:
        camera: Index of the camera.
        station: Index of the station.
        kind: "labels", "mount" or "stale".
        residual: Root mean square residual as it stands, px.
        left: The same as the other reading has it, px.
        reading: The labels in the order they belong, the mount (from 1), or the
            station of the image.
    """

    camera: int
    station: int
    kind: Literal["labels", "mount", "stale"]
    residual: float
    left: float
    reading: str


def odd_views(session: Session, with_mounts: Floats) -> list[OddView]:
    """Find them by what the rest of the session predicts.

    Args:
        session: What was detected.
        with_mounts: Where the markers would be with each mount, (k, m, n, 3, 2), px.
    """
    pixels = session.pixels
    stations = np.arange(len(session.stations))
    predicted = np.moveaxis(with_mounts[session.mounts, :, stations], 0, 1)
    seen = np.isfinite(pixels).all(axis=(-2, -1)) & np.isfinite(predicted).all(
        axis=(-2, -1)
    )
    residual = np.sqrt(np.mean((pixels - predicted) ** 2, axis=(-2, -1)))
    usual = float(np.median(residual[seen])) if seen.any() else 0.0
    found = []
    for i, j in np.argwhere(seen & (residual > max(_LEAST, _USUAL * usual))):
        view = (int(i), int(j))
        limit = min(_SHARE * residual[view], _USUAL * usual + _LEAST)
        odd = _exchanged(pixels[view], predicted[view], limit)
        kind: Literal["labels", "mount", "stale"] = "labels"
        if odd is None:
            odd, kind = (
                _otherwise_held(pixels[view], with_mounts[:, i, j], limit),
                "mount",
            )
        if odd is None:
            odd, kind = _repeated(session, predicted, *view), "stale"
        if odd is not None:
            found.append(OddView(*view, kind, float(residual[view]), *odd))
    return found


def _exchanged(
    pixels: Floats, predicted: Floats, limit: float
) -> tuple[float, str] | None:
    best = None
    for order in list(permutations(range(3)))[1:]:
        left = float(np.sqrt(np.mean((pixels[list(order)] - predicted) ** 2)))
        if left < limit and (best is None or left < best[0]):
            best = left, ", ".join(VERTICES[k] for k in order)
    return best


def _otherwise_held(
    pixels: Floats, predicted: Floats, limit: float
) -> tuple[float, str] | None:
    """Whether the view is one with another mount, of predicted (k, 3, 2)."""
    left = np.sqrt(np.mean((pixels - predicted) ** 2, axis=(-2, -1)))
    # NaN, behind the camera, is no explanation.
    mount = int(np.argmin(np.where(np.isfinite(left), left, np.inf)))
    return (float(left[mount]), str(mount + 1)) if left[mount] < limit else None


def _repeated(
    session: Session, predicted: Floats, i: int, j: int
) -> tuple[float, str] | None:
    """Whether the view is that of another station, which fits there."""
    pixels, covariance = session.pixels[i], session.pixel_covariance[i]
    sigma = np.sqrt(covariance[..., [0, 1], [0, 1]])
    apart = np.abs(pixels - pixels[j]) / np.hypot(sigma, sigma[j])
    same = (apart < _SAME).all(axis=(-2, -1))
    same[j] = False
    here = np.mean((pixels[j] - predicted[i, j]) ** 2)
    for other in np.flatnonzero(same):
        there = np.mean((pixels[other] - predicted[i, other]) ** 2)
        if there < _SHARE**2 * here:
            return float(np.sqrt(there)), str(int(other))
    return None
