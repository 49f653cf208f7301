"""Checksums of MCAP files: a flipped bit must not become another number."""

from __future__ import annotations

import zlib
from pathlib import Path

from handeye_tri.errors import StorageError

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
