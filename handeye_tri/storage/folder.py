"""A session on disk: a plain folder that knows what is done, stale or damaged."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

from handeye_tri.config import CellToCalibrate, parse_any_cell
from handeye_tri.errors import HandEyeError, StorageError
from handeye_tri.storage.files import AGAIN, read_json, sha256, write_json

SESSION_SCHEMA = "handeye_tri.session/2"
StageState = Literal["missing", "stale", "damaged", "done"]
T = TypeVar("T")


def fingerprint(data: Mapping[str, Any]) -> str:
    """SHA-256 of plain data, independent of the order of keys."""
    text = json.dumps(data, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


class SessionFolder:
    """One session folder.

    Attributes:
        path: The folder.
        header: What ``session.json`` holds: schema, software, cell, cell_file,
            model_file, seed, half_turns, simulated, stages.
    """

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        self.path = path
        self.header = header

    @classmethod
    def open(cls, path: Path) -> SessionFolder:
        """Open an existing session.

        Raises:
            StorageError: no session there, or its session.json is damaged.
        """
        if not path.is_dir():
            raise StorageError(
                f"{path}: there is no such session folder; "
                f"make one with: handeye-tri run CELL -o {path}"
            )
        if not (path / "session.json").is_file():
            raise StorageError(
                f"{path}: this folder holds no session.json, so it is no session; "
                "name a folder that handeye-tri wrote"
            )
        header = read_json(
            path / "session.json",
            SESSION_SCHEMA,
            "run or import the session again into a new folder",
        )
        digest = header.pop("sha256", None)
        wrong = [
            key
            for key, kind in (
                ("cell", dict),
                ("stages", dict),
                ("seed", int),
                ("half_turns", int),
                ("model_file", str),
                ("simulated", bool),
            )
            if not isinstance(header.get(key), kind)
        ]
        if wrong:
            raise StorageError(
                f"{path / 'session.json'}: {', '.join(wrong)} missing or of the wrong "
                "kind; run the session again into a new folder"
            )
        if digest != fingerprint(header):
            raise StorageError(
                f"{path / 'session.json'}: it was changed or damaged since it was "
                "written; put it back, or run or import the session again into a new "
                "folder"
            )
        return cls(path, header)

    @classmethod
    def prepare(cls, path: Path, header: dict[str, Any]) -> SessionFolder:
        """Take a new, empty or continued folder for a session; writes nothing.

        A session that is already there goes on: its finished stages are kept, and
        whether they are stale is judged stage by stage.

        Raises:
            StorageError: the folder holds something else.
        """
        if path.exists() and not path.is_dir():
            raise StorageError(f"{path}: this is a file; choose a folder with -o")
        if path.is_dir() and any(path.iterdir()):
            if not (path / "session.json").is_file():
                raise StorageError(
                    f"{path}: this folder holds something else (no session.json); "
                    "choose a new or empty folder with -o"
                )
            old = cls.open(path)
            if not old.header["simulated"]:
                raise StorageError(
                    f"{path}: this session holds a real robot's data, which a "
                    "simulation must not replace; choose another folder with -o"
                )
            header = {**header, "stages": old.header["stages"]}
        return cls(path, header)

    @property
    def cell(self) -> CellToCalibrate:
        """The cell that the session is about."""
        return parse_any_cell(self.header["cell"], str(self.path / "session.json"))

    def file(self, name: str) -> Path:
        """Path of a file of the session; it cannot leave the folder.

        Raises:
            StorageError: the name points out of the session.
        """
        parts = Path(name).parts
        if Path(name).is_absolute() or ".." in parts or not parts:
            raise StorageError(
                f"{self.path / 'session.json'}: the file name {name!r} leaves the "
                "session's folder"
            )
        return self.path / name

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes out while stages run.

        Raises:
            StorageError: another process works on this session, or the folder
                cannot be made.
        """
        made = [p for p in (self.path, *self.path.parents) if not p.exists()]
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            handle = os.open(self.path, os.O_RDONLY)
        except OSError as error:
            raise StorageError(
                f"{self.path}: cannot be made ({(error.strerror or '').lower()}); "
                "choose a folder that you may write with -o"
            ) from None
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            for part in self.path.rglob(".*.part"):
                # A killed process left it; nobody else writes here now.
                part.unlink(missing_ok=True)
            yield
        except BlockingIOError:
            raise StorageError(
                f"{self.path}: another handeye-tri works on this session; "
                "wait for it to end, or choose another folder with -o"
            ) from None
        finally:
            os.close(handle)
            for folder in made:
                # Only folders that stayed empty go: a failed start leaves no trace.
                with contextlib.suppress(OSError):
                    folder.rmdir()

    def state(self, stage: str, inputs: str) -> tuple[StageState, str]:
        """How a stage stands, and a word on why.

        Args:
            stage: Name of the stage.
            inputs: Fingerprint of what the stage would now be made from.
        """
        entry = self.header["stages"].get(stage)
        if not isinstance(entry, dict):
            return "missing", "not done yet"
        if entry.get("inputs") != inputs:
            return "stale", "its inputs changed"
        outputs = entry.get("outputs")
        if not isinstance(outputs, dict) or not outputs:
            return "damaged", "session.json does not say what it wrote"
        for name, why in self.verified(stage):
            if why:
                return "damaged", f"{name} {why}"
        return "done", "up to date"

    def verified(self, stage: str) -> Iterator[tuple[str, str]]:
        """Each file that a finished stage wrote, and what is wrong with it, if so."""
        for name, digest in self.outputs(stage).items():
            path = self.file(name)
            if not path.is_file():
                yield name, "is missing"
            else:
                yield name, "" if sha256(path) == digest else "was changed or damaged"

    def outputs(self, stage: str) -> dict[str, str]:
        """Names and SHA-256 of what a finished stage wrote."""
        entry = self.header["stages"].get(stage)
        outputs = entry.get("outputs") if isinstance(entry, dict) else None
        return dict(outputs) if isinstance(outputs, dict) else {}

    def require(self, stage: str) -> None:
        """Raise StorageError unless a stage's files are there and whole."""
        state, why = self.state(
            stage, (self.header["stages"].get(stage) or {}).get("inputs", "")
        )
        if state != "done":
            raise StorageError(
                f"{self.path}: the stage {stage!r} is needed first: {why}; "
                f"run: handeye-tri {stage} {self.path}"
            )

    def record(self, stage: str, inputs: str, outputs: list[str], line: str) -> None:
        """Note a finished stage in session.json, and drop files it no longer writes."""
        before = set(self.outputs(stage))
        self.header["stages"][stage] = {
            "inputs": inputs,
            "outputs": {name: sha256(self.file(name)) for name in outputs},
            "line": line,
        }
        self.save()
        for name in before - set(outputs):
            self.file(name).unlink(missing_ok=True)

    def save(self) -> None:
        """Write session.json, with the SHA-256 of what it says."""
        write_json(
            self.path / "session.json",
            {**self.header, "sha256": fingerprint(self.header)},
        )


def decoded(
    path: Path,
    schema: str,
    decode: Callable[[dict[str, Any]], T],
    remedy: str = AGAIN,
) -> T:
    """Read one of our JSON files into its record.

    Args:
        path: The file.
        schema: What it must say it is.
        decode: Makes the record of its content.
        remedy: What to do where it cannot be read.

    Raises:
        StorageError: missing, not ours, or a key or value does not fit.
    """
    data = read_json(path, schema, remedy)
    try:
        return decode(data)
    except StorageError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, HandEyeError) as error:
        what = f"key {error}" if isinstance(error, KeyError) else str(error)
        raise StorageError(
            f"{path}: {what} is missing or wrong for {schema}; it is damaged, or of "
            f"another version of handeye-tri; {remedy}"
        ) from None
