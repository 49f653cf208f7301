"""What the images themselves say: blur along one direction, poor detection."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.diagnose.gates import Finding
from handeye_tri.records import Session

Floats = NDArray[np.float64]

# An edge that is drawn out over a length L has a variance of L^2 / 12 more across it.
_PER_LENGTH = 12.0
# A view is blurred where all its markers are drawn out by this, px, and by so many
# times what views usually show.
_LEAST_LENGTH = 1.0
_USUAL = 3.0
# ... and by so many standard deviations of what detection leaves open.
_SIGMAS = 5.0
# A centre is found to 0.02 px on a ball of 10 px radius in a clean image.
_POOR_SIGMA = 0.1
# One view's detection is poor beside the others at so many times their sigma.
_POOR_RATIO = 5.0
# Markers that may be unseen, as a share of all.
_MISSING = 0.02


def drawn_out(edges: Floats) -> Floats:
    """Length of the motion in each view, (m, n), px; NaN where not all is measured.

    Args:
        edges: Mean variance of an edge and both parts of its elongation: the variance
            in direction t is mean + cos(2t) c + sin(2t) s, (m, n, 3, 3), px^2.
    """
    # Markers of one view move alike; noise of the three does not add up.
    parts = edges[..., 1:].mean(axis=2)
    return np.asarray(np.sqrt(2.0 * _PER_LENGTH * np.linalg.norm(parts, axis=-1)))


def blurred_views(session: Session, edges: Floats | None) -> list[tuple[int, int]]:
    """Views whose markers are drawn out along one direction, as (camera, station).

    Args:
        session: How well the markers were found, which the width of their edges shares.
        edges: See :func:`drawn_out`, (m, n, 3, 3), px^2; None where not measured.
    """
    if edges is None:
        return []
    length = drawn_out(edges)
    if not np.isfinite(length).any():
        return []
    # The blur of an edge is found about as well as its place, and its variance is the
    # square of it.
    noise = np.trace(session.pixel_covariance, axis1=-2, axis2=-1).mean(axis=-1) / 2.0
    spread = 2.0 * np.sqrt(edges[..., 0].mean(axis=-1).clip(0.0) * noise)
    chance = np.sqrt(2.0 * _PER_LENGTH * _SIGMAS * spread)
    limit = max(_LEAST_LENGTH, _USUAL * float(np.nanmedian(length)))
    return [(int(i), int(j)) for i, j in np.argwhere(length > np.fmax(limit, chance))]


def image_findings(
    session: Session, blurred: list[tuple[int, int]], edges: Floats | None
) -> list[Finding]:
    """Findings that need no geometry.

    Args:
        session: What was detected.
        blurred: What :func:`blurred_views` found.
        edges: What it found it in, (m, n, 3, 3), px^2; None where not measured.
    """
    names = [info.name for info in session.cameras]
    findings = []
    if blurred and edges is not None:
        length = drawn_out(edges)
        cameras = {i for i, _ in blurred}
        findings.append(
            Finding(
                "BLUR",
                "the robot moved while images were exposed",
                "markers are drawn out: "
                + "; ".join(
                    f"{names[i]}, station {j}: {length[i, j]:.1f} px"
                    for i, j in blurred
                )
                + f" (usually {np.nanmedian(length):.1f})",
                "warning",
                "wait until the robot stands, or expose for a shorter time; record "
                "those stations again",
                tuple(sorted({j for _, j in blurred})),
                names[cameras.pop()] if len(cameras) == 1 else "",
            )
        )
    poor = _poor_detection(session, names)
    return findings if poor is None else [*findings, poor]


def _poor_detection(session: Session, names: list[str]) -> Finding | None:
    seen = np.isfinite(session.pixels).all(axis=-1)
    taken = seen.any(axis=-1)
    variance = np.trace(session.pixel_covariance, axis1=-2, axis2=-1) / 2.0
    filled = np.where(seen, variance, 0.0).sum(axis=-1)
    sigma = np.sqrt(filled / np.maximum(seen.sum(axis=-1), 1))
    usual = float(np.median(sigma[taken])) if taken.any() else 0.0
    limit = min(_POOR_SIGMA, max(_POOR_RATIO * usual, 0.5 * _POOR_SIGMA))
    poor = np.argwhere(taken & (sigma > limit))
    missing = int((~seen).sum())
    if not len(poor) and missing <= _MISSING * seen.size:
        return None
    lacking = np.argwhere(~seen.all(axis=-1))
    views = {(int(i), int(j)) for i, j in (*poor, *lacking)}
    cameras = {i for i, _ in views}
    return Finding(
        "DETECTION",
        "markers are found poorly, or not at all",
        f"{missing} of {seen.size} markers missing; sigma {usual:.3f} px at the median "
        f"view, {sigma.max():.3f} at the worst, above {limit:.2f} in {len(poor)} views",
        "warning",
        "more and even light, focus, larger or more saturated markers, less gain; "
        "nothing before the markers",
        tuple(sorted({j for _, j in views})),
        names[cameras.pop()] if len(cameras) == 1 else "",
    )
