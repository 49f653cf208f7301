"""Two calibrations of one cell: chance against change, part by part."""

import dataclasses

import numpy as np
import pytest
from finished_session import finished
from scipy import stats

from handeye_tri.adjustment import adjust
from handeye_tri.camera import Intrinsics, PinholeCamera
from handeye_tri.errors import InputError
from handeye_tri.evaluate import part_changes, placement_change
from handeye_tri.evaluate.change import FALSE_ALARMS
from handeye_tri.records import MARKER_LABELS, Covariance, motion_labels
from handeye_tri.se3 import SE3


@pytest.fixture(scope="module")
def calibrated():
    """Jointly adjusted: its covariance has the markers one by one."""
    done = finished()
    return adjust(done.session, done.calibration)


def drawn(calibration, rng):
    """The same cell calibrated again: errors drawn from the covariance."""
    labels = list(calibration.covariance.labels)
    step = rng.multivariate_normal(
        np.zeros(len(labels)), calibration.covariance.matrix, method="eigh"
    )
    at = dict(zip(labels, step, strict=True))

    def moved(name, motion):
        return motion @ SE3.exp([at[label] for label in motion_labels(name)])

    cameras = tuple(
        PinholeCamera(
            camera.name,
            Intrinsics(
                *(
                    camera.parameter(name) + at.get(f"{camera.name}.{name}", 0.0)
                    for name in ("fx", "fy", "skew", "cx", "cy")
                )
            ),
            camera.image_size,
            camera.lens,
        )
        for camera in calibration.cameras
    )
    return dataclasses.replace(
        calibration,
        cameras=cameras,
        base_from_camera=tuple(
            moved(f"base_from_{camera.name}", motion)
            for camera, motion in zip(
                cameras, calibration.base_from_camera, strict=True
            )
        ),
        flange_from_triangle=moved(
            "flange_from_triangle", calibration.flange_from_triangle
        ),
        markers=calibration.markers
        + np.reshape([at[label] for label in MARKER_LABELS], (3, 3)),
    )


def test_chance_alone_has_its_theoretical_distribution(calibrated):
    """chi2 has its mean, p-values are even, and alarms are as rare as stated."""
    rng, trials = np.random.default_rng(5), 300
    changes = [
        part_changes(drawn(calibrated, rng), drawn(calibrated, rng))
        for _ in range(trials)
    ]
    for parts in zip(*changes, strict=True):
        dof = parts[0].dof
        mean = np.mean([part.chi2 for part in parts])
        assert mean == pytest.approx(dof, abs=4 * np.sqrt(2 * dof / trials))
        even = stats.kstest([part.p_value for part in parts], "uniform")
        assert even.pvalue > 1e-4
    alarms = sum(any(part.changed for part in parts) for parts in changes)
    assert alarms <= stats.binom.ppf(0.9999, trials, FALSE_ALARMS)


def test_parts_and_their_freedom(calibrated):
    parts = part_changes(calibrated, calibrated)
    assert [(p.part, p.camera, p.dof) for p in parts] == [
        ("intrinsics", "left", 5),
        ("intrinsics", "right", 5),
        ("place", "left", 6),
        ("place", "right", 6),
        ("between", "right", 6),
        ("rig", "", 9),
    ]
    assert not any(part.changed for part in parts)
    assert max(part.chi2 for part in parts) < 1e-12  # rounding of after less before


def changed_parts(before, after):
    return {(p.part, p.camera) for p in part_changes(before, after) if p.changed}


def test_what_moved_is_named_and_nothing_else(calibrated):
    before = drawn(calibrated, np.random.default_rng(1))
    after = drawn(calibrated, np.random.default_rng(2))
    left, right = after.base_from_camera
    knock = SE3.exp([2e-3, 0, 0, 0, 5e-3, 0])
    one = dataclasses.replace(after, base_from_camera=(left @ knock, right))
    assert changed_parts(before, one) == {("place", "left"), ("between", "right")}
    (place,) = (p for p in part_changes(before, one) if p.camera == "left" and p.moved)
    assert place.moved == pytest.approx(2e-3, rel=0.2)
    assert place.turned == pytest.approx(5e-3, rel=0.2)
    # Moved alike, as where the robot's base moved: not against each other.
    both = dataclasses.replace(after, base_from_camera=(knock @ left, knock @ right))
    assert changed_parts(before, both) == {("place", "left"), ("place", "right")}
    rig = dataclasses.replace(after, markers=after.markers + [0, 0, 1e-3])
    assert changed_parts(before, rig) == {("rig", "")}
    k = after.cameras[1].intrinsics
    zoomed = PinholeCamera(
        "right",
        Intrinsics(1.005 * k.fx, 1.005 * k.fy, k.skew, k.cx, k.cy),
        after.cameras[1].image_size,
        after.cameras[1].lens,
    )
    lens = dataclasses.replace(after, cameras=(after.cameras[0], zoomed))
    assert changed_parts(before, lens) == {("intrinsics", "right")}


def test_placement_by_the_older_calibration(calibrated):
    """A shift of both cameras is seen in full; noise scatters as predicted."""
    points = finished().track.observed
    same = placement_change(calibrated, calibrated, points)
    assert same.points == len(points)
    assert same.rms == pytest.approx(0, abs=1e-9)
    shift = SE3.exp([0, 3e-3, 0, 0, 0, 0])
    shifted = tuple(shift @ motion for motion in calibrated.base_from_camera)
    moved = dataclasses.replace(calibrated, base_from_camera=shifted)
    seen = placement_change(calibrated, moved, shift.apply(points))
    assert seen.rms == pytest.approx(3e-3, rel=1e-6)
    assert seen.max == pytest.approx(3e-3, rel=1e-6)
    rng = np.random.default_rng(3)
    drawn_rms = [
        placement_change(drawn(calibrated, rng), drawn(calibrated, rng), points).rms
        for _ in range(200)
    ]
    # Six or so free directions in a place's error: 200 draws know it to 5 %.
    assert np.sqrt(np.mean(np.square(drawn_rms))) == pytest.approx(
        same.expected_rms, rel=0.15
    )


def test_places_that_no_two_cameras_see_are_refused(calibrated):
    with pytest.raises(InputError, match="seen by two cameras"):
        placement_change(calibrated, calibrated, np.full((2, 3), 50.0))


def test_other_unknowns_are_refused(calibrated):
    less = calibrated.covariance.labels[1:]
    other = dataclasses.replace(
        calibrated, covariance=Covariance(less, calibrated.covariance.block(less))
    )
    with pytest.raises(InputError, match=r"same unknowns \(left.fx"):
        part_changes(calibrated, other)
