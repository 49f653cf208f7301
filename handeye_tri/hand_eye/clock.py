"""Two clocks: where the robot was when the camera looked.

The angular speed of a rigid body is the same in every frame, so both streams tell the
same speed as a function of time, shifted by the clocks' offset (Furrer et al. 2017,
doi:10.1007/978-3-319-67361-5_33). The correlation's maximum starts a refinement
together with the motions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import DegenerateMotionError
from handeye_tri.se3 import se3_inverse, so3_exp, so3_log

Floats = NDArray[np.float64]

# Angular speeds are taken over about this time: shorter ones amplify pose noise.
_WINDOW = 0.1
_STEP = 2e-3
_LONGEST_GRID = 2**18
# Share of the shorter stream that must overlap.
_OVERLAP = 0.5
_LEAST_CORRELATION = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class RobotTrack:
    """Robot poses between which one interpolates.

    Attributes:
        times: Shape (n,), seconds, increasing.
        poses: base_from_flange, shape (n, 4, 4).
    """

    times: Floats
    poses: Floats

    def covers(self, times: Floats) -> NDArray[np.bool_]:
        """Whether instants lie within the track, shape (m,)."""
        return np.asarray((times >= self.times[0]) & (times <= self.times[-1]))

    def at(self, times: Floats) -> tuple[Floats, Floats]:
        """Poses and velocities at instants, by constant velocity between samples.

        Args:
            times: Shape (m,), seconds; beyond the ends the last velocity goes on.

        Returns:
            Shape (m, 4, 4); right tangents per second, shape (m, 6).
        """
        after = np.clip(np.searchsorted(self.times, times), 1, len(self.times) - 1)
        first, last = self.poses[after - 1], self.poses[after]
        span = self.times[after] - self.times[after - 1]
        share = (times - self.times[after - 1]) / span
        turn = so3_log(np.swapaxes(first[:, :3, :3], 1, 2) @ last[:, :3, :3])
        shift = last[:, :3, 3] - first[:, :3, 3]
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, :3] = first[:, :3, :3] @ so3_exp(share[:, None] * turn)
        poses[:, :3, 3] = first[:, :3, 3] + share[:, None] * shift
        velocity = np.einsum("nba,nb->na", poses[:, :3, :3], shift)
        return poses, np.concatenate([velocity, turn], axis=1) / span[:, None]


def correlate_clocks(
    robot_times: Floats, robot: Floats, camera_times: Floats, camera: Floats
) -> tuple[float, float]:
    """Offset of the camera's clock against the robot's, by angular speeds.

    Args:
        robot_times: Shape (n,), seconds.
        robot: Poses, shape (n, 4, 4), in any frames.
        camera_times: Shape (m,), seconds.
        camera: Poses, shape (m, 4, 4).

    Returns:
        The offset in seconds (a picture stamped t was taken at robot time
        t - offset), and the correlation of the angular speeds there, at most 1.

    Raises:
        DegenerateMotionError: the speeds do not tell, as when nothing turns.
    """
    streams = [
        _angular_speed(robot_times, robot),
        _angular_speed(camera_times, camera),
    ]
    spans = [times[-1] - times[0] for times, _ in streams]
    step = max(_STEP, sum(spans) / _LONGEST_GRID)
    sampled = []
    for times, speeds in streams:
        grid = np.arange(times[0], times[-1], step)
        sampled.append(np.interp(grid, times, speeds))
    size = 2 ** int(np.ceil(np.log2(sum(len(s) for s in sampled))))
    # Every lag's overlap has its own mean and size: five correlations by FFT.
    transforms = [
        [np.fft.rfft(part, size) for part in (np.ones_like(s), s, s * s)]
        for s in sampled
    ]

    def sums(of_robot: int, of_camera: int) -> Floats:
        product = np.conj(transforms[0][of_robot]) * transforms[1][of_camera]
        return np.asarray(np.fft.irfft(product, size))

    count = np.round(sums(0, 0))
    least = _OVERLAP * min(len(s) for s in sampled)
    safe = np.maximum(count, 1)
    robot_sum, camera_sum = sums(1, 0), sums(0, 1)
    covariance = sums(1, 1) - robot_sum * camera_sum / safe
    robot_square = sums(2, 0) - robot_sum**2 / safe
    camera_square = sums(0, 2) - camera_sum**2 / safe
    scale = np.sqrt(np.maximum(robot_square * camera_square, 0.0))
    # A speed that hardly varies carries no time.
    floor = 1e-6 * scale.max()
    correlation = np.where(
        (count >= least) & (scale > floor), covariance / np.maximum(scale, 1e-300), -1.0
    )
    best = int(np.argmax(correlation))
    peak = float(correlation[best])
    if peak < _LEAST_CORRELATION:
        raise DegenerateMotionError(
            "the two streams' angular speeds do not tell the clocks' offset (best "
            f"correlation {peak:.2f}, needed {_LEAST_CORRELATION}); record a motion "
            "that turns faster and slower, in both streams at the same time"
        )
    lag = best if best < size // 2 else best - size
    before, after = correlation[best - 1], correlation[(best + 1) % size]
    curve = before - 2 * peak + after
    fine = 0.5 * (before - after) / curve if curve < 0 else 0.0
    # Sample j of the robot's grid meets sample j + lag of the camera's.
    shift = streams[1][0][0] - streams[0][0][0]
    return float(shift + (lag + fine) * step), peak


def _angular_speed(times: Floats, poses: Floats) -> tuple[Floats, Floats]:
    """Instants and angular speeds, rad/s, over windows of about 0.1 s."""
    later = np.minimum(np.searchsorted(times, times + _WINDOW), len(times) - 1)
    first = np.flatnonzero(later > np.arange(len(times)))
    later = later[first]
    turned = so3_log((se3_inverse(poses[first]) @ poses[later])[:, :3, :3])
    speed = np.linalg.norm(turned, axis=1) / (times[later] - times[first])
    return 0.5 * (times[first] + times[later]), speed
