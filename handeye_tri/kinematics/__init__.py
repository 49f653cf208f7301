"""Kinematics of serial chains in plain numpy, many configurations at once."""

from handeye_tri.kinematics.chain import SerialChain
from handeye_tri.kinematics.inverse import InverseKinematics, InverseSolutions

__all__ = ["InverseKinematics", "InverseSolutions", "SerialChain"]
