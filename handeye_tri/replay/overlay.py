"""What is drawn over the images: seen, predicted, half-turn lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handeye_tri.camera import PinholeCamera
from handeye_tri.records import Session
from handeye_tri.replay.engine import rr
from handeye_tri.replay.half_turns import HalfTurnView
from handeye_tri.replay.paths import camera_path
from handeye_tri.replay.shapes import (
    ESTIMATE,
    HELD_OUT,
    WHITE,
    Colour,
    crosses,
    rings,
)
from handeye_tri.replay.story import Story

Floats = NDArray[np.float64]

# Our pixel (0, 0) is the first pixel's centre, rerun's is its outer corner.
CORNER = 0.5
# Letters stand this far outside of their markers, pixels; rerun writes them below the
# place it is given.
_LETTER_PX = 46.0
_LETTER_UP = np.array([0.0, -22.0])


def log_view(
    recording: rr.RecordingStream,
    session: Session,
    story: Story,
    i: int,
    camera: PinholeCamera,
    j: int,
) -> None:
    """What camera i saw at station j, over its image."""
    path = camera_path(camera.name)
    colour = HELD_OUT if story.held_out[j] else ESTIMATE
    seen = session.pixels[i, j]
    found = np.isfinite(seen).all(axis=1)
    recording.log(
        f"{path}/seen",
        rr.LineStrips2D(
            rings(seen[found] + CORNER), colors=[colour], radii=[-1.2], draw_order=20
        ),
    )
    log_predicted(recording, story, camera.name, seen, story.predicted[i, j], colour)
    _log_half_turn(recording, path, story.turns[i][j], camera.image_size)


def log_predicted(
    recording: rr.RecordingStream,
    story: Story,
    camera: str,
    seen: Floats,
    predicted: Floats,
    colour: Colour,
) -> None:
    """Where markers are predicted, and from there to where they are seen.

    Args:
        recording: To log to.
        story: For the magnification.
        camera: Name of the camera.
        seen: Shape (3, 2), pixels, NaN where not seen.
        predicted: Shape (3, 2), pixels, NaN behind the camera.
        colour: Of the arrows.
    """
    path = camera_path(camera)
    found, known = (np.isfinite(p).all(axis=1) for p in (seen, predicted))
    plus = crosses(predicted[known] + CORNER)
    # White on dark, and with a dark edge on white. Negative radii are widths on the
    # screen, however large the image is shown.
    for name, paint, width, order in (
        ("predicted/edge", (0, 0, 0), -1.6, 21),
        ("predicted", WHITE, -0.7, 22),
    ):
        recording.log(
            f"{path}/{name}",
            rr.LineStrips2D(plus, colors=[paint], radii=[width], draw_order=order),
        )
    both = found & known
    recording.log(
        f"{path}/gap",
        rr.Arrows2D(
            origins=predicted[both] + CORNER,
            vectors=story.magnification_px * (seen - predicted)[both],
            colors=[colour],
            radii=[-1.2],
            draw_order=23,
        ),
    )


def _log_half_turn(
    recording: rr.RecordingStream,
    path: str,
    turn: HalfTurnView,
    image_size: tuple[int, int],
) -> None:
    """Lines AA' BB' CC', their letters, and O."""
    recording.log(
        f"{path}/half_turn",
        rr.LineStrips2D(
            [line + CORNER for line in turn.lines],
            colors=[WHITE],
            radii=[-0.6],
            draw_order=30,
        ),
    )
    edge = [] if turn.edge is None else [turn.edge + CORNER]
    recording.log(
        f"{path}/half_turn/axis",
        rr.LineStrips2D(edge, colors=[(*WHITE, 110)], radii=[-0.6], draw_order=29),
    )
    ends = [
        (f"{letter}{prime}", line[end])
        for letter, line in zip(turn.markers, turn.lines, strict=True)
        for prime, end in (("", 0), ("'", -1))
    ]
    visible = bool(np.isfinite(turn.centre).all())
    places = []
    for _, place in ends if visible else []:
        outwards = place - turn.centre
        length = max(float(np.linalg.norm(outwards)), 1.0)
        place = place + outwards / length * _LETTER_PX + _LETTER_UP
        places.append(np.clip(place, 0.0, np.array(image_size) + 2 * _LETTER_UP))
    recording.log(
        f"{path}/half_turn/letters",
        rr.Points2D(
            places,
            colors=[WHITE],
            radii=[0.0],
            labels=[name for name, _ in ends] if places else None,
            show_labels=True,
            draw_order=32,
        ),
    )
    recording.log(
        f"{path}/O",
        rr.Points2D(
            [turn.centre + CORNER] if visible else [],
            colors=[WHITE],
            radii=[-2.5],
            labels=["O"] if visible else None,
            draw_order=31,
        ),
    )
