"""Systematic errors of a robot: seen without the parameters, gone with them."""

from dataclasses import replace
from functools import cache

import adjust_scene
import numpy as np
import pytest

from handeye_tri.adjustment import (
    RobotParameters,
    adjust,
    clock_offset,
    joint_offsets,
    link_corrections,
)
from handeye_tri.adjustment.robot import determined
from handeye_tri.errors import InputError
from handeye_tri.evaluate import evaluate_track
from handeye_tri.se3 import SE3, se3_adjoint, se3_exp, se3_inverse, se3_log
from handeye_tri.synthesize import reference_geometry, synthesize

JOINTS = ("s", "l", "u", "r", "b", "t")
# Axes of a 6R arm with a spherical wrist: direction and a point, at zero angles.
_AXES = np.array([
    [0, 0, 1], [0, 1, 0], [0, -1, 0], [-1, 0, 0], [0, -1, 0], [-1, 0, 0]
], dtype=float)  # fmt: skip
_POINTS = np.array([
    [0, 0, 0.3], [0.1, 0, 0.3], [0.1, 0, 0.59], [0.4, 0, 0.675], [0.4, 0, 0.675],
    [0.49, 0, 0.675],
])  # fmt: skip
_HOME = SE3.from_parts([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], [0.49, 0, 0.675]).matrix


def arm(joints):
    """base_from_flange (n, 4, 4), its right Jacobian (n, 6, 6), frames of the links.

    Product of exponentials (Brockett 1984, doi:10.1007/BFb0031048).
    """
    twists = np.concatenate([-np.cross(_AXES, _POINTS), _AXES], axis=1)
    steps = se3_exp(joints[..., None] * twists)
    whole = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    spatial, links = [], []
    for k in range(6):
        spatial.append((se3_adjoint(whole) @ twists[k])[..., None])
        whole = whole @ steps[:, k]
        links.append(whole)
    flange = whole @ _HOME
    jacobian = se3_adjoint(se3_inverse(flange)) @ np.concatenate(spatial, axis=-1)
    return flange, jacobian, np.stack(links, axis=1)


@cache
def nominal_cell():
    """Geometry, and joints that reach its poses."""
    geometry = reference_geometry(np.random.default_rng([11, 0]), half_turns=16)
    nominal = np.array([s.base_from_flange.matrix for s in geometry.stations])
    return geometry, nominal, solved(nominal, np.random.default_rng(1))


def solved(poses, rng):
    """Joints that reach poses, by Newton's method from random starts."""
    joints = np.zeros((len(poses), 6))
    left = np.arange(len(poses))
    for _ in range(60):
        trial = rng.uniform(-1.5, 1.5, size=(len(left), 6))
        for _ in range(25):
            flange, jacobian, _ = arm(trial)
            error = se3_log(se3_inverse(flange) @ poses[left])
            damped = jacobian.mT @ jacobian + 1e-9 * np.eye(6)
            right = jacobian.mT @ error[..., None]
            step = np.linalg.solve(damped, right)[..., 0]
            trial = trial + step / np.maximum(1, np.abs(step).max(1, keepdims=True))
        flange, jacobian, _ = arm(trial)
        miss = np.abs(se3_log(se3_inverse(flange) @ poses[left])).max(axis=1)
        good = (miss < 1e-10) & (np.linalg.cond(jacobian) < 100)
        joints[left[good]] = np.arctan2(np.sin(trial[good]), np.cos(trial[good]))
        left = left[~good]
        if len(left) == 0:
            return joints
    raise AssertionError(f"no joints for {len(left)} poses")


def offset_cell(offsets, noise, sigma_px=0.03, kinematics=False):
    """A robot whose joints are off: session, truth, start, parameters, joints."""
    geometry, nominal, joints = nominal_cell()
    true, _, _ = arm(joints + offsets)
    stations = tuple(
        replace(s, base_from_flange=SE3(pose))
        for s, pose in zip(geometry.stations, true, strict=True)
    )
    session, truth = synthesize(
        replace(geometry, stations=stations),
        np.random.default_rng([11, noise]),
        sigma_px=sigma_px,
        repeatability=adjust_scene.ROBOT,
        estimate_skew=False,
    )
    session = replace(
        session,
        stations=tuple(
            replace(s, base_from_flange=SE3(pose), joints=q)
            for s, pose, q in zip(geometry.stations, nominal, joints, strict=True)
        ),
    )
    parameters = joint_offsets(JOINTS, arm(joints)[1])
    if kinematics:
        parameters = replace(
            parameters, kinematics=lambda theta: arm(joints + theta)[:2]
        )
    start = adjust_scene.rough(truth, np.random.default_rng([11, 3]))
    return session, truth, start, parameters, joints


OFFSETS = np.radians(0.05) * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])


def test_joint_offsets_show_and_are_estimated():
    tracks, bound, found_offsets = [], [], []
    for noise in range(1, 5):
        clean = offset_cell(np.zeros(6), noise)
        reference = adjust(clean[0], clean[2])
        bound.append(evaluate_track(reference, clean[0]).predicted_rms ** 2)
        session, _, start, parameters, _ = offset_cell(OFFSETS, noise)
        blind = adjust(session, start)
        assert blind.chi2 / blind.dof > 2.5
        found = adjust(session, start, robot_parameters=parameters)
        assert found.chi2 / found.dof < 1.25
        # The first joint turns the base, the last the flange: nobody can tell.
        assert {"s.offset", "t.offset"} >= set(found.details["undetermined"])
        assert {"l.offset", "u.offset", "b.offset", "r.offset"} <= set(found.robot)
        tracks.append(evaluate_track(found, session, parameters).rms ** 2)
        found_offsets.append([
            (found.robot[f"{j}.offset"] - OFFSETS[k])
            / found.covariance.std(f"{j}.offset")
            for k, j in enumerate(JOINTS)
            if j in "lub"
        ])  # fmt: skip
    # Four sets of 18 positions know an RMS to some 10 %.
    assert np.sqrt(np.mean(tracks) / np.mean(bound)) < 1.3
    assert np.sqrt(np.mean(np.square(found_offsets))) < 1.8


def test_exact_kinematics_leave_nothing_of_large_offsets():
    session, truth, start, parameters, _ = offset_cell(
        20 * OFFSETS, 1, sigma_px=0.0, kinematics=True
    )
    reported = np.array([s.base_from_flange.matrix for s in session.stations])
    loose = replace(parameters, sigma=np.full(6, 0.1))
    exact = replace(session, repeatability=adjust_scene.EXACT)
    missed = se3_log(se3_inverse(reported) @ truth.base_from_flange)
    assert np.abs(missed).max() > 0.01
    assert np.array_equal(
        loose.poses(reported, np.zeros(6))[0], arm(_joints(session))[0]
    )
    found = adjust(exact, start, robot_parameters=loose)
    # What remains is the robot's noise, which this session calls exact.
    track = evaluate_track(found, exact, loose)
    assert track.rms < 1e-4
    for k, joint in enumerate("lub", start=1):
        label = f"{joint}.offset"
        value = 20 * OFFSETS[JOINTS.index(joint)]
        assert found.robot[label] == pytest.approx(value, rel=0.02), k


def _joints(session):
    return np.array([s.joints for s in session.stations])


def test_link_corrections_move_the_links_end():
    rng = np.random.default_rng(0)
    joints = rng.uniform(-1, 1, size=(5, 6))
    flange, _, links = arm(joints)
    parameters = link_corrections(JOINTS, se3_inverse(flange)[:, None] @ links)
    assert parameters.labels[:2] == ("s.x", "s.y")
    assert parameters.labels[-1] == "t.rz"
    values = np.zeros(36)
    small = 1e-6 * rng.normal(size=6)
    values[12:18] = small
    poses, _ = parameters.poses(flange, values)
    # The third link's end moves: base_from_link @ exp(d) @ link_from_flange.
    expected = links[:, 2] @ se3_exp(small) @ se3_inverse(links[:, 2]) @ flange
    assert np.abs(poses - expected).max() < 1e-14


def test_a_clock_offset_is_found():
    rng = np.random.default_rng(4)
    session, truth, start = adjust_scene.cell(
        12, sigma_px=0.05, repeatability=adjust_scene.ROBOT
    )
    twist = np.r_[np.full(3, 0.1), np.full(3, 0.3)] * rng.normal(size=(28, 6))
    late = 0.02
    reported = tuple(
        replace(s, base_from_flange=s.base_from_flange @ SE3.exp(-late * v))
        for s, v in zip(session.stations, twist, strict=True)
    )
    moving = replace(session, stations=reported)
    parameters = clock_offset(twist)
    found = adjust(moving, start, robot_parameters=parameters)
    sigma = found.covariance.std("clock.offset")
    assert sigma < 1e-4
    assert abs(found.robot["clock.offset"] - late) < 4 * sigma
    standing = adjust(session, start)
    assert evaluate_track(found, moving, parameters).rms == pytest.approx(
        evaluate_track(standing, session).rms, rel=0.1
    )
    # The robot stood still: no data on its clock.
    still = adjust(session, start, robot_parameters=clock_offset(np.zeros((28, 6))))
    assert still.details["undetermined"] == ("clock.offset",)
    assert still.robot == {}


def test_what_data_determine_is_chosen_greedily():
    information = np.diag([4.0, 0.1, 4.0])
    sigma = np.ones(3)
    np.testing.assert_array_equal(determined(information, sigma), [0, 2])
    # Two parameters of which only the sum matters: one of them stays.
    twins = np.array([[9.0, 9.0], [9.0, 9.0]])
    assert len(determined(twins, np.ones(2))) == 1
    np.testing.assert_array_equal(determined(np.diag([4.0]), np.array([0.1])), [])


def test_parameters_that_do_not_fit_are_named():
    good = joint_offsets(("a", "b"), np.zeros((4, 6, 2)))
    with pytest.raises(InputError, match=r"lack c\.offset"):
        good.select(("c.offset",))
    with pytest.raises(InputError, match="must differ"):
        joint_offsets(("a", "a"), np.zeros((4, 6, 2)))
    with pytest.raises(InputError, match="positive"):
        joint_offsets(("a", "b"), np.zeros((4, 6, 2)), sigma=0.0)
    with pytest.raises(InputError, match="jacobian must have shape"):
        RobotParameters(("a.offset",), np.zeros((4, 6, 2)), np.ones(1))
    with pytest.raises(InputError, match="flange_from_link must have shape"):
        link_corrections(("a",), np.zeros((4, 2, 4, 4)))
    with pytest.raises(InputError, match="same stations"):
        _ = good + clock_offset(np.zeros((5, 6)))
    with pytest.raises(InputError, match="cannot be joined"):
        _ = good + replace(good, kinematics=lambda theta: theta)
    both = good + clock_offset(np.ones((4, 6)))
    assert both.labels == ("a.offset", "b.offset", "clock.offset")
    assert both.jacobian.shape == (4, 6, 3)
    session, _, start = adjust_scene.cell(0, sigma_px=0.1, half_turns=3)
    with pytest.raises(InputError, match="all 12 stations"):
        adjust(session, start, robot_parameters=good)
    clash = joint_offsets(("left",), np.zeros((12, 6, 1)))
    with pytest.raises(InputError, match="share the names left"):
        adjust(session, start, robot_parameters=clash)
