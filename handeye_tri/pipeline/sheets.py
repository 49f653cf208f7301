"""Pictures of what the detection took for what, for a person to look at."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from handeye_tri import storage
from handeye_tri.errors import StorageError
from handeye_tri.pipeline.run import Run


def write_sheets(
    run: Run, folder: Path, progress: Callable[[int, int], None] | None = None
) -> int:
    """Write a sheet of every view, as ``<camera>_<station>.png``.

    The detection is run again, with the session's markers: what is drawn is what it
    finds in these images.

    Args:
        run: A session with its images.
        folder: Made where it is missing.
        progress: Told how many of how many are done.

    Returns:
        How many sheets were written.

    Raises:
        StorageError: an image is missing or damaged, or nothing can be written.
    """
    from handeye_tri.detect import MarkerSpec, detect_markers, detection_sheet

    spec = MarkerSpec.from_rig(run.cell.rig)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(
            f"{folder}: cannot make this folder ({error.strerror}); name another"
        ) from None
    views = [
        (camera.name, j)
        for camera in run.cell.cameras
        for j in range(len(run.plan().stations))
        if run.was_taken(camera.name, j)
    ]
    for done, (camera, j) in enumerate(views, 1):
        image = run.image(camera, j)
        sheet = detection_sheet(image, detect_markers(image, spec))
        storage.write_image(folder / f"{camera}_{j:03d}.png", sheet)
        if progress is not None:
            progress(done, len(views))
    return len(views)
