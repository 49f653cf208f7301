"""The report's drawings of directions and frames in space."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import NDArray

from handeye_tri.records import HandEyeCalibration, Session
from handeye_tri.report.labels import place_names
from handeye_tri.report.style import ESTIMATE, INK, RULE, WIDTH, svg

Floats = NDArray[np.float64]

_AXIS_COLOURS = ("#b3261e", "#2e7d32", "#1a4fb4")


def plane_directions(session: Session, calibration: HandEyeCalibration) -> str:
    """Normals of the triangle's planes at the half-turns, as the cameras see them.

    An equal-area picture (Lambert) of the half sphere about the direction from the
    rig to the cameras; a plane's normal is drawn on the side of the cameras.
    """
    normals = _plane_normals(session, calibration)
    centres = np.array([m.translation for m in calibration.base_from_camera])
    rig = session.base_from_flange[:, :3, 3].mean(axis=0)
    centre = centres.mean(axis=0) - rig
    centre /= np.linalg.norm(centre)
    places = on_half_sphere(normals, centre)
    made = session.mounts[[turn.before for turn in session.half_turns]]

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        for degrees in (15, 30, 45, 60):
            radius = np.sqrt(2 * (1 - np.cos(np.radians(degrees))))
            turn = np.linspace(0, 2 * np.pi, 121)
            ax.plot(
                *(radius * np.cos(turn), radius * np.sin(turn)),
                color=RULE,
                linewidth=0.7,
            )
            ax.text(
                *(0, radius, f"{degrees} deg"),
                fontsize=6.5,
                color="#777777",
                ha="center",
                va="bottom",
            )
        for mount in np.unique(made):
            own = places[made == mount]
            ax.plot(*own.T, color=ESTIMATE, linewidth=0.5, alpha=0.5)
            ax.plot(
                *(*own.T, "osd"[mount % 3]),
                color=ESTIMATE,
                markersize=4.5,
                markerfacecolor=ESTIMATE if mount == 0 else "white",
                label=session.mount_name(int(mount)),
            )
        if made.any():
            figure.legend(
                loc="outside upper center", ncols=2, frameon=False, fontsize=7.5
            )
        for turn_, place in zip(session.half_turns, places, strict=True):
            ax.annotate(
                f"{turn_.before}-{turn_.after}",
                place,
                xytext=(4, 3),
                textcoords="offset points",
                fontsize=7,
            )
        ax.plot(0, 0, "+", color=INK, markersize=7)
        ax.set_aspect("equal")
        ax.set_axis_off()

    return svg("planes", draw, 3.9)


def on_half_sphere(normals: Floats, towards_eye: Floats) -> Floats:
    """Equal-area picture (Lambert) of directions that have no sign.

    Args:
        normals: Unit vectors, shape (k, 3).
        towards_eye: Unit vector in the middle of the picture, shape (3,).

    Returns:
        Shape (k, 2); the distance from the middle is sqrt(2 (1 - cos tilt)).
    """
    facing = normals * np.where(normals @ towards_eye < 0, -1.0, 1.0)[:, None]
    flat = facing @ np.stack(_screen_axes(towards_eye)).T
    length = np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    cosine = np.clip(facing @ towards_eye, 0.0, 1.0)
    return np.asarray(flat / length * np.sqrt(2.0 * (1.0 - cosine))[:, None])


def _plane_normals(session: Session, calibration: HandEyeCalibration) -> Floats:
    """Triangle normals before each half-turn in the base, shape (t, 3)."""
    before = session.base_from_flange[[turn.before for turn in session.half_turns]]
    made = session.mounts[[turn.before for turn in session.half_turns]]
    held = np.array([m.flange_from_triangle.rotation for m in calibration.mounts])
    return np.asarray((before[:, :3, :3] @ held[made])[:, :, 2])


def _screen_axes(towards_eye: Floats) -> tuple[Floats, Floats]:
    """Right and up of a picture whose viewer is in a direction."""
    vertical = np.array([0.0, 0.0, 1.0])
    if abs(towards_eye @ vertical) > 0.99:
        vertical = np.array([0.0, 1.0, 0.0])
    right = np.cross(vertical, towards_eye)
    right /= np.linalg.norm(right)
    return right, np.cross(towards_eye, right)


def frames(session: Session, calibration: HandEyeCalibration) -> str:
    """Where base, cameras and triangle stand, with their axes; drawn to scale."""
    held_out = session.indices("evaluation").tolist()
    mounts, rigs = session.mounts, []
    for k, mount in enumerate(calibration.mounts):
        own = np.flatnonzero(mounts == k).tolist()
        j = next((j for j in held_out if j in own), own[0])
        pose = session.stations[j].base_from_flange @ mount.flange_from_triangle
        # Short names: two triangles may be near to each other.
        several = bool(calibration.other_mounts)
        name = f"mount {k + 1}, station {j}" if several else f"triangle at station {j}"
        rigs.append((name, pose.matrix))
    cameras = 1 + len(rigs)
    places = [
        ("robot base", np.eye(4)),
        *rigs,
        *(
            (camera.name, motion.matrix)
            for camera, motion in zip(
                calibration.cameras, calibration.base_from_camera, strict=True
            )
        ),
    ]
    origins = np.array([pose[:3, 3] for _, pose in places])
    spread = float(np.linalg.norm(np.ptp(origins, axis=0)))
    towards = origins[cameras:].mean(axis=0) - origins[1]
    side = np.cross([0.0, 0.0, 1.0], towards)
    eye = 0.35 * towards / np.linalg.norm(towards) - side / max(
        float(np.linalg.norm(side)), 1e-9
    )
    eye[2] += 0.55
    flat = np.stack(_screen_axes(eye / np.linalg.norm(eye)))
    starts = origins @ flat.T
    # Tips of the three axes of each frame, shape (frames, 3, 2).
    poses = np.array([pose for _, pose in places])
    tips = starts[:, None] + 0.13 * spread * poses[:, :3, :3].swapaxes(1, 2) @ flat.T
    extent = np.ptp(np.vstack([starts, tips.reshape(-1, 2)]), axis=0)

    def draw(figure: Figure) -> None:
        ax = figure.subplots()
        for k in range(cameras, len(places)):
            ax.plot(
                *starts[[0, k]].T,
                linestyle=(0, (2, 2)),
                color="#999999",
                linewidth=0.7,
            )
        letters: list[Text] = []
        for start, ends in zip(starts, tips, strict=True):
            for k, end in enumerate(ends):
                colour = _AXIS_COLOURS[k]
                along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
                ax.annotate(
                    "",
                    (end[0], end[1]),
                    (start[0], start[1]),
                    arrowprops={
                        "arrowstyle": "->",
                        "color": colour,
                        "linewidth": 1.3,
                        "shrinkA": 0,
                        "shrinkB": 0,
                    },
                )
                letters.append(
                    ax.annotate(
                        "xyz"[k],
                        (end[0], end[1]),
                        xytext=(5 * along[0], 5 * along[1]),
                        textcoords="offset points",
                        color=colour,
                        fontsize=7,
                        ha="center",
                        va="center",
                    )
                )
        ax.plot(*tips.reshape(-1, 2).T, alpha=0)
        ax.set_aspect("equal")
        ax.margins(0.14)
        ax.set_axis_off()
        arrows = [(a, b) for a, ends in zip(starts, tips, strict=True) for b in ends]
        sights = [(starts[0], starts[k]) for k in range(cameras, len(places))]
        names = [name for name, _ in places]
        place_names(ax, names, starts, letters, np.array(arrows + sights))

    height = float(np.clip(WIDTH * extent[1] / extent[0], 1.2, 3.8)) + 0.3
    return svg("frames", draw, height)
