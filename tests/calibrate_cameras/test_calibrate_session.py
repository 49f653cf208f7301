import re
from dataclasses import replace

import numpy as np
import pytest
from bundle_scene import LENS, errors, nees, observe, scene, true_motions, two_feet

from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.calibrate_cameras.session_camera import turn_covariance
from handeye_tri.errors import DegenerateMotionError, HandEyeError, InputError
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.records import DroppedHalfTurn, Repeatability
from handeye_tri.se3 import SE3, se3_adjoint, se3_exp, se3_inverse, se3_log, so3_exp
from handeye_tri.synthesize import reference_geometry
from handeye_tri.triangle import TriangleRig

RADII = (0.0065, 0.008, 0.01)


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("axis", ["normal", "BC"])
def test_exact_spheres(axis, count):
    geometry = scene(count=count, axis=axis, skew=1.2)
    session, truth = observe(geometry, sigma_px=0.0, robot=None, marker_radii=RADII)
    result = calibrate_session_cameras(session)
    # What eccentricity is left is (r / Z)^2 of what the cameras still missed when it
    # was last computed: a hundredth of the sigmas at 0.015 px.
    sigma = 0.015 * np.sqrt(np.diagonal(result.covariance.matrix))
    np.testing.assert_allclose(errors(result, truth) / sigma, 0, atol=0.01)
    assert len(result.details["separate"]) == count
    assert np.nanmax(np.abs(result.residuals)) < 1e-4


def test_exact_points_with_a_lens():
    session, truth = observe(scene(lens=LENS, skew=1.2), sigma_px=0.0, robot=None)
    result = calibrate_session_cameras(session)
    np.testing.assert_allclose(errors(result, truth), 0, atol=1e-6)
    labels = result.covariance.labels
    assert [label for label in labels if label.startswith("left")] == [
        f"left.{q}" for q in ("fx", "fy", "skew", "cx", "cy", "k1", "k2", "p1", "p2")
    ]


def test_what_the_session_asks_for_is_estimated():
    session, _ = observe(scene(lens=LENS))
    infos = (
        replace(session.cameras[0], skew=False, lens=("k1",)),
        replace(session.cameras[1], lens=("k1", "k2"), lens_model="rational"),
    )
    result = calibrate_session_cameras(replace(session, cameras=infos))
    left, right = result.cameras
    assert left.intrinsics.skew == 0
    np.testing.assert_array_equal(left.lens.coefficients[1:], 0)
    assert right.lens.model == "rational"
    np.testing.assert_array_equal(right.lens.coefficients[2:], 0)
    assert "left.skew" not in result.covariance.labels
    assert "right.k2" in result.covariance.labels


def test_noisy_session_is_as_good_as_it_says():
    scores, chi2, dof = [], 0.0, 0
    gain = []
    for seed in range(8):
        geometry = reference_geometry(np.random.default_rng([seed, 1]))
        session, truth = observe(geometry, seed, marker_radii=RADII)
        result = calibrate_session_cameras(session)
        scores.append(nees(result, truth))
        chi2, dof = chi2 + result.chi2, dof + result.dof
        alone = result.details["separate"][0]
        gain.append(
            abs(alone.camera.intrinsics.fx - truth.cameras[0].intrinsics.fx)
            / alone.covariance.std("left.fx")
        )
    # 8 trials of 16 unknowns: the mean score spreads by 0.13, chi2 / dof by 0.05.
    assert np.mean(scores) == pytest.approx(1, abs=0.4)
    assert chi2 / dof == pytest.approx(1, abs=0.15)
    assert np.max(gain) < 3.5


BOTH = (("normal", "normal"), ("normal", "BC"), ("CA", "AB"))


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("axes", BOTH)
def test_exact_half_turns_of_both_mounts(axes, count):
    session, truth = observe(two_feet(count=count, axes=axes), sigma_px=0.0, robot=None)
    result = calibrate_session_cameras(session)
    np.testing.assert_allclose(errors(result, truth), 0, atol=1e-7)
    places, poses = true_motions(truth, session.mounts)
    np.testing.assert_allclose(
        result.details["reference_from_triangle"], poses, atol=1e-9
    )
    for i, one in enumerate(result.details["separate"]):
        np.testing.assert_allclose(
            one.camera.intrinsics.vector,
            truth.cameras[i].intrinsics.vector,
            atol=1e-6,
        )
        assert one.chi2 < 1e-10


@pytest.mark.parametrize("seed", range(3, 9))
def test_exact_spheres_on_both_mounts_settle(seed):
    # What is left of the eccentricity weighs far more than rounding and cannot go.
    geometry = two_feet(seed, axes=("normal", "BC"), half_turns=12)
    session, truth = observe(
        geometry, sigma_px=0.0, robot=None, marker_radii=(0.008,) * 3
    )
    result = calibrate_session_cameras(session)
    sigma = 0.015 * np.sqrt(np.diagonal(result.covariance.matrix))
    np.testing.assert_allclose(errors(result, truth) / sigma, 0, atol=0.01)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("axes", BOTH[:2])
def test_noisy_half_turns_of_both_mounts_are_as_good_as_they_say(axes, count):
    scores, chi2, dof = [], 0.0, 0
    for seed in range(8):
        session, truth = observe(
            two_feet(seed, count, axes=axes, half_turns=12), seed, marker_radii=RADII
        )
        result = calibrate_session_cameras(session)
        assert not result.details["dropped"]
        scores.append(nees(result, truth))
        chi2, dof = chi2 + result.chi2, dof + result.dof
    # 8 trials of 5 or 16 unknowns: the mean score spreads by 0.22 or 0.13; chi2 / dof
    # of 8 trials of some 60 by 0.065.
    assert np.mean(scores) == pytest.approx(1, abs=0.66 if count == 1 else 0.4)
    assert chi2 / dof == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize("correlation", [0.0, 0.75])
def test_correlation_on_the_axis_is_found(correlation):
    found = []
    for seed in range(4):
        geometry = scene(seed, axis="CA", half_turns=11)
        exact, _ = observe(geometry, sigma_px=0.0)
        rng = np.random.default_rng([seed, 8])
        noise = rng.standard_normal(exact.pixels.shape)
        common = rng.standard_normal(exact.pixels.shape)
        for turn in exact.half_turns:
            for j in (turn.before, turn.after):
                mine = noise[:, j, [2, 0]] * np.sqrt(1 - correlation)
                same = common[:, turn.before, [2, 0]] * np.sqrt(correlation)
                noise[:, j, [2, 0]] = mine + same
        session = replace(
            exact,
            pixels=exact.pixels + 0.015 * noise,
            pixel_covariance=exact.pixel_covariance * 0.015**2,
        )
        result = calibrate_session_cameras(session)
        found.append(result.details["on_axis_correlation"])
    # 88 pairs of coordinates, half of them spent on poses: 0.1 to 0.15 each.
    assert np.mean(found) == pytest.approx(correlation, abs=0.2)


def test_no_correlation_where_no_marker_is_on_the_axis():
    session, _ = observe(scene())
    assert calibrate_session_cameras(session).details["on_axis_correlation"] == 0


def test_separate_stereo_motion_is_kept():
    session, truth = observe(scene(half_turns=11))
    result = calibrate_session_cameras(session)
    places, _ = true_motions(truth)
    separate = result.details["separate_reference_from_camera"]
    assert len(separate) == 2
    np.testing.assert_array_equal(separate[0].matrix, np.eye(4))
    before = np.linalg.norm((separate[1].inverse() @ places[1]).log())
    after = np.linalg.norm(
        (result.reference_from_camera[1].inverse() @ places[1]).log()
    )
    assert after < before < 0.01


def test_shift_that_was_removed():
    session, truth = observe(scene(), sigma_px=0.0, robot=None, marker_radii=RADII)
    points, _ = observe(scene(), sigma_px=0.0, robot=None)
    shift = calibrate_session_cameras(session).details["sphere_shift"]
    np.testing.assert_allclose(session.pixels - points.pixels, shift, atol=1e-6)
    assert np.abs(shift).max() > 0.01
    dots, _ = observe(scene(), sigma_px=0.0, robot=None)
    assert not calibrate_session_cameras(dots).details["sphere_shift"].any()


def test_evaluation_stations_are_not_read():
    geometry = reference_geometry(np.random.default_rng(0))
    session, _ = observe(geometry, marker_radii=RADII)
    held_out = session.indices("evaluation")
    assert len(held_out) == 6
    pixels = session.pixels.copy()
    pixels[:, held_out] += 50.0
    result = calibrate_session_cameras(session)
    spoilt = calibrate_session_cameras(replace(session, pixels=pixels))
    np.testing.assert_array_equal(result.covariance.matrix, spoilt.covariance.matrix)
    assert np.isnan(result.residuals[:, held_out]).all()
    assert np.isfinite(result.residuals[:, session.indices("calibration")]).all()


def test_missing_views_and_stations_without_a_partner():
    session, truth = observe(scene(half_turns=9), sigma_px=0.0, robot=None)
    pixels = session.pixels.copy()
    pixels[0, 1] = np.nan  # half-turn 0 incomplete in the left view
    pixels[:, 3] = np.nan  # half-turn 1 without its second station in any view
    pixels[1, 4, 2] = np.nan
    result = calibrate_session_cameras(replace(session, pixels=pixels))
    np.testing.assert_allclose(errors(result, truth), 0, atol=1e-6)
    used = result.details["used"].tolist()
    assert 3 not in used
    # Station 2 has lost its partner but is triangulated; 0 too.
    assert 2 in used
    assert 0 in used


def test_cameras_that_see_each_other_through_a_third():
    session, truth = observe(scene(count=3, half_turns=12), sigma_px=0.0, robot=None)
    pixels = session.pixels.copy()
    pixels[0, 12:] = np.nan
    pixels[1, :12] = np.nan
    result = calibrate_session_cameras(replace(session, pixels=pixels))
    np.testing.assert_allclose(errors(result, truth), 0, atol=1e-5)


def test_turn_covariance_by_sampling():
    rng = np.random.default_rng(0)
    robot = Repeatability(3e-5, 1e-4)
    sigma = np.sqrt(np.diagonal(robot.covariance))
    flange_from_triangle = SE3.exp([0, 0, 0.1, 0, 0, 0])
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    first = se3_exp(sigma * rng.standard_normal((20000, 6)))
    second = turn @ se3_exp(sigma * rng.standard_normal((20000, 6)))
    executed = se3_inverse(turn) @ se3_inverse(first) @ second
    missed = se3_log(executed) @ se3_adjoint(flange_from_triangle.inverse().matrix).T
    sampled = np.diagonal(np.cov(missed.T))
    stated = np.diagonal(turn_covariance(robot))
    # The lever acts on two of three directions; stated is the larger for the third.
    np.testing.assert_allclose(
        sampled[[0, 1, 3, 4, 5]], stated[[0, 1, 3, 4, 5]], rtol=0.05
    )
    assert sampled[2] < stated[2]


def swapped(pixels, truth, session, turn):
    pixels[1, turn.after] = pixels[1, turn.after, [1, 0, 2]]
    return ["right"], "labels exchanged after it: its A, B, C are B, A, C"


def moved_point(pixels, truth, session, turn):
    pixels[0, turn.before, 2] += (3.0, -4.0)
    return ["left"], "marker C before it is 5.0 px off"


def repeated(pixels, truth, session, turn):
    pixels[0, turn.after] = pixels[0, turn.before]
    return ["left"], "same image|unturned"


def turned_by_170(pixels, truth, session, turn):
    _, poses = true_motions(truth)
    angle = np.radians(170.0)
    edge = session.triangle.points[0] - session.triangle.points[2]
    along = edge / np.linalg.norm(edge)
    motion = np.eye(4)
    motion[:3, :3] = so3_exp(along * angle)
    motion[:3, 3] = session.triangle.points[2]
    motion[:3, 3] -= motion[:3, :3] @ session.triangle.points[2]
    places, _ = true_motions(truth)
    seen = poses[turn.before] @ motion
    points = session.triangle.points @ seen[:3, :3].T + seen[:3, 3]
    for i, (camera, place) in enumerate(zip(truth.cameras, places, strict=True)):
        pixels[i, turn.after] = camera.project(place.inverse().apply(points))
    return ["left", "right"], r"a turn of 1(69|70)\.\d \+- \S+ degrees, not 180"


@pytest.mark.parametrize("damage", [swapped, moved_point, repeated, turned_by_170])
def test_a_bad_half_turn_is_named_and_does_no_harm(damage):
    session, truth = observe(scene(axis="CA"), sigma_px=0.03)
    pixels, turn = session.pixels.copy(), session.half_turns[5]
    names, why = damage(pixels, truth, session, turn)
    bad = replace(session, pixels=pixels)
    result = calibrate_session_cameras(bad)
    dropped = result.details["dropped"]
    assert [(one.camera, one.half_turn) for one in dropped] == [(n, 5) for n in names]
    for one in dropped:
        assert (one.before, one.after) == (turn.before, turn.after)
        assert re.search(why, one.why)
        assert f"half-turn 5 (stations {turn.before} and {turn.after})" in str(one)
    rest = bad.without(dropped)
    lost = [[info.name for info in session.cameras].index(n) for n in names]
    assert np.isnan(rest.pixels[lost][:, [turn.before, turn.after]]).all()
    clean = calibrate_session_cameras(rest)
    assert clean.details["dropped"] == ()
    np.testing.assert_allclose(
        errors(result, truth), errors(clean, truth), rtol=1e-6, atol=1e-9
    )
    assert result.chi2 / result.dof < 1.5
    assert calibrate_hand_eye(rest, result).chi2 > 0


@pytest.mark.parametrize("damage", [swapped, moved_point, repeated])
def test_a_bad_half_turn_of_the_second_mount_is_named(damage):
    session, truth = observe(two_feet(half_turns=12), sigma_px=0.03)
    pixels, turn = session.pixels.copy(), session.half_turns[9]
    names, why = damage(pixels, truth, session, turn)
    result = calibrate_session_cameras(replace(session, pixels=pixels))
    (dropped,) = result.details["dropped"]
    assert (dropped.camera, dropped.half_turn) == (names[0], 9)
    assert re.search(why, dropped.why)


def test_healthy_sessions_lose_nothing():
    for seed in range(6):
        axis = ("normal", "CA", "AB")[seed % 3]
        session, _ = observe(scene(seed, axis=axis), seed, marker_radii=RADII)
        assert calibrate_session_cameras(session).details["dropped"] == ()


def test_a_robot_that_repeats_worse_than_stated_is_no_outlier():
    worse = Repeatability(3e-4, 5e-4)
    session, _ = observe(scene(1), 1, robot=worse)
    session = replace(session, repeatability=Repeatability(3e-5, 5e-5))
    assert calibrate_session_cameras(session).details["dropped"] == ()


def test_views_of_a_camera_that_is_not_there():
    session, _ = observe(scene())
    with pytest.raises(InputError, match="no camera 'top', only left, right"):
        session.without([DroppedHalfTurn("top", 0, 0, 1, "")])


class TestRefusals:
    def test_no_half_turns(self):
        session, _ = observe(scene())
        with pytest.raises(DegenerateMotionError, match="no half_turns"):
            calibrate_session_cameras(replace(session, half_turns=()))

    def test_camera_that_saw_too_little(self):
        session, _ = observe(scene(half_turns=4))
        pixels = session.pixels.copy()
        pixels[1, [1, 2], 0] = np.nan
        with pytest.raises(DegenerateMotionError) as caught:
            calibrate_session_cameras(replace(session, pixels=pixels))
        for part in ("'right'", "only 2 of 4", "at least 3"):
            assert part in str(caught.value)

    @pytest.mark.parametrize(
        ("camera", "index", "value", "message"),
        [
            (1, np.s_[:], np.nan, "'right' saw all three.*only 0 of 8"),
            (0, np.s_[:, 1], (300.0, 200.0), None),
            (0, np.s_[:, 2], (9000.0, 5.0), "'left'.*outside the 1024 x 768 image"),
        ],
    )
    def test_camera_whose_points_cannot_be_used(self, camera, index, value, message):
        session, _ = observe(scene())
        pixels = session.pixels.copy()
        pixels[camera][index] = value
        if message is None:
            pixels[camera, :, 0] = pixels[camera, :, 1]
            message = "'left': markers A and B before half-turn 0 are 0.000 px apart"
        with pytest.raises((InputError, DegenerateMotionError), match=message):
            calibrate_session_cameras(replace(session, pixels=pixels))

    def test_wrong_image_size_and_wrong_triangle(self):
        session, _ = observe(scene())
        infos = tuple(replace(info, image_size=(100, 80)) for info in session.cameras)
        with pytest.raises(InputError, match=r"'left'.*outside the 100 x 80 image"):
            calibrate_session_cameras(replace(session, cameras=infos))
        wrong = TriangleRig(1.0, 0.1, 0.3)
        with pytest.raises(HandEyeError, match="camera 'left'.*triangle"):
            calibrate_session_cameras(replace(session, triangle=wrong))

    def test_camera_that_shares_nothing(self):
        session, _ = observe(scene(half_turns=12))
        pixels = session.pixels.copy()
        pixels[0, 12:] = np.nan
        pixels[1, :12] = np.nan
        with pytest.raises(DegenerateMotionError, match="'right' shares no whole"):
            calibrate_session_cameras(replace(session, pixels=pixels))

    def test_message_of_one_camera_names_it(self):
        session, _ = observe(scene(half_turns=4))
        # The right view shows the triangle unturned.
        pixels = session.pixels.copy()
        pixels[1, 1::2] = pixels[1, ::2]
        with pytest.raises(DegenerateMotionError, match="camera 'right': half-turn"):
            calibrate_session_cameras(replace(session, pixels=pixels))
