from __future__ import annotations

from dataclasses import replace

import numpy as np
import planning_scene as scene
import pytest

from handeye_tri.arm import Arm
from handeye_tri.plan.candidates import _BATCH, CandidateSearch
from handeye_tri.plan.poses import HALF_TURN, View


def limited(name, **limits_deg):
    """The arm of a cell with other joint limits, by joint name, degrees."""
    mechanism = scene.compiled(scene.cell_of(name))
    joints = []
    for joint in mechanism.joints:
        if joint.name in limits_deg:
            lower, upper = np.radians(limits_deg[joint.name])
            joint = replace(joint, lower=lower, upper=upper)  # noqa: PLW2901
        joints.append(joint)
    return Arm(replace(mechanism, joints=tuple(joints)))


def search(name, arm=None, seed=0):
    return CandidateSearch(
        View(scene.cell_of(name)),
        arm or scene.arm_of(name),
        np.random.default_rng(seed),
    )


@pytest.mark.parametrize("name", ["hp3_stereo", "hp3_stereo_edge"])
def test_half_turns_turn_by_exactly_180_degrees(name):
    arm = scene.arm_of(name)
    found = search(name).find(6, turns=True)
    assert len(found) == 6
    for (candidate,) in found:
        before, after = arm.forward(candidate.joints)
        np.testing.assert_allclose(candidate.base_from_flange, [before, after])
        np.testing.assert_allclose(before @ HALF_TURN, after, atol=1e-9)
        # Only the last joint moved.
        np.testing.assert_array_equal(*candidate.joints[:, :-1])


def test_a_wrist_without_room_turns_over_instead():
    """The last joint has 160 degrees: r and t by 180 and b mirrored do the turn."""
    arm = limited("hp3_stereo", t=(-80, 80))
    found = search("hp3_stereo", arm).find(2, turns=True)
    assert len(found) == 2
    for (candidate,) in found:
        np.testing.assert_allclose(
            candidate.base_from_flange[0] @ HALF_TURN,
            candidate.base_from_flange[1],
            atol=1e-9,
        )
        assert (np.abs(candidate.joints[:, -1]) <= np.radians(80)).all()
        assert np.prod(candidate.joints[:, 4]) < 0


@pytest.mark.parametrize("turns", [True, False])
def test_a_longer_search_adds_solutions_and_keeps_the_known(turns):
    """A six-axis arm with a spherical wrist has up to eight."""
    one, arm = search("hp3_stereo"), scene.arm_of("hp3_stereo")
    known = one.prospects(20) if turns else one._solved(turns=False)[:20]
    wide = [one.widened(prospect) for prospect in known]
    for before, after in zip(known, wide, strict=True):
        np.testing.assert_array_equal(after.joints[: len(before.joints)], before.joints)
        np.testing.assert_allclose(
            arm.forward(after.joints),
            np.broadcast_to(after.base_from_flange, (*after.joints.shape[:2], 4, 4)),
            atol=1e-8,
        )
        gaps = np.abs(after.joints[:, None] - after.joints[None]).max(axis=(-1, -2))
        assert (gaps + np.eye(len(gaps)) > 1e-5).all()
    counts = [sum(len(p.joints) for p in each) for each in (known, wide)]
    assert counts[1] > 1.2 * counts[0]


def test_every_drawn_pose_is_found_or_counted():
    one = search("hp3_stereo_edge")
    found = one.find(25, turns=False)
    assert len(found) == 25
    assert all(len(c.joints) == 1 for (c,) in found)
    # The last batch may not have been used up.
    left = one.drawn - sum(one.rejected.values()) - len(found)
    assert 0 <= left < _BATCH


def test_a_wrist_that_cannot_turn_is_named():
    """Neither the last joint, nor turning the wrist over, nor reaching backwards."""
    arm = limited("hp3_stereo", t=(-80, 80), b=(5, 120), r=(-60, 60), s=(-60, 60))
    one = search("hp3_stereo", arm)
    assert one.find(1, turns=True) == []
    assert one.rejected["half_turn"] + one.rejected["limits"] > 500
    assert one.rejected["half_turn"] > 100


def test_prospects_become_the_same_half_turns_when_solids_allow_them():
    one = search("hp3_stereo")
    prospects = one.prospects(30)
    assert len(prospects) == 30
    arm = scene.arm_of("hp3_stereo")
    free = [one.free(p, 8) for p in prospects[:6]]
    assert sum(map(len, free)) > 6
    for prospect, ways in zip(prospects, free, strict=False):
        assert len(one.free(prospect, 1)) == min(len(ways), 1)
        for way in ways:
            np.testing.assert_allclose(
                way.base_from_flange, prospect.base_from_flange, atol=1e-9
            )
            assert all(arm.collision(q) is None for q in way.joints)
            assert ((way.joints >= arm.lower) & (way.joints <= arm.upper)).all()
