"""Where the adjustment of several cameras may start.

Zhao, Liu and Zhang 2008 (doi:10.1109/TIP.2008.2005562), Appendix A: factorisation and
a metric frame by the sides. For two cameras, and as another try for more, a sweep
over two focal lengths.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from handeye_tri.calibrate_cameras.assemble import MetricCamera, decompose
from handeye_tri.calibrate_cameras.focal_sweep import sweep_focals
from handeye_tri.calibrate_cameras.general_motion_views import LEAST_SIDES, Views
from handeye_tri.calibrate_cameras.metric_upgrade import quadric_start, upgrade
from handeye_tri.calibrate_cameras.projective import factorise, fundamental
from handeye_tri.errors import DegenerateMotionError

# Cameras that are factorised together.
_CORE = 8
# Focal lengths over the image's longer side for the coordinates of the quadric.
_NOMINAL_FOCALS = (1.5, 0.8, 3.0)
# Pairs of cameras that are swept before giving up, and guesses of each.
_PAIRS = 4
_GUESSES = 3


def starts(
    views: Views, said: list[str]
) -> Iterator[tuple[str, dict[int, MetricCamera]]]:
    """Cameras to start from, two or more of them, the likeliest first.

    Args:
        views: The images.
        said: Takes the reasons why a start could not be had.

    Yields:
        How the start was made; the cameras by index, in a common metric frame.
    """
    m = len(views.images)
    if m > 2:
        for core in _cores(views):
            for focal in _NOMINAL_FOCALS:
                try:
                    cameras = _by_factorisation(views, core, focal)
                except (DegenerateMotionError, np.linalg.LinAlgError) as error:
                    said.append(f"factorisation: {error}")
                    continue
                if cameras is not None:
                    yield "factorisation", cameras
    for i, j in views.ranked_pairs()[:_PAIRS]:
        yield from _by_sweep(views, i, j, said)


def _cores(views: Views) -> list[list[int]]:
    """Groups of three to eight cameras that see markers together, one or none."""
    images = views.images[:, views.few]
    seen = np.isfinite(images).all(axis=-1).reshape(len(images), -1)
    core = [int(np.argmax(seen.sum(axis=1)))]
    together = seen[core[0]]
    while len(core) < min(_CORE, len(images)):
        counts = (seen & together).sum(axis=1)
        counts[core] = -1
        best = int(np.argmax(counts))
        # Twelve markers fix three projective cameras with some to spare.
        if counts[best] < (12 if len(core) < 3 else 0.7 * together.sum()):
            break
        core.append(best)
        together = together & seen[best]
    return [core] if len(core) >= 3 else []


def _by_factorisation(
    views: Views, core: list[int], focal: float
) -> dict[int, MetricCamera] | None:
    images = views.images[core][:, views.few] / focal
    seen = np.asarray(np.isfinite(images).all(axis=(0, -1)))
    projective, points = factorise(images[:, seen], 0)
    ends, lengths = views.edges(seen)
    if len(ends) < LEAST_SIDES:
        raise DegenerateMotionError(
            f"{len(core)} cameras see only {len(ends)} sides of the triangle together"
        )
    k, plane = quadric_start(projective)
    metric = upgrade(points[ends], lengths, k, plane)
    places = metric.points(points)
    result = {}
    for i, matrix in zip(core, metric.cameras(projective), strict=True):
        camera = decompose(matrix, places)
        if camera is None:
            return None
        scaled = camera.k * focal
        scaled[2, 2] = 1.0
        result[i] = MetricCamera(scaled, camera.camera_from_world)
    return result


def _by_sweep(
    views: Views, i: int, j: int, said: list[str]
) -> Iterator[tuple[str, dict[int, MetricCamera]]]:
    rows = views.pair_views(i, j)
    both = views.common(i, j)[rows]
    first, second = views.images[i, rows][both], views.images[j, rows][both]
    matrix = fundamental(first, second).matrix
    guesses = sweep_focals(first, second, matrix, *views.edges(both))
    if not guesses:
        said.append(f"cameras {i}, {j}: no focal lengths put the markers before both")
    for guess in guesses[:_GUESSES]:
        yield (
            f"sweep of cameras {i}, {j}",
            {
                i: MetricCamera(np.diag([*[guess.focals[0]] * 2, 1.0]), np.eye(4)),
                j: MetricCamera(
                    np.diag([*[guess.focals[1]] * 2, 1.0]), guess.second_from_first
                ),
            },
        )
