"""The recording: whole, the same each time, and equal to what was evaluated."""

import io
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from finished_session import (
    BASE_FROM_WORLD,
    evaluation,
    finished,
    finished_on_two_mounts,
    mechanism,
    photograph,
    world_from_body,
)
from PIL import Image
from rerun.chunk import RrdReader

from handeye_tri.diagnose import Finding
from handeye_tri.errors import InputError, StorageError
from handeye_tri.records import TrackEvaluation
from handeye_tri.replay import SolverStep, write_recording
from handeye_tri.replay.drawing import log_cell, log_mount
from handeye_tri.replay.engine import only_views, recorded, rrb
from handeye_tri.replay.recording import read_numbers
from handeye_tri.replay.story import tell
from handeye_tri.se3 import SE3


def write(path, **changes):
    done = finished()
    arguments = {
        "name": "test 1",
        "mechanisms": (mechanism(),),
        "world_from_body": world_from_body(done.session),
        "base_from_world": BASE_FROM_WORLD,
        "session": done.session,
        "photograph": photograph,
        "calibration": done.calibration,
        "track": done.track,
        "truth": done.truth,
        "evaluation": evaluation(done),
    }
    write_recording(path, **{**arguments, **changes})
    return done


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "replay.rrd"
    write(path)
    return path


def told():
    done = finished()
    return done.session, done.calibration, done.track, done.truth


def column(path, entity, component, timeline="station"):
    """Values by station; None is the key of what holds at all times."""
    found = {}
    for chunk in RrdReader(path).stream().filter(content=f"/{entity}").to_chunks():
        batch = chunk.to_record_batch()
        if component not in batch.schema.names:
            continue
        values = batch.column(component).to_pylist()
        names = batch.schema.names
        when = (
            batch.column(timeline).to_pylist()
            if timeline in names
            else [None] * len(values)
        )
        found.update(zip(when, values, strict=True))
    return found


def logged(path):
    """Lines of the log by station and level."""
    log = {}
    for chunk in RrdReader(path).stream().filter(content="/log").to_chunks():
        batch = chunk.to_record_batch()
        if "station" not in batch.schema.names:
            continue
        for station, text, level in zip(
            batch.column("station").to_pylist(),
            batch.column("TextLog:text").to_pylist(),
            batch.column("TextLog:level").to_pylist(),
            strict=True,
        ):
            log.setdefault((station, level[0]), []).append(text[0])
    return log


def test_the_held_out_track_reads_back_equal_to_the_bit(recording):
    track = finished().track
    numbers = read_numbers(recording)
    again = TrackEvaluation(
        np.array(numbers["stations"]),
        np.array(numbers["markers"]),
        np.array(numbers["reported_m"]),
        np.array(numbers["observed_m"]),
        np.array(numbers["predicted_covariance_m2"]),
    )
    for name in (
        "stations",
        "markers",
        "reported",
        "observed",
        "predicted_covariance",
        "distances",
    ):
        assert np.array_equal(getattr(again, name), getattr(track, name)), name
    assert numbers["mean_mm"] == 1e3 * track.mean
    assert numbers["rms_mm"] == 1e3 * track.rms
    assert numbers["max_mm"] == 1e3 * track.max
    assert numbers["predicted_rms_mm"] == 1e3 * track.predicted_rms


def test_the_plotted_errors_are_the_evaluated_ones_to_the_bit(recording):
    track = finished().track
    plotted = column(recording, "error_mm/held_out", "Scalars:scalars")
    assert sorted(plotted, key=str) == sorted(set(track.stations.tolist()), key=str)
    for row, distance in enumerate(track.distances):
        found = plotted[int(track.stations[row])][int(track.markers[row])]
        assert found == 1e3 * distance


def test_what_is_first_on_screen_is_the_worst_used_station(recording):
    story = tell(*told())
    shown = read_numbers(recording)["shown_station"]
    used = np.where(story.held_out[:, None], -np.inf, story.distances_mm)
    assert shown == story.shown == np.argmax(used.max(axis=1))
    text = column(recording, "verdict", "TextDocument:text")[None][0]
    marker, gap = story.worst(shown)
    assert f"station {shown}**" in text
    assert f"marker {marker} is {gap:.3f} mm off" in text


def test_findings_stand_in_the_log_at_their_stations(tmp_path):
    slip = Finding("SLIP", "the rig slipped", "1.2 mm", "error", "tighten it", (4, 6))
    few = replace(slip, code="FEW", severity="note", stations=(), follows="SLIP")
    path = tmp_path / "replay.rrd"
    findings = [asdict(slip), asdict(few)]
    write(path, evaluation={**evaluation(finished()), "findings": findings})
    log = logged(path)
    told_ = "SLIP the rig slipped (1.2 mm). Do: tighten it."
    assert told_ in log[4, "ERROR"]
    assert told_ in log[6, "ERROR"]
    assert (5, "ERROR") not in log
    (text,) = (text for text in log[0, "INFO"] if text.startswith("All stations: FEW"))
    assert text.endswith("(1.2 mm). Likely from SLIP.")
    # And each station's worst marker.
    marker, gap = tell(*told()).worst(5)
    assert f"used: {marker} {gap:.3f} mm" in log[5, "INFO"]


def test_frusta_slide_from_step_to_step_to_where_they_end(tmp_path):
    done = finished()
    off = SE3.exp([0.001, 0.0, -0.002, 0.0, 0.001, 0.0])
    moved = replace(
        done.calibration,
        base_from_camera=tuple(m @ off for m in done.calibration.base_from_camera),
    )
    path = tmp_path / "replay.rrd"
    steps = [SolverStep("closed form", moved)]
    write(path, steps=steps)
    story = tell(*told(), steps)
    where = "cell/base/estimate/left"
    places = column(path, where, "Transform3D:translation", "step")
    end = done.calibration.base_from_camera[0]
    drawn = end @ SE3.exp(story.magnification_slide * off.log())
    assert np.allclose(places[0][0], drawn.translation, atol=1e-6)
    assert np.allclose(places[1][0], end.translation, atol=1e-6)
    by_station = column(path, where, "Transform3D:translation")
    assert np.allclose(by_station[0][0], end.translation, atol=1e-6)
    assert story.slides[0].moved_mm == pytest.approx(1e3 * np.hypot(0.001, 0.002))
    assert story.slides[0].rms_px > 5 * story.slides[1].rms_px


def test_ellipsoids_hold_95_percent_of_the_cameras_errors(recording):
    story, covariance = tell(*told()), finished().calibration.covariance
    sizes = column(
        recording,
        "cell/base/uncertainty/left/ellipsoid",
        "Ellipsoids3D:half_sizes",
    )[None][0]
    assert np.allclose(sizes, story.ellipsoids[0].half_sizes, rtol=1e-6)
    block = covariance.block([f"base_from_left.{axis}" for axis in "xyz"])
    errors = np.random.default_rng(0).multivariate_normal(np.zeros(3), block, 20_000)
    turned = story.magnification_ellipsoid * errors @ story.ellipsoids[0].rotation
    inside = ((turned / story.ellipsoids[0].half_sizes) ** 2).sum(axis=1) <= 1
    assert inside.mean() == pytest.approx(0.95, abs=0.006)


def test_the_track_has_its_own_timeline(recording):
    stations = finished().session.indices("evaluation")
    path = f"cell/robot/{rr.escape_entity_path_part('link/1 t')}"
    moved = column(recording, path, "Transform3D:translation", "track")
    expected = world_from_body(finished().session)[stations, 2, :3, 3]
    for k, place in enumerate(expected):
        assert np.allclose(moved[k][0], place, atol=1e-6)


def test_letters_stand_at_the_ends_of_the_half_turn_lines(recording):
    labels = column(
        recording, "cell/base/estimate/left/half_turn/letters", "Points2D:labels"
    )
    assert labels[0] == ["A", "A'", "B", "B'", "C", "C'"]


def test_read_back_as_a_table_by_the_catalog(recording):
    """The way that a user reads a recording with rerun's own tools."""
    pytest.importorskip("datafusion")
    store = RrdReader(recording).stream().collect()
    table = store.reader(index="station", contents="/error_mm/**").to_pandas()
    held_out = table.dropna(subset=["/error_mm/held_out:Scalars:scalars"])
    values = np.array(held_out["/error_mm/held_out:Scalars:scalars"].tolist())
    track = finished().track
    assert values.max() == 1e3 * track.max


def test_bodies_stand_where_the_mechanism_puts_them(recording):
    session = finished().session
    path = f"cell/robot/{rr.escape_entity_path_part('link/1 t')}"
    moved = column(recording, path, "Transform3D:translation")
    expected = world_from_body(session)[:, 2, :3, 3]
    for j in range(len(session.stations)):
        # rerun keeps positions in 32 bits.
        assert np.allclose(moved[j][0], expected[j], atol=1e-6)


def test_every_shape_is_drawn(recording):
    drawn = " ".join(
        name
        for chunk in RrdReader(recording).stream().to_chunks()
        if "/surroundings/" in chunk.entity_path or "/robot/" in chunk.entity_path
        for name in chunk.to_record_batch().schema.names
    )
    for archetype in ("Boxes3D", "Cylinders3D", "Capsules3D", "Ellipsoids3D", "Mesh3D"):
        assert archetype in drawn


def test_what_is_seen_lies_on_the_image_by_rerun_s_pixel_corners(recording):
    """Our pixel (0, 0) is the first pixel's centre; rerun's is its corner."""
    session = finished().session
    rings = column(recording, "cell/base/estimate/left/seen", "LineStrips2D:strips")
    for k in range(3):
        centre = np.mean(rings[0][k][:-1], axis=0)
        assert np.allclose(centre, session.pixels[0, 0, k] + 0.5, atol=1e-3)


def test_images_are_stored_as_jpeg_of_the_same_picture(recording):
    blobs = column(recording, "cell/base/estimate/right/image", "EncodedImage:blob")
    assert len(blobs) == len(finished().session.stations)
    image = np.asarray(Image.open(io.BytesIO(bytes(blobs[4][0]))))
    assert image.shape == (768, 1024, 3)
    assert np.abs(image.astype(int) - photograph("right", 4)).mean() < 2


def test_grey_images_are_taken_too(tmp_path):
    def grey(camera, station):
        return photograph(camera, station)[..., 0]

    write(tmp_path / "grey.rrd", photograph=grey)
    blobs = column(
        tmp_path / "grey.rrd", "cell/base/estimate/left/image", "EncodedImage:blob"
    )
    assert np.asarray(Image.open(io.BytesIO(bytes(blobs[0][0])))).shape == (768, 1024)


def test_the_same_input_gives_the_same_recording(recording, tmp_path):
    write(tmp_path / "again.rrd")
    tool = Path(sys.prefix) / "bin" / "rerun"
    compared = subprocess.run(
        [tool, "rrd", "compare", "--unordered", recording, tmp_path / "again.rrd"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert compared.returncode == 0, compared.stderr
    # The comparison does see a difference where there is one.
    other = {**evaluation(finished()), "verdict": "FAIL"}
    write(tmp_path / "other.rrd", evaluation=other)
    compared = subprocess.run(
        [tool, "rrd", "compare", "--unordered", recording, tmp_path / "other.rrd"],
        capture_output=True,
        check=False,
    )
    assert compared.returncode != 0


def test_without_truth_nothing_grey_is_drawn(tmp_path):
    write(tmp_path / "real.rrd", truth=None)
    paths = {
        chunk.entity_path
        for chunk in RrdReader(tmp_path / "real.rrd").stream().to_chunks()
    }
    assert not [path for path in paths if "truth" in path]


def test_a_marker_that_was_not_seen_is_left_out(tmp_path):
    done = finished()
    pixels = done.session.pixels.copy()
    pixels[0, 0, 1] = np.nan
    pixels[:, 1] = np.nan
    covariance = done.session.pixel_covariance.copy()
    covariance[~np.isfinite(pixels).all(axis=-1)] = np.nan
    session = replace(done.session, pixels=pixels, pixel_covariance=covariance)
    path = tmp_path / "unseen.rrd"
    write(path, session=session)
    rings = column(path, "cell/base/estimate/left/seen", "LineStrips2D:strips")
    assert [len(rings[j]) for j in (0, 1, 2)] == [2, 0, 3]
    errors = column(path, "error_mm/used", "Scalars:scalars")
    assert np.isfinite(errors[0]).tolist() == [True, False, True]
    assert not np.isfinite(errors[1]).any()


def test_nothing_is_written_where_an_image_is_missing(tmp_path):
    def torn(camera, station):
        if station == 3:
            raise StorageError("left_003.png: this file is missing")
        return photograph(camera, station)

    path = tmp_path / "replay.rrd"
    with pytest.raises(StorageError, match="left_003"):
        write(path, photograph=torn)
    assert list(tmp_path.iterdir()) == []


def test_poses_that_do_not_fit_are_refused(tmp_path):
    poses = world_from_body(finished().session)
    with pytest.raises(InputError, match="world_from_body must have shape"):
        write(tmp_path / "replay.rrd", world_from_body=poses[:-1])


@pytest.mark.parametrize("content", [None, b"not a recording"])
def test_another_file_is_refused_by_name(tmp_path, content):
    path = tmp_path / "replay.rrd"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(StorageError, match="replay.rrd"):
        read_numbers(path)


def test_a_recording_of_something_else_is_refused(tmp_path):
    path = tmp_path / "other.rrd"
    other = rr.RecordingStream("other")
    other.save(path)
    other.log("x", rr.Scalars(1.0))
    other.flush()
    other.disconnect()
    with pytest.raises(StorageError, match="not a recording of ours"):
        read_numbers(path)


def test_strict_mode_is_left_as_it_was(tmp_path):
    before = rr.strict_mode()
    write(tmp_path / "replay.rrd")
    assert rr.strict_mode() == before


def test_each_mount_is_drawn_at_its_own_stations(tmp_path):
    """Solids of the one are there while those of the other are cleared."""
    path = tmp_path / "replay.rrd"
    one = mechanism()
    fewer = tuple(g for g in one.geometries if g.shape != "ellipsoid")
    both = (replace(one, marker_body=1), replace(one, marker_body=1, geometries=fewer))
    with recorded(
        path, "two mounts", only_views(rrb.Vertical(), rrb.TimePanel())
    ) as to:
        log_cell(to, both, BASE_FROM_WORLD)
        for station, mount in enumerate((0, 0, 1)):
            to.set_time("station", sequence=station)
            log_mount(to, both, mount)
    body = "cell/robot/base"
    length = "Cylinders3D:lengths"
    for number, shown, cleared in ((1, [0, 1], [2]), (2, [2], [0, 1])):
        mount = f"{body}/mount_{number}"
        solids = column(path, rf"{mount}/cylinder\ of\ 1", length)
        assert sorted(solids) == shown
        cleared_at = column(path, mount, "Clear:is_recursive")
        assert sorted(cleared_at) == cleared
    # What no mount changes is there at all times.
    assert list(column(path, r"cell/surroundings/box\ of\ 0", "Boxes3D:half_sizes"))


def test_a_tool_change_is_told_and_the_bodies_stay(tmp_path):
    done = finished_on_two_mounts()
    path = tmp_path / "replay.rrd"
    write(
        path,
        mechanisms=(mechanism(), mechanism()),
        world_from_body=world_from_body(done.session),
        evaluation=evaluation(done),
        **{
            name: getattr(done, name)
            for name in ("session", "calibration", "track", "truth")
        },
    )
    assert "tool change: mount 2 (about its edge BC)" in logged(path)[8, "INFO"]
    verdict = column(path, "verdict", "TextDocument:text")[None][0]
    assert (
        "Stations 0-7: mount 1 (about a normal); 8-15: mount 2 (about its edge BC)."
        in verdict
    )
    assert "About a normal: White lines" in verdict
    assert "About an edge: A white line" in verdict
    body = rf"cell/robot/{rr.escape_entity_path_part('link/1 t')}"
    solid = rf"{body}/mount_2/sphere\ of\ 2"
    shown = column(path, solid, "Transform3D:translation")
    assert sorted(shown) == list(range(8, 16))
    # Beside the two of the track, those that it does not show.
    tracked = column(path, solid, "Transform3D:translation", "track")
    assert set(tracked) == {2, 3, None}
