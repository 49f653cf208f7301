"""Where things stand in a recording's tree, and its timelines."""

from __future__ import annotations

# A station of the session; how the calibration got there; a station of the track.
STATION, STEP, TRACK = "station", "step", "track"
# Seconds since a planned programme starts.
TIME = "time"
NUMBERS = "numbers/track"


def camera_path(name: str) -> str:
    """The estimated camera, under which its images are."""
    return f"cell/base/estimate/{name}"
