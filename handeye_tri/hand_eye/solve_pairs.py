"""Hand-eye and robot-world calibration of bare pose pairs, as a whole."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from handeye_tri import arguments
from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.hand_eye.absolute import AbsoluteMethod, solve_axzb
from handeye_tri.hand_eye.clock import RobotTrack, correlate_clocks
from handeye_tri.hand_eye.consensus import find_start
from handeye_tri.hand_eye.motions import check_motions, relative_motions
from handeye_tri.hand_eye.pose_fit import fit_poses, squared_distances
from handeye_tri.hand_eye.pose_model import PoseFit, PoseInput
from handeye_tri.hand_eye.pose_solution import PoseSolution, Undetermined
from handeye_tri.hand_eye.relative import RelativeMethod, solve_axxb
from handeye_tri.hand_eye.twin import require_no_twin
from handeye_tri.records import Covariance, PosePairs, motion_labels
from handeye_tri.se3 import SE3, se3_inverse, se3_log, so3_log

Floats = NDArray[np.float64]
Rows = NDArray[np.bool_]

PairMethod = Literal["likelihood", AbsoluteMethod, RelativeMethod]
PAIR_METHODS: tuple[PairMethod, ...] = (
    "likelihood",
    *get_args(AbsoluteMethod),
    *get_args(RelativeMethod),
)

# A pose is dropped where noise alone would be that far out in 1 of 100 data sets.
_FALSE_ALARMS = 0.01
_DROP_ROUNDS = 6
# An open direction, as a unit vector in metres, with at least this much of a turn (or
# shift) in it is named after it.
_NAMED = 0.2
# Leave-one-out standard deviations: in at most this many groups.
_GROUPS = 50
# All pairs of so many poses are used by the relative methods, beyond it successive.
_ALL_PAIRS = 150


def solve_pose_pairs(
    pairs: PosePairs,
    *,
    method: PairMethod = "likelihood",
    shift_along_axis: float | None = None,
    seed: int = 0,
) -> PoseSolution:
    """Where a camera or target sits on a flange, and the other one in the base.

    "likelihood" finds what most poses agree on, drops those that noise cannot explain,
    and fits the rest by maximum likelihood, with the noise estimated unless it is
    stated. Poses that leave a direction open (parallel axes, as of 4-axis robots) give
    a solution all the same, with that direction named. The closed forms use all poses
    as they are; their standard deviations come from leaving poses out (jackknife).

    Args:
        pairs: The poses. Streams with clocks are paired by interpolation, the
            clocks' offset found first; other pairs belong together one by one.
        method: "likelihood" or one of the closed forms of ``solve_axzb`` and
            ``solve_axxb``.
        shift_along_axis: Where the poses leave the shift along one axis open: the
            origin of X along that axis in the flange frame, metres, measured
            otherwise.
        seed: Of the random samples; the same seed gives the same result.

    Raises:
        InputError: unusable poses, fewer than three, an unknown method, or a
            ``shift_along_axis`` where none is open.
        DegenerateMotionError: nothing moves; the clocks cannot be compared; two
            solutions fit few half-turns alike; a closed form needs more than the
            poses have.
        ConvergenceError: an iteration did not settle.
    """
    arguments.record("pairs", pairs, PosePairs)
    arguments.check_one_of("method", method, PAIR_METHODS)
    arguments.seed("seed", seed)
    if shift_along_axis is not None:
        arguments.number("shift_along_axis", shift_along_axis)
    data, rows, offset, correlation = read_pairs(pairs)
    poses = tuple(name for name, row in zip(pairs.names, rows, strict=True) if row)
    if method != "likelihood":
        if pairs.timed or not pairs.metric or shift_along_axis is not None:
            raise InputError(
                f'method "{method}" takes pairs in metres without clocks and without '
                'a stated shift; use method="likelihood"'
            )
        return _closed_form(pairs, data, poses, method)
    data, x, z, scale, used = _start(data, offset, seed)
    fit, used = _fit_and_drop(data, x, z, scale, offset, used, pairs)
    a, _ = data.robot(fit.offset)
    if not data.few_axes:
        require_no_twin(data, fit, used)
    undetermined = _name_directions(fit, a, pairs)
    if shift_along_axis is not None:
        shift = _only_shift(undetermined, shift_along_axis)
        # Over a long way the axis' own error counts: fit the rest again there.
        data = replace(data, few_axes=True)
        fit, used = _fit_and_drop(
            data,
            *_placed(fit, shift, shift_along_axis),
            fit.scale,
            fit.offset,
            used,
            pairs,
        )
        undetermined = tuple(one for one in undetermined if one is not shift)
        x, z = _placed(fit, shift, shift_along_axis)
        fit = replace(fit, x=x, z=z)
    camera = np.array(data.camera_from_target)
    camera[:, :3, 3] *= fit.scale
    b = se3_inverse(camera) if data.eye_in_hand else camera
    x_motion, z_motion = SE3(fit.x), SE3(fit.z)
    return PoseSolution(
        names=pairs.unknowns,
        x=x_motion,
        z=z_motion,
        scale=fit.scale,
        clock_offset=fit.offset if pairs.timed else None,
        clock_correlation=correlation,
        covariance=Covariance(_labels(pairs), fit.covariance),
        residuals=se3_log(se3_inverse(a @ x_motion.matrix) @ (z_motion.matrix @ b)),
        poses=poses,
        used=used,
        base_from_flange=a,
        b=b,
        noise=fit.noise,
        noise_is_stated=pairs.noise is not None,
        tail=fit.tail,
        correlation=fit.correlation,
        chi2=fit.chi2,
        dof=fit.dof,
        undetermined=undetermined,
        certainty=fit.certainty,
        method="consensus, then maximum likelihood"
        + (" with stated noise" if pairs.noise else ", noise from the residuals"),
    )


def read_pairs(pairs: PosePairs) -> tuple[PoseInput, Rows, float, float | None]:
    """Check poses and bring both streams to one clock.

    Returns:
        The input of the fit; which observed poses it holds (those taken while the
        robot's stream ran), shape (m,); the clocks' offset, 0 without clocks; and the
        correlation it rests on.

    Raises:
        InputError: a pose is none, or fewer than three are left.
        DegenerateMotionError: the angular speeds do not tell the clocks' offset.
    """
    check_motions("robot", pairs.robot, 3)
    check_motions("observed", pairs.observed, 3)
    a, camera = pairs.base_from_flange, pairs.camera_from_target
    eye_in_hand = pairs.mounting == "eye_in_hand"
    if pairs.robot_times is None or pairs.observed_times is None:
        data = PoseInput(a, camera, eye_in_hand, not pairs.metric)
        return data, np.ones(len(camera), bool), 0.0, None
    offset, correlation = correlate_clocks(
        pairs.robot_times, a, pairs.observed_times, camera
    )
    track = RobotTrack(pairs.robot_times, a)
    rows = track.covers(pairs.observed_times - offset)
    if rows.sum() < 3:
        raise InputError(
            f"only {rows.sum()} of {len(rows)} observed poses fall within the robot's "
            f"stream once the clocks' offset of {offset:.3f} s is taken off; at least "
            "3 are needed: record both streams at the same time"
        )
    data = PoseInput(
        a,
        camera[rows],
        eye_in_hand,
        not pairs.metric,
        track=track,
        times=pairs.observed_times[rows],
    )
    return data, rows, offset, correlation


def _start(
    data: PoseInput, offset: float, seed: int
) -> tuple[PoseInput, Floats, Floats, float, Rows]:
    """The input, X, Z and scale that most poses agree on, and which poses do."""
    a, _ = data.robot(offset)
    b = data.b
    for name, poses in (("robot", a), ("observed", b)):
        if _are_the_same(poses):
            raise DegenerateMotionError(
                f"all {len(a)} {name} poses are the same (within 1 um and 1 urad): "
                "nothing is determined; record poses that turn by 20 degrees or more "
                "about two different axes"
            )
    found = find_start(a, b, free_scale=data.free_scale, seed=seed)
    data = replace(data, few_axes=found.few_axes)
    return data, found.x, found.z, found.scale, found.agreeing


def _are_the_same(poses: Floats) -> bool:
    """Within 1 um and 1 urad."""
    apart = np.abs(poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)).max()
    turned = so3_log(poses[:, :3, :3] @ poses[0, :3, :3].T)
    return bool(apart < 1e-6 and np.linalg.norm(turned, axis=1).max() < 1e-6)


def _fit_and_drop(
    data: PoseInput,
    x: Floats,
    z: Floats,
    scale: float,
    offset: float,
    used: Rows,
    pairs: PosePairs,
) -> tuple[PoseFit, Rows]:
    """Fit the poses that noise explains; those left out are asked again each time."""
    seen: set[bytes] = set()
    fit = fit_poses(
        data.take(used), x, z, scale=scale, offset=offset, noise=pairs.noise
    )
    for _ in range(_DROP_ROUNDS):
        seen.add(used.tobytes())
        distances = squared_distances(data, fit)
        within = distances < _limit(fit.tail, len(used))
        if within.tobytes() in seen or within.sum() < 3:
            break
        used = within
        fit = fit_poses(
            data.take(used),
            fit.x,
            fit.z,
            scale=fit.scale,
            offset=fit.offset,
            noise=pairs.noise,
        )
    return fit, used


def _limit(tail: float, n: int) -> float:
    """Squared distance that noise exceeds once in 100 data sets of n poses."""
    from scipy.special import fdtri, gammaincinv

    share = 1 - _FALSE_ALARMS / n
    if np.isinf(tail):
        return float(2 * gammaincinv(3.0, share))
    return float(6 * fdtri(6, tail, share))


def _labels(pairs: PosePairs) -> tuple[str, ...]:
    x, z = pairs.unknowns
    return (
        *motion_labels(x),
        *motion_labels(z),
        *(() if pairs.metric else ("log_scale",)),
        *(("clock_offset",) if pairs.timed else ()),
    )


def _name_directions(
    fit: PoseFit, a: Floats, pairs: PosePairs
) -> tuple[Undetermined, ...]:
    """Shifts and turns in the flange's and base's words from bare directions."""
    left = np.array(fit.undetermined)
    named = []
    labels = _labels(pairs)
    if "log_scale" in labels and len(left):
        column = labels.index("log_scale")
        if np.abs(left[:, column]).max() > 0.5:
            named.append(Undetermined("scale", np.zeros(3), np.zeros(3)))
            left = left[np.abs(left[:, column]) <= 0.5]
    if not len(left):
        return tuple(named)
    # In metres: a turn counts by the distances at which it moves things.
    reach = max(
        np.linalg.norm(motion[..., :3, 3], axis=-1).max()
        for motion in (a, fit.x, fit.z)
    )
    left[:, [0, 1, 2, 6, 7, 8]] *= fit.length
    left[:, [3, 4, 5, 9, 10, 11]] *= reach
    left = np.linalg.qr(left[:, :12].T)[0].T
    for kind, columns in (("turn", slice(3, 6)), ("shift", slice(0, 3))):
        if not len(left):
            break
        u, values, vt = np.linalg.svd(left[:, columns])
        large = int((values > _NAMED).sum())
        for axis in vt[:large]:
            flange = fit.x[:3, :3] @ axis
            flange = flange * np.sign(flange[np.argmax(np.abs(flange))])
            base = (a[:, :3, :3] @ flange).mean(axis=0)
            base = base / max(np.linalg.norm(base), 1e-300)
            named.append(Undetermined(kind, flange, base))
        # What does not turn must shift.
        left = u[:, large:].T @ left
    return tuple(named)


def _only_shift(undetermined: tuple[Undetermined, ...], value: float) -> Undetermined:
    """The one shift that is open."""
    shifts = [one for one in undetermined if one.kind == "shift"]
    if len(shifts) != 1:
        raise InputError(
            f"shift_along_axis is {value} m, but the poses leave {len(shifts)} shifts "
            "open; it is for poses that leave exactly one (all turns about one "
            "direction); leave it out"
        )
    return shifts[0]


def _placed(fit: PoseFit, shift: Undetermined, value: float) -> tuple[Floats, Floats]:
    """X and Z moved along the axis until X's origin is where it was measured."""
    x, z = np.array(fit.x), np.array(fit.z)
    along = value - shift.axis_in_flange @ x[:3, 3]
    x[:3, 3] += along * shift.axis_in_flange
    z[:3, 3] += along * shift.axis_in_base
    return x, z


def _closed_form(
    pairs: PosePairs, data: PoseInput, poses: tuple[str, ...], method: PairMethod
) -> PoseSolution:
    """A closed form on all poses as they are, with its jackknife covariance."""
    a, b = data.a, data.b
    n = len(a)
    x, z = _solve_by(method, a, b)
    # Each group of poses left out once; Efron 1982, doi:10.1137/1.9781611970319.
    groups = np.arange(n) % min(n, _GROUPS)
    moved = []
    for group in range(groups.max() + 1 if n > 4 else 0):
        kept = groups != group
        other_x, other_z = _solve_by(method, a[kept], b[kept])
        moved.append(
            np.append((x.inverse() @ other_x).log(), (z.inverse() @ other_z).log())
        )
    covariance = np.full((12, 12), 0.0)
    if moved:
        centred = np.array(moved) - np.mean(moved, axis=0)
        covariance = (len(moved) - 1) / len(moved) * centred.T @ centred
    return PoseSolution(
        names=pairs.unknowns,
        x=x,
        z=z,
        scale=1.0,
        clock_offset=None,
        clock_correlation=None,
        covariance=Covariance(_labels(pairs), covariance),
        residuals=se3_log(se3_inverse(a @ x.matrix) @ (z.matrix @ b)),
        poses=poses,
        used=np.ones(n, bool),
        base_from_flange=a,
        b=b,
        noise=None,
        noise_is_stated=False,
        tail=None,
        correlation=0.0,
        chi2=None,
        dof=6 * n - 12,
        undetermined=(),
        certainty=np.inf,
        method=f"{method} on all poses",
    )


def _solve_by(method: PairMethod, a: Floats, b: Floats) -> tuple[SE3, SE3]:
    if method in get_args(AbsoluteMethod):
        return solve_axzb(a, b, method=method)  # type: ignore[arg-type]
    which: Literal["all", "successive"] = (
        "all" if len(a) <= _ALL_PAIRS else "successive"
    )
    x = solve_axxb(
        relative_motions(a, pairs=which, side="right"),
        relative_motions(b, pairs=which, side="right"),
        method=method,  # type: ignore[arg-type]
    )
    return x, SE3.mean(SE3(matrix) for matrix in a @ x.matrix @ se3_inverse(b))
