"""Where the refinement of one camera starts: the closed form, and a generic camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handeye_tri.calibrate_cameras.closed_form import ClosedForm
from handeye_tri.calibrate_cameras.extrinsics import poses_from_homographies
from handeye_tri.calibrate_cameras.homography import Homographies
from handeye_tri.calibrate_cameras.refine import HalfTurnModel, State

Floats = NDArray[np.float64]

# Focal length of the generic second start over the longer side of the image: too
# long rather than too short, from where the descent is smoother.
GENERIC_FOCAL = 2.5


def blank_state(
    model: HalfTurnModel, coefficients: Floats, homographies: Homographies
) -> State:
    """Lens and O to start from; camera and poses are to be filled in.

    Args:
        model: The half-turns.
        coefficients: Of the lens, shape (5,) or (8,).
        homographies: One per half-turn.
    """
    n = len(model.data)
    return State(
        np.zeros(5),
        coefficients,
        np.zeros((n, 4, 4)),
        homographies.o,
        np.zeros((n, model.turn_unknowns)),
    )


def pinhole_state(
    model: HalfTurnModel, blank: State, k: Floats, poses: Floats
) -> State:
    """A state with K (3, 3), as near as what is known of it allows, and poses."""
    vector = np.array([k[0, 0], k[1, 1], k[0, 1], k[0, 2], k[1, 2]])
    return replace(blank, intrinsics=model.choice.impose(vector), poses=poses)


def refinement_starts(
    model: HalfTurnModel,
    blank: State,
    first: ClosedForm | None,
    homographies: Homographies,
) -> dict[str, State]:
    """States to start from by name, the closed form first where there is one."""
    width, height = model.data.image_size
    focal = GENERIC_FOCAL * max(width, height)
    generic = np.diag([focal, focal, 1.0])
    generic[:2, 2] = 0.5 * (width - 1), 0.5 * (height - 1)
    poses = poses_from_homographies(generic, homographies, model.data.triangle)
    starts = {"generic": pinhole_state(model, blank, generic, poses)}
    if first is not None:
        closed = pinhole_state(model, blank, first.k, first.poses)
        starts = {"closed form": closed, **starts}
    return starts
