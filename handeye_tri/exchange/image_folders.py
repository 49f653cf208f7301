"""Images in folders, and which pose each belongs to."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from handeye_tri.counting import counted
from handeye_tri.errors import InputError
from handeye_tri.exchange.capture import MAX_POSES, Capture, ImageStream, Picture, Shot
from handeye_tri.exchange.pose_tables import PoseTable
from handeye_tri.se3 import SE3
from handeye_tri.storage import read_bytes, read_image

TimeUnit = Literal["s", "ns"]
_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm")


def find_images(source: Path, patterns: Mapping[str, str]) -> dict[str, list[Path]]:
    """Image files of each camera, in the order of the numbers in their names.

    Args:
        source: The folder.
        patterns: Glob of each camera's images, below the folder.

    Raises:
        InputError: a pattern leaves the folder or matches no image.
    """
    if not source.is_dir():
        raise InputError(f"{source}: there is no such folder of images")
    found = {}
    for camera, pattern in patterns.items():
        if Path(pattern).is_absolute() or ".." in Path(pattern).parts or not pattern:
            raise InputError(
                f"--image {camera}={pattern!r:.80}: it must stay below {source}"
            )
        try:
            paths = [
                path
                for path in source.glob(pattern)
                if path.suffix.lower() in _SUFFIXES and path.is_file()
            ]
        except (ValueError, NotImplementedError, IndexError, OSError) as error:
            raise InputError(
                f"--image {camera}={pattern!r:.80}: this is no pattern "
                f"({type(error).__name__})"
            ) from None
        if not paths:
            raise InputError(
                f"{source}: no image matches {pattern!r} for camera {camera}; say "
                f"where they are with --image {camera}=PATTERN, such as "
                f"--image {camera}='{camera}/*.png'"
            )
        if len(paths) > MAX_POSES:
            raise InputError(f"{source}: {len(paths)} images match {pattern!r}")
        found[camera] = sorted(paths, key=_by_numbers)
    return found


def _by_numbers(path: Path) -> list[tuple[int, int, str]]:
    """Order in which 2 comes before 10."""
    return [
        (1, int(part), "") if part.isdecimal() and len(part) < 30 else (0, 0, part)
        for part in re.split(r"(\d+)", path.as_posix())
    ]


def paired_stations(table: PoseTable, images: Mapping[str, list[Path]]) -> Capture:
    """Every pose with its images: by the names in the file, or else by order.

    A name is a file's name with or without its suffix, or the last number in it.

    Raises:
        InputError: counts differ, a named pose has no image, or two have the same.
    """
    poses = table.base_from_flange
    if table.names:
        return _by_name(table, images)
    for camera, paths in images.items():
        if len(paths) != len(poses):
            raise InputError(
                f"{counted(len(poses), 'pose')} and {counted(len(paths), 'image')} of "
                f"{camera}; "
                "without names the i-th of both must belong together: add a first "
                "column called image or station to the poses"
            )
    return Capture(
        tuple(
            Shot(
                SE3(pose),
                np.zeros(0),
                {camera: _reader(paths[j]) for camera, paths in images.items()},
                f"pose {j}",
            )
            for j, pose in enumerate(poses)
        )
    )


def _by_name(table: PoseTable, images: Mapping[str, list[Path]]) -> Capture:
    shots, remarks = [], []
    lookups = {camera: _lookup(camera, paths) for camera, paths in images.items()}
    poses: dict[Path, str] = {}
    for name, pose in zip(table.names, table.base_from_flange, strict=True):
        found: dict[str, Picture] = {}
        for camera, lookup in lookups.items():
            path = lookup.get(name) or lookup.get(_number(name))
            if path is None:
                continue
            if path in poses:
                raise InputError(
                    f"the poses {poses[path]!r} and {name!r} have one image, "
                    f"{camera}/{path.name}; name each image once"
                )
            poses[path] = name
            found[camera] = _reader(path)
        if not found:
            some = ", ".join(path.name for paths in images.values() for path in paths)
            raise InputError(
                f"no camera has an image for the pose {name!r}; there are {some:.160}"
            )
        lacking = [camera for camera in images if camera not in found]
        if lacking:
            remarks.append(f"pose {name} has no image of {', '.join(lacking)}")
        shots.append(Shot(SE3(pose), np.zeros(0), found, f"pose {name}"))
    return Capture(tuple(shots), tuple(remarks))


def _lookup(camera: str, paths: Sequence[Path]) -> dict[str, Path]:
    """Images by file name, by stem, and by number where that is unique."""
    table: dict[str, Path] = {}
    numbers = [_number(path.stem) for path in paths]
    for path, number in zip(paths, numbers, strict=True):
        if numbers.count(number) == 1:
            table[number] = path
    for path in paths:
        for name in (path.stem, path.name):
            if table.get(name, path) != path and name not in numbers:
                raise InputError(f"{camera} has two images called {name!r}")
            table[name] = path
    return table


def _number(name: str) -> str:
    """The last whole number in a name without leading zeros, marked as one; or ""."""
    parts = re.findall(r"\d+", name)
    return f"#{parts[-1].lstrip('0') or '0'}" if parts else "#"


def timed_images(paths: Sequence[Path], unit: TimeUnit) -> ImageStream:
    """Images whose names are their times.

    Raises:
        InputError: a name is no time, or two are the same.
    """
    times = []
    for path in paths:
        pattern = r"\d{1,20}" if unit == "ns" else r"\d{1,12}(\.\d{1,12})?"
        if not re.fullmatch(pattern, path.stem):
            raise InputError(
                f"the image {str(path)!r:.160} has a name that is no time in {unit}"
            )
        times.append(int(path.stem) / 1e9 if unit == "ns" else float(path.stem))
    return _ordered(list(paths), times, "their names")


def euroc_images(folder: Path) -> ImageStream:
    """Images of one camera in EuRoC/ASL layout: ``data.csv`` beside ``data/``.

    Raises:
        InputError: the list names a file outside ``data`` or is malformed.
        StorageError: it is missing.
    """
    listing = folder / "data.csv"
    paths, times = [], []
    text = read_bytes(listing).decode("utf-8", "replace")
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        cells = [cell.strip() for cell in line.split(",")]
        if len(cells) != 2 or not re.fullmatch(r"\d{1,20}", cells[0]):
            raise InputError(
                f"{listing}: line {number} must be: timestamp in ns, file name"
            )
        if Path(cells[1]).name != cells[1] or cells[1] in ("", ".", ".."):
            raise InputError(
                f"{listing}: line {number}: {cells[1]!r:.80} is no file in data"
            )
        times.append(int(cells[0]) / 1e9)
        paths.append(folder / "data" / cells[1])
        if len(paths) > MAX_POSES:
            raise InputError(f"{listing}: more than {MAX_POSES} images")
    if not paths:
        raise InputError(f"{listing}: it lists no image")
    return _ordered(paths, times, str(listing))


def _ordered(paths: list[Path], times: list[float], where: str) -> ImageStream:
    order = np.argsort(times, kind="stable")
    sorted_times = [times[i] for i in order]
    if len(set(sorted_times)) < len(sorted_times):
        raise InputError(f"two images of {paths[0].parent} have one time in {where}")

    def read(index: int) -> NDArray[np.uint8]:
        return read_image(paths[order[index]])

    return ImageStream(tuple(sorted_times), read)


def _reader(path: Path) -> Picture:
    return lambda: read_image(path)
