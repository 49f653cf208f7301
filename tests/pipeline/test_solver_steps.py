"""The steps that a recording shows are those that the calibration took."""

import numpy as np
import pytest

from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.camera import Lens
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.pipeline.solver_steps import solver_steps
from handeye_tri.records import Repeatability
from handeye_tri.synthesize import (
    reference_geometry,
    synthesize,
    two_mount_geometry,
)

# A robot that repeats badly, so that whether that is known makes pixels of difference.
ROUGH = Repeatability(5e-4, np.radians(0.05))


@pytest.fixture(scope="module", params=[False, True], ids=["pinhole", "lens"])
def cell(request):
    lens = Lens("radtan", np.array([-0.15, 0.05, 0, 0, 0])) if request.param else None
    geometry = reference_geometry(
        np.random.default_rng([3, 1]), lens=lens, evaluation_stations=0
    )
    session, _ = synthesize(
        geometry, np.random.default_rng(3), sigma_px=0.05, repeatability=ROUGH
    )
    cameras = calibrate_session_cameras(session)
    return session, cameras, calibrate_hand_eye(session, cameras)


def test_no_step_is_left_out(cell):
    words = [step.words for step in solver_steps(*cell)]
    assert words == [
        "closed form, each camera alone",
        "refined, each camera alone",
        "all cameras together, then hand-eye",
    ]


def test_each_camera_alone_is_the_one_that_the_calibration_began_with(cell):
    session, cameras, result = cell
    refined = solver_steps(session, cameras, result)[1].calibration
    for shown, alone in zip(refined.cameras, cameras.details["separate"], strict=True):
        np.testing.assert_array_equal(
            shown.intrinsics.vector, alone.camera.intrinsics.vector
        )
        np.testing.assert_array_equal(
            shown.lens.coefficients, alone.camera.lens.coefficients
        )


def test_each_camera_alone_is_placed_by_the_stations_of_both_mounts():
    geometry = two_mount_geometry(np.random.default_rng(0), evaluation_stations=0)
    session, truth = synthesize(geometry, np.random.default_rng(1), sigma_px=0.0)
    cameras = calibrate_session_cameras(session)
    result = calibrate_hand_eye(session, cameras)
    steps = solver_steps(session, cameras, result)
    assert len(steps) == 3
    for step in steps:
        found = step.calibration
        for place, true in zip(
            found.base_from_camera, truth.base_from_camera, strict=True
        ):
            np.testing.assert_allclose(place.matrix, true.matrix, atol=1e-7)
        (second,) = found.other_mounts
        np.testing.assert_allclose(
            second.markers, truth.other_mounts[0].markers, atol=1e-7
        )
