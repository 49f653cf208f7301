"""Rigid motions, safe at rotation 0 and at rotation pi.

The batched functions on arrays serve the estimators; :class:`SE3` is the one
motion that records carry. Tangent vectors are (translation, rotation), in
metres and radians.
"""

from handeye_tri.se3.motions import (
    SE3,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_left_jacobian,
    se3_left_jacobian_inverse,
    se3_log,
)
from handeye_tri.se3.rotations import (
    hat,
    nearest_rotation,
    quaternion_wxyz,
    rotation_from_quaternion_wxyz,
    so3_exp,
    so3_left_jacobian,
    so3_left_jacobian_inverse,
    so3_log,
)

__all__ = [
    "SE3",
    "hat",
    "nearest_rotation",
    "quaternion_wxyz",
    "rotation_from_quaternion_wxyz",
    "se3_adjoint",
    "se3_exp",
    "se3_inverse",
    "se3_left_jacobian",
    "se3_left_jacobian_inverse",
    "se3_log",
    "so3_exp",
    "so3_left_jacobian",
    "so3_left_jacobian_inverse",
    "so3_log",
]
