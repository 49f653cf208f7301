"""URDF joints that place the cameras on the robot's base."""

from __future__ import annotations

from typing import Literal
from xml.sax.saxutils import quoteattr

import numpy as np

from handeye_tri.exchange.results import Results, number
from handeye_tri.records import Floats
from handeye_tri.se3 import SE3

CameraFrame = Literal["mounting", "optical"]

# REP 103: a body's frame is x forward, y left, z up; an optical frame is z forward,
# x right, y down. Columns: the optical axes in the mounting frame.
MOUNTING_FROM_OPTICAL = SE3.from_parts(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3)
)


def roll_pitch_yaw(rotation: Floats) -> Floats:
    """URDF's rpy of a rotation, shape (3, 3): Rz(yaw) Ry(pitch) Rx(roll), radians.

    Roll is taken from what the yaw found leaves, so that the three together give the
    rotation back also where pitch is 90 degrees and each alone is undefined.
    """
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    # Second row of Rz(-yaw) R, which is that of Rx(roll).
    _, cosine, minus_sine = -np.sin(yaw) * rotation[0] + np.cos(yaw) * rotation[1]
    return np.array([np.arctan2(-minus_sine, cosine), pitch, yaw])


def origin(motion: SE3) -> str:
    """The ``origin`` element of a joint or a solid: metres and radians."""
    xyz = " ".join(map(number, motion.translation))
    rpy = " ".join(map(number, roll_pitch_yaw(motion.rotation)))
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'


def fixed_joint(name: str, parent: str, child: str, motion: SE3) -> str:
    """A fixed joint; ``motion`` is the pose of the child in the parent."""
    return (
        f'  <joint name={quoteattr(name)} type="fixed">\n'
        f"    <parent link={quoteattr(parent)}/>\n"
        f"    <child link={quoteattr(child)}/>\n"
        f"    {origin(motion)}\n"
        "  </joint>\n"
    )


def cameras_urdf(results: Results, frame: CameraFrame) -> str:
    """A robot of the base and the cameras, to be read alone or copied from.

    Args:
        results: The calibrated session.
        frame: "optical": one joint from the base to each optical frame. "mounting":
            a joint to ``<camera>_link`` (x forward, y left, z up, its origin in the
            optical centre), and a fixed one from there to the optical frame.
    """
    calibration, frames = results.calibration, results.frames
    lines = [
        *results.head,
        "xyz in metres; rpy in radians about the fixed axes x, y, z. Every origin is "
        "the pose of the child in the parent.",
    ]
    if frame == "mounting":
        lines.append(
            f"Chain: {frames.base}, <camera>_link (x forward, y left, z up), "
            f"{frames.camera('<camera>')} (z forward, x right, y down); both camera "
            "frames have their origin in the optical centre."
        )
    else:
        lines.append(
            f"Chain: {frames.base}, {frames.camera('<camera>')} (optical: z forward, "
            "x right, y down)."
        )
    # A comment must not hold two hyphens in a row, nor end in one.
    comment = "\n  ".join(lines).replace("--", "- -")
    text = f'<?xml version="1.0"?>\n<!--\n  {comment}\n-->\n'
    text += f"<robot name={quoteattr(results.cell)}>\n"
    text += f"  <link name={quoteattr(frames.base)}/>\n"
    for camera, motion in zip(
        calibration.cameras, calibration.base_from_camera, strict=True
    ):
        optical, parent, placed = frames.camera(camera.name), frames.base, motion
        if frame == "mounting":
            mounting = f"{camera.name}_link"
            text += f"  <link name={quoteattr(mounting)}/>\n"
            text += fixed_joint(
                f"{camera.name}_joint",
                frames.base,
                mounting,
                motion @ MOUNTING_FROM_OPTICAL.inverse(),
            )
            parent, placed = mounting, MOUNTING_FROM_OPTICAL
        text += f"  <link name={quoteattr(optical)}/>\n"
        text += fixed_joint(f"{camera.name}_optical_joint", parent, optical, placed)
    return text + "</robot>\n"
