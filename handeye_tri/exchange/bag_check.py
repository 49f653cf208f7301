"""Recordings before they are read: checksums fit, and nothing unpacks without end."""

from __future__ import annotations

import bz2
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from handeye_tri.errors import StorageError
from handeye_tri.storage import read_structured

# A recorder's chunks are of a megabyte or a few; no image of ours is larger.
_MAX_UNPACKED = 512 * 1024 * 1024
# Footer's own checksum and the closing magic, which the summary's does not cover.
_BEHIND_SUMMARY = 4 + 8


def check_mcap(path: Path) -> None:
    """Verify every checksum that a file carries: chunks, data section, summary.

    Writers may leave them out; then there is nothing to verify.

    Raises:
        StorageError: one does not fit, or the file is no whole MCAP file.
    """
    from mcap.exceptions import McapError
    from mcap.records import Chunk, Footer
    from mcap.stream_reader import StreamReader, get_chunk_data_stream

    footer = None
    try:
        with path.open("rb") as stream:
            reader = StreamReader(stream, emit_chunks=True, validate_crcs=True)
            for record in reader.records:
                if isinstance(record, Chunk):
                    _refuse_bomb(record)
                    get_chunk_data_stream(record, validate_crc=True)
                elif isinstance(record, Footer):
                    footer = record
        if footer is not None and footer.summary_crc:
            data = path.read_bytes()[footer.summary_start : -_BEHIND_SUMMARY]
            if not footer.summary_start or zlib.crc32(data) != footer.summary_crc:
                raise McapError("crc validation failed in the summary")
    except Exception as error:
        # Damaged lengths and compressed blocks make the libraries raise anything.
        raise StorageError(
            f"{path}: this recording is damaged or cut off "
            f"({type(error).__name__}: {' '.join(str(error).split()):.120}); copy it "
            "again from where it was recorded"
        ) from None
    if footer is None:
        raise StorageError(
            f"{path}: this recording is cut off (no footer); repair it with: "
            "mcap recover, or copy it again"
        )


def _refuse_bomb(chunk: Any) -> None:
    """Raise McapError where a chunk unpacks to more than it says, or may."""
    import lz4.frame
    import zstandard
    from mcap.exceptions import McapError

    size = chunk.uncompressed_size
    found = size
    if size <= _MAX_UNPACKED and chunk.compression == "zstd":
        # -1 where the frame does not say; then the library stops at the chunk's size.
        found = zstandard.frame_content_size(chunk.data)
    elif size <= _MAX_UNPACKED and chunk.compression == "lz4":
        unpacker = lz4.frame.LZ4FrameDecompressor()
        found = len(unpacker.decompress(chunk.data, max_length=size + 1))
    if size > _MAX_UNPACKED or found > size:
        raise McapError(f"a chunk of {size} bytes unpacks to {found} or more")


def bound_chunks(reader: Any) -> None:
    """See that a ``rosbags.rosbag1`` reader unpacks no chunk without end."""
    for place, chunk in reader.chunks.items():
        unpacker = _bounded(chunk.decompressor)
        reader.chunks[place] = chunk._replace(decompressor=unpacker)


def _bounded(unpack: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """An unpacker that raises ValueError for what unpacks to over 512 MiB."""

    def bounded(data: bytes) -> bytes:
        import lz4.frame

        makers: dict[bytes, Callable[[], Any]] = {
            b"BZh": bz2.BZ2Decompressor,
            b"\x04\x22\x4d": lz4.frame.LZ4FrameDecompressor,
        }
        maker = makers.get(data[:3])
        if maker is None:
            return unpack(data)
        whole: bytes = maker().decompress(data, max_length=_MAX_UNPACKED + 1)
        if len(whole) > _MAX_UNPACKED:
            raise ValueError(f"a chunk unpacks to over {_MAX_UNPACKED} bytes")
        return whole

    return bounded


def refuse_compressed(folder: Path) -> None:
    """Raise StorageError for a rosbag2 folder that is compressed as a whole.

    What its files or messages unpack to is only known once they are unpacked.
    """
    about = folder / "metadata.yaml"
    if not about.is_file():
        return
    data = read_structured(about)
    head = data.get("rosbag2_bagfile_information") if isinstance(data, dict) else None
    mode = head.get("compression_mode") if isinstance(head, dict) else None
    if mode and str(mode).lower() != "none":
        raise StorageError(
            f"{about}: compression_mode is {mode!r}, which is not read; write the "
            "recording again without it (ros2 bag convert), or with compressed chunks: "
            "ros2 bag record -s mcap --storage-preset-profile zstd_fast"
        )
