"""A session and its result as a recording to look at; the only user of rerun."""

from handeye_tri.replay.reconstruction import Thing, write_reconstruction
from handeye_tri.replay.recording import write_recording
from handeye_tri.replay.story import verdict_markdown, worst_station
from handeye_tri.replay.viewer import open_viewer, screenshot, serve

__all__ = [
    "Thing",
    "open_viewer",
    "screenshot",
    "serve",
    "verdict_markdown",
    "worst_station",
    "write_reconstruction",
    "write_recording",
]
