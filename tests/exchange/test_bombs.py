"""What unpacks to more than any memory is refused before it is unpacked."""

import bz2
import io
import json
import zipfile
from types import SimpleNamespace

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.exceptions import McapError
from mcap.writer import CompressionType, Writer
from PIL import Image

from handeye_tri.errors import InputError, StorageError
from handeye_tri.exchange import bag_check
from handeye_tri.exchange.bags import BagFile
from handeye_tri.storage import decode_image, files, read_arrays, read_structured

MEGABYTE = bytes(10**6)


def test_an_archive_of_zeros(monkeypatch, tmp_path):
    """A kilobyte that unpacks to a megabyte, where a tenth of that is allowed."""
    path = tmp_path / "observations.npz"
    inside = io.BytesIO()
    np.save(inside, np.zeros(10**6, dtype=np.uint8))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("pixels.npy", inside.getvalue())
    assert path.stat().st_size < 3000
    assert len(read_arrays(path, ("pixels",))["pixels"]) == 10**6
    monkeypatch.setattr(files, "_MAX_BYTES", 10**5)
    with pytest.raises(StorageError, match=r"unpacks to 1000128 bytes, more than"):
        read_arrays(path, ("pixels",))


def test_an_array_that_lies_about_its_shape(tmp_path):
    path = tmp_path / "observations.npz"
    head = str({"descr": "<f8", "fortran_order": False, "shape": (1 << 40,)})
    data = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head.encode()
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("pixels.npy", data)
    with pytest.raises(StorageError, match="not a readable array file"):
        read_arrays(path, ("pixels",))


def test_an_array_that_would_be_executed(tmp_path):
    path = tmp_path / "observations.npz"
    np.savez(path, pixels=np.array([SimpleNamespace()], dtype=object))
    with pytest.raises(StorageError, match="not a readable array file"):
        read_arrays(path, ("pixels",))


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_an_image_larger_than_any_camera():
    buffer = io.BytesIO()
    Image.new("1", (20_000, 20_000)).save(buffer, format="PNG")
    assert buffer.tell() < 10**5
    with pytest.raises(StorageError, match=r"20000 x 20000 pixels|damaged"):
        decode_image(buffer.getvalue(), "bomb.png")


@pytest.mark.parametrize("suffix", [".json", ".yaml"])
def test_nesting_without_end(tmp_path, suffix):
    path = tmp_path / f"deep{suffix}"
    path.write_text("[" * 50_000)
    with pytest.raises(StorageError, match="this is not readable"):
        read_structured(path)
    path = tmp_path / "ours.json"
    path.write_text(json.dumps({"schema": "s"})[:-1] + ', "x": ' + "[" * 50_000)
    with pytest.raises(StorageError, match="this is not readable JSON"):
        files.read_json(path, "s")


def test_aliases_of_aliases(tmp_path):
    rows = ["a0: &a0 [" + "1," * 10 + "]"]
    rows += [f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 9)]
    (tmp_path / "laughs.yaml").write_text("\n".join(rows))
    with pytest.raises(InputError, match="unfolds to more than"):
        read_structured(tmp_path / "laughs.yaml")


@pytest.mark.parametrize("said", [10**6, 1000])
@pytest.mark.parametrize(
    ("name", "pack"),
    [("zstd", zstandard.ZstdCompressor().compress), ("lz4", lz4.frame.compress)],
)
def test_a_chunk_that_unpacks_to_more_than_it_says(name, pack, said):
    chunk = SimpleNamespace(
        compression=name, data=pack(MEGABYTE), uncompressed_size=said
    )
    if said == len(MEGABYTE):
        bag_check._refuse_bomb(chunk)
        return
    with pytest.raises(McapError, match="a chunk of 1000 bytes unpacks to"):
        bag_check._refuse_bomb(chunk)


@pytest.mark.parametrize("kind", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_recording_of_huge_chunks(monkeypatch, tmp_path, kind):
    path = tmp_path / "x.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=kind, chunk_size=10**7)
        writer.start(profile="ros2")
        schema = writer.register_schema("x/X", "ros2msg", b"uint8[] data")
        channel = writer.register_channel("/x", "cdr", schema)
        writer.add_message(channel, 1, MEGABYTE, 1)
        writer.finish()
    assert path.stat().st_size < 10**4
    assert set(BagFile(path).topics) == {"/x"}
    monkeypatch.setattr(bag_check, "_MAX_UNPACKED", 10**5)
    with pytest.raises(StorageError, match="damaged or cut off"):
        BagFile(path)


@pytest.mark.parametrize("pack", [bz2.compress, lz4.frame.compress])
def test_a_chunk_of_a_ros_1_bag(monkeypatch, pack):
    unpack = bag_check._bounded(bytes)
    assert unpack(pack(MEGABYTE)) == MEGABYTE
    assert unpack(b"plain") == b"plain"
    monkeypatch.setattr(bag_check, "_MAX_UNPACKED", 10**5)
    with pytest.raises(ValueError, match="unpacks to over 100000 bytes"):
        unpack(pack(MEGABYTE))


@pytest.mark.parametrize("mode", ["FILE", "message"])
def test_a_folder_compressed_as_a_whole(tmp_path, mode):
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").write_text(
        f"rosbag2_bagfile_information: {{compression_mode: {mode}}}\n"
    )
    with pytest.raises(StorageError, match=f"compression_mode is '{mode}'"):
        BagFile(folder)
