"""Pose pairs of a robot, a camera and a target with known noise."""

import numpy as np

from handeye_tri.records import PoseNoise, PosePairs
from handeye_tri.se3 import (
    rotation_from_quaternion_wxyz,
    se3_exp,
    se3_inverse,
    so3_exp,
)

# Robot mm and mrad; camera lateral, depth and angle.
NOISE = PoseNoise(2e-4, 1e-4, 5e-4, 1.5e-3, 2e-3)


def random_poses(rng, n, spread=0.5):
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = rotation_from_quaternion_wxyz(rng.standard_normal((n, 4)))
    poses[:, :3, 3] = spread * rng.standard_normal((n, 3))
    return poses


def noisy(rng, base_from_flange, camera_from_target, noise, tail=None):
    """Both streams with noise as PoseNoise describes it, Student's on request."""
    n = len(camera_from_target)
    size = np.ones((n, 1))
    if tail is not None:
        size = np.sqrt(tail / rng.chisquare(tail, (n, 1)))
    draws = size * rng.standard_normal((n, 12))
    robot_sigma = np.repeat([noise.robot_translation, noise.robot_rotation], 3)
    robot = base_from_flange @ se3_exp(robot_sigma * draws[:, :6])
    observed = np.array(camera_from_target)
    place = observed[:, :3, 3]
    ray = place / np.linalg.norm(place, axis=1, keepdims=True)
    moved = noise.lateral * draws[:, 6:9]
    along = (moved * ray).sum(axis=1, keepdims=True) * ray
    observed[:, :3, 3] += moved + (noise.depth / max(noise.lateral, 1e-300) - 1) * along
    observed[:, :3, :3] = observed[:, :3, :3] @ so3_exp(noise.rotation * draws[:, 9:])
    return robot, observed


def scene(seed, n=20, mounting="eye_in_hand", noise=NOISE, tail=None, tilt=0.4):
    """Robot poses, observed poses (target in camera), true X and Z, (4, 4) each."""
    rng = np.random.default_rng([seed, n])
    x, z = random_poses(rng, 2, 0.1)
    z[:3, 3] += (0.6, 0.0, 0.3)
    camera_from_target = np.tile(np.eye(4), (n, 1, 1))
    camera_from_target[:, :3, :3] = so3_exp(tilt * rng.standard_normal((n, 3)))
    camera_from_target[:, :3, 3] = (0, 0, 0.8) + 0.12 * rng.standard_normal((n, 3))
    b = (
        se3_inverse(camera_from_target)
        if mounting == "eye_in_hand"
        else camera_from_target
    )
    a = z @ b @ se3_inverse(x)
    robot, observed = noisy(rng, a, camera_from_target, noise, tail)
    return robot, observed, x, z


EXACT = PoseNoise(0.0, 1e-300, 1e-300, 1e-300, 0.0)


def pairs_of(robot, observed, mounting="eye_in_hand", **changes):
    return PosePairs(
        robot,
        observed,
        mounting,
        changes.pop("robot_direction", "flange_in_base"),
        changes.pop("observed_direction", "target_in_camera"),
        **changes,
    )
