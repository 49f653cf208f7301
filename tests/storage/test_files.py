import numpy as np
import pytest

from handeye_tri.errors import StorageError
from handeye_tri.storage import files


def test_write_replaces_whole_and_leaves_no_part(tmp_path):
    path = tmp_path / "deep" / "a.json"
    files.write_json(path, {"schema": "s", "x": 1.0})
    files.write_json(path, {"schema": "s", "x": 2.0})
    assert files.read_json(path, "s")["x"] == 2.0
    assert [p.name for p in path.parent.iterdir()] == ["a.json"]


def test_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.bin"
    files.write_bytes(path, b"old")

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(StorageError, match=r"a\.bin: cannot be written \(no space"):
        files.write_bytes(path, b"new")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


def test_json_refuses_nan_and_other_schemas(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        files.write_json(tmp_path / "a.json", {"x": float("nan")})
    assert not (tmp_path / "a.json").exists()
    files.write_json(tmp_path / "a.json", {"schema": "one"})
    with pytest.raises(StorageError, match="'one'.*'two'"):
        files.read_json(tmp_path / "a.json", "two")


@pytest.mark.parametrize("data", [b"", b"{", b"\xff\xfe", b"[1]", b"[" * 100_000])
def test_damaged_json_is_one_clear_error(tmp_path, data):
    path = tmp_path / "a.json"
    path.write_bytes(data)
    with pytest.raises(StorageError, match=r"a\.json"):
        files.read_json(path, "s")


def test_arrays_round_trip_with_nan_and_the_same_bytes(tmp_path):
    values = {"a": np.array([[1.0, np.nan], [np.pi, -0.0]]), "b": np.arange(3)}
    files.write_arrays(tmp_path / "x.npz", values)
    files.write_arrays(tmp_path / "y.npz", values)
    assert (tmp_path / "x.npz").read_bytes() == (tmp_path / "y.npz").read_bytes()
    back = files.read_arrays(tmp_path / "x.npz", ("a", "b"))
    assert np.array_equal(back["a"], values["a"], equal_nan=True)
    with pytest.raises(StorageError, match="'c' is missing"):
        files.read_arrays(tmp_path / "x.npz", ("c",))


def test_every_flipped_byte_of_an_array_file_is_noticed_or_harmless(tmp_path):
    values = {"a": np.arange(6.0).reshape(2, 3)}
    path = tmp_path / "x.npz"
    files.write_arrays(path, values)
    whole = path.read_bytes()
    outcomes = set()
    for position in range(len(whole)):
        damaged = bytearray(whole)
        damaged[position] ^= 0x10
        path.write_bytes(bytes(damaged))
        try:
            same = np.array_equal(files.read_arrays(path, ("a",))["a"], values["a"])
        except StorageError:
            outcomes.add("refused")
        else:
            assert same
            outcomes.add("same")
    assert "refused" in outcomes


def test_pickled_arrays_are_refused(tmp_path):
    np.savez(tmp_path / "x.npz", a=np.array([{"code": 1}], dtype=object))
    with pytest.raises(StorageError, match="not a readable array file"):
        files.read_arrays(tmp_path / "x.npz", ("a",))


@pytest.mark.parametrize("shape", [(4, 5, 3), (4, 5)])
def test_images_round_trip_exactly(tmp_path, shape):
    image = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    files.write_image(tmp_path / "i.png", image)
    assert np.array_equal(files.read_image(tmp_path / "i.png"), image)


def test_bad_images_are_one_clear_error(tmp_path):
    path = tmp_path / "i.png"
    with pytest.raises(StorageError, match=r"i\.png: this file is missing"):
        files.read_image(path)
    path.write_text("no image")
    with pytest.raises(StorageError, match="not an image"):
        files.read_image(path)
    noise = np.random.default_rng(1).integers(0, 256, (40, 50, 3), dtype=np.uint8)
    files.write_image(path, noise)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(StorageError, match="damaged"):
        files.read_image(path)
