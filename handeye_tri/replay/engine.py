"""The only place that imports rerun: files, motions and solids as it takes them."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.chunk import RrdReader
from rerun.experimental import ViewerClient

from handeye_tri.mechanism import Geometry
from handeye_tri.replay.shapes import vertex_normals
from handeye_tri.se3 import quaternion_wxyz
from handeye_tri.storage import write_bytes

__all__ = [
    "RrdReader",
    "connect",
    "only_views",
    "open_tab",
    "recorded",
    "rr",
    "rrb",
    "solid",
    "transform",
]

Floats = NDArray[np.float64]


@contextmanager
def recorded(
    path: Path, name: str, layout: rrb.Blueprint
) -> Iterator[rr.RecordingStream]:
    """A recording to log to, written whole or not at all when all is logged.

    Args:
        path: The file, ``.rrd``.
        name: Names the recording in the viewer.
        layout: Which views a person sees.

    Raises:
        StorageError: the file cannot be written.
    """
    with ExitStack() as stack:
        # What cannot be logged is an error here, never a picture without it.
        stack.callback(rr.set_strict_mode, rr.strict_mode())
        rr.set_strict_mode(True)
        folder = stack.enter_context(TemporaryDirectory(prefix="handeye-tri-"))
        file = Path(folder) / "replay.rrd"
        recording = rr.RecordingStream(
            "handeye_tri",
            recording_id=name,
            send_properties=False,
            # Chunks end where the writer ends, not when a clock says so.
            batcher_config=rr.ChunkBatcherConfig.NEVER(),
        )
        recording.set_log_time_enabled(False)
        recording.save(file, default_blueprint=layout)
        yield recording
        recording.flush()
        recording.disconnect()
        write_bytes(path, file.read_bytes())


def connect(url: str) -> ViewerClient:
    """A client of a running viewer."""
    return ViewerClient.connect(url)


def open_tab(client: ViewerClient, number: int) -> None:
    """Bring a tab of the recording's root container to the front.

    Args:
        client: Of a viewer that shows a recording.
        number: Which tab, from 0.
    """
    layout = client.get_blueprint().blueprint
    root = layout["/viewport"]["ViewportBlueprint"]["root_container"]
    tabs = layout[f"/container/{root}"]["ContainerBlueprint"]
    tabs["active_tab"] = tabs["contents"][number]
    client.set_blueprint(layout, of="recording")


def transform(motion: Floats) -> rr.Transform3D:
    """A motion, shape (4, 4); rerun's quaternions are x y z w."""
    w, x, y, z = quaternion_wxyz(motion[:3, :3])
    return rr.Transform3D(
        translation=motion[:3, 3], quaternion=rr.Quaternion(xyzw=[x, y, z, w])
    )


def solid(geometry: Geometry) -> Any:
    """A geometry as rerun draws it, in its own frame."""
    size = geometry.size
    colour = [round(255 * float(value)) for value in geometry.rgba]
    look = {"colors": [colour], "fill_mode": "solid"}
    if geometry.shape == "box":
        return rr.Boxes3D(half_sizes=[size], **look)
    if geometry.shape in ("sphere", "ellipsoid"):
        return rr.Ellipsoids3D(half_sizes=[np.broadcast_to(size, 3)], **look)
    if geometry.shape == "cylinder":
        return rr.Cylinders3D(radii=[size[0]], lengths=[2 * size[1]], **look)
    if geometry.shape == "capsule":
        # rerun's capsule begins at its first end, ours has its middle at the origin.
        start = [[0.0, 0.0, -float(size[1])]]
        return rr.Capsules3D(
            radii=[size[0]], lengths=[2 * size[1]], translations=start, **look
        )
    if geometry.shape == "plane":
        # Infinite in truth; a thin sheet of the cell's size shows where it is.
        return rr.Boxes3D(half_sizes=[[2.0, 2.0, 1e-4]], **look)
    return rr.Mesh3D(
        vertex_positions=geometry.vertices,
        triangle_indices=geometry.faces,
        vertex_normals=vertex_normals(geometry.vertices, geometry.faces),
        albedo_factor=colour,
    )


def only_views(layout: rrb.Container, time: rrb.TimePanel) -> rrb.Blueprint:
    """A layout without rerun's own panels, the same from run to run."""
    _name_by_place(layout, "layout")
    return rrb.Blueprint(
        layout,
        time,
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TopPanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )


def _name_by_place(part: rrb.Container | rrb.View, place: str) -> None:
    """Give a layout's parts identities that do not change from run to run."""
    part.id = uuid.uuid5(uuid.NAMESPACE_OID, place)
    for number, child in enumerate(getattr(part, "contents", ())):
        if isinstance(child, (rrb.Container, rrb.View)):
            _name_by_place(child, f"{place}/{number}")
