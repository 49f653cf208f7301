"""Whole files only: written under a temporary name, synced, then renamed."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import struct
import tempfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handeye_tri.errors import StorageError

# Larger than any calibration image or record of ours; refuses bombs.
_MAX_BYTES = 256 * 1024 * 1024
_MAX_PIXELS = 100_000_000
# What to do about a file of ours that cannot be read.
AGAIN = "run the stage that wrote it again"
_PNG = b"\x89PNG\r\n\x1a\n"


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file whole, or leave what was there.

    Raises:
        StorageError: the folder cannot be written or the disk is full.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(
            prefix=f".{path.name}.", suffix=".part", dir=path.parent
        )
    except OSError as error:
        raise StorageError(_cannot_write(path, error)) from None
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        # mkstemp makes files private to the user; a result is an ordinary file.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
    except OSError as error:
        raise StorageError(_cannot_write(path, error)) from None
    finally:
        Path(temporary).unlink(missing_ok=True)


def _cannot_write(path: Path, error: OSError) -> str:
    reason = (error.strerror or str(error)).lower()
    return (
        f"{path}: cannot be written ({reason}); nothing was changed; "
        "free the disk, or choose a folder that you may write with -o"
    )


def read_bytes(path: Path) -> bytes:
    """Read a file whole.

    Raises:
        StorageError: missing, unreadable, or over 256 MiB.
    """
    try:
        size = path.stat().st_size
        if size > _MAX_BYTES:
            raise StorageError(
                f"{path}: {size} bytes is more than the {_MAX_BYTES} allowed; "
                "it cannot be one of our files"
            )
        return path.read_bytes()
    except FileNotFoundError:
        raise StorageError(f"{path}: this file is missing") from None
    except OSError as error:
        raise StorageError(
            f"{path}: cannot be read ({(error.strerror or str(error)).lower()})"
        ) from None


def sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    return hashlib.sha256(read_bytes(path)).hexdigest()


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write JSON with sorted sections left in their order; NaN is refused."""
    text = json.dumps(data, indent=1, allow_nan=False, ensure_ascii=False)
    write_bytes(path, (text + "\n").encode())


def read_json(path: Path, schema: str, remedy: str = AGAIN) -> dict[str, Any]:
    """Read JSON that states the expected schema.

    Args:
        path: The file.
        schema: What it must say it is.
        remedy: What to do where it does not.

    Raises:
        StorageError: missing, not JSON, or of another schema.
    """
    try:
        data = json.loads(
            read_bytes(path).decode(), parse_float=_finite, parse_constant=_finite
        )
    except (ValueError, RecursionError) as error:
        raise StorageError(
            f"{path}: this is not readable JSON ({error}); {remedy}"
        ) from None
    found = data.get("schema") if isinstance(data, dict) else None
    if found != schema:
        raise StorageError(
            f"{path}: its schema is {found!r}, this version of handeye-tri reads "
            f"{schema!r}; {remedy}"
        )
    return dict(data)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a finite number")
    return value


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays as .npz, byte for byte the same for the same values."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def read_arrays(
    path: Path, names: tuple[str, ...], optional: tuple[str, ...] = ()
) -> dict[str, NDArray[Any]]:
    """Read named arrays, and optional ones if there; nothing in the file is executed.

    Raises:
        StorageError: missing, damaged, too large, or an array is absent.
    """
    data = read_bytes(path)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            unpacked = sum(entry.file_size for entry in archive.zip.infolist())
            if unpacked > _MAX_BYTES:
                raise StorageError(
                    f"{path}: this unpacks to {unpacked} bytes, more than the "
                    f"{_MAX_BYTES} allowed; it cannot be one of our files"
                )
            absent = [name for name in names if name not in archive.files]
            arrays = {
                name: archive[name]
                for name in (*names, *optional)
                if name in archive.files
            }
    except StorageError:
        raise
    except Exception as error:
        # zipfile, zlib and numpy raise a dozen types for a damaged archive.
        raise StorageError(
            f"{path}: this is not a readable array file ({error}); {AGAIN}"
        ) from None
    if absent:
        raise StorageError(f"{path}: the array {absent[0]!r} is missing; {AGAIN}")
    return arrays


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an image, shape (h, w) or (h, w, 3) RGB, as PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", compress_level=1)
    write_bytes(path, buffer.getvalue())


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read an image as uint8, shape (h, w) or (h, w, 3) RGB.

    Raises:
        StorageError: missing, not an image, damaged, too large, or of more than 8
            bits a channel.
    """
    return decode_image(read_bytes(path), str(path))


def decode_image(data: bytes, name: str) -> NDArray[np.uint8]:
    """An image file's content as uint8, shape (h, w) or (h, w, 3) RGB.

    Args:
        data: The content, in any format that Pillow knows.
        name: What messages call it.

    Raises:
        StorageError: as :func:`read_image`.
    """
    from PIL import Image, UnidentifiedImageError

    _check_png(data, name)
    try:
        with Image.open(io.BytesIO(data)) as picture:
            width, height = picture.size
            if width * height > _MAX_PIXELS:
                raise StorageError(
                    f"{name}: {width} x {height} pixels is more than the "
                    f"{_MAX_PIXELS} allowed"
                )
            if picture.mode.startswith(("I", "F")):
                raise StorageError(
                    f"{name}: more than 8 bits a channel (mode {picture.mode}); "
                    "convert the images to 8 bits, all with the same scale"
                )
            grey = picture.mode in ("L", "1")
            return np.asarray(picture.convert("L" if grey else "RGB"))
    except UnidentifiedImageError:
        raise StorageError(
            f"{name}: this is not an image; take or render it again"
        ) from None
    except (
        *(OSError, SyntaxError, ValueError, EOFError, OverflowError, MemoryError),
        *(TypeError, IndexError, struct.error, zlib.error),
        Image.DecompressionBombError,
    ) as error:
        # Pillow's decoders raise all of these for damaged files.
        raise StorageError(
            f"{name}: this image is damaged ({error}); take or render it again"
        ) from None


def _check_png(data: bytes, name: str) -> None:
    """Verify a PNG's checksums, which Pillow leaves out where the pixels are."""
    if not data.startswith(_PNG):
        return
    place = len(_PNG)
    while place + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, place)
        end = place + 8 + length
        checksum = data[end : end + 4]
        if zlib.crc32(data[place + 4 : end]).to_bytes(4, "big") != checksum:
            raise StorageError(
                f"{name}: this image is damaged (checksum at byte {place}); take or "
                "render it again"
            )
        if kind == b"IEND":
            return
        place = end + 4
    raise StorageError(f"{name}: this image is cut off; take or render it again")
