"""The headless viewer draws the recording without an error, and always ends."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from finished_session import (
    BASE_FROM_WORLD,
    evaluation,
    finished,
    mechanism,
    photograph,
    world_from_body,
)
from listening import listening
from PIL import Image

from handeye_tri.errors import HandEyeError, InputError, MissingDependencyError
from handeye_tri.replay import (
    BLUEPRINTS,
    open_viewer,
    screenshot,
    serve,
    viewer,
    write_recording,
)
from handeye_tri.replay.recording import read_numbers


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    done = finished()
    path = tmp_path_factory.mktemp("viewer") / "replay.rrd"
    write_recording(
        path,
        name="test",
        mechanisms=(mechanism(),),
        world_from_body=world_from_body(done.session),
        base_from_world=BASE_FROM_WORLD,
        session=done.session,
        photograph=photograph,
        calibration=done.calibration,
        track=done.track,
        truth=done.truth,
        evaluation=evaluation(done),
    )
    return path


@pytest.fixture
def processes(monkeypatch):
    """Every process that the viewer's file starts."""
    started = []

    class Watched(subprocess.Popen):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            started.append(self)

    monkeypatch.setattr(viewer.subprocess, "Popen", Watched)
    return started


def share(picture, colour, reach=60):
    """Share of pixels near a colour."""
    return float((np.abs(picture - np.array(colour)).max(axis=-1) < reach).mean())


def test_views_have_no_errors_and_show_used_and_held_out(
    recording, processes, tmp_path
):
    pictures = {}
    last = len(finished().session.stations) - 1
    for station in (last, None):
        path = tmp_path / f"{station}.png"
        assert screenshot(recording, path, size=(1200, 800), station=station) == []
        image = Image.open(path)
        assert image.size == (1200, 800)
        pictures[station] = np.asarray(image.convert("RGB")).astype(int)
    # The images fill a third of the picture: held out with orange rings, used blue.
    rings = {key: picture[:, 560:950] for key, picture in pictures.items()}
    assert share(rings[last], (255, 149, 0)) > 3 * share(rings[None], (255, 149, 0))
    assert share(rings[None], (64, 156, 255)) > 3 * share(rings[last], (64, 156, 255))
    # The arm, the images and the text are there: not one dark surface.
    assert pictures[None].std() > 30
    assert [process.poll() is not None for process in processes] == [True, True]


@pytest.mark.parametrize("blueprint", BLUEPRINTS[1:])
def test_every_blueprint_draws_without_errors(recording, tmp_path, blueprint):
    pictures = {}
    for name in ("overview", blueprint):
        path = tmp_path / f"{name}.png"
        assert screenshot(recording, path, size=(1200, 800), blueprint=name) == []
        pictures[name] = np.asarray(Image.open(path).convert("RGB")).astype(int)
    changed = np.abs(pictures[blueprint] - pictures["overview"]).max(axis=-1) > 30
    assert changed.mean() > 0.15


def test_a_blueprint_or_step_that_is_not_there_is_refused(recording, tmp_path):
    with pytest.raises(InputError, match="blueprint 'x' is not in .*overview"):
        screenshot(recording, tmp_path / "x.png", blueprint="x")
    with pytest.raises(InputError, match="step 1 is not in .*0 to 0"):
        screenshot(recording, tmp_path / "x.png", step=1)
    with pytest.raises(InputError, match="not both"):
        screenshot(recording, tmp_path / "x.png", step=0, station=0)


def test_a_station_that_is_not_there_is_refused_before_anything_starts(
    recording, processes, tmp_path
):
    with pytest.raises(InputError, match="station 99 is not in"):
        screenshot(recording, tmp_path / "x.png", station=99)
    assert processes == []


def fake(tmp_path, monkeypatch, script):
    """Put a program in the viewer's place."""
    program = tmp_path / "rerun"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setattr(viewer, "_executable", lambda: program)


def test_no_vulkan_names_the_package(recording, processes, tmp_path, monkeypatch):
    fake(tmp_path, monkeypatch, "echo No graphics adapter was found >&2; exit 1")
    with pytest.raises(MissingDependencyError, match="mesa-vulkan-drivers"):
        screenshot(recording, tmp_path / "x.png")
    assert processes[0].poll() is not None
    assert not (tmp_path / "x.png").exists()


def test_no_display_says_what_to_use_instead(recording, tmp_path, monkeypatch):
    fake(tmp_path, monkeypatch, "echo neither WAYLAND_DISPLAY nor DISPLAY; exit 1")
    with pytest.raises(MissingDependencyError, match="--screenshot"):
        open_viewer(recording)


def test_a_viewer_that_hangs_is_killed(recording, processes, tmp_path, monkeypatch):
    fake(tmp_path, monkeypatch, "trap '' TERM; echo starting; exec sleep 60")
    monkeypatch.setattr(viewer, "_START_S", 0.5)
    monkeypatch.setattr(viewer, "_END_S", 0.5)
    with pytest.raises(HandEyeError, match="starting"):
        screenshot(recording, tmp_path / "x.png")
    assert processes[0].poll() is not None


def test_serving_stays_on_loopback_and_says_where(recording, tmp_path, monkeypatch):
    told = []
    fake(tmp_path, monkeypatch, f'echo "$@" > {tmp_path}/arguments')
    port = viewer._free_port()
    serve(recording, port, told.append)
    assert told[0].startswith(f"open http://127.0.0.1:{port}?url=rerun%2Bhttp%3A%2F%2F")
    shown = read_numbers(recording)["shown_station"]
    assert told[0].endswith(f" in a browser and go to station {shown}, bottom right")
    arguments = (tmp_path / "arguments").read_text().split()
    assert arguments[arguments.index("--bind") + 1] == "127.0.0.1"
    assert arguments[-1] == str(recording)


def test_a_port_in_use_is_refused(recording):
    with viewer.socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"port {port}"):
            serve(recording, port)


def test_the_served_page_answers_on_loopback_only(recording):
    """The true program: a browser gets the page, and it is not on other addresses."""
    port = viewer._free_port()
    # A shell's background jobs inherit an ignored SIGINT; this one must heed it.
    code = (
        "import signal, sys; from pathlib import Path\n"
        "from handeye_tri.replay import serve\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "serve(Path(sys.argv[1]), int(sys.argv[2]))"
    )
    import time
    import urllib.request

    with subprocess.Popen(
        [sys.executable, "-c", code, str(recording), str(port)],
        stderr=subprocess.PIPE,
        env=os.environ,
    ) as process:
        try:
            for _ in range(150):
                try:
                    url = f"http://127.0.0.1:{port}"
                    with urllib.request.urlopen(url, timeout=2) as answer:
                        page = answer.read()
                    break
                except OSError:
                    time.sleep(0.1)
            assert b"<html" in page.lower()
            ours = listening(process.pid)
            assert ("127.0.0.1", port) in ours
            # The page's port and that of its data, and no other address.
            assert {address for address, _ in ours} == {"127.0.0.1"}
            assert len(ours) == 2
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:
                process.kill()
                raise
