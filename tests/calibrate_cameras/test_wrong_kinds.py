"""Every flag, name, choice and size that a calibration of cameras takes."""

from __future__ import annotations

from typing import Any

import general_motion_scene
import numpy as np
import pytest
from half_turn_scene import IMAGE_SIZE, TRIANGLE, make_scene

from handeye_tri.calibrate_cameras import (
    calibrate_camera,
    calibrate_cameras_general,
    calibrate_session_cameras,
    calibrate_target_views,
    calibrate_trials,
)
from handeye_tri.errors import InputError

SCENE = make_scene(np.random.default_rng(0), 6)
GENERAL = general_motion_scene.make_scene(np.random.default_rng(0), 3, 6).pixels
GRID = np.array([[x, y, 0.0] for x in range(4) for y in range(3)])
NOT = {
    "flag": (None, 1, "yes", "", [], np.array([1, 2]), object()),
    "name": (None, 3, True, "", b"left", ["left"]),
    "names": (3, "abc", [1, 2, 3], ["a", "a", "b"], {"a": 1}),
    "size": ((1024.5, 768), ("1024", "768"), (np.inf, 768), (1, 2, 3), None, "wide"),
    "choice": (3, None, ["whitened"], np.array([1, 2]), "best"),
    "loss": (3, True, ["huber"], np.array([1, 2]), "best"),
    "lens": (3, True, [["k1"]], [None], ("k1", 2), "best", np.array([1, 2])),
    "positive": (True, "0.1", [], {}, 0, -1.0, np.inf, np.array([1, 2]), object(), 1j),
    "axis": (3, [3] * 6, ["AB", None], [["AB"]] * 6, np.array([1, 2])),
}


def one_camera(**given: Any) -> Any:
    options = {"image_size": IMAGE_SIZE, "sigma_px": 0.1, **given}
    return calibrate_camera(SCENE.before, SCENE.after, TRIANGLE, **options)


def trials(**given: Any) -> Any:
    options = {"image_size": IMAGE_SIZE, "sigma_px": 0.1, **given}
    return calibrate_trials(SCENE.before[None], SCENE.after[None], TRIANGLE, **options)


def several_cameras(**given: Any) -> Any:
    options = {"image_sizes": IMAGE_SIZE, "sigma_px": 0.1, **given}
    return calibrate_cameras_general(GENERAL, TRIANGLE, **options)


def flat_target(**given: Any) -> Any:
    options = {"image_sizes": IMAGE_SIZE, **given}
    return calibrate_target_views(GRID, np.full((3, 4, 12, 2), 5.0), **options)


CASES = [
    (call, argument, value)
    for call, kinds in {
        one_camera: {
            "image_size": "size",
            "axis": "axis",
            "skew": "flag",
            "refine": "flag",
            "reject": "flag",
            "method": "choice",
            "distortion": "lens",
            "loss": "loss",
            "sigma_px": "positive",
            "aspect": "positive",
            "name": "name",
        },
        trials: {
            "image_size": "size",
            "axis": "axis",
            "skew": "flag",
            "distortion": "lens",
            "sigma_px": "positive",
        },
        several_cameras: {
            "image_sizes": "size",
            "skew": "flag",
            "distortion": "lens",
            "sigma_px": "positive",
            "names": "names",
        },
        flat_target: {
            "image_sizes": "size",
            "skew": "flag",
            "distortion": "lens",
            "sigma_px": "positive",
            "names": "names",
        },
    }.items()
    for argument, kind in kinds.items()
    for value in NOT[kind]
]


@pytest.mark.parametrize(("call", "argument", "value"), CASES)
def test_an_argument_of_the_wrong_kind_is_named(call, argument, value) -> None:
    with pytest.raises(InputError, match=rf"^{argument}\b.* must ") as caught:
        call(**{argument: value})
    assert len(str(caught.value)) < 250


def test_a_number_known_of_the_camera_is_a_number() -> None:
    for value in (True, "511", None, [511.5]):
        with pytest.raises(InputError, match=r"fixed\['cx'\] must be a number"):
            one_camera(fixed={"cx": value})


def test_what_is_no_session_is_named() -> None:
    with pytest.raises(InputError, match="session must be a Session, got 'cell'"):
        calibrate_session_cameras("cell")


@pytest.mark.parametrize(
    "call",
    [
        lambda: calibrate_camera(
            SCENE.before > 500, SCENE.after, TRIANGLE, image_size=IMAGE_SIZE
        ),
        lambda: one_camera(o=[True, False]),
        lambda: one_camera(turn_covariance=np.eye(6, dtype=bool)),
        lambda: calibrate_trials(
            SCENE.before[None], SCENE.after[None] > 500, TRIANGLE, image_size=IMAGE_SIZE
        ),
        lambda: calibrate_cameras_general(
            GENERAL > 500, TRIANGLE, image_sizes=IMAGE_SIZE
        ),
        lambda: calibrate_target_views(
            GRID, np.ones((3, 4, 12, 2), dtype=bool), image_sizes=IMAGE_SIZE
        ),
    ],
)
def test_flags_are_no_coordinates(call: Any) -> None:
    with pytest.raises(InputError, match="must be real numbers, not True and False"):
        call()
