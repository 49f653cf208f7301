"""Maximum-likelihood adjustment of m cameras that see one known triangle.

Unknown are the intrinsics and lenses of all cameras, where the cameras stand to each
other, and the triangle's pose at every station; known are the triangle's sides and the
covariance of every detected point. Zhao, Liu and Zhang 2008
(doi:10.1109/TIP.2008.2005562), Appendix A, step (e), extended by half-turns that tie
two stations together as far as the robot repeats them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handeye_tri.calibrate_cameras.bundle_input import (
    check_links,
    observations,
    pairs,
    start_poses,
    unknowns,
)
from handeye_tri.calibrate_cameras.bundle_model import (
    BundleModel,
    Linearisation,
    State,
    Turns,
)
from handeye_tri.calibrate_cameras.bundle_result import bundle_result
from handeye_tri.calibrate_cameras.least_squares import Minimum, minimise
from handeye_tri.camera import PinholeCamera
from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.records import CameraCalibration, HalfTurn
from handeye_tri.se3 import SE3
from handeye_tri.triangle import EDGES, Axis, TriangleRig

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class TurnNoise:
    """How far half-turns may be trusted.

    Attributes:
        covariance: Of the tangent xi (translation m, rotation rad) by which a half-turn
            misses, ``after = before @ half_turn @ exp(xi)`` in the triangle's
            frame, shape (6, 6); zero for a perfect robot. The line itself, where the
            half-turns' axis truly runs in the triangle's frame, is estimated. None
            leaves the two poses independent of each other.
        on_axis_correlation: Correlation of a marker's detection errors before and
            after, for the two markers on an edge axis. They are seen twice at the same
            place, and what a detector gets wrong there, it gets wrong twice.
    """

    covariance: Floats | None = None
    on_axis_correlation: float = 0.0

    def __post_init__(self) -> None:
        """Raise InputError where this is no covariance or no correlation."""
        if not 0 <= self.on_axis_correlation < 1:
            raise InputError(
                "on_axis_correlation must be at least 0 and below 1, "
                f"got {self.on_axis_correlation}"
            )
        if self.covariance is None:
            return
        matrix = np.asarray(self.covariance, dtype=float)
        if matrix.shape != (6, 6) or not np.isfinite(matrix).all():
            raise InputError(
                f"a turn's covariance must be finite, shape (6, 6), got {matrix.shape}"
            )
        # Metres and radians differ in size: judge each entry against its own scale.
        root = np.sqrt(np.abs(np.diagonal(matrix)))
        scaled = matrix / np.outer(*[np.where(root > 0, root, 1.0)] * 2)
        if (
            np.abs(scaled - scaled.T).max() > 1e-9
            or np.linalg.eigvalsh(scaled)[0] < -1e-9
        ):
            raise InputError(
                "a turn's covariance must be symmetric and positive semi-definite"
            )

    @property
    def root(self) -> Floats | None:
        """A square root of the covariance, shape (6, 6)."""
        if self.covariance is None:
            return None
        values, vectors = np.linalg.eigh(self.covariance)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def bundle_cameras(
    cameras: Sequence[PinholeCamera],
    reference_from_camera: Sequence[SE3],
    reference_from_triangle: ArrayLike,
    pixels: ArrayLike,
    covariance: ArrayLike,
    triangle: TriangleRig,
    *,
    skew: bool | Sequence[bool] = True,
    lenses: Sequence[Sequence[str]] | None = None,
    half_turns: Sequence[HalfTurn] = (),
    turn_noise: TurnNoise | None = None,
    mounts: Indices | None = None,
    huber: float | None = None,
) -> CameraCalibration:
    """Adjust all cameras, their places and the triangle's poses together.

    The first camera is the reference. The cost is that of the likelihood: pixel
    residuals whitened by each point's covariance, and the deviations of the
    half-turns whitened by theirs. Stations are eliminated from the normal equations, a
    half-turn's two together, so that the cost grows in proportion to the stations.

    Args:
        cameras: Where to start: m cameras, 1 or more.
        reference_from_camera: Where they stand at the start; the first is moved to the
            identity and everything else with it.
        reference_from_triangle: Start of the triangle's poses, (n, 4, 4), metres; not
            read at stations that cannot be used.
        pixels: Shape (m, n, 3, 2); NaN where a camera does not see a marker. Stations
            at which not every marker is seen by some camera are not used.
        covariance: Shape (m, n, 3, 2, 2), px^2; not read where unseen.
        triangle: The rig, whose sides are taken for exact.
        skew: Whether skew is estimated, for all cameras or one by one; elsewhere it
            keeps its start.
        lenses: Names of the lens coefficients to estimate, one sequence per camera;
            others keep their start. None estimates none.
        half_turns: Which stations are half-turns of each other. A station takes part
            in one at most. Only used with ``turn_noise``.
        turn_noise: How far they may be trusted. None leaves stations independent, which
            one camera cannot do with.
        mounts: Which mount holds the triangle at each station, shape (n,), from 0;
            each has axes of its own. None for one mount.
        huber: Distance in sigmas beyond which a point counts linearly; None for none.

    Returns:
        The cameras. ``residuals`` has one view per station. ``covariance`` has the
        estimated quantities only. ``details`` has:

        - "reference_from_triangle": (n, 4, 4), and "station_covariance" of its tangents
          (n, 6, 6), NaN where not used;
        - "used": indices of the stations used; "iterations";
        - "deviance": -2 log of the restricted likelihood up to a constant, by which
          values of ``on_axis_correlation`` compare on the same data (Patterson and
          Thompson 1971, doi:10.1093/biomet/58.3.545);
        - with a covariance in turn_noise, "turn_sigmas": (len(half_turns), 6), the
          deviation of each half-turn over its prior's root, NaN where not used; "axes":
          names of the axes, and "axis_mounts" the mount of each; "triangle_from_axis":
          (a, 4, 4), they run along its z.

    Raises:
        InputError: an argument cannot be used; names it.
        DegenerateMotionError: the stations do not determine the cameras.
        ConvergenceError: the iteration did not settle.
    """
    m = len(cameras)
    observed, weights = observations(m, pixels, covariance)
    inner, outer = unknowns(cameras, skew, lenses)
    if len(reference_from_camera) != m:
        raise InputError(
            f"reference_from_camera must have one motion for each of the {m} cameras, "
            f"got {len(reference_from_camera)}"
        )
    names = [camera.name for camera in cameras]
    if len(set(names)) < m:
        raise InputError(f"camera names must differ, got {names}")
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(observed).all(axis=-1))
    used = np.flatnonzero(seen.any(axis=0).all(axis=-1))
    check_links(names, seen[:, used])
    poses = start_poses(reference_from_triangle, observed.shape[1], used)
    if turn_noise is None:
        blocks, members = used[:, None], np.empty(0, dtype=np.intp)
    else:
        blocks, members = pairs(half_turns, used, observed.shape[1])
    if mounts is None:
        mounts = np.zeros(observed.shape[1], dtype=np.intp)
    of_members = [
        (half_turns[i].axis, int(mounts[half_turns[i].before]))
        for i in members.tolist()
    ]
    kinds: tuple[tuple[Axis, int], ...] = tuple(dict.fromkeys(of_members))
    present = blocks >= 0
    turns = None
    if turn_noise is not None:
        turns = _turns(of_members, len(blocks), kinds, turn_noise)
    model = BundleModel(
        triangle.points,
        np.where(seen[:, blocks, :, None], observed[:, blocks], 0.0),
        weights[:, blocks] * present[..., None, None, None],
        inner,
        outer,
        turns,
        np.inf if huber is None else huber,
    )
    origin = reference_from_camera[0].inverse().matrix
    start = State(
        np.array([camera.intrinsics.vector for camera in cameras]),
        tuple(camera.lens.coefficients for camera in cameras),
        origin @ np.array([motion.matrix for motion in reference_from_camera]),
        origin @ poses[blocks[:, 0]],
        np.zeros((len(blocks), 0 if turns is None else 6)),
        np.array([_nominal_axis(triangle, axis) for axis, _ in kinds]).reshape(
            -1, 4, 4
        ),
    )
    start.reference_from_camera[0] = np.eye(4)
    end = _minimum(model, start, names)
    return bundle_result(
        model, end, cameras, blocks, members, len(half_turns), kinds, seen.shape[1]
    )


def _turns(
    members: Sequence[tuple[Axis, int]],
    blocks: int,
    kinds: tuple[tuple[Axis, int], ...],
    noise: TurnNoise,
) -> Turns:
    if not members:
        raise InputError(
            "turn_noise needs half_turns of which both stations are seen; there are "
            "none: give them, or leave turn_noise out"
        )
    paired = np.arange(blocks) < len(members)
    kind = np.zeros(blocks, dtype=np.intp)
    correlation = np.zeros((blocks, 3))
    for block, member in enumerate(members):
        kind[block] = kinds.index(member)
        axis, _ = member
        if axis != "normal":
            correlation[block, list(EDGES[axis])] = noise.on_axis_correlation
    return Turns(paired, kind, noise.root, correlation)


def _nominal_axis(triangle: TriangleRig, axis: Axis) -> Floats:
    """A frame (4, 4) whose z axis is the axis as built: normals at the circumcentre."""
    frame = np.eye(4)
    if axis == "normal":
        frame[:2, 3] = triangle.circumcentre
        return frame
    start, end = triangle.points[list(EDGES[axis])]
    along = (end - start) / np.linalg.norm(end - start)
    normal = np.array([0.0, 0.0, 1.0])
    frame[:3, :3] = np.stack([np.cross(normal, along), normal, along], axis=1)
    frame[:3, 3] = start
    return frame


def _minimum(
    model: BundleModel, start: State, names: Sequence[str]
) -> Minimum[State, Linearisation]:
    first = model.evaluate(start)
    if first is None:
        raise InputError(
            "reference_from_triangle or reference_from_camera puts a seen marker "
            "behind its camera; start from better poses"
        )
    freedom = first.observations - first.unknowns
    if freedom < 1:
        raise DegenerateMotionError(
            f"{first.observations} observations are too few for {first.unknowns} "
            f"unknowns of {len(names)} camera(s) and "
            f"{int(model.seen.any(axis=(0, 3)).sum())} poses; add stations, cameras or "
            "half-turns with turn_noise, or estimate fewer lens coefficients"
        )
    largest = float(np.abs(model.pixels).max())
    rounding = float(np.finfo(float).eps * largest * np.abs(model.whitener).max())
    if model.turns is not None:
        # Whitening the difference of two correlated errors magnifies it.
        rounding /= float(np.sqrt(1.0 - model.turns.correlation.max(initial=0.0)))
    end = minimise(model.evaluate, model.retract, start, rounding)
    assert end is not None
    return end
