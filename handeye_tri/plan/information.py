"""What stations tell about the cell: Fisher information, before any image exists.

Model: every camera's intrinsics and lens, every camera in the base, and the three
markers in the flange frame on each mount are unknown; each station's pose differs from
the reported one by the robot's repeatability, which is eliminated station by station.
The information of stations adds up, and the inverse of its sum is the Cramer-Rao bound
of the joint adjustment, which solves this very model.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import INTRINSIC_NAMES
from handeye_tri.config import Cell
from handeye_tri.counting import counted
from handeye_tri.errors import InputError
from handeye_tri.plan.poses import HALF_TURN, View
from handeye_tri.records import (
    Covariance,
    Repeatability,
    marker_labels,
    motion_labels,
)
from handeye_tri.se3 import SE3, hat, se3_inverse
from handeye_tri.triangle import frame_by_markers

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Ints = NDArray[np.intp]

# Prior standard deviations that keep a few stations solvable; far wider than what
# two half-turns give: pixels for intrinsics, bare numbers for the lens, m and rad.
_PRIOR_PIXELS = 1000.0
_PRIOR_LENS = 1.0
_PRIOR_MOTION = 1.0
# A camera alone may be known worse than that.
_WEAKER = 1e-4
# Places in the workspace box that the track error is predicted at, and how many are
# drawn to find that many which all cameras see.
_PLACES = 300
_DRAWN_PLACES = 3000


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Places in the workspace box with one mount.

    Attributes:
        base_from_flange: Shape (n, 4, 4), metres.
        seen: Which cameras see all markers there, shape (n, m).
        mounts: Which mount holds the triangle, the same at all, shape (n,).
    """

    base_from_flange: Floats
    seen: Flags
    mounts: Ints


class StationInformation:
    """Predicts covariances of a calibration from flange poses.

    Attributes:
        labels: Names of the p unknowns, as in a calibration's covariance.
        sigma_px: Standard deviation of a detected centre per axis, pixels.
        views: Cameras and rig, by mount.
        names: What a person calls the mounts.
        base_from_world: Shape (4, 4), metres.
        prior: Weak information on every unknown, shape (p, p).
    """

    def __init__(
        self,
        cell: Cell,
        base_from_world: Floats,
        repeatability: Repeatability,
        sigma_px: float,
    ) -> None:
        """Set up the unknowns.

        Args:
            cell: Cameras, and the rig on one mount or two.
            base_from_world: Shape (4, 4), metres.
            repeatability: The robot's pose error.
            sigma_px: Of a detected centre, per axis, pixels.
        """
        self.views = tuple(View(mounted) for mounted in cell.mounted)
        self.names = tuple(cell.mount_name(k) for k in range(len(self.views)))
        self.base_from_world = base_from_world
        self._camera_from_base = se3_inverse(
            base_from_world @ self.views[0].world_from_camera
        )
        self._markers = np.array([view.markers for view in self.views])
        self._pose_covariance = repeatability.covariance
        self.sigma_px = sigma_px
        labels: list[str] = []
        self._columns: list[tuple[slice, list[int], list[int]]] = []
        prior: list[float] = []
        for config in cell.cameras:
            chosen = [
                k
                for k, name in enumerate(INTRINSIC_NAMES)
                if name != "skew" or config.estimate.skew
            ]
            lens_names = config.camera.lens.names
            lens = [
                k for k, name in enumerate(lens_names) if name in config.estimate.lens
            ]
            begin = len(labels)
            labels += [f"{config.name}.{INTRINSIC_NAMES[k]}" for k in chosen]
            labels += [f"{config.name}.{lens_names[k]}" for k in lens]
            labels += motion_labels(f"base_from_{config.name}")
            self._columns.append((slice(begin, len(labels)), chosen, lens))
            prior += [_PRIOR_PIXELS] * len(chosen) + [_PRIOR_LENS] * len(lens)
            prior += [_PRIOR_MOTION] * 6
        self._first_marker = len(labels)
        for mount in range(len(self.views)):
            labels += marker_labels(mount)
            prior += [_PRIOR_MOTION] * 9
        self.labels = tuple(labels)
        self.prior = np.diag(1.0 / np.square(prior))

    def _marker(self, mount: int, k: int) -> slice:
        """Columns of marker k on a mount; markers come last."""
        begin = self._first_marker + 9 * mount + 3 * k
        return slice(begin, begin + 3)

    def _derivatives(
        self, base_from_flange: Floats, seen: Flags, mounts: Ints
    ) -> tuple[Floats, Floats, Floats]:
        """Pixels by unknowns, by the station's error, and by the points in base.

        Args:
            base_from_flange: Shape (n, 4, 4), metres.
            seen: Which cameras count, shape (n, m); all is zero for the others.
            mounts: Which mount holds the triangle there, shape (n,).

        Returns:
            Shapes (n, m, 3, 2, p), (n, m, 3, 2, 6), (n, m, 3, 2, 3).
        """
        cameras, markers = self.views[0].cameras, self._markers[mounts]
        n, m, p = len(base_from_flange), len(cameras), len(self.labels)
        by_unknowns = np.zeros((n, m, 3, 2, p))
        by_error = np.zeros((n, m, 3, 2, 6))
        by_base_point = np.zeros((n, m, 3, 2, 3))
        there = [np.flatnonzero(mounts == j) for j in range(len(self.views))]
        for i, camera in enumerate(cameras):
            camera_from_flange = self._camera_from_base[i] @ base_from_flange
            rotation = camera_from_flange[:, None, :3, :3]
            points = (rotation @ markers[..., None])[..., 0]
            points += camera_from_flange[:, None, :3, 3]
            points = np.where(seen[:, i, None, None], points, (0.0, 0.0, 1.0))
            _, by_point, by_intrinsics, by_lens = camera.project_jacobians(points)
            columns, chosen, lens = self._columns[i]
            by_camera = np.concatenate([-by_point, by_point @ hat(points)], axis=-1)
            by_unknowns[:, i, :, :, columns] = np.concatenate(
                [by_intrinsics[..., chosen], by_lens[..., lens], by_camera], axis=-1
            )
            by_flange = by_point @ rotation
            by_error[:, i] = np.concatenate(
                [by_flange, -by_flange @ hat(markers)], axis=-1
            )
            for mount, rows in enumerate(there):
                for k in range(3):
                    own = self._marker(mount, k)
                    by_unknowns[rows, i, k, :, own] = by_flange[rows, k]
            by_base_point[:, i] = by_point @ self._camera_from_base[i, :3, :3]
        for result in (by_unknowns, by_error, by_base_point):
            result[~seen] = 0.0
        return by_unknowns, by_error, by_base_point

    def of_stations(
        self, base_from_flange: Floats, seen: Flags, mounts: Ints
    ) -> Floats:
        """Information of each station.

        Args:
            base_from_flange: Shape (n, 4, 4), metres.
            seen: Which cameras see all markers there, shape (n, m).
            mounts: Which mount holds the triangle there, shape (n,).

        Returns:
            Shape (n, p, p).
        """
        by_unknowns, by_error, _ = self._derivatives(base_from_flange, seen, mounts)
        n, p = len(base_from_flange), len(self.labels)
        rows = by_unknowns.shape[1] * 6
        a = by_unknowns.reshape(n, rows, p)
        b = by_error.reshape(n, rows, 6)
        noise = b @ self._pose_covariance @ b.swapaxes(-1, -2)
        noise += self.sigma_px**2 * np.eye(a.shape[1])
        return np.asarray(a.swapaxes(-1, -2) @ np.linalg.solve(noise, a))

    def of_half_turns(
        self, base_from_flange: Floats, seen: Flags, mounts: Ints
    ) -> Floats:
        """Information of each half-turn.

        Args:
            base_from_flange: Shape (n, 2, 4, 4), metres.
            seen: Which cameras see all markers before and after, shape (n, m).
            mounts: Which mount holds the triangle there, shape (n,).

        Returns:
            Shape (n, p, p).
        """
        each = self.of_stations(
            base_from_flange.reshape(-1, 4, 4),
            np.repeat(seen, 2, axis=0),
            np.repeat(mounts, 2),
        )
        size = len(self.labels)
        return np.asarray(each.reshape(-1, 2, size, size).sum(axis=1))

    def focal_sigmas_alone(
        self, base_from_flange: Floats, seen: Flags, mounts: Ints
    ) -> Floats:
        """Predicted sigma of each camera's fx from half-turns by itself.

        As a calibration begins (Zhao, Liu and Zhang 2008, Sec. III): one camera, the
        triangle's sides known, where it is before each half-turn unknown, and after it
        turned by 180 degrees within the robot's repeatability.

        Args:
            base_from_flange: Shape (k, 2, 4, 4), metres.
            seen: Which cameras see all markers before and after, shape (k, m).
            mounts: Which mount holds the triangle there, shape (k,).

        Returns:
            Shape (m,), pixels.
        """
        k = len(base_from_flange)
        by_unknowns, by_error, _ = self._derivatives(
            base_from_flange.reshape(-1, 4, 4),
            np.repeat(seen, 2, axis=0),
            np.repeat(mounts, 2),
        )
        # T exp(d) H = T H exp(Ad(H^-1) d).
        back = SE3(HALF_TURN).inverse().adjoint()
        sigmas = []
        for i, (columns, chosen, lens) in enumerate(self._columns):
            own = range(columns.start, columns.start + len(chosen) + len(lens))
            error = by_error[:, i].reshape(k, 2, 6, 6)
            noise = np.zeros((k, 12, 12))
            for j in range(2):
                rows = slice(6 * j, 6 * j + 6)
                noise[:, rows, rows] = (
                    error[:, j] @ self._pose_covariance @ error[:, j].mT
                )
            noise += self.sigma_px**2 * np.eye(12)
            pose = np.concatenate([error[:, 0], error[:, 1] @ back], axis=1)
            a = by_unknowns[:, i][..., own].reshape(k, 12, len(own))
            both = np.concatenate([a, pose], axis=2)
            normal = both.mT @ np.linalg.solve(noise, both)
            p = a.shape[2]
            inner = normal[:, p:, p:] + _WEAKER * np.eye(6) / _PRIOR_MOTION**2
            cross = normal[:, :p, p:]
            total = (normal[:, :p, :p] - cross @ _inverse(inner) @ cross.mT).sum(axis=0)
            total += _WEAKER * self.prior[columns, columns][:p, :p]
            sigmas.append(np.sqrt(_inverse(total)[0, 0]))
        return np.array(sigmas)

    @cached_property
    def places(self) -> tuple[Places, ...]:
        """Where the track error is predicted, by mount: all over the workspace box.

        Raises:
            InputError: no place there is seen.
        """
        found = []
        for mount, view in enumerate(self.views):
            world = view.draw(np.random.default_rng(0), _DRAWN_PLACES)
            seen = view.seen(world)
            enough = np.flatnonzero(seen.sum(axis=1) >= view.required)[:_PLACES]
            if len(enough) == 0:
                cell = view.cell
                whose = f" of {self.names[mount]}" if len(self.views) > 1 else ""
                raise InputError(
                    f"cell {cell.name!r}: of {_DRAWN_PLACES} poses in the workspace "
                    f"box none shows the triangle{whose} to "
                    f"{counted(view.required, 'camera')}; turn the cameras there, or "
                    "move plan.workspace_min_m and workspace_max_m to what they see"
                )
            poses = np.asarray(self.base_from_world @ world[enough])
            mounts = np.full(len(enough), mount, dtype=np.intp)
            found.append(Places(poses, seen[enough], mounts))
        return tuple(found)

    @cached_property
    def workspace_cost(self) -> Floats:
        """What a covariance of the unknowns costs, shape (p, p).

        ``trace(workspace_cost @ covariance)`` is the mean squared distance between
        reported and observed markers that the calibration causes, in m^2, over
        poses in the workspace box that enough cameras see, with either mount as often.
        """
        cost = np.zeros((len(self.labels), len(self.labels)))
        for there in self.places:
            track = self.track_derivatives(
                there.base_from_flange, there.seen, there.mounts
            ).reshape(-1, len(self.labels))
            cost += track.T @ track / (len(track) / 3)
        return cost / len(self.places)

    @cached_property
    def workspace_noise(self) -> float:
        """Mean squared distance there from a new view's and the robot's noise, m^2."""
        means = []
        for there, lever in zip(self.places, self._levers, strict=True):
            observed = self._observed(there.base_from_flange, there.seen, there.mounts)
            noise = self.sigma_px**2 * observed[1]
            robot = lever @ self._pose_covariance @ lever.swapaxes(1, 2)
            means.append(
                np.trace(noise, axis1=2, axis2=3).mean()
                + np.trace(robot, axis1=1, axis2=2).mean()
            )
        return float(np.mean(means))

    @property
    def _levers(self) -> Floats:
        """Markers in the flange by the flange's right tangent, (mounts, 3, 3, 6)."""
        eye = np.broadcast_to(np.eye(3), (*self._markers.shape[:2], 3, 3))
        return np.concatenate([eye, -hat(self._markers)], axis=-1)

    def baseline_sigma(self, covariance: Covariance) -> float:
        """Predicted sigma of the distance of the first two cameras, metres."""
        position = np.linalg.inv(self._camera_from_base)[:2]
        apart = position[1, :3, 3] - position[0, :3, 3]
        along = apart / np.linalg.norm(apart)
        gradient = np.zeros(len(self.labels))
        for pose, camera, sign in zip(
            position, self.views[0].cell.cameras[:2], (-1.0, 1.0), strict=True
        ):
            labels = [f"base_from_{camera.name}.{q}" for q in "xyz"]
            places = [self.labels.index(label) for label in labels]
            gradient[places] = sign * along @ pose[:3, :3]
        return float(np.sqrt(gradient @ covariance.matrix @ gradient))

    def track_derivatives(
        self, base_from_flange: Floats, seen: Flags, mounts: Ints
    ) -> Floats:
        """Observed less reported marker positions by the unknowns.

        Observed: from fixed pixels with equal weights, each marker triangulated; a
        cell's only camera sees where the rigid triangle is. Reported: the robot's pose
        applied to the markers on the flange.

        Args:
            base_from_flange: Shape (n, 4, 4), metres.
            seen: Which cameras place the markers, shape (n, m), two or more each, or
                the only one.
            mounts: Which mount holds the triangle there, shape (n,).

        Returns:
            Shape (n, 3, 3, p): station, marker, axis in base.
        """
        result = self._observed(base_from_flange, seen, mounts)[0]
        return result - self._reported(base_from_flange, mounts)

    def _reported(self, base_from_flange: Floats, mounts: Ints) -> Floats:
        """Markers in the base by unknowns, shape (n, 3, 3, p), of known poses."""
        result = np.zeros((len(mounts), 3, 3, len(self.labels)))
        for mount in range(len(self.views)):
            rows = np.flatnonzero(mounts == mount)
            for k in range(3):
                columns = self._marker(mount, k)
                result[rows, k, :, columns] = base_from_flange[rows, :3, :3]
        return result

    def _observed(
        self, base_from_flange: Floats, seen: Flags, mounts: Ints
    ) -> tuple[Floats, Floats]:
        """Observed markers by the unknowns, and their covariance at 1 px.

        Returns:
            Shapes (n, 3, 3, p) and (n, 3, 3, 3), in the base.
        """
        by_unknowns, by_error, by_point = self._derivatives(
            base_from_flange, seen, mounts
        )
        if len(self.views[0].cameras) > 1:
            # The triangle does not move what the cameras observe.
            by_unknowns[..., self._first_marker :] = 0.0
            normal = np.einsum("nikac,nikad->nkcd", by_point, by_point)
            pull = np.einsum("nikac,nikap->nkcp", by_point, by_unknowns)
            return -np.linalg.solve(normal, pull), np.linalg.inv(normal)
        # Six coordinates for six of a pose.
        pose = np.linalg.inv(by_error.reshape(-1, 6, 6))
        moved = base_from_flange[:, None, :3, :3] @ self._levers[mounts]
        by_pixels = moved @ pose[:, None]
        result = -by_pixels @ by_unknowns.reshape(len(pose), 1, 6, -1)
        result += self._reported(base_from_flange, mounts)
        return result, by_pixels @ by_pixels.swapaxes(-1, -2)

    def covariance(self, information: Floats) -> Covariance:
        """Predicted covariance of the unknowns from summed information, (p, p)."""
        return Covariance(self.labels, _inverse(information + self.prior))

    def rig_covariance(self, covariance: Covariance, mount: int) -> Floats:
        """That of a mount's flange_from_triangle's right tangent, (6, 6), m and rad.

        Args:
            covariance: Of the unknowns.
            mount: Which, from 0.
        """
        by_markers = frame_by_markers(self._markers[mount])
        own = covariance.block(marker_labels(mount))
        return np.asarray(by_markers @ own @ by_markers.T)


def _inverse(information: Floats) -> Floats:
    """Inverses of symmetric matrices (..., p, p), scaled to unit diagonal first."""
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    scale = 1.0 / np.sqrt(diagonal)
    scaled = information * scale[..., :, None] * scale[..., None, :]
    inverse = np.linalg.inv(scaled) * scale[..., :, None] * scale[..., None, :]
    return np.asarray(0.5 * (inverse + inverse.swapaxes(-1, -2)))
