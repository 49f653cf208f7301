"""Finding and reading cell descriptions and robot models."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from handeye_tri.config import Cell, CellToCalibrate, parse_any_cell, parse_cell
from handeye_tri.errors import InputError
from handeye_tri.storage.files import read_bytes


def shipped(folder: str) -> Path:
    """The folder ``robot_models`` or ``scenes``, in the wheel or in the checkout."""
    package = Path(__file__).resolve().parent.parent
    inside = package / folder
    return inside if inside.is_dir() else package.parent / folder


def find_cell(name_or_path: str) -> Path:
    """Path of a cell given by path, or by its name in ``scenes``.

    Raises:
        InputError: neither exists; lists the shipped names.
    """
    given = Path(name_or_path)
    if given.suffix in (".yaml", ".yml") or given.is_file():
        if not given.is_file():
            raise InputError(f"{given}: there is no such cell file")
        return given.resolve()
    path = shipped("scenes") / f"{name_or_path}.yaml"
    if "/" in name_or_path or not path.is_file():
        names = sorted(p.stem for p in shipped("scenes").glob("*.yaml"))
        raise InputError(
            f"there is no cell {name_or_path!r}; give the path of a YAML file, "
            f"or one of {', '.join(names)}"
        )
    return path


def read_cell(path: Path) -> Cell:
    """Read and check the description of a cell to plan and simulate.

    Raises:
        InputError: not YAML, an unknown key, a wrong unit, an impossible value.
    """
    return parse_cell(_mapping(path), str(path))


def read_any_cell(path: Path) -> CellToCalibrate:
    """Read and check a cell description of either kind.

    Raises:
        InputError: as :func:`read_cell`.
    """
    return parse_any_cell(_mapping(path), str(path))


def _mapping(path: Path) -> dict[str, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        data = YAML(typ="safe", pure=True).load(read_bytes(path).decode())
    except UnicodeDecodeError:
        raise InputError(f"{path}: this is not a UTF-8 text file") from None
    except YAMLError as error:
        detail = " ".join(str(error).split())
        raise InputError(f"{path}: this is not valid YAML: {detail}") from None
    if not isinstance(data, dict):
        raise InputError(f"{path}: a cell description is a mapping of keys")
    return data


def find_model(cell: Cell, cell_path: Path) -> Path:
    """Path of the arm's model: beside the cell, absolute, or in ``robot_models``.

    Raises:
        InputError: there is no such file.
    """
    for folder in (cell_path.parent, shipped("robot_models")):
        path = folder / cell.arm.model
        if path.is_file():
            return path.resolve()
    names = sorted(p.name for p in shipped("robot_models").glob("*.xml"))
    raise InputError(
        f"{cell_path}: arm.model: no file {cell.arm.model!r} beside the cell; "
        f"give its path, or one of {', '.join(names)}"
    )
