"""Where the rig may go: drawing flange poses, and checks that need no robot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import PinholeCamera
from handeye_tri.config import Cell
from handeye_tri.se3 import SE3

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# The rotation of a half-turn: about the flange's z axis, which is its own inverse.
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
# Nearly fronto-parallel views say little about the focal lengths.
_MIN_TILT = np.radians(8.0)
# An edge rig's holder comes from behind where the flange axis is lifted this far
# from the image plane towards the cameras.
_LIFT = np.radians([15.0, 50.0])
_OUTLINE_POINTS = 12
# A pose is turned to a camera and to those that look from this near its direction.
_SIDE = np.radians(60.0)
# A lens model may fold far points back into the image: without its lens, the
# image extends by at most this part of its size.
_BEYOND_IMAGE = 0.25


class View:
    """The cell as planning sees it: cameras, rig and workspace in the world.

    Attributes:
        cell: The cell's description.
        cameras: The m cameras.
        world_from_camera: Where they stand, shape (m, 4, 4), metres.
        flange_from_triangle: The rig on the flange.
        markers: A, B, C in the flange frame, shape (3, 3), metres.
        radii: Marker radii, shape (3,), metres.
        required: How many cameras must see a station: two, to place a marker.
    """

    def __init__(self, cell: Cell) -> None:
        """Collect from the cell's description."""
        self.cell = cell
        self.cameras = tuple(c.camera for c in cell.cameras)
        self.world_from_camera = np.array(
            [c.world_from_camera.matrix for c in cell.cameras]
        )
        self.flange_from_triangle: SE3 = cell.rig.flange_from_triangle
        self.markers = self.flange_from_triangle.apply(cell.rig.triangle.points)
        self.radii = 1e-3 * np.array(cell.rig.marker_radii_mm)
        self.required = min(2, len(self.cameras))

    def draw(self, rng: np.random.Generator, n: int) -> Floats:
        """Random flange poses that show the rig to the cameras.

        The rig's centre is uniform in the workspace box. The triangle is tilted
        against the mean line of sight of cameras on one side, up to the cell's
        ``max_tilt_deg`` in any direction, and spun about its half-turn axis.

        Returns:
            ``world_from_flange``, shape (n, 4, 4), metres.
        """
        plan = self.cell.plan
        centre = rng.uniform(plan.workspace_min_m, plan.workspace_max_m, (n, 3))
        sight = _frames_along(self._side(rng, centre) - centre)
        around = rng.uniform(0.0, 2 * np.pi, n)
        most = np.radians(plan.max_tilt_deg)
        if self.cell.rig.axis == "normal":
            tilt = rng.uniform(min(_MIN_TILT, most), most, n)
            z = _direction(sight, tilt, around)
            spin = rng.uniform(0.0, 2 * np.pi, n)[:, None]
            frames = _frames_along(z)
            x = np.cos(spin) * frames[..., 0] + np.sin(spin) * frames[..., 1]
            rotation = np.stack([x, np.cross(z, x), z], axis=-1)
        else:
            lift = rng.uniform(_LIFT[0], min(_LIFT[1], most), n)
            z = _direction(sight, np.pi / 2 - lift, around)
            facing = sight[..., 2] - np.sin(lift)[:, None] * z
            facing /= np.linalg.norm(facing, axis=1, keepdims=True)
            lean = rng.uniform(-most, most, n)[:, None]
            normal = np.cos(lean) * facing + np.sin(lean) * np.cross(z, facing)
            normal *= rng.choice([-1.0, 1.0], (n, 1))
            own = self.flange_from_triangle.rotation[:, 2]
            up = np.array([0.0, 0.0, 1.0])
            flange = np.stack([np.cross(own, up), own, up], axis=-1)
            world = np.stack([np.cross(normal, z), normal, z], axis=-1)
            rotation = world @ flange.T
        poses = np.zeros((n, 4, 4))
        poses[:, :3, :3] = rotation
        poses[:, :3, 3] = centre - self.markers[:, 2].mean() * rotation[..., 2]
        poses[:, 3, 3] = 1.0
        return poses

    def _side(self, rng: np.random.Generator, centre: Floats) -> Floats:
        """Mean position of the cameras on one side of each place (n, 3), (n, 3)."""
        places = self.world_from_camera[:, :3, 3]
        toward = places - centre[:, None]
        toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
        near = np.einsum("nia,nja->nij", toward, toward) > np.cos(_SIDE)
        if near.all():
            return np.broadcast_to(places.mean(axis=0), centre.shape)
        lead = rng.integers(len(places), size=len(centre))
        weight = near[np.arange(len(centre)), lead].astype(float)
        return np.asarray(weight @ places / weight.sum(axis=1, keepdims=True))

    def marker_positions(self, world_from_flange: Floats) -> Floats:
        """A, B, C in the world, shape (n, 3, 3), metres, of poses (n, 4, 4)."""
        turned = self.markers @ np.swapaxes(world_from_flange[:, :3, :3], -1, -2)
        return np.asarray(turned + world_from_flange[:, None, :3, 3])

    def normals(self, world_from_flange: Floats) -> Floats:
        """Unit normals of the triangle in the world, shape (n, 3)."""
        own = self.flange_from_triangle.rotation[:, 2]
        return np.asarray(world_from_flange[:, :3, :3] @ own)

    def in_image(self, world_from_flange: Floats) -> Flags:
        """Which cameras have every marker's outline inside by the margin.

        Args:
            world_from_flange: Shape (n, 4, 4), metres.

        Returns:
            Shape (n, m).
        """
        points = self.marker_positions(world_from_flange)
        margin = self.cell.plan.image_margin_px
        inside = np.ones((len(points), len(self.cameras)), dtype=bool)
        for i, (camera, pose) in enumerate(
            zip(self.cameras, self.world_from_camera, strict=True)
        ):
            local = (points - pose[:3, 3]) @ pose[:3, :3]
            inside[:, i] = _outlines_inside(camera, local, self.radii, margin)
        return inside

    def tilts(self, world_from_flange: Floats) -> Floats:
        """Angle between the triangle's normal and each camera's line of sight.

        An edge rig shows both faces: the acute angle counts.

        Args:
            world_from_flange: Shape (n, 4, 4), metres.

        Returns:
            Shape (n, m), radians.
        """
        centre = self.marker_positions(world_from_flange).mean(axis=1)
        toward = self.world_from_camera[:, :3, 3] - centre[:, None]
        toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
        cosine = np.einsum("nma,na->nm", toward, self.normals(world_from_flange))
        if self.cell.rig.axis != "normal":
            cosine = np.abs(cosine)
        return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))

    def tilt_allowed(self, world_from_flange: Floats) -> Flags:
        """Which cameras do not see the triangle too steeply, shape (n, m)."""
        most = np.radians(self.cell.plan.max_tilt_deg)
        return np.asarray(self.tilts(world_from_flange) <= most)

    def seen(self, world_from_flange: Floats) -> Flags:
        """Which cameras see the rig well, whatever stands between, shape (n, m)."""
        return self.tilt_allowed(world_from_flange) & self.in_image(world_from_flange)


def plane_angles(first: Floats, second: Floats) -> Floats:
    """Acute angles between planes given by unit normals, (..., 3), radians."""
    cosine = np.abs((first * second).sum(axis=-1))
    sine = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.asarray(np.arctan2(sine, cosine))


def _frames_along(directions: Floats) -> Floats:
    """Rotations whose z axes are the directions of vectors (n, 3); (n, 3, 3)."""
    z = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    side = np.eye(3)[np.argmin(np.abs(z), axis=1)]
    x = side - (side * z).sum(axis=1, keepdims=True) * z
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def _direction(frames: Floats, tilt: Floats, around: Floats) -> Floats:
    """Unit vectors at an angle from the frames' z axes, shape (n, 3)."""
    local = np.stack(
        [np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt)],
        axis=-1,
    )
    return np.asarray((frames @ local[..., None])[..., 0])


def _outlines_inside(
    camera: PinholeCamera, centres: Floats, radii: Floats, margin: float
) -> Flags:
    """Whether spheres (n, 3, 3) in the camera frame lie wholly in its image, (n,)."""
    distance = np.linalg.norm(centres, axis=-1)
    sine = radii / np.maximum(distance, radii)
    frames = _frames_along(centres.reshape(-1, 3)).reshape(*centres.shape, 3)
    angle = np.linspace(0.0, 2 * np.pi, _OUTLINE_POINTS, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    # Directions of the tangents to the sphere: a cone about the line of sight.
    rays = (
        np.sqrt(1 - sine**2)[..., None, None] * frames[..., 2, None]
        + sine[..., None, None] * (frames[..., :2] @ circle)
    ).swapaxes(-1, -2)
    ahead = (rays[..., 2] > 1e-3) & (distance > radii)[..., None]
    depth = np.where(ahead, rays[..., 2], 1.0)
    ideal = rays[..., :2] / depth[..., None]
    size = np.array(camera.image_size, dtype=float)
    k = camera.intrinsics.matrix
    plain = ideal @ k[:2, :2].T + k[:2, 2]
    beyond = _BEYOND_IMAGE * size
    possible = ((plain >= -beyond) & (plain <= size - 1 + beyond)).all(axis=-1)
    pixels = camera.pixels(np.where(possible[..., None], ideal, 0.0))
    inside = ((pixels >= margin) & (pixels <= size - 1 - margin)).all(axis=-1)
    return np.asarray((ahead & possible & inside).all(axis=(1, 2)))
