"""A mechanism as arrays: its tree, its joints in order, what it refuses."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from handeye_tri.errors import InputError
from handeye_tri.mechanism import Body, Geometry, Joint, Mechanism
from handeye_tri.se3 import SE3


def joint(name: str, body: int, **changes: Any) -> Joint:
    values: dict[str, Any] = {
        "name": name,
        "body": body,
        "kind": "hinge",
        "anchor": (0.0, 0.0, 0.0),
        "axis": (0.0, 0.0, 1.0),
        "lower": -3.0,
        "upper": 3.0,
        "reference": 0.0,
        "speed": np.inf,
    }
    return Joint(**(values | changes))


def geometry(**changes: Any) -> Geometry:
    values: dict[str, Any] = {
        "name": "rod",
        "body": 4,
        "shape": "capsule",
        "size": (0.01, 0.1),
        "body_from_geometry": SE3.identity(),
        "vertices": np.empty((0, 3)),
        "faces": np.empty((0, 3), dtype=np.int64),
        "rgba": (0.5, 0.5, 0.5, 1.0),
        "collides": True,
    }
    return Geometry(**(values | changes))


def body(name: str, parent: int) -> Body:
    return Body(name, parent, SE3.identity())


def mechanism(**changes: Any) -> Mechanism:
    """World, a rail (moving the base), base, two links, a gripper beside the tip."""
    values: dict[str, Any] = {
        "bodies": (
            body("world", 0),
            body("rail", 0),
            body("base", 1),
            body("link1", 2),
            body("link2", 3),
            body("finger", 4),
        ),
        # Listed out of order, as an engine may.
        "joints": (
            joint("rail", 1, kind="slide"),
            joint("tip", 4),
            joint("shoulder", 3),
            joint("finger", 5),
        ),
        "geometries": (geometry(),),
        "base": "base",
        "flange": "link2",
        "base_body": 2,
        "flange_body": 4,
        "body_from_flange": SE3.identity(),
        "marker_body": 4,
        "markers": np.arange(9.0).reshape(3, 3),
        "touching": frozenset({(3, 4)}),
    }
    return Mechanism(**(values | changes))


def test_chain_leads_from_the_world_to_the_body() -> None:
    assert mechanism().chain(4) == (1, 2, 3, 4)
    assert mechanism().chain(0) == ()


def test_arm_joints_lie_between_base_and_flange_from_the_base_outward() -> None:
    """Neither the rail below the base nor the finger beyond the flange."""
    assert mechanism().arm_joints == (2, 1)


def test_two_joints_of_one_body_keep_the_models_order() -> None:
    both = (joint("b", 4), joint("a", 3), joint("c", 4))
    assert mechanism(joints=both).arm_joints == (1, 0, 2)


def test_no_joint_between_base_and_flange() -> None:
    with pytest.raises(
        InputError, match="between base 'base' and flange 'link2'.*last"
    ):
        _ = mechanism(joints=(joint("rail", 1),)).arm_joints


def test_bodies_come_after_their_parents() -> None:
    with pytest.raises(InputError, match="body 'b' comes before its parent"):
        mechanism(bodies=(body("world", 0), body("b", 2), body("c", 1)))


@pytest.mark.parametrize(
    "changes",
    [
        {"flange_body": 6},
        {"joints": (joint("a", 9),)},
        {"geometries": (geometry(body=-1),)},
    ],
)
def test_indices_beyond_the_bodies(changes: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="beyond the 6 bodies"):
        mechanism(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"axis": (0, 0, 2.0)}, r"joint 'j': the axis must have length 1"),
        ({"axis": (0, 0)}, r"joint 'j': axis must have shape \(3,\)"),
        ({"anchor": (0, 0, np.nan)}, "joint 'j': anchor must be finite"),
        ({"lower": 1.0, "upper": -1.0}, "lower limit 1 exceeds the upper limit -1"),
        ({"lower": np.nan}, "lower limit nan"),
    ],
)
def test_joints_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        joint("j", 1, **changes)


def test_a_joint_without_limits() -> None:
    free = joint("j", 1, lower=-np.inf, upper=np.inf)
    assert free.lower == -np.inf


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size": (0.1,)}, r"geometry 'rod': size must have shape \(2,\), got \(1,\)"),
        ({"shape": "box"}, r"size must have shape \(3,\)"),
        ({"rgba": (1.0, 1.0, 1.0)}, "rgba"),
        (
            {
                "shape": "mesh",
                "size": (),
                "vertices": np.eye(3),
                "faces": [[0, 1, 3]],
            },
            "a face names a vertex beyond the 3",
        ),
    ],
)
def test_geometries_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        geometry(**changes)


def test_arrays_are_copied_and_locked() -> None:
    markers = np.zeros((3, 3))
    cell = mechanism(markers=markers)
    markers[0, 0] = 1.0
    assert cell.markers[0, 0] == 0.0
    mesh = geometry(shape="mesh", size=(), vertices=np.eye(3), faces=[[0, 1, 2]])
    for array in (
        cell.markers,
        cell.joints[0].axis,
        mesh.vertices,
        mesh.faces,
        mesh.rgba,
    ):
        assert not array.flags.writeable
    with pytest.raises(dataclasses.FrozenInstanceError):
        cell.base = "x"  # type: ignore[misc]
