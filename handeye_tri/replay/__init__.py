"""A session and its result as a recording to look at; the only user of rerun."""

from handeye_tri.replay.layout import BLUEPRINTS
from handeye_tri.replay.preview import PlannedMotion, View, write_preview
from handeye_tri.replay.reconstruction import Thing, write_reconstruction
from handeye_tri.replay.recording import write_recording
from handeye_tri.replay.steps import SolverStep
from handeye_tri.replay.viewer import open_viewer, screenshot, serve

__all__ = [
    "BLUEPRINTS",
    "PlannedMotion",
    "View",
    "SolverStep",
    "Thing",
    "open_viewer",
    "screenshot",
    "serve",
    "write_preview",
    "write_reconstruction",
    "write_recording",
]
