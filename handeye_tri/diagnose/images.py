"""What the images themselves say: blur along one direction, poor detection."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.counting import counted
from handeye_tri.diagnose.gates import Finding
from handeye_tri.diagnose.loop import Fit, Loop
from handeye_tri.records import Session
from handeye_tri.triangle import MIN_FACING, apparent_scales

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

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


def views_due(loop: Loop, fit: Fit) -> Bools:
    """Views that hold all markers, and not nearly from the triangle's edge, (m, n).

    What stands before a marker is not looked for.
    """
    pixels = loop.predicted(fit)
    sizes = np.array([info.image_size for info in loop.session.cameras])
    inside = (pixels > 0.0) & (pixels < sizes[:, None, None] - 1.0)
    due: Bools = np.asarray(inside.all(axis=(2, 3)))
    markers = loop.local(fit)[due]
    _, sides = np.linalg.qr((markers[:, 1:] - markers[:, :1]).mT)
    long, short = apparent_scales(pixels[due], sides.mT).T
    due[due] = short > MIN_FACING * long
    return due


def image_findings(
    session: Session,
    blurred: list[tuple[int, int]],
    edges: Floats | None,
    due: Bools | None = None,
) -> list[Finding]:
    """What is wrong with the images.

    Args:
        session: What was detected.
        blurred: What :func:`blurred_views` found.
        edges: What it found it in, (m, n, 3, 3), px^2; None where not measured.
        due: Views in which all markers should be found, (m, n); None for all.
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
    poor = _poor_detection(session, names, due)
    return findings if poor is None else [*findings, poor]


def _poor_detection(
    session: Session, names: list[str], due: Bools | None
) -> Finding | None:
    seen: Bools = np.asarray(np.isfinite(session.pixels).all(axis=-1))
    taken: Bools = np.asarray(seen.any(axis=-1))
    variance = np.trace(session.pixel_covariance, axis1=-2, axis2=-1) / 2.0
    filled = np.where(seen, variance, 0.0).sum(axis=-1)
    sigma = np.sqrt(filled / np.maximum(seen.sum(axis=-1), 1))
    usual = float(np.median(sigma[taken])) if taken.any() else 0.0
    limit = min(_POOR_SIGMA, max(_POOR_RATIO * usual, 0.5 * _POOR_SIGMA))
    poor = np.argwhere(taken & (sigma > limit))
    if due is None:
        due = np.ones(taken.shape, dtype=bool)
    due = due | taken
    missing, markers = int((~seen[due]).sum()), seen[due].size
    if not len(poor) and missing <= _MISSING * markers:
        return None
    lacking = np.argwhere(due & ~seen.all(axis=-1))
    views = {(int(i), int(j)) for i, j in (*poor, *lacking)}
    cameras = {i for i, _ in views}
    return Finding(
        "DETECTION",
        "markers are found poorly, or not at all",
        f"{missing} of {markers} markers missing; sigma {usual:.3f} px at the median "
        f"view, {sigma.max():.3f} at the worst, above {limit:.2f} in "
        f"{counted(len(poor), 'view')}",
        "warning",
        "more and even light, focus, larger or more saturated markers, less gain; "
        "nothing before the markers",
        tuple(sorted({j for _, j in views})),
        names[cameras.pop()] if len(cameras) == 1 else "",
    )
