"""Results: errors have their sign, statistics their definition."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from handeye_tri.camera import Intrinsics, PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.records import (
    CameraCalibration,
    Covariance,
    GroundTruth,
    HandEyeCalibration,
    Mount,
    TrackEvaluation,
)
from handeye_tri.se3 import SE3

CAMERA = PinholeCamera("left", Intrinsics(900.0, 910.0, 0.0, 320.0, 240.0), (640, 480))
NOTHING = Covariance((), np.empty((0, 0)))


def track(**changes: Any) -> TrackEvaluation:
    values: dict[str, Any] = {
        "stations": [22, 22],
        "markers": [0, 1],
        "reported": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]],
        "observed": [[3e-4, 0.0, 4e-4], [1.0, 1.0, 1.0 - 1e-4]],
        "predicted_covariance": [4e-8 * np.eye(3), 2e-8 * np.eye(3)],
    }
    return TrackEvaluation(**(values | changes))


def camera_calibration(**changes: Any) -> CameraCalibration:
    values: dict[str, Any] = {
        "cameras": (CAMERA,),
        "reference_from_camera": (SE3.identity(),),
        "covariance": NOTHING,
        "chi2": 10.0,
        "dof": 9,
        "residuals": np.full((1, 4, 3, 2), np.nan),
        "condition": 1e4,
        "cost_start": 12.0,
        "method": "half-turns",
    }
    return CameraCalibration(**(values | changes))


def test_track_errors_are_observed_less_reported() -> None:
    assert track().errors[1] == pytest.approx([0, 0, -1e-4])


def test_track_statistics() -> None:
    assert track().distances == pytest.approx([5e-4, 1e-4])
    assert track().mean == pytest.approx(3e-4)
    assert track().rms == pytest.approx(np.sqrt(13) * 1e-4)
    assert track().max == pytest.approx(5e-4)
    assert track().predicted_rms == pytest.approx(np.sqrt(9e-8))


def test_track_arrays_are_locked() -> None:
    record = track()
    for name in ("stations", "markers", "reported", "observed", "predicted_covariance"):
        assert not getattr(record, name).flags.writeable


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stations": []}, "no marker of a held-out station was seen"),
        ({"markers": [0]}, r"markers must have shape \(2,\), got \(1,\)"),
        ({"observed": np.zeros((3, 3))}, r"observed must have shape \(2, 3\)"),
        ({"reported": np.full((2, 3), np.nan)}, "reported must be finite"),
    ],
)
def test_tracks_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        track(**changes)


def test_the_one_camera() -> None:
    assert camera_calibration().camera is CAMERA
    two = camera_calibration(
        cameras=(CAMERA, CAMERA),
        reference_from_camera=(SE3.identity(),) * 2,
        residuals=np.zeros((2, 4, 3, 2)),
    )
    with pytest.raises(InputError, match=r"several cameras \(left, left\)"):
        _ = two.camera


def test_each_camera_has_a_place_and_residuals() -> None:
    with pytest.raises(InputError, match="1 cameras need as many motions, got 2"):
        camera_calibration(reference_from_camera=(SE3.identity(),) * 2)
    with pytest.raises(InputError, match="residuals must have shape"):
        camera_calibration(residuals=np.zeros((2, 4, 3, 2)))
    assert not camera_calibration().residuals.flags.writeable


def test_hand_eye_and_truth_lock_and_check() -> None:
    def hand_eye(**changes: Any) -> HandEyeCalibration:
        values: dict[str, Any] = {
            "cameras": (CAMERA,),
            "base_from_camera": (SE3.identity(),),
            "flange_from_triangle": SE3.identity(),
            "markers": np.zeros((3, 3)),
            "covariance": NOTHING,
            "chi2": 1.0,
            "dof": 1,
            "residuals": np.zeros((5, 6)),
            "method": "axzb",
        }
        return HandEyeCalibration(**(values | changes))

    assert not hand_eye().markers.flags.writeable
    with pytest.raises(InputError, match="1 cameras need as many motions, got 0"):
        hand_eye(base_from_camera=())
    with pytest.raises(InputError, match="markers must have shape"):
        hand_eye(markers=np.zeros((3, 2)))
    with pytest.raises(InputError, match="residuals must have shape"):
        hand_eye(residuals=np.zeros(6))
    truth = GroundTruth((CAMERA,), (SE3.identity(),), SE3.identity(), [np.eye(4)])  # type: ignore[arg-type]
    assert not truth.base_from_flange.flags.writeable
    with pytest.raises(InputError, match="base_from_flange must have shape"):
        GroundTruth((CAMERA,), (SE3.identity(),), SE3.identity(), np.eye(4))
    with pytest.raises(InputError, match="markers must have shape"):
        GroundTruth((CAMERA,), (SE3.identity(),), SE3.identity(), [np.eye(4)], [[0.0]])  # type: ignore[arg-type]


def test_markers_at_stations_are_those_of_their_mount() -> None:
    first, second = np.eye(3), 2.0 * np.eye(3)
    calibration = HandEyeCalibration(
        cameras=(CAMERA,),
        base_from_camera=(SE3.identity(),),
        flange_from_triangle=SE3.identity(),
        markers=first,
        covariance=NOTHING,
        chi2=1.0,
        dof=1,
        residuals=np.zeros((2, 6)),
        method="",
        other_mounts=(Mount(SE3.identity(), second),),
    )
    found = calibration.markers_at(np.array([1, 0, 1]))
    np.testing.assert_array_equal(found, [second, first, second])
    assert len(calibration.mounts) == 2
