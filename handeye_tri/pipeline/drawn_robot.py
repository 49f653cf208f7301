"""What the recording draws at a station: the robot, or its flange and the markers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handeye_tri.mechanism import Body, Geometry, Mechanism
from handeye_tri.pipeline.run import Run
from handeye_tri.records import Floats, HandEyeCalibration, Session
from handeye_tri.se3 import SE3

# Half sides of the box that stands for the base, and radius of the flange, metres.
_BASE = (0.06, 0.06, 0.01)
_FLANGE_RADIUS = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class DrawnRobot:
    """Bodies and where they are.

    Attributes:
        mechanisms: The bodies with their solids, by mount.
        world_from_body: Shape (stations, bodies, 4, 4), metres.
        base_from_world: The base that poses refer to.
    """

    mechanisms: tuple[Mechanism, ...]
    world_from_body: Floats
    base_from_world: SE3


def drawn_robot(run: Run, session: Session, hand_eye: HandEyeCalibration) -> DrawnRobot:
    """The robot at the joints it reported, or its flange where those are unknown."""
    if run.has_robot:
        joints = np.array([station.joints for station in session.stations])
        return DrawnRobot(
            run.mechanisms, run.arm.body_poses(joints), run.arm.base_from_world
        )
    poses = np.tile(np.eye(4), (len(session.stations), 3, 1, 1))
    poses[:, 2] = session.base_from_flange
    return DrawnRobot(
        tuple(
            _flange_and_markers(run, mount.markers, session.marker_radii)
            for mount in hand_eye.mounts
        ),
        poses,
        SE3.identity(),
    )


def _flange_and_markers(run: Run, markers: Floats, radii: Floats) -> Mechanism:
    """A base and a flange that carries three balls, shape (3, 3) and (3,), metres."""
    solids = [
        _solid("base", 1, "box", np.array(_BASE), SE3.identity(), (0.5, 0.5, 0.5)),
        _solid(
            *("flange", 2, "cylinder", np.array([_FLANGE_RADIUS, 0.005])),
            *(SE3.identity(), (0.3, 0.3, 0.3)),
        ),
    ]
    for name, place, radius, colour in zip(
        "ABC", markers, radii, run.cell.rig.marker_colours, strict=True
    ):
        # A flat dot is drawn as the smallest ball that can be seen.
        size = np.array([max(float(radius), 0.002)])
        at = SE3.from_parts(np.eye(3), place)
        solids.append(_solid(f"marker {name}", 2, "sphere", size, at, colour))
    return Mechanism(
        bodies=(
            Body("world", 0, SE3.identity()),
            Body("base", 0, SE3.identity()),
            Body("flange", 1, SE3.identity()),
        ),
        joints=(),
        geometries=tuple(solids),
        base="base",
        flange="flange",
        base_body=1,
        flange_body=2,
        body_from_flange=SE3.identity(),
        marker_body=2,
        markers=markers,
        touching=frozenset(),
    )


def _solid(
    name: str,
    body: int,
    shape: str,
    size: Floats,
    body_from_geometry: SE3,
    colour: tuple[float, ...],
) -> Geometry:
    return Geometry(
        name=name,
        body=body,
        shape=shape,  # type: ignore[arg-type]
        size=size,
        body_from_geometry=body_from_geometry,
        vertices=np.empty((0, 3)),
        faces=np.empty((0, 3), dtype=np.int64),
        rgba=np.array([*colour, 1.0]),
        collides=False,
    )
