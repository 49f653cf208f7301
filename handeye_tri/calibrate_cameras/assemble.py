"""From a few metric cameras to all of them, the markers and the triangle's poses.

Zhao, Liu and Zhang 2008 (doi:10.1109/TIP.2008.2005562), Appendix A: cameras by the
direct linear transformation and RQ decomposition (Eq. (35)), poses by Procrustes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.special_motion import homogeneous
from handeye_tri.se3 import nearest_rotation, se3_inverse, so3_exp
from handeye_tri.triangle import TriangleRig

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Points that fix the eleven numbers of a camera, with some to spare.
_MIN_RESECTION = 8
# Focal lengths over the images' scale beyond which a resection is not believed.
_FOCAL_LIMITS = (0.1, 30.0)
# Angles at which a triangle with one marker seen once is tried.
_TRIED_ANGLES = 90


@dataclass(frozen=True, slots=True, eq=False)
class MetricCamera:
    """A pinhole camera in some metric frame.

    Attributes:
        k: Shape (3, 3).
        camera_from_world: Shape (4, 4), metres.
    """

    k: Floats
    camera_from_world: Floats

    @property
    def matrix(self) -> Floats:
        """P = K [R t], shape (3, 4)."""
        return np.asarray(self.k @ self.camera_from_world[:3])


def decompose(matrix: Floats, points: Floats) -> MetricCamera | None:
    """K, R and t of a camera matrix, by RQ decomposition.

    Args:
        matrix: Shape (3, 4), any scale.
        points: Points that the camera sees, shape (n, 3), metres, which settle the
            sign.

    Returns:
        The camera; None where it sees most points from behind or its K is none.
    """
    depth = points @ matrix[2, :3] + matrix[2, 3]
    matrix = matrix * np.sign(np.median(depth))
    left = matrix[:, :3]
    determinant = np.linalg.det(left)
    if not np.isfinite(matrix).all() or determinant <= 0:
        # A reflection: what is in front of the camera would be mirrored.
        return None
    q, r = np.linalg.qr(np.linalg.inv(left))
    k, rotation = np.linalg.inv(r), q.T
    signs = np.diag(np.sign(np.diagonal(k)))
    k, rotation = k @ signs, signs @ rotation
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = np.linalg.solve(k, matrix[:, 3])
    k = k / k[2, 2]
    low, high = _FOCAL_LIMITS
    if not (low < k[0, 0] < high and low < k[1, 1] < high):
        return None
    return MetricCamera(k, pose)


def resect(images: Floats, points: Floats) -> MetricCamera | None:
    """A camera from points that it sees, by the direct linear transformation.

    Args:
        images: Shape (n, 2), of about unit size.
        points: Shape (n, 3), metres.

    Returns:
        The camera; None where no camera comes out.
    """
    centre = points.mean(axis=0)
    size = np.sqrt(((points - centre) ** 2).sum(axis=1).mean())
    world = homogeneous((points - centre) / size)
    rows = np.zeros((len(points), 2, 12))
    rows[:, 0, 0:4] = rows[:, 1, 4:8] = world
    rows[:, :, 8:] = -images[..., None] * world[:, None]
    matrix = np.linalg.svd(rows.reshape(-1, 12), full_matrices=False)[2][-1]
    matrix = matrix.reshape(3, 4)
    back = np.eye(4) / size
    back[:3, 3] = -centre / size
    back[3, 3] = 1.0
    return decompose(matrix @ back, points)


def triangulate_linear(cameras: dict[int, MetricCamera], images: Floats) -> Floats:
    """Markers that two or more of the cameras see, in front of all of those.

    Args:
        cameras: The cameras that are known.
        images: Shape (m, ..., 2), NaN where unseen.

    Returns:
        Shape (..., 3), metres, NaN where there are fewer than two.
    """
    shape = images.shape[1:-1]
    x = images.reshape(len(images), -1, 2)
    normal = np.zeros((x.shape[1], 4, 4))
    count = np.zeros(x.shape[1], dtype=int)
    for i, camera in cameras.items():
        seen = np.isfinite(x[i]).all(axis=-1)
        # In rays, so that each camera counts by angle.
        inverse = np.linalg.inv(camera.k)
        ray = homogeneous(np.where(seen[:, None], x[i], 0.0)) @ inverse.T
        pose = camera.camera_from_world
        rows = ray[:, :2, None] * pose[2] - ray[:, 2:, None] * pose[:2]
        rows /= np.linalg.norm(ray, axis=-1)[:, None, None]
        rows[~seen] = 0.0
        normal += np.swapaxes(rows, 1, 2) @ rows
        count += seen
    vector = np.linalg.eigh(normal)[1][..., 0]
    enough = (count >= 2) & (np.abs(vector[:, 3]) > 1e-12)
    points = np.full((len(vector), 3), np.nan)
    points[enough] = vector[enough, :3] / vector[enough, 3:]
    for i, camera in cameras.items():
        pose = camera.camera_from_world
        behind = points @ pose[2, :3] + pose[2, 3] <= 0
        points[np.isfinite(x[i]).all(axis=-1) & behind] = np.nan
    return points.reshape(*shape, 3)


def place_all(
    cameras: dict[int, MetricCamera], images: Floats
) -> dict[int, MetricCamera]:
    """Resect the other cameras, one that sees most known markers at a time.

    Args:
        cameras: Those that are known, two or more.
        images: Shape (m, n, 3, 2), NaN where unseen.

    Returns:
        The cameras with all that could be added.
    """
    placed = dict(cameras)
    refused: set[int] = set()
    flat = images.reshape(len(images), -1, 2)
    seen = np.asarray(np.isfinite(flat).all(axis=-1))
    while len(placed) + len(refused) < len(images):
        points = triangulate_linear(placed, flat)
        known: Bools = np.asarray(np.isfinite(points).all(axis=-1))
        left = [i for i in range(len(images)) if i not in placed and i not in refused]
        counts = [int((seen[i] & known).sum()) for i in left]
        if max(counts) < _MIN_RESECTION:
            break
        best = max(counts)
        for i, count in zip(left, counts, strict=True):
            # Others that see nearly as much need not wait for new markers.
            if count < max(0.7 * best, _MIN_RESECTION):
                continue
            rows = seen[i] & known
            camera = resect(flat[i, rows], points[rows])
            if camera is None:
                refused.add(i)
            else:
                placed[i] = camera
    return placed


def triangle_poses(
    cameras: dict[int, MetricCamera], images: Floats, triangle: TriangleRig
) -> Floats:
    """world_from_triangle in every view, shape (n, 4, 4), metres, NaN where unknown.

    Three triangulated markers fix it by Procrustes. With two, and the third seen by
    one camera, the triangle is turned about the line through the two until its third
    marker is where that camera sees it.

    Args:
        cameras: The cameras.
        images: Shape (m, n, 3, 2), NaN where unseen.
        triangle: The rig.
    """
    points = triangulate_linear(cameras, images)
    known: Bools = np.asarray(np.isfinite(points).all(axis=-1))
    result = np.full((len(points), 4, 4), np.nan)
    whole = known.all(axis=1)
    result[whole] = _procrustes(points[whole], triangle.points)
    for third in range(3):
        rows = np.flatnonzero(~known[:, third] & (known.sum(axis=1) == 2))
        for i, camera in cameras.items():
            seen = rows[np.isfinite(images[i, rows, third]).all(axis=-1)]
            if len(seen):
                result[seen] = _turned_into_place(
                    points[seen], images[i, seen, third], camera, triangle, third
                )
    return result


def _procrustes(seen: Floats, points: Floats) -> Floats:
    """The rigid motions (n, 4, 4) that fit points (3, 3) best to seen (n, 3, 3)."""
    middle, centre = points.mean(axis=0), seen.mean(axis=1)
    spread = np.swapaxes(seen - centre[:, None], 1, 2) @ (points - middle)
    rotation = nearest_rotation(spread)
    motion = np.tile(np.eye(4), (len(seen), 1, 1))
    motion[:, :3, :3] = rotation
    motion[:, :3, 3] = centre - rotation @ middle
    return motion


def _turned_into_place(
    seen: Floats,
    image: Floats,
    camera: MetricCamera,
    triangle: TriangleRig,
    third: int,
) -> Floats:
    """Poses from two markers (n, 3, 3) and the image (n, 2) of the third."""
    first, second = (third + 1) % 3, (third + 2) % 3
    points = triangle.points
    along = points[second] - points[first]
    foot = points[first] + along * ((points[third] - points[first]) @ along) / (
        along @ along
    )
    reach = float(np.linalg.norm(points[third] - foot))
    line = seen[:, second] - seen[:, first]
    length = np.linalg.norm(line, axis=-1, keepdims=True)
    line = line / length
    middle = 0.5 * (seen[:, first] + seen[:, second])
    start = middle - 0.5 * np.linalg.norm(along) * line
    offset = float((foot - points[first]) @ along / np.linalg.norm(along))
    base = start + offset * line
    # Any direction across the line, then the others by turning it.
    other = np.eye(3)[np.argmin(np.abs(line), axis=-1)]
    across = np.cross(line, other)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    angles = np.linspace(0.0, 2.0 * np.pi, _TRIED_ANGLES, endpoint=False)
    turn = so3_exp(line[:, None] * angles[:, None])
    apex = base[:, None] + reach * (turn @ across[:, None, :, None])[..., 0]
    mapped = homogeneous(apex) @ camera.matrix.T
    missed = mapped[..., :2] / mapped[..., 2:] - image[:, None]
    square = np.where(mapped[..., 2] > 0, (missed**2).sum(axis=-1), np.inf)
    best = np.argmin(square, axis=1)
    corners = np.empty((len(seen), 3, 3))
    corners[:, first] = start
    corners[:, second] = start + np.linalg.norm(along) * line
    corners[:, third] = apex[np.arange(len(seen)), best]
    return _procrustes(corners, points)


def in_first_frame(
    cameras: dict[int, MetricCamera], poses: Floats
) -> tuple[Floats, Floats]:
    """reference_from_camera (m, 4, 4) and reference_from_triangle, camera 0 first."""
    first = cameras[0].camera_from_world
    places = np.array(
        [first @ se3_inverse(cameras[i].camera_from_world) for i in range(len(cameras))]
    )
    return places, first @ poses
