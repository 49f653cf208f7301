"""A healthy cell, rendered once, whose images and truth can be changed in part."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from handeye_tri import simulate
from handeye_tri.arm import Arm
from handeye_tri.config import Cell
from handeye_tri.detect import MarkerSpec, detect_markers
from handeye_tri.records import Floats, HalfTurn, Plan, Session, Station

Image = NDArray[np.uint8]
View = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """What calibration gets of a cell.

    Attributes:
        session: What was detected and what is stated.
        edges: How wide the markers' edges are, (m, n, 3, 3), px^2.
    """

    session: Session
    edges: Floats


@dataclass(slots=True, eq=False)
class RenderedCell:
    """A healthy cell, rendered once, of which faults change what they must.

    Attributes:
        cell: Its description.
        model_path: The arm's model.
        arm: Its kinematics, whatever the mount.
        plan: What the robot is told.
        joints: Where it truly goes, (n, q), rad or m.
        seed: Of the sensor's noise.
        images: By camera and station.
        found: What was detected in them: pixels, covariance, edges.
    """

    cell: Cell
    model_path: Path
    arm: Arm
    plan: Plan
    joints: Floats
    seed: int
    images: dict[View, Image] = field(default_factory=dict)
    found: tuple[Floats, Floats, Floats] | None = None

    @property
    def views(self) -> list[View]:
        """All views."""
        cameras = range(len(self.cell.cameras))
        return [(i, j) for j in range(len(self.plan.stations)) for i in cameras]

    def photograph(self) -> None:
        """Render and detect the healthy views."""
        self.images = self.rendered(self.cell, self.joints, self.views)
        m, n = len(self.cell.cameras), len(self.plan.stations)
        blank = (
            np.full((m, n, 3, 2), np.nan),
            np.full((m, n, 3, 2, 2), np.nan),
            np.full((m, n, 3, 3), np.nan),
        )
        self.found = self._detected(blank, self.images)

    @property
    def mounts(self) -> list[int]:
        """Which mount truly holds the triangle at each station, from 0."""
        return [station.mount for station in self.plan.stations]

    def rendered(
        self,
        cell: Cell,
        joints: Floats,
        views: Iterable[View],
        mounts: Sequence[int] | None = None,
    ) -> dict[View, Image]:
        """Images of some views of a cell whose truth may be another.

        Args:
            cell: The cell as it then is.
            joints: Where the robot then is at each station, shape (n, q), rad or m.
            views: Camera and station of each.
            mounts: Of that cell, at each station; None: as planned.
        """
        drawn = simulate.render_views(
            *(cell, self.model_path, joints, self.seed, views),
            mounts=self.mounts if mounts is None else mounts,
        )
        return {(i, j): image for i, j, image in drawn}

    def observed(
        self,
        changed: Mapping[View, Image] | None = None,
        stations: tuple[Station, ...] | None = None,
        half_turns: tuple[HalfTurn, ...] | None = None,
    ) -> Observed:
        """What calibration gets where some images are other ones.

        Args:
            changed: Images that replace the healthy ones.
            stations: What the robot reports; None for what it was told.
            half_turns: Of those stations; None for the plan's.
        """
        assert self.found is not None
        pixels, covariance, edges = self._detected(self.found, changed or {})
        return Observed(
            Session(
                triangle=self.cell.rig.triangle,
                marker_radii=1e-3 * np.array(self.cell.rig.marker_radii_mm),
                cameras=tuple(camera.info for camera in self.cell.cameras),
                stations=self.plan.stations if stations is None else stations,
                half_turns=self.plan.half_turns if half_turns is None else half_turns,
                pixels=pixels,
                pixel_covariance=covariance,
                repeatability=self.cell.repeatability,
                simulated=True,
            ),
            edges,
        )

    def _detected(
        self, known: tuple[Floats, Floats, Floats], images: Mapping[View, Image]
    ) -> tuple[Floats, Floats, Floats]:
        pixels, covariance, edges = (values.copy() for values in known)
        spec = MarkerSpec.from_rig(self.cell.rig)
        for view, image in images.items():
            found = detect_markers(image, spec)
            pixels[view], covariance[view] = found.pixels, found.covariance
            edges[view] = found.edges
        return pixels, covariance, edges
