"""The loop base, flange, markers, camera at every station, open to extra motions.

A marker p is seen by camera i at station j where ``camera_from_base(i, j) @
base_from_flange(j) @ p`` projects. What may be wrong with a cell moves one of these
frames at some stations: the flange, as the robot reports it, by ``exp(F_j phi)``, or a
camera by ``exp(E_j phi)``, with few numbers phi. Such a cause is fitted beside all that
calibration estimates, and its chi2 is set against that of the others.

The robot's own scatter is not estimated but weighed: the pixels of one station share
it, so that their covariance is that of detection plus that of the flange.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.eccentricity import sphere_shift
from handeye_tri.camera import INTRINSIC_NAMES, Intrinsics, Lens, PinholeCamera
from handeye_tri.records import HandEyeCalibration, Session
from handeye_tri.se3 import hat, se3_exp, se3_inverse

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Directions that say less than this share of the largest are taken for undetermined.
_RANK = 1e-7
_ITERATIONS = 12
# A step that lowers chi2 by less than this has arrived.
_SETTLED = 1e-3
# Stations count in full up to this chi2 per number while a start is looked for.
_ROBUST = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Cause:
    """Something that may be wrong, as motions that calibration does not know.

    Attributes:
        kind: Its short name.
        flange: How the flange moves at each station by the p numbers, (n, 6, p),
            right tangents in m and rad; zeros where it does not.
        camera: Index of the camera that moves; -1 for none.
        places: How that camera moves at each station, (n, 6, p), likewise.
        station: The station that it is about, or begins at; -1 for all.
        siblings: How many causes of this kind compete.
        label: What of its kind it is, such as a joint's name.
    """

    kind: str
    flange: Floats
    camera: int = -1
    places: Floats | None = None
    station: int = -1
    siblings: int = 1
    label: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A cell as one hypothesis has it.

    Attributes:
        cameras: The cameras.
        places: base_from_camera at every station, (m, n, 4, 4), metres.
        poses: base_from_flange at every station, (n, 4, 4), metres.
        markers: In the flange frame, by mount, (k, 3, 3), metres.
        chi2: Sum of squared whitened residuals.
        dof: Numbers less unknowns.
        by_station: chi2 of each station, (n,).
        values: phi of the last cause, (p,); none without a cause.
        covariance: Of phi, (p, p).
        markers_covariance: Of the markers, (9 k, 9 k), m^2.
        rank: How many of phi's directions the data determine.
    """

    cameras: tuple[PinholeCamera, ...]
    places: Floats
    poses: Floats
    markers: Floats
    chi2: float = np.inf
    dof: int = 0
    by_station: Floats = field(default_factory=lambda: np.zeros(0))
    values: Floats = field(default_factory=lambda: np.zeros(0))
    covariance: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    markers_covariance: Floats = field(default_factory=lambda: np.zeros((9, 9)))
    rank: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """Whitened rows of all stations.

    Attributes:
        residual: Detected less predicted, (n, 6 m).
        shared: Derivative of the prediction by what calibration estimates, (n, 6 m, g).
        flange: By the flange's right tangent, (n, 6 m, 6).
        places: By each camera's right tangent, (m, n, 6 m, 6).
    """

    residual: Floats
    shared: Floats
    flange: Floats
    places: Floats

    def columns(self, cause: Cause) -> Floats:
        """Derivative by a cause's numbers, (n, 6 m, p)."""
        rows = self.flange @ cause.flange
        if cause.places is not None:
            rows = rows + self.places[cause.camera] @ cause.places
        return np.asarray(rows)


class Loop:
    """All that was observed of a cell's loops."""

    def __init__(self, session: Session, usable: Bools | None = None) -> None:
        """Take a session.

        Args:
            session: All its stations are used, those held out of calibration too.
            usable: Which views to use, shape (m, n); None for all.
        """
        self.session = session
        seen = np.isfinite(session.pixels).all(axis=-1)
        if usable is not None:
            seen &= usable[..., None]
        self.seen: Bools = np.asarray(seen)
        self.free = [
            [k for k, name in enumerate(INTRINSIC_NAMES) if info.skew or name != "skew"]
            for info in session.cameras
        ]
        self.root = _root(session)
        self.mounts = session.mounts

    def start(self, calibration: HandEyeCalibration) -> Fit:
        """The cell as it was calibrated."""
        n = len(self.session.stations)
        places = np.array([place.matrix for place in calibration.base_from_camera])
        return Fit(
            calibration.cameras,
            np.repeat(places[:, None], n, axis=1),
            self.session.base_from_flange,
            np.array([mount.markers for mount in calibration.mounts]),
        )

    def local(self, fit: Fit) -> Floats:
        """Markers in each camera's frame, (m, n, 3, 3), metres."""
        markers = fit.markers[self.mounts]
        base = markers @ fit.poses[:, :3, :3].mT + fit.poses[:, None, :3, 3]
        inverse = se3_inverse(fit.places)
        return np.asarray(base @ inverse[..., :3, :3].mT + inverse[..., None, :3, 3])

    def in_front(self, fit: Fit) -> Bools:
        """Views whose markers are all before the camera, (m, n)."""
        depth = self.local(fit)[..., 2]
        return np.asarray((depth > self.session.marker_radii.max()).all(axis=-1))

    def predicted(self, fit: Fit) -> Floats:
        """Centres of the markers' outlines, (m, n, 3, 2), px; NaN behind a camera."""
        local = self.local(fit)
        return np.stack(
            [
                camera.project(local[i])
                + sphere_shift(camera, local[i], self.session.marker_radii)
                for i, camera in enumerate(fit.cameras)
            ]
        )

    def predicted_with_mounts(self, fit: Fit) -> Floats:
        """The same were each mount the only one, (k, m, n, 3, 2), px."""
        k = len(fit.markers)
        return np.array(
            [
                self.predicted(replace(fit, markers=np.repeat(one[None], k, axis=0)))
                for one in fit.markers
            ]
        )

    def fitted(
        self, start: Fit, cause: Cause | None = None, *, robust: bool = False
    ) -> Fit:
        """Least squares over what calibration estimates, and over a cause's numbers.

        Args:
            start: Where to begin; motions that it already holds stay as they are.
            cause: What else may move; None for nothing.
            robust: Give stations that fit badly less weight, to start from.
        """
        p = 0 if cause is None else cause.flange.shape[2]
        values = np.zeros(p)
        fit = replace(start, values=values)
        best: Fit | None = None
        for _ in range(_ITERATIONS):
            equations = self._equations(fit)
            if equations is None:
                break
            by_station = (equations.residual**2).sum(axis=1)
            chi2 = float(by_station.sum())
            solved = self._solve(equations, cause, by_station, robust=robust)
            step, covariance, rank = solved
            g = equations.shared.shape[2]
            nine = slice(g - fit.markers.size, g)
            found = replace(
                fit,
                chi2=chi2,
                dof=2 * int(self.seen.sum()) - (rank if p else 0) - g,
                by_station=by_station,
                values=values,
                covariance=covariance[g:, g:],
                markers_covariance=covariance[nine, nine],
                rank=rank if p else 0,
            )
            settled = best is not None and best.chi2 - chi2 < _SETTLED
            if best is None or chi2 < best.chi2 or robust:
                best = found
            if settled and not robust:
                break
            values = values + step[g:]
            fit = self._moved(fit, start, step[:g], cause, values)
        assert best is not None
        return best

    def drops(self, fit: Fit, causes: list[Cause]) -> list[tuple[float, int]]:
        """By how much each cause would lower chi2, to first order, and its rank."""
        equations = self._equations(fit)
        assert equations is not None
        size = equations.residual.size
        shared = equations.shared.reshape(size, -1)
        scale = np.maximum(np.linalg.norm(shared, axis=0), 1e-300)
        basis, _ = np.linalg.qr(shared / scale)
        residual = equations.residual.ravel()
        residual = residual - basis @ (basis.T @ residual)
        found = []
        for cause in causes:
            columns = equations.columns(cause).reshape(size, -1)
            columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
            columns = columns - basis @ (basis.T @ columns)
            own, values, _ = np.linalg.svd(columns, full_matrices=False)
            own = own[:, values > np.sqrt(_RANK)]
            found.append((float(((own.T @ residual) ** 2).sum()), own.shape[1]))
        return found

    def _solve(
        self,
        equations: _Equations,
        cause: Cause | None,
        by_station: Floats,
        *,
        robust: bool,
    ) -> tuple[Floats, Floats, int]:
        """Step of shared numbers and phi, their covariance, the rank of phi."""
        n, size, g = equations.shared.shape
        rows = equations.shared
        if cause is not None:
            rows = np.concatenate([rows, equations.columns(cause)], axis=2)
        residual = equations.residual
        if robust:
            count = np.maximum(2 * self.seen.sum(axis=(0, 2)), 1)
            weight = 1.0 / np.sqrt(1.0 + by_station / (_ROBUST * count))
            rows, residual = rows * weight[:, None, None], residual * weight[:, None]
        matrix = rows.reshape(n * size, -1)
        scale = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
        left, values, right = np.linalg.svd(matrix / scale, full_matrices=False)
        kept = values > _RANK * values[0]
        inverse = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
        step = (right.T * inverse) @ (left.T @ residual.ravel()) / scale
        covariance = (right.T * inverse**2) @ right / np.outer(scale, scale)
        return step, covariance, int(kept.sum()) - g

    def _moved(
        self, fit: Fit, start: Fit, step: Floats, cause: Cause | None, values: Floats
    ) -> Fit:
        cameras, places = [], fit.places.copy()
        at = 0
        for i, camera in enumerate(fit.cameras):
            inner, lens = self._columns(i)
            vector = camera.intrinsics.vector
            vector[inner] += step[at : at + len(inner)]
            at += len(inner)
            coefficients = camera.lens.coefficients.copy()
            coefficients[lens] += step[at : at + len(lens)]
            at += len(lens)
            cameras.append(
                PinholeCamera(
                    camera.name,
                    Intrinsics.from_vector(vector),
                    camera.image_size,
                    Lens(camera.lens.model, coefficients),
                )
            )
            places[i] = places[i] @ se3_exp(step[at : at + 6])
            at += 6
        poses = fit.poses
        if cause is not None:
            poses = start.poses @ se3_exp(cause.flange @ values)
            if cause.places is not None:
                i = cause.camera
                before = se3_exp(cause.places @ fit.values)
                after = se3_exp(cause.places @ values)
                places[i] = places[i] @ se3_inverse(before) @ after
        return replace(
            fit,
            cameras=tuple(cameras),
            places=places,
            poses=poses,
            markers=fit.markers + step[at:].reshape(fit.markers.shape),
            values=values,
        )

    def _columns(self, i: int) -> tuple[list[int], list[int]]:
        info = self.session.cameras[i]
        names = Lens(info.lens_model, np.zeros(5 if info.lens_model == "radtan" else 8))
        return self.free[i], [names.names.index(name) for name in info.lens]

    def _equations(self, fit: Fit) -> _Equations | None:
        """Whitened rows; None where a seen marker is behind a camera."""
        session = self.session
        m, n = session.pixels.shape[:2]
        local = self.local(fit)
        if not (local[self.seen][:, 2] > session.marker_radii.max()).all():
            return None
        safe = np.where(self.seen[..., None], local, [0.0, 0.0, 1.0])
        widths = [sum(map(len, self._columns(i))) + 6 for i in range(m)]
        first_marker = sum(widths)
        g = first_marker + fit.markers.size
        residual = np.zeros((n, m, 3, 2))
        shared = np.zeros((n, m, 3, 2, g))
        flange = np.zeros((n, m, 3, 2, 6))
        places = np.zeros((m, n, m, 3, 2, 6))
        at = 0
        for i, camera in enumerate(fit.cameras):
            inner, lens = self._columns(i)
            shown = self.seen[i][..., None]
            pixels, by_point, by_inner, by_lens = camera.project_jacobians(safe[i])
            shift = sphere_shift(camera, safe[i], session.marker_radii)
            missed = session.pixels[i] - pixels - shift
            residual[:, i] = np.where(shown, missed, 0.0)
            by_point = by_point * shown[..., None]
            rotation = fit.places[i, :, :3, :3].mT
            by_base = by_point @ rotation[:, None]
            by_place = np.concatenate([-by_point, by_point @ hat(safe[i])], axis=-1)
            by_marker = by_base @ fit.poses[:, None, :3, :3]
            turning = -by_marker @ hat(fit.markers[self.mounts])
            flange[:, i] = np.concatenate([by_marker, turning], axis=-1)
            places[i, :, i] = by_place
            stop = at + len(inner)
            shared[:, i, ..., at:stop] = by_inner[..., inner] * shown[..., None]
            shared[:, i, ..., stop : stop + len(lens)] = (
                by_lens[..., lens] * shown[..., None]
            )
            at += widths[i]
            shared[:, i, ..., at - 6 : at] = by_place
            for mount in range(len(fit.markers)):
                held = self.mounts == mount
                for k in range(3):
                    start = first_marker + 9 * mount + 3 * k
                    shared[held, i, k, :, start : start + 3] = by_marker[held, k]
        size = 6 * m
        by_flange = flange.reshape(n, size, 6)
        whitener = self._whitener(by_flange)
        return _Equations(
            (whitener @ residual.reshape(n, size, 1))[..., 0],
            whitener @ shared.reshape(n, size, g),
            whitener @ by_flange,
            whitener @ places.reshape(m, n, size, 6),
        )

    def _whitener(self, flange: Floats) -> Floats:
        """Inverse Cholesky factors of the stations' covariances, (n, 6 m, 6 m)."""
        m, n = self.session.pixels.shape[:2]
        size = 6 * m
        noise = np.where(
            self.seen[..., None, None], self.session.pixel_covariance, np.eye(2)
        )
        own = np.moveaxis(noise, 0, 1).reshape(n, 3 * m, 2, 2)
        total = np.zeros((n, 3 * m, 2, 3 * m, 2))
        index = np.arange(3 * m)
        total[:, index, :, index] = np.moveaxis(own, 1, 0)
        moved = flange @ self.root
        whole = total.reshape(n, size, size) + moved @ moved.mT
        return np.asarray(np.linalg.inv(np.linalg.cholesky(whole)))


def _root(session: Session) -> Floats:
    robot = session.repeatability
    return np.diag(np.repeat([robot.translation, robot.rotation], 3))
