from __future__ import annotations

import numpy as np
import pytest

from handeye_tri.errors import ConvergenceError, InputError
from handeye_tri.kinematics import InverseKinematics, SerialChain
from handeye_tri.se3 import se3_exp, se3_inverse, se3_log, so3_exp


def placement(x, y, z, about_x=0.0, about_y=0.0):
    m = np.eye(4)
    m[:3, :3] = so3_exp([about_x, 0, 0]) @ so3_exp([0, about_y, 0])
    m[:3, 3] = x, y, z
    return m


QUARTER = np.pi / 2
FLANGE = placement(0, 0, 0.09)


def six_joints():
    placements = [
        placement(0, 0, 0.3),
        placement(0.1, 0, 0, -QUARTER),
        placement(0, -0.29, 0),
        placement(0, -0.085, 0, 0, QUARTER),
        placement(0, 0, 0.3, 0, -QUARTER),
        placement(0, 0, 0, 0, QUARTER),
    ]
    limits = np.radians(
        [(-170, 170), (-85, 90), (-130, 240), (-180, 180), (-125, 125), (-360, 360)]
    )
    return SerialChain(np.array(placements), np.zeros(6, bool), FLANGE, *limits.T)


def seven_joints():
    turns = [0, -QUARTER, QUARTER, -QUARTER, QUARTER, -QUARTER, QUARTER]
    heights = [0.3, 0, 0, 0.3, 0, 0.3, 0]
    placements = [placement(0, 0, z, t) for z, t in zip(heights, turns, strict=True)]
    limit = np.full(7, 2.8)
    return SerialChain(np.array(placements), np.zeros(7, bool), FLANGE, -limit, limit)


def three_parallel_axes():
    """Lengths of a UR5e: no wrist whose axes meet."""
    placements = [
        placement(0, 0, 0.1625),
        placement(0, 0, 0, QUARTER),
        placement(-0.425, 0, 0),
        placement(-0.3922, 0, 0.1333),
        placement(0, -0.0997, 0, QUARTER),
        placement(0, 0.0996, 0, -QUARTER),
    ]
    limit = np.array([2, 2, 1, 2, 2, 2]) * np.pi
    return SerialChain(np.array(placements), np.zeros(6, bool), FLANGE, -limit, limit)


def on_a_rail():
    """Six joints on a rail along x: the first joint slides."""
    arm = six_joints()
    rail = placement(0, 0, 0, 0, QUARTER)
    first = se3_inverse(rail) @ arm.placements[0]
    return SerialChain(
        np.concatenate([rail[None], first[None], arm.placements[1:]]),
        np.array([True] + [False] * 6),
        FLANGE,
        np.append(-0.5, arm.lower),
        np.append(0.5, arm.upper),
    )


CHAINS = {
    "six": six_joints,
    "parallel": three_parallel_axes,
    "seven": seven_joints,
    "rail": on_a_rail,
}


@pytest.fixture(params=CHAINS)
def chain(request):
    return CHAINS[request.param]()


def test_forward_is_the_product_of_placements_and_joint_motions(chain, rng):
    q = chain.random(rng, 20)
    expected = np.broadcast_to(np.eye(4), (20, 4, 4))
    for i, slide in enumerate(chain.slides):
        tangent = np.zeros((20, 6))
        tangent[:, 2 if slide else 5] = q[:, i]
        expected = expected @ chain.placements[i] @ se3_exp(tangent)
    np.testing.assert_allclose(
        chain.forward(q), expected @ chain.last_from_flange, atol=1e-14
    )


def test_forward_takes_any_batch(chain, rng):
    q = chain.random(rng, (2, 3))
    assert chain.forward(q).shape == (2, 3, 4, 4)
    # Matrix products of other sizes may round differently in the last digit.
    np.testing.assert_allclose(
        chain.forward(q[1, 2]), chain.forward(q)[1, 2], atol=1e-15
    )
    with pytest.raises(InputError, match="shape"):
        chain.forward(np.zeros(3))


def test_jacobian_meets_central_differences(chain, rng):
    q = chain.random(rng, 50)
    jacobian = chain.jacobian(q)
    # Central differences: truncation h^2/6 |f'''| ~ 1e-11, rounding 1e-16/h ~ 1e-10.
    h = 1e-6
    back = se3_inverse(chain.forward(q))
    for i in range(len(chain)):
        step = np.zeros(len(chain))
        step[i] = h
        ahead = se3_log(back @ chain.forward(q + step))
        behind = se3_log(back @ chain.forward(q - step))
        np.testing.assert_allclose(
            jacobian[..., i], (ahead - behind) / (2 * h), atol=2e-9
        )


@pytest.mark.parametrize("name", CHAINS)
def test_inverse_reaches_reachable_targets(name, rng):
    chain = CHAINS[name]()
    target = chain.forward(chain.random(rng, 1000))
    solutions = InverseKinematics(chain).solve(target, rng, first=True)
    found = np.array([len(q) > 0 for q in solutions.joints])
    assert found.mean() >= 0.995
    joints = np.array([q[0] for q in solutions.joints if len(q)])
    assert ((joints >= chain.lower) & (joints <= chain.upper)).all()
    error = se3_log(se3_inverse(chain.forward(joints)) @ target[found])
    assert np.abs(error).max() < 1e-9


def test_a_short_slide_leaves_the_way_to_the_hinges(rng):
    """Else the shortest step would drive it far beyond its range."""
    chain = on_a_rail()
    chain.lower[0], chain.upper[0] = -0.05, 0.05
    start = chain.random(rng, 300)
    target = chain.forward(chain.random(rng, 300))
    q, norm = chain.descend(start, target, 40)
    reached = norm < 1e-8
    assert reached.mean() > 0.5
    # Metres; as far as hinges turn it would be half a metre.
    assert np.median(np.abs(q[reached, 0])) < 0.1


def test_inverse_tries_longer_where_only_the_limits_are_in_the_way(rng):
    """Narrow limits: most of what is reached from 12 starts is beyond them."""
    chain = seven_joints()
    chain.lower[:] = -1.2
    chain.upper[:] = 1.2
    target = chain.forward(chain.random(rng, 300))
    solver = InverseKinematics(chain)
    few = solver.solve(target, rng, starts=12, first=True)
    assert np.mean([len(rows) > 0 for rows in few.joints]) > 0.98
    every = solver.solve(target, rng, starts=12)
    assert np.mean([len(rows) > 0 for rows in every.joints]) < 0.98


def test_inverse_finds_all_branches_of_a_spherical_wrist(rng):
    """Elbow and wrist give four solutions here; the drawn one is among them."""
    chain = six_joints()
    drawn = np.radians([[20, 10, -20, 40, 60, 30]])
    solutions = (
        InverseKinematics(chain).solve(chain.forward(drawn), rng, starts=80).joints[0]
    )
    assert np.abs(solutions - drawn).max(axis=1).min() < 1e-8
    # Turning the wrist over: r + 180, -b, t + 180 is the same pose.
    flipped = np.radians([20, 10, -20, -140, -60, -150])
    assert np.abs(solutions - flipped).max(axis=1).min() < 1e-8
    gaps = np.abs(solutions[:, None] - solutions[None]).max(axis=-1)
    assert gaps[~np.eye(len(solutions), dtype=bool)].min() > 1e-3


def test_inverse_tells_out_of_reach_from_beyond_the_limits(rng):
    chain = six_joints()
    far = np.eye(4)
    far[:3, 3] = 3.0, 0.0, 0.0
    behind = six_joints()
    # The same pose for an arm whose first joint may not look there.
    q = np.radians([[90.0, 10, -20, 40, 60, 30]])
    behind.lower, behind.upper = behind.lower.copy(), behind.upper.copy()
    behind.lower[0], behind.upper[0] = -0.1, 0.1
    assert len(InverseKinematics(chain).solve(far, rng).joints[0]) == 0
    assert not InverseKinematics(chain).solve(far, rng).beyond_limits[0]
    limited = InverseKinematics(behind).solve(chain.forward(q), rng)
    assert len(limited.joints[0]) == 0
    assert limited.beyond_limits[0]


def test_inverse_of_nothing_is_nothing(rng):
    solutions = InverseKinematics(six_joints()).solve(np.zeros((0, 4, 4)), rng)
    assert solutions.joints == ()
    assert solutions.beyond_limits.shape == (0,)


def test_inverse_repeats_by_seed():
    chain = six_joints()
    target = chain.forward(chain.random(np.random.default_rng(3), 20))
    first, second = (
        InverseKinematics(chain).solve(target, np.random.default_rng(4)).joints
        for _ in range(2)
    )
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


def test_wrapping_uses_whole_turns_of_hinges_only(rng):
    chain = on_a_rail()
    q = np.zeros((1, 7))
    q[0, 0], q[0, 1], q[0, 6] = 0.4, 2 * np.pi + 0.3, 3 * np.pi
    wrapped, inside = chain.wrapped(q)
    assert inside[0]
    np.testing.assert_allclose(wrapped[0, :2], (0.4, 0.3), atol=1e-14)
    np.testing.assert_allclose(np.abs(wrapped[0, 6]), np.pi, atol=1e-14)
    q[0, 0] = 0.6
    assert not chain.wrapped(q)[1][0]


def test_perturbed_moves_the_flange_by_the_tangent(chain, rng):
    q = chain.random(rng, 30)
    tangent = rng.normal(0.0, 1.0, (30, 6)) * ([3e-5] * 3 + [1e-4] * 3)
    moved = chain.perturbed(q, tangent)
    np.testing.assert_allclose(
        chain.forward(moved), chain.forward(q) @ se3_exp(tangent), atol=1e-9
    )
    assert np.abs(moved - q).max() < 0.5


def test_perturbed_says_when_a_pose_cannot_be_reached():
    chain = six_joints()
    away = np.array([3.0, 0, 0, 0, 0, 0])
    with pytest.raises(ConvergenceError, match="displaced pose 0"):
        chain.perturbed(np.full(6, 0.3), away)


@pytest.fixture
def rng():
    return np.random.default_rng(7)
