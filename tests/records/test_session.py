"""Sessions are built valid or not at all."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from handeye_tri.errors import InputError
from handeye_tri.records import (
    CameraInfo,
    HalfTurn,
    Plan,
    Repeatability,
    Session,
    Station,
    ToolChange,
)
from handeye_tri.se3 import SE3
from handeye_tri.triangle import TriangleRig


def station(index: int, kind: str = "calibration") -> Station:
    pose = SE3.exp([0.1 * index, 0, 0, 0, 0, 0.2])
    return Station(index, kind, np.full(6, 0.1 * index), pose)  # type: ignore[arg-type]


def session(**changes: Any) -> Session:
    values: dict[str, Any] = {
        "triangle": TriangleRig(0.13, 0.12, 1.1),
        "marker_radii": (0.008, 0.008, 0.008),
        "cameras": (CameraInfo("left", (64, 48)), CameraInfo("right", (64, 48))),
        "stations": (station(0), station(1), station(2, "evaluation")),
        "half_turns": (HalfTurn(0, 1, "normal"),),
        "pixels": np.arange(36.0).reshape(2, 3, 3, 2),
        "pixel_covariance": np.tile(np.eye(2), (2, 3, 3, 1, 1)),
        "repeatability": Repeatability(3e-5, 1e-4),
        "simulated": True,
    }
    return Session(**(values | changes))


def test_arrays_are_locked_copies() -> None:
    pixels = np.zeros((2, 3, 3, 2))
    record = session(pixels=pixels)
    pixels[:] = 1.0
    assert (record.pixels == 0).all()
    for array in (record.pixels, record.pixel_covariance, record.marker_radii):
        assert not array.flags.writeable
    assert not record.stations[0].joints.flags.writeable
    with pytest.raises(dataclasses.FrozenInstanceError):
        record.simulated = False  # type: ignore[misc]


def test_indices_and_poses() -> None:
    record = session()
    assert record.indices("calibration").tolist() == [0, 1]
    assert record.indices("evaluation").tolist() == [2]
    assert record.base_from_flange.shape == (3, 4, 4)
    assert record.base_from_flange[2, 0, 3] == pytest.approx(
        record.stations[2].base_from_flange.translation[0]
    )


def test_an_unseen_marker_needs_no_covariance() -> None:
    pixels = np.zeros((2, 3, 3, 2))
    covariance = np.tile(np.eye(2), (2, 3, 3, 1, 1))
    pixels[1, 2, 0] = covariance[1, 2, 0] = np.nan
    assert np.isnan(session(pixels=pixels, pixel_covariance=covariance).pixels).any()


def test_a_seen_marker_needs_one() -> None:
    covariance = np.tile(np.eye(2), (2, 3, 3, 1, 1))
    covariance[1, 2, 0] = np.nan
    with pytest.raises(InputError, match=r"camera 'right', station 2, marker A: a det"):
        session(pixel_covariance=covariance)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixels": np.zeros((2, 3, 2))}, r"pixels must have shape \(2, 3, 3, 2\)"),
        ({"marker_radii": (1.0, 1.0)}, "marker_radii must have shape"),
        ({"marker_radii": (1.0, 1.0, np.nan)}, "marker_radii must be finite"),
        (
            {"cameras": (CameraInfo("left", (64, 48)),) * 2},
            "camera names must differ, got left, left",
        ),
        (
            {"stations": (station(0), station(2), station(1))},
            "station 1 in the session has index 2",
        ),
        ({"half_turns": (HalfTurn(0, 3, "AB"),)}, "beyond the 3 there are"),
        ({"half_turns": (HalfTurn(-1, 0, "AB"),)}, "beyond the 3 there are"),
        ({"half_turns": (HalfTurn(0, 2, "AB"),)}, "uses station 2, which is held out"),
    ],
)
def test_what_does_not_fit_together(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        session(**changes)


def test_stations_and_half_turns_refuse_unknown_words() -> None:
    with pytest.raises(InputError, match="station 3: kind must be one of calibration"):
        station(3, "training")
    with pytest.raises(InputError, match="one of normal, AB, BC, CA, got 'AC'"):
        HalfTurn(0, 1, "AC")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="two stations, got 4 for both"):
        HalfTurn(4, 4, "AB")


def test_camera_info_knows_its_lens() -> None:
    assert CameraInfo("left", (64, 48), lens=("k4",), lens_model="rational")
    with pytest.raises(InputError, match=r"camera 'left': lens \['k4'\]"):
        CameraInfo("left", (64, 48), lens=("k4",))
    with pytest.raises(InputError, match="got model 'fisheye'"):
        CameraInfo("left", (64, 48), lens_model="fisheye")  # type: ignore[arg-type]


@pytest.mark.parametrize("bad", [-1e-5, np.nan, np.inf])
def test_repeatability_is_a_deviation(bad: float) -> None:
    with pytest.raises(InputError, match="translation must be 0 or more"):
        Repeatability(bad, 0.0)
    with pytest.raises(InputError, match="rotation must be 0 or more"):
        Repeatability(0.0, bad)


def test_repeatability_covariance_is_translation_first() -> None:
    expected = [9e-10] * 3 + [4e-8] * 3
    assert np.diag(Repeatability(3e-5, 2e-4).covariance) == pytest.approx(expected)


def on_mounts(*mounts: int) -> tuple[Station, ...]:
    return tuple(
        dataclasses.replace(station(j), mount=mount) for j, mount in enumerate(mounts)
    )


def test_each_station_has_a_mount() -> None:
    assert session().mounts.tolist() == [0, 0, 0]
    record = session(stations=on_mounts(0, 0, 1), half_turns=())
    assert record.mounts.tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    ("mounts", "turns", "message"),
    [
        ((0, 0, 2), (), r"without a gap, got \[0, 2\]"),
        ((1, 1, 1), (), r"without a gap, got \[1\]"),
        ((0, 1, 1), (HalfTurn(0, 1, "normal"),), "different mounts"),
    ],
)
def test_mounts_that_do_not_fit(
    mounts: tuple[int, ...], turns: tuple[HalfTurn, ...], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        session(stations=on_mounts(*mounts), half_turns=turns)


def test_a_mount_is_called_by_what_it_turns_about() -> None:
    stations = (*on_mounts(0, 0, 1, 1), *(dataclasses.replace(station(4), mount=2),))
    nothing = {
        "pixels": np.full((2, 5, 3, 2), np.nan),
        "pixel_covariance": np.full((2, 5, 3, 2, 2), np.nan),
    }
    turns = (HalfTurn(0, 1, "normal"), HalfTurn(2, 3, "BC"))
    record = session(stations=stations, half_turns=turns, **nothing)
    assert [record.mount_name(mount) for mount in range(3)] == [
        "mount 1 (about a normal)",
        "mount 2 (about its edge BC)",
        "mount 3",
    ]


def test_a_mount_is_counted_from_zero() -> None:
    with pytest.raises(InputError, match="station 0: mount must be 0 or more, got -1"):
        dataclasses.replace(station(0), mount=-1)


def plan(*mounts: int, change: ToolChange | None) -> Plan:
    stations = on_mounts(*mounts)
    return Plan(stations, (), {}, {}, 0, "PASS", (), tool_change=change)


def test_a_plan_states_its_tool_change() -> None:
    change = ToolChange(2, np.zeros(6), np.zeros((1, 6)))
    assert plan(0, 0, 1, change=change).tool_change is change
    assert not change.joints.flags.writeable
    assert not change.via.flags.writeable


def test_a_tool_change_may_come_before_the_first_station() -> None:
    """The robot then carries the mount that the last programme ended with."""
    change = ToolChange(0, np.zeros(6), np.zeros((0, 6)))
    assert plan(1, 1, change=change).tool_change is change
    with pytest.raises(InputError, match="one tool change, where the mount changes"):
        plan(0, 1, change=change)


@pytest.mark.parametrize(
    ("mounts", "before"),
    [((0, 0, 1), None), ((0, 0, 1), 1), ((0, 0), 1), ((0, 1, 0), 1)],
)
def test_a_tool_change_is_where_the_mount_changes(
    mounts: tuple[int, ...], before: int | None
) -> None:
    change = None
    if before is not None:
        change = ToolChange(before, np.zeros(6), np.zeros((0, 6)))
    with pytest.raises(InputError, match="one tool change, where the mount changes"):
        plan(*mounts, change=change)


def test_a_tool_change_passes_joints_of_one_arm() -> None:
    with pytest.raises(InputError, match="via must have shape"):
        ToolChange(1, np.zeros(6), np.zeros((2, 7)))
