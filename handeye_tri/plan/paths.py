"""Ways from joints to joints that nothing stands in: straight, or round about.

The only module that talks to OMPL (Sucan, Moll and Kavraki 2012,
doi:10.1109/MRA.2012.2205651), which is an extra: without it only straight ways are
found.
"""

from __future__ import annotations

from importlib.util import find_spec
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.arm import Arm

Floats = NDArray[np.float64]

# How often the search tree may grow before a way is given up.
_GROWTHS = 3000
# Joints without limits are searched within a turn, or a metre, of both ends.
_BEYOND = 2 * np.pi


def can_go_round() -> bool:
    """Whether ways round about can be searched for at all."""
    return find_spec("ompl") is not None


def way_round(arm: Arm, start: Floats, end: Floats, seed: int) -> Floats | None:
    """Points to pass on a free way that is not straight.

    RRT-Connect (Kuffner and LaValle 2000, doi:10.1109/ROBOT.2000.844730), then
    shortened. Every straight piece is free as :meth:`Arm.path_collision` judges it.

    Args:
        arm: The robot in its cell.
        start: Shape (q,), rad or m, free.
        end: Shape (q,), rad or m, free.
        seed: Same seed, same way.

    Returns:
        Shape (k, q), without the ends; None where no way was found.
    """
    from ompl import base, geometric, util

    util.noOutputHandler()
    # Zero would mean a seed from the clock.
    util.RNG.setSeed(seed + 1)
    count = len(start)
    space = base.RealVectorStateSpace(count)
    bounds = base.RealVectorBounds(count)
    low = np.where(np.isfinite(arm.lower), arm.lower, np.minimum(start, end) - _BEYOND)
    high = np.where(np.isfinite(arm.upper), arm.upper, np.maximum(start, end) + _BEYOND)
    for k in range(count):
        bounds.setLow(k, float(low[k]))
        bounds.setHigh(k, float(high[k]))
    space.setBounds(bounds)

    def joints(state: Any) -> Floats:
        return np.array([state[k] for k in range(count)])

    class Straight(base.MotionValidator):  # type: ignore[misc]
        def checkMotion(self, first: Any, second: Any, *_: Any) -> bool:  # noqa: N802
            return arm.path_collision(joints(first), joints(second)) is None

    setup = geometric.SimpleSetup(space)
    information = setup.getSpaceInformation()
    setup.setStateValidityChecker(lambda state: arm.collision(joints(state)) is None)
    validator = Straight(information)
    information.setMotionValidator(validator)
    ends = [space.allocState(), space.allocState()]
    for state, values in zip(ends, (start, end), strict=True):
        for k in range(count):
            state[k] = float(values[k])
    setup.setStartAndGoalStates(*ends)
    setup.setPlanner(geometric.RRTConnect(information))
    growths = 0

    def enough() -> bool:
        nonlocal growths
        growths += 1
        return growths > _GROWTHS

    setup.solve(base.PlannerTerminationCondition(enough))
    if not setup.haveExactSolutionPath():
        return None
    path = setup.getSolutionPath()
    simplifier = geometric.PathSimplifier(information)
    simplifier.reduceVertices(path)
    simplifier.partialShortcutPath(path)
    simplifier.reduceVertices(path)
    points = np.array([joints(state) for state in path.getStates()])
    points[0], points[-1] = start, end
    if any(arm.path_collision(a, b) is not None for a, b in pairwise(points)):
        return None
    return np.asarray(points[1:-1])
