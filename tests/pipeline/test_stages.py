"""The main job on rendered images, from the command line."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from handeye_tri.replay.recording import read_numbers
from handeye_tri.storage import read_image, sha256, write_image


def command(*arguments):
    """Run the command line in its own process, away from any terminal."""
    return subprocess.run(
        [sys.executable, "-m", "handeye_tri.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )


def digests(folder):
    """SHA-256 of every file of a session by name."""
    return {
        str(path.relative_to(folder)): sha256(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def stamps(folder):
    """When each image was written."""
    return {path.name: path.stat().st_mtime_ns for path in folder.glob("images/*.png")}


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "out"
    done = command("run", "hp3_stereo", "-o", folder, "--seed", "1")
    assert done.returncode == 0, done.stderr
    (folder.parent / "stdout").write_text(done.stdout)
    (folder.parent / "stderr").write_text(done.stderr)
    return folder


def evaluation(folder):
    return json.loads((folder / "evaluation.json").read_text())


def test_the_summary_leads_with_the_verdict(session):
    text = (session.parent / "stdout").read_text()
    assert text.startswith("VERDICT  PASS")
    assert "truth - value" in text
    progress = (session.parent / "stderr").read_text()
    for stage in ("plan", "simulate", "detect", "cameras", "hand-eye", "evaluate"):
        assert f"  {stage}" in progress


def test_every_file_is_there_and_recorded(session):
    header = json.loads((session / "session.json").read_text())
    recorded = {
        name: digest
        for stage in header["stages"].values()
        for name, digest in stage["outputs"].items()
    }
    found = digests(session)
    del found["session.json"]
    assert found == recorded
    assert len([name for name in found if name.startswith("images/")]) == 56
    results = {"plan.json", "truth.json", "observations.npz", "cameras.json"}
    results |= {"hand_eye.json", "evaluation.json", "replay.rrd", "report.html"}
    assert results <= set(found)


def test_the_recording_holds_the_numbers_of_the_evaluation(session):
    numbers, track = read_numbers(session / "replay.rrd"), evaluation(session)["track"]
    for name in ("mean_mm", "rms_mm", "max_mm", "predicted_rms_mm"):
        assert numbers[name] == track[name]
    positions = track["positions"]
    for name in ("reported_m", "observed_m"):
        assert numbers[name] == [row[name] for row in positions]
    assert numbers["stations"] == [row["station"] for row in positions]
    assert numbers["worst_station"] == track["worst_station"]
    # Closed form, each camera alone, all cameras, everything together.
    assert numbers["step_count"] == 4


def test_detect_debug_writes_a_sheet_of_every_view(session, tmp_path):
    done = command("detect", session, "--debug", tmp_path / "sheets")
    assert done.returncode == 0, done.stderr
    sheets = sorted(path.name for path in (tmp_path / "sheets").iterdir())
    images = sorted(path.name for path in (session / "images").glob("*.png"))
    assert sheets == images
    assert f"wrote {len(images)} sheets" in done.stdout
    sheet = read_image(tmp_path / "sheets" / sheets[0])
    # The image with the three markers enlarged beside it.
    assert sheet.shape == (768, 1024 + 256, 3)
    (tmp_path / "file").write_text("")
    done = command("detect", session, "--debug", tmp_path / "file" / "sheets")
    assert done.returncode == 2
    assert "cannot make this folder" in done.stderr


def test_the_recording_opens_without_a_view_error(session, tmp_path):
    picture = tmp_path / "replay.png"
    done = command("replay", session, "--screenshot", picture)
    assert done.returncode == 0, done.stderr
    assert "view error" not in done.stderr
    seen = read_image(picture)
    assert seen.shape == (1000, 1600, 3)
    # Markers of all three pure colours are on screen: the images are shown.
    for channel in range(3):
        others = [c for c in range(3) if c != channel]
        pure = (seen[..., channel] > 200) & (seen[..., others].max(axis=2) < 60)
        assert pure.sum() > 20


def test_the_track_is_accurate_and_adds_up(session):
    result = evaluation(session)
    track = result["track"]
    errors = [
        1e3 * np.linalg.norm(np.subtract(row["observed_m"], row["reported_m"]))
        for row in track["positions"]
    ]
    assert len(errors) == 18
    assert errors == pytest.approx([row["error_mm"] for row in track["positions"]])
    assert track["mean_mm"] == pytest.approx(np.mean(errors))
    assert track["max_mm"] == pytest.approx(np.max(errors))
    # One seed of a mean of 0.07 mm; six stations scatter it by about a quarter.
    assert track["mean_mm"] < 0.14
    assert 0.5 < track["rms_mm"] / track["predicted_rms_mm"] < 1.6


def test_every_estimate_is_within_its_stated_sigma_of_the_truth(session):
    truth = evaluation(session)["truth"]
    assert {"left.fx", "right.cy", "base_from_left.x", "baseline.right",
            "flange_from_triangle.rz"} <= set(truth)  # fmt: skip
    ratios = np.array([row["error"] / row["sigma"] for row in truth.values()])
    assert np.abs(ratios).max() < 4.5
    assert np.sqrt(np.mean(ratios**2)) < 1.8


def test_a_second_run_does_nothing_and_says_the_same(session):
    before = digests(session)
    done = command("run", "hp3_stereo", "-o", session, "--seed", "1")
    assert done.returncode == 0
    assert done.stdout == (session.parent / "stdout").read_text()
    assert done.stderr.count("up to date") == len(
        json.loads((session / "session.json").read_text())["stages"]
    )
    assert digests(session) == before


@pytest.mark.parametrize("verb", ["detect", "calibrate", "evaluate"])
def test_a_stage_done_again_writes_the_same_bytes(session, verb):
    before = digests(session)
    done = command(verb, session, "--again")
    assert done.returncode == 0, done.stderr
    assert digests(session) == before


def test_separate_steps_on_request_and_back(session):
    before = digests(session)
    methods, tracks = [], []
    for arguments in (("--method", "separate"), ()):
        for verb, more in (("calibrate", arguments), ("evaluate", ())):
            done = command(verb, session, *more)
            assert done.returncode == 0, done.stderr
        written = json.loads((session / "hand_eye.json").read_text())
        methods.append(written["method"])
        tracks.append(evaluation(session)["track"]["predicted_rms_mm"])
    assert methods[0].startswith("AX=ZB")
    assert methods[1].startswith("joint adjustment")
    assert "separate" in written["base_from_reference_by_method"]
    assert tracks[1] < tracks[0]
    # Another method is other numbers in hand_eye.json; the same, the same bytes.
    assert digests(session) == before


def test_json_is_the_evaluation_and_nothing_else(session):
    done = command("run", "hp3_stereo", "-o", session, "--seed", "1", "--json")
    assert json.loads(done.stdout) == evaluation(session)


@pytest.mark.parametrize("damage", ["missing", "text", "cut", "size"])
def test_a_bad_image_is_named_and_run_renders_it_again(session, damage):
    path = session / "images" / "left_003.png"
    whole, before = path.read_bytes(), digests(session)
    if damage == "missing":
        path.unlink()
    elif damage == "text":
        path.write_text("no image")
    elif damage == "cut":
        path.write_bytes(whole[: len(whole) // 2])
    else:
        write_image(path, read_image(path)[:100])
    done = command("detect", session, "--again")
    assert done.returncode == 2
    assert "left_003.png" in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.count("error:") == 1
    path.write_bytes(whole)
    assert digests(session) == before


def test_output_into_a_closed_pipe_is_quiet(session):
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as closed:
        done = subprocess.run(
            [sys.executable, "-m", "handeye_tri.cli", "evaluate", session],
            stdout=closed, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr


def test_the_same_seed_gives_the_same_session_and_another_seed_another(tmp_path):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        done = command(
            "plan", tmp_path / name, "--cell", "hp3_stereo", "--seed", seed,
            "--half-turns", 4,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
    for name in ("a", "b"):
        done = command("simulate", tmp_path / name)
        assert done.returncode == 0, done.stderr
    found = [digests(tmp_path / name) for name in ("a", "b")]
    # Rerun draws the identifiers of a recording's rows anew each time.
    for files in found:
        del files["plan.rrd"]
    assert found[0] == found[1]
    tool = Path(sys.prefix) / "bin" / "rerun"
    previews = [tmp_path / name / "plan.rrd" for name in ("a", "b")]
    done = subprocess.run(
        [tool, "rrd", "compare", "--unordered", *previews],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    plans = [(tmp_path / name / "plan.json").read_bytes() for name in ("a", "c")]
    assert plans[0] != plans[1]


def test_an_interrupted_simulation_goes_on_where_it_was(tmp_path):
    folder = tmp_path / "s"
    command("plan", folder, "--cell", "hp3_stereo", "--half-turns", 4)
    assert command("simulate", folder).returncode == 0
    whole = digests(folder)
    header = (folder / "session.json").read_text()
    running = subprocess.Popen(
        [sys.executable, "-m", "handeye_tri.cli", "simulate", str(folder), "--again"],
        stderr=subprocess.PIPE,
    )
    mark = folder / "images" / ".started"
    while running.poll() is None and not (mark.exists() and len(stamps(folder)) >= 3):
        pass
    running.kill()
    running.communicate()
    left = stamps(folder)
    assert (folder / "session.json").read_text() == header
    done = command("simulate", folder)
    assert done.returncode == 0, done.stderr
    assert digests(folder) == whole
    kept = [name for name, stamp in left.items() if stamp == stamps(folder).get(name)]
    assert left
    assert sorted(kept) == sorted(left)


def test_a_track_test_writes_both_tracks(session):
    rows = [
        np.loadtxt(session / f"track_{name}.tum") for name in ("reported", "observed")
    ]
    positions = evaluation(session)["track"]["positions"]
    for table, name in zip(rows, ("reported_m", "observed_m"), strict=True):
        assert table[:, 1:4].tolist() == [row[name] for row in positions]
        np.testing.assert_allclose(
            np.linalg.norm(table[:, 4:], axis=1), 1.0, atol=1e-12
        )
        # "ABC" within a station, stations in order.
        assert table[:, 0].tolist() == [
            pytest.approx(row["station"] + 0.1 * "ABC".index(row["marker"]))
            for row in positions
        ]


def test_cross_checks_agree_with_the_covariance(session):
    result = evaluation(session)
    checks = result["cross_checks"]
    validation = checks["cross_validation"]
    assert (validation["folds"], validation["stations"]) == (11, 22)
    assert 0.6 < validation["rms_mm"] / validation["predicted_rms_mm"] < 1.5
    for name, most in (("bootstrap", 2.0), ("parametric_bootstrap", 1.35)):
        assert 1 / most < checks[name]["rms_ratio_to_covariance"] < most
        assert checks[name]["failed"] == 0
    assert "Cross-validation, one half-turn left out" in (
        (session.parent / "stdout").read_text()
    )


def test_what_to_add_is_planned_from_what_was_detected(session):
    header = (session / "session.json").read_text()
    done = command("plan", session, "--next", 2)
    assert done.returncode == 0, done.stderr
    assert "2 half-turns, 4 stations + 0 held out" in done.stdout
    listed = (session / "next.csv").read_text().splitlines()
    assert listed[0] == "s_deg,l_deg,u_deg,r_deg,b_deg,t_deg"
    assert len(listed) == 5
    # It is no stage: what the session holds stays as it was.
    assert (session / "session.json").read_text() == header


def test_what_to_add_counts_what_was_seen_and_starts_where_the_arm_stands(
    session, monkeypatch
):
    """The programme stopped at station 9, and one camera missed station 3."""
    from dataclasses import replace

    from handeye_tri.pipeline import NullProgress, Run
    from handeye_tri.pipeline.programme import plan_more
    from handeye_tri.storage import SessionFolder

    run = Run(SessionFolder.open(session), NullProgress())
    whole = run.observed()
    pixels = np.array(whole.pixels)
    pixels[:, 10:] = pixels[1, 3] = np.nan
    covariance = np.where(
        np.isfinite(pixels)[..., None], whole.pixel_covariance, np.nan
    )
    part = replace(whole, pixels=pixels, pixel_covariance=covariance)
    monkeypatch.setattr(Run, "observed", lambda _run: part)
    more, path = plan_more(run, 2)
    assert path.is_file()
    arm, here = run.arm, whole.stations[9].joints
    for station, via in zip(more.stations, more.via, strict=True):
        for end in (*via, station.joints):
            assert arm.path_collision(here, end) is None
            here = end
        assert arm.collision(station.joints) is None
    # Fewer stations were seen than planned: two more do not make up for the rest.
    assert (
        more.certificate["track_calibration_rms_mm"]
        > run.plan().certificate["track_calibration_rms_mm"]
    )
    # The other of the two forms is not left over from before.
    assert len(list(session.glob("next.*"))) == 1


def test_ways_round_about_are_not_lost(session, monkeypatch):
    """A list of stations cannot hold them: the file is then the whole programme."""
    from dataclasses import replace

    import handeye_tri.plan
    from handeye_tri.pipeline import NullProgress, Run
    from handeye_tri.pipeline.programme import plan_more
    from handeye_tri.storage import SessionFolder

    run = Run(SessionFolder.open(session), NullProgress())
    via = tuple(
        np.full((int(k == 1), 6), 0.25) for k in range(len(run.plan().stations))
    )
    monkeypatch.setattr(
        handeye_tri.plan, "plan_next", lambda *_: replace(run.plan(), via=via)
    )
    _, path = plan_more(run, 2)
    assert path.name == "next.json"
    assert not (session / "next.csv").exists()
    stations = json.loads(path.read_text())["stations"]
    assert stations[1]["via"] == [[0.25] * 6]
    path.unlink()
