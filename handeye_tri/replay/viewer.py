"""Shows a recording: in the viewer, in a browser, or as a picture without a display."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import quote

from handeye_tri.errors import HandEyeError, InputError, MissingDependencyError
from handeye_tri.replay.engine import connect, open_tab
from handeye_tri.replay.layout import BLUEPRINTS
from handeye_tri.replay.paths import STATION, STEP
from handeye_tri.replay.recording import read_numbers
from handeye_tri.storage import write_bytes

# Servers of ours are for the user of this machine only.
_LOOPBACK = "127.0.0.1"
_START_S = 30.0
_LOAD_S = 60.0
# A view reports what it cannot draw after it has been drawn, and an image appears when
# it has been unpacked: a picture is taken when so many in a row are the same.
_SETTLE_S = 0.4
_STILL = 3
_END_S = 5.0

_NO_VULKAN = (
    "the viewer finds no Vulkan driver to draw with; on Debian and Ubuntu install one "
    "that needs no graphics card by `apt-get install mesa-vulkan-drivers`"
)
_NO_DISPLAY = (
    "the viewer cannot open a window here; make a picture instead with "
    "`handeye-tri replay SESSION --screenshot FILE.png`, or use `--serve`"
)

_NO_GRAPHICS = ("graphics adapter", "vulkan", "wgpu", "display", "wayland", "x11")


def screenshot(
    recording: Path,
    picture: Path,
    *,
    size: tuple[int, int] = (1600, 1000),
    station: int | None = None,
    blueprint: str = BLUEPRINTS[0],
    step: int | None = None,
) -> list[str]:
    """Draw a recording into a PNG; needs no display.

    Args:
        recording: A file by :func:`handeye_tri.replay.write_recording`.
        picture: Where the PNG goes.
        size: (width, height), pixels.
        station: Which station to show; by default the worst that was used.
        blueprint: Which tab to show, one of BLUEPRINTS.
        step: Which solver step to show, at that worst station, instead of a station.

    Returns:
        What the views could not draw, one sentence each; empty when all is well.

    Raises:
        InputError: the recording has no such station, or is none of ours.
        MissingDependencyError: there is no Vulkan driver.
        HandEyeError: the viewer did not answer in time.
    """
    place = _place(recording, station, step, blueprint)
    options = ["--headless", "--window-size", f"{size[0]}x{size[1]}"]
    with _viewer(options) as (process, client):
        _open_at(process, client, recording, *place, still=True)
        drawn = _when_still(client)
        views = client.get_state().views
    write_bytes(picture, drawn)
    return [
        f"{view.name}: {report.summary}"
        + (f" ({report.details})" if report.details else "")
        for view in views
        for report in view.reports
    ]


def open_viewer(
    recording: Path,
    station: int | None = None,
    blueprint: str = BLUEPRINTS[0],
    step: int | None = None,
) -> None:
    """Show a recording in a window and wait until the user closes it.

    Args:
        recording: A file by :func:`handeye_tri.replay.write_recording`.
        station: Which station to begin at; by default the worst that was used.
        blueprint: Which tab to begin with, one of BLUEPRINTS.
        step: Which solver step to begin at instead of a station.

    Raises:
        InputError: the recording has no such station, or is none of ours.
        MissingDependencyError: no window can be opened.
    """
    place = _place(recording, station, step, blueprint)
    with _viewer([]) as (process, client):
        _open_at(process, client, recording, *place, still=False)
        process.wait()


def serve(
    recording: Path,
    port: int = 9090,
    announce: Callable[[str], object] | None = None,
) -> None:
    """Serve a recording to a browser on this machine until interrupted.

    Args:
        recording: A file by :func:`handeye_tri.replay.write_recording`.
        port: Of the page, on the loopback interface only.
        announce: Called with the page's address; written to stderr by default.

    Raises:
        InputError: the port is taken, or the recording is none of ours.
    """
    shown = read_numbers(recording)["shown_station"]
    if not _is_free(port):
        raise InputError(
            f"port {port} of {_LOOPBACK} is in use; end what uses it, or give another"
        )
    data_port = _free_port()
    command = [
        *("--serve-web", "--bind", _LOOPBACK, "--port", str(data_port)),
        *("--web-viewer-port", str(port), str(recording)),
    ]
    source = quote(f"rerun+http://{_LOOPBACK}:{data_port}/proxy", safe="")
    with _running(command) as process:
        (announce or _to_stderr)(
            f"open http://{_LOOPBACK}:{port}?url={source} in a browser"
            # A page cannot be told where to begin: it follows what it loads.
            + ("" if shown is None else f" and go to station {shown}, bottom right")
        )
        process.wait()


def _to_stderr(line: str) -> None:
    sys.stderr.write(line + "\n")


def _place(
    recording: Path, station: int | None, step: int | None, blueprint: str
) -> tuple[str, int | None, str]:
    """Timeline, where on it, and tab; reads the file before anything is started.

    A recording that plays by itself shows no station first: None.
    """
    numbers = read_numbers(recording)
    if blueprint not in BLUEPRINTS:
        raise InputError(
            f"blueprint {blueprint!r} is not in {recording}: it has "
            f"{', '.join(BLUEPRINTS)}"
        )
    if station is not None and step is not None:
        raise InputError("give a station or a step to show, not both")
    timeline, at, count = STATION, station, int(numbers["station_count"])
    if step is not None:
        timeline, at, count = STEP, step, int(numbers["step_count"])
    if at is None:
        shown = numbers["shown_station"]
        return timeline, None if shown is None else int(shown), blueprint
    if not 0 <= at < count:
        raise InputError(
            f"{timeline} {at} is not in {recording}: it has 0 to {count - 1}"
        )
    return timeline, at, blueprint


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((_LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((_LOOPBACK, port)) != 0


def _executable() -> Path:
    """The viewer that came with rerun."""
    found = find_spec("rerun_cli")
    for folder in (found.submodule_search_locations or []) if found else []:
        for name in ("rerun", "rerun.exe"):
            if (Path(folder) / name).is_file():
                return Path(folder) / name
    raise MissingDependencyError(
        "the rerun viewer is missing from this environment; install it again by "
        "`pip install --force-reinstall rerun-sdk`"
    )


@contextmanager
def _running(options: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
    """The viewer's process; ended in every case."""
    # A file, since a pipe that nobody reads would stop the viewer when full.
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            [str(_executable()), *options],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            # Below this level the viewer covers its own picture with messages.
            env={**os.environ, "RUST_LOG": "warn"},
        )
        try:
            yield process
        except _ViewerGone:
            log.seek(0)
            text = log.read().decode(errors="replace")
            if any(sign in text.lower() for sign in _NO_GRAPHICS):
                raise MissingDependencyError(
                    _NO_VULKAN if "--headless" in options else _NO_DISPLAY
                ) from None
            lines = [line for line in text.splitlines() if line.strip()]
            raise HandEyeError(
                f"the viewer ended or hung before it showed anything: "
                f"{lines[-1] if lines else 'it said nothing'}; see what "
                f"`{_executable()} --version` says"
            ) from None
        finally:
            process.terminate()
            try:
                process.wait(timeout=_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


class _ViewerGone(Exception):
    """The process ended, or does not answer."""


@contextmanager
def _viewer(options: Sequence[str]) -> Iterator[tuple[subprocess.Popen[bytes], Any]]:
    """A viewer with a client that drives it."""
    port = _free_port()
    command = [*options, "--bind", _LOOPBACK, "--port", str(port)]
    with _running(command) as process:
        until = time.monotonic() + _START_S
        while True:
            try:
                client = connect(f"rerun+http://{_LOOPBACK}:{port}/proxy")
                client.get_state()
                break
            except Exception:
                # rerun raises several kinds until its server is up.
                if process.poll() is not None or time.monotonic() > until:
                    raise _ViewerGone from None
                time.sleep(0.1)
        yield process, client


def _open_at(
    process: subprocess.Popen[bytes],
    client: Any,
    recording: Path,
    timeline: str,
    at: int | None,
    blueprint: str,
    *,
    still: bool,
) -> None:
    """Open a recording, wait until it is loaded, and go to a place and a tab.

    Where no place is asked for it plays, or stands at its first station.
    """
    client.open(str(recording.resolve()))
    until = time.monotonic() + _LOAD_S
    while client.get_state().loading:
        if process.poll() is not None or time.monotonic() > until:
            raise _ViewerGone
        time.sleep(0.1)
    if blueprint != BLUEPRINTS[0]:
        open_tab(client, BLUEPRINTS.index(blueprint))
    if at is not None or still:
        client.set_time(timeline, sequence=at or 0, play_state="paused")


def _when_still(client: Any) -> bytes:
    """A PNG of the whole viewer, once nothing moves in it any more."""
    until = time.monotonic() + _LOAD_S
    same, last = 0, b""
    while same < _STILL and time.monotonic() < until:
        time.sleep(_SETTLE_S)
        picture = bytes(client.take_screenshot())
        same = same + 1 if picture == last else 1
        last = picture
    return last
