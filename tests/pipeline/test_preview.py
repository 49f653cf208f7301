"""The recording of a plan: the arm on its way, and what the cameras will see."""

import numpy as np
import pytest
from PIL import Image

from handeye_tri import simulate, storage
from handeye_tri.cli import main
from handeye_tri.errors import InputError, MissingDependencyError
from handeye_tri.pipeline import NullProgress, Run
from handeye_tri.pipeline.preview import driven, reduced
from handeye_tri.plan.sequence import travel_time
from handeye_tri.replay import PlannedMotion, screenshot
from handeye_tri.replay.engine import RrdReader


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("preview") / "out"
    with pytest.raises(SystemExit):
        main(["plan", str(folder), "--cell", "hp3_stereo", "--half-turns", "3"])
    return Run(storage.SessionFolder.open(folder), NullProgress())


def in_time(run):
    plan, arm = run.plan(), run.arm
    return driven(plan, arm.home, arm.speed, run.cell.arm.acceleration_time_s)


def test_the_arm_keeps_its_limits_and_the_stated_time(run):
    plan, arm = run.plan(), run.arm
    times, joints, station, mounts = in_time(run)
    assert not mounts.any()
    assert (np.diff(times) > 0).all()
    standing = len(plan.stations) * 1.0
    assert times[-1] - standing == pytest.approx(plan.certificate["cycle_time_s"])
    rates = np.abs(np.diff(joints, axis=0)) / np.diff(times)[:, None]
    assert (rates <= 1.001 * arm.speed).all()
    # Somewhere a joint is as fast as it may be.
    assert (rates / arm.speed).max() > 0.95
    jumps = np.diff(rates, axis=0) / np.diff(times)[1:, None]
    assert (np.abs(jumps) <= 2.1 * arm.speed / 0.3).all()
    for j, stop in enumerate(plan.stations):
        np.testing.assert_array_equal(joints[station == j], [stop.joints] * 2)


def test_ways_are_straight_and_pass_their_points():
    from types import SimpleNamespace

    home, speed = np.zeros(2), np.array([1.0, 2.0])
    stop = SimpleNamespace(joints=np.array([1.0, -1.0]), mount=0)
    via = np.array([[0.5, 0.5]])
    plan = SimpleNamespace(
        stations=(stop, stop), via=(via, np.zeros((0, 2))), tool_change=None
    )
    times, joints, station, _ = driven(plan, home, speed, 0.3)
    at = int(np.argmin(np.linalg.norm(joints - via[0], axis=1)))
    np.testing.assert_allclose(joints[at], via[0], atol=1e-12)
    expected = travel_time(home, via[0], speed, 0.3)
    assert times[at] == pytest.approx(expected)
    np.testing.assert_allclose(joints[:at, 0], joints[:at, 1], atol=1e-12)
    # A station where the arm stands already takes no move.
    assert (station >= 0).sum() == 4
    assert times[-1] == pytest.approx(
        expected + travel_time(via[0], stop.joints, speed, 0.3) + 2.0
    )


def test_images_hold_what_the_plan_promises(run):
    times, joints, station, mounts = in_time(run)
    cell, arm = run.designed_cell, run.arm
    motion = PlannedMotion(
        run.plan(), times, station, mounts, ("the only",), arm.body_poses(joints),
        arm.marker_positions(joints), tuple(c.camera for c in cell.cameras),
        tuple(arm.base_from_world @ c.world_from_camera for c in cell.cameras),
        np.array(cell.rig.marker_colours),
    )  # fmt: skip
    seen = motion.images()
    assert np.isfinite(seen[:, station >= 0]).all()
    assert np.isnan(seen[:, station < 0]).any()
    with pytest.raises(InputError, match="never stands at station 0"):
        PlannedMotion(
            run.plan(), times, np.full(len(times), -1), mounts, ("the only",),
            motion.world_from_body, motion.markers, motion.cameras,
            motion.base_from_camera, motion.marker_colours,
        )  # fmt: skip


def test_it_is_drawn_without_a_view_error(run, tmp_path):
    picture = tmp_path / "picture.png"
    assert screenshot(run.folder.file("plan.rrd"), picture, station=3) == []
    drawn = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    # Rings of a station that is used are blue; the triangle's lines are white.
    blue = (np.abs(drawn - (64, 156, 255)).max(axis=-1) < 40).mean()
    assert blue > 1e-3
    other = tmp_path / "other.png"
    with pytest.raises(InputError, match="station 99 is not in"):
        screenshot(run.folder.file("plan.rrd"), other, station=99)


def entities(path):
    chunks = RrdReader(path).stream().to_chunks()
    return {str(chunk.entity_path) for chunk in chunks}


def test_views_are_rendered_once_a_station_and_small(run):
    path = run.folder.file("plan.rrd")
    images = [
        chunk
        for chunk in RrdReader(path).stream().to_chunks()
        if str(chunk.entity_path).endswith("left/image")
        and any("Image" in str(name) for name in chunk.to_record_batch().schema.names)
    ]
    assert sum(chunk.num_rows for chunk in images) >= len(run.plan().stations)
    assert path.stat().st_size < 2**21


def test_a_smaller_camera_sees_the_same(run):
    cell = run.designed_cell
    small = reduced(cell)
    rng = np.random.default_rng(0)
    for one, other in zip(cell.cameras, small.cameras, strict=True):
        assert other.image_size_px == (512, 384)
        points = np.append(rng.uniform(-0.2, 0.2, (20, 2)), np.ones((20, 1)), axis=1)
        np.testing.assert_allclose(
            other.camera.project(points),
            (one.camera.project(points) + 0.5) / 2 - 0.5,
            atol=1e-9,
        )


def test_without_opengl_views_are_outlines_and_the_user_is_told(
    run, monkeypatch, tmp_path, capsys
):
    def refuse():
        raise MissingDependencyError("no OpenGL here; install it")

    monkeypatch.setattr(simulate, "check_rendering", refuse)
    rendered = entities(run.folder.file("plan.rrd"))
    run.folder.file("plan.rrd").rename(tmp_path / "plan.rrd")
    with pytest.raises(SystemExit):
        main(["plan", str(run.folder.path)])
    outlined = entities(run.folder.file("plan.rrd"))
    (tmp_path / "plan.rrd").rename(run.folder.file("plan.rrd"))
    assert "its views are outlines: no OpenGL here" in capsys.readouterr().err
    gone = {name for name in rendered - outlined}
    assert {name.rsplit("/", 2)[-2] for name in gone} == {"left", "right"}
    assert {name.rsplit("/", 1)[-1] for name in gone} == {"image"}


def test_timelines_are_time_and_station(run):
    chunks = RrdReader(run.folder.file("plan.rrd")).stream().to_chunks()
    timelines = {name for chunk in chunks for name in chunk.timeline_names}
    assert timelines == {"time", "station"}


def test_a_session_without_a_plan_recording_says_so(run, capsys, tmp_path):
    run.folder.file("plan.rrd").rename(tmp_path / "plan.rrd")
    with pytest.raises(SystemExit) as left:
        main(["replay", str(run.folder.path), "--plan", "--screenshot", "x.png"])
    (tmp_path / "plan.rrd").rename(run.folder.file("plan.rrd"))
    assert left.value.code == 2
    assert f"handeye-tri plan {run.folder.path}" in capsys.readouterr().err


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    folder = tmp_path_factory.mktemp("preview_both") / "out"
    with pytest.raises(SystemExit):
        main(["plan", str(folder), "--cell", "hp3_stereo_both", "--half-turns", "4"])
    return Run(storage.SessionFolder.open(folder), NullProgress())


def test_the_arm_waits_at_home_while_the_tool_is_changed(both):
    plan, arm = both.plan(), both.arm
    times, joints, station, mounts = in_time(both)
    (changed,) = np.flatnonzero(np.diff(mounts)) + 1
    np.testing.assert_array_equal(joints[changed], arm.home)
    np.testing.assert_array_equal(joints[changed - 1], arm.home)
    before = plan.tool_change.before
    assert station[:changed].max() == before - 1
    assert station[changed:][station[changed:] >= 0].min() == before
    standing = len(plan.stations) * 1.0 + 2.0
    assert times[-1] - standing == pytest.approx(plan.certificate["cycle_time_s"])


def test_each_station_is_seen_with_its_mount(both):
    """The holder in the recording, the words, and markers inside every image."""
    reader = RrdReader(both.folder.file("plan.rrd"))
    chunks = list(reader.stream().to_chunks())
    logged = [
        text
        for chunk in chunks
        if str(chunk.entity_path) == "/log"
        for text in chunk.to_record_batch().column("TextLog:text").to_pylist()
    ]
    said = [text for texts in logged for text in texts]
    assert said.count("tool change: mount 2 (about its edge BC)") == 1
    holders = {
        str(chunk.entity_path).split("/mount_")[1][0]
        for chunk in chunks
        if "/mount_" in str(chunk.entity_path)
    }
    assert holders == {"1", "2"}
    images = sum(
        chunk.num_rows
        for chunk in chunks
        if str(chunk.entity_path).endswith("left/image")
        and any("Image" in str(n) for n in chunk.to_record_batch().schema.names)
    )
    assert images >= len(both.plan().stations)
