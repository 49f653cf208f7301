"""Sessions whose triangle changes its mount: each has markers of its own."""

from dataclasses import replace

import adjust_scene
import numpy as np
import pytest

from handeye_tri.adjustment import Loss, adjust, clock_offset
from handeye_tri.calibrate_cameras import calibrate_session_cameras
from handeye_tri.errors import DegenerateMotionError, InputError
from handeye_tri.evaluate import compare_with_truth, evaluate_track
from handeye_tri.hand_eye import calibrate_hand_eye
from handeye_tri.se3 import SE3
from handeye_tri.synthesize import synthesize, two_mount_geometry


@pytest.mark.parametrize("lens", [None, adjust_scene.LENS])
@pytest.mark.parametrize("axes", [("normal", "BC"), ("CA", "normal"), ("AB", "BC")])
@pytest.mark.parametrize("count", [1, 2])
def test_exact_pixels_give_the_exact_cell_by_every_step(axes, count, lens):
    geometry = two_mount_geometry(np.random.default_rng(0), axes=axes, lens=lens)
    geometry = replace(
        geometry,
        cameras=geometry.cameras[:count],
        base_from_camera=geometry.base_from_camera[:count],
    )
    session, truth = synthesize(geometry, np.random.default_rng(1), sigma_px=0.0)
    separate = calibrate_hand_eye(session, calibrate_session_cameras(session))
    joint = adjust(session, separate)
    for found in (separate, joint):
        for row in compare_with_truth(found, truth):
            pixels = row.quantity.split(".")[0] in ("left", "right")
            assert abs(row.error) < (1e-7 if pixels else 1e-9), row
        for mine, true in zip(found.other_mounts, truth.other_mounts, strict=True):
            np.testing.assert_allclose(mine.markers, true.markers, atol=1e-9)
        assert evaluate_track(found, session).max < 1e-9


def test_a_second_mount_has_labels_of_its_own_in_order():
    session, _, start = adjust_scene.cell(
        0, axes=("normal", "BC"), sigma_px=0.1, half_turns=4
    )
    found = adjust(session, start)
    owners = list(dict.fromkeys(x.split(".")[0] for x in found.covariance.labels))
    first = ["flange_from_triangle", "marker_A", "marker_B", "marker_C"]
    assert owners[-8:] == [*first, *(f"{owner}_2" for owner in first)]
    (second,) = found.other_mounts
    # The frame of each mount's triangle is built on its own markers.
    local = second.flange_from_triangle.inverse().apply(second.markers)
    assert np.abs(local[0]).max() < 1e-12
    assert np.abs(local[1, 1:]).max() < 1e-12
    assert local[2, 1] > 0
    assert abs(local[2, 2]) < 1e-12


def test_both_mounts_together_tell_more_of_the_cameras_than_each_alone():
    session, _, start = adjust_scene.cell(0, axes=("normal", "BC"), sigma_px=0.0)
    session = replace(session, repeatability=adjust_scene.ROBOT)
    both = adjust(session, start, on_axis_correlation=0.3)
    shared = [
        label
        for label in both.covariance.labels
        if label.startswith(("left", "right", "base_from"))
    ]
    std = np.sqrt(np.diagonal(both.covariance.block(shared)))
    total = np.zeros((len(shared), len(shared)))
    for mount in (0, 1):
        hidden = np.zeros(session.pixels.shape[:3], dtype=bool)
        hidden[:, session.mounts != mount] = True
        # Stations with the other mount say nothing then, so its markers are left out.
        alone = replace(
            adjust_scene.hide(session, hidden),
            stations=tuple(replace(s, mount=0) for s in session.stations),
        )
        chosen = start.mounts[mount]
        single = adjust(
            alone,
            replace(
                start,
                flange_from_triangle=chosen.flange_from_triangle,
                markers=chosen.markers,
                other_mounts=(),
            ),
            on_axis_correlation=0.3,
        )
        own = single.covariance.block(shared)
        assert (np.diagonal(own) > 1.2 * std**2).all()
        total += np.linalg.inv(own / np.outer(std, std))
    # Each mount's markers eliminated, what the mounts tell of the cameras adds up.
    np.testing.assert_allclose(
        np.linalg.inv(total), both.covariance.block(shared) / np.outer(std, std),
        atol=1e-6,
    )  # fmt: skip


def test_a_mount_that_shows_too_little_is_named():
    session, _, start = adjust_scene.cell(
        0, axes=("normal", "BC"), sigma_px=0.1, half_turns=4
    )
    hidden = np.zeros(session.pixels.shape[:3], dtype=bool)
    hidden[:, session.mounts == 1] = True
    with pytest.raises(InputError, match="mount 2 .* at 0 calibration stations.*add"):
        adjust(adjust_scene.hide(session, hidden), start)
    hidden[0, 11, 1] = False
    with pytest.raises(InputError, match="mount 2 .* at 1 calibration station,"):
        adjust(adjust_scene.hide(session, hidden), start)
    hidden[0, 12:14, 1] = False
    with pytest.raises(DegenerateMotionError, match="on marker_A_2.x, .*marker_C_2.z;"):
        adjust(adjust_scene.hide(session, hidden), start)
    with pytest.raises(DegenerateMotionError, match="open: rig_2 trade"):
        adjust(adjust_scene.hide(session, hidden), start, side_sigma=0.0)
    with pytest.raises(InputError, match="start knows 1 mount .* have 2;"):
        adjust(session, replace(start, other_mounts=()))


def moved_robot(session, tangents):
    """The session as a robot reports it that stands off by tangents (n, 6)."""
    return replace(
        session,
        stations=tuple(
            replace(s, base_from_flange=s.base_from_flange @ SE3.exp(-tangent))
            for s, tangent in zip(session.stations, tangents, strict=True)
        ),
    )


def test_a_clock_offset_is_found_at_the_stations_of_both_mounts():
    session, truth, start = adjust_scene.cell(
        2, axes=("normal", "BC"), sigma_px=0.0, half_turns=5
    )
    rng = np.random.default_rng(4)
    # Some centimetres and degrees a second.
    twist = rng.normal(size=(len(session.stations), 6)) * np.repeat([0.05, 0.1], 3)
    late = moved_robot(session, 0.02 * twist)
    late = replace(late, repeatability=adjust_scene.ROBOT)
    found = adjust(late, start, robot_parameters=clock_offset(twist))
    sigma = found.covariance.std("clock.offset")
    # Pixels without noise, believed to 1 px: the parameter's prior hardly pulls.
    assert found.robot["clock.offset"] == pytest.approx(0.02, abs=0.1 * sigma)
    assert found.chi2 < 0.5
    without = adjust(late, start)
    assert without.chi2 > 20 * found.chi2
    for mine, true in zip(found.other_mounts, truth.other_mounts, strict=True):
        np.testing.assert_allclose(mine.markers, true.markers, atol=1e-4)


def test_residuals_are_in_the_frame_of_the_triangle_on_the_mount():
    session, truth, start = adjust_scene.cell(
        3, axes=("normal", "BC"), sigma_px=0.0, half_turns=6
    )
    tangents = np.zeros((len(session.stations), 6))
    off = np.array([1e-4, -2e-4, 1e-4, 1e-4, 3e-4, -2e-4])
    # A station of each mount.
    tangents[[3, 20]] = off
    reported = moved_robot(session, tangents)
    # A robot that is believed far more than the pixels: the cell hardly moves.
    strict = replace(reported, repeatability=adjust_scene.EXACT)
    hidden = np.zeros(session.pixels.shape[:3], dtype=bool)
    hidden[:, [3, 20]] = True
    clean = adjust(adjust_scene.hide(strict, hidden), start)
    assert clean.chi2 < 1e-12
    result = adjust(strict, clean, loss=Loss("cauchy", 1e-3))
    rigs = [truth.flange_from_triangle]
    rigs += [mount.flange_from_triangle for mount in truth.other_mounts]
    for j, rig in zip((3, 20), rigs, strict=True):
        row = result.residuals[result.details["stations"].tolist().index(j)]
        np.testing.assert_allclose(row, rig.inverse().adjoint() @ off, rtol=0.02)


@pytest.mark.parametrize("loss", [Loss("huber", 2.5), Loss("cauchy", 2.5)])
def test_wrong_detections_with_one_mount_do_not_spoil_the_other(loss):
    session, _, start = adjust_scene.cell(
        6, axes=("normal", "BC"), sigma_px=0.05, repeatability=adjust_scene.ROBOT
    )
    rng = np.random.default_rng(0)
    wrong = rng.random(session.pixels.shape[:3]) < 0.08
    wrong[:, (session.mounts == 0)] = False
    wrong[:, session.indices("evaluation")] = False
    pixels = session.pixels.copy()
    pixels[wrong] += rng.uniform(3, 8, size=(wrong.sum(), 2))
    spoiled = replace(session, pixels=pixels)
    clean, plain, robust = (
        evaluate_track(adjust(one, start, loss=how), session).rms
        for one, how in ((session, None), (spoiled, None), (spoiled, loss))
    )
    assert robust < 1.3 * clean
    assert robust < 0.5 * plain
