"""The shipped cells, and the table that explains their keys."""

from __future__ import annotations

import re
import typing
from pathlib import Path

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from handeye_tri.config import Cell, parse_cell
from handeye_tri.errors import InputError
from handeye_tri.storage.cells import read_cell

SCENES = Path(__file__).resolve().parent.parent / "scenes"
CELLS = sorted(SCENES.glob("*.yaml"))


def nested(annotation: object) -> tuple[type[BaseModel] | None, bool]:
    """The model inside a field's type, and whether there may be several."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation, False
    for argument in typing.get_args(annotation):
        model, _ = nested(argument)
        if model is not None:
            return model, typing.get_origin(annotation) is tuple
    return None, False


def keys_of(model: type[BaseModel], prefix: str = "") -> dict[str, FieldInfo]:
    """Every leaf key, dotted, with its field."""
    keys = {}
    for name, field in model.model_fields.items():
        key = prefix + (field.alias or name)
        inner, several = nested(field.annotation)
        if inner is None:
            keys[key] = field
        else:
            keys |= keys_of(inner, f"{key}{'[]' if several else ''}.")
    return keys


def documented() -> dict[str, tuple[bool, str]]:
    """Keys of the README's table: whether a default is stated, and the unit."""
    _, table = (SCENES / "README.md").read_text().split("## Keys")
    table = table.split("\n## ")[0]
    rows = re.findall(r"^\| `([\w.\[\]]+)`( \*)? \| *([^|]*?) *\|", table, re.MULTILINE)
    return {key: (bool(star), unit) for key, star, unit in rows}


def test_every_key_is_explained_and_none_that_does_not_exist() -> None:
    keys = keys_of(Cell)
    assert len(keys) > 40
    table = set(documented()) - {"surroundings"}
    assert table - set(keys) == set()
    assert set(keys) - table == set()


def test_what_may_be_left_out_is_marked() -> None:
    optional = {"cameras[].lens.coefficients"}  # a lens as a whole may be left out
    for key, field in keys_of(Cell).items():
        star, _ = documented()[key]
        assert star == (not field.is_required() or key in optional), key


def test_the_unit_in_the_table_is_that_of_the_key() -> None:
    units = {"mm": "mm", "m": "m", "deg": "degrees", "px": "px"}
    for key, (_, unit) in documented().items():
        suffix = key.rsplit("_", 1)[-1]
        if "_" in key and suffix in units:
            assert unit == units[suffix], key


@pytest.mark.parametrize("path", CELLS, ids=lambda path: path.stem)
def test_a_cell_has_the_name_of_its_file_and_a_row(path: Path) -> None:
    assert read_cell(path).name == path.stem
    assert f"| `{path.stem}` |" in (SCENES / "README.md").read_text()


def test_the_four_cells_differ_in_what_they_show() -> None:
    cells = {path.stem: read_cell(path) for path in CELLS}
    assert set(cells) >= {
        "hp3_stereo",
        "hp3_stereo_edge",
        "hp3_stereo_lens",
        "hp3_stereo_mono",
    }
    assert cells["hp3_stereo"].rig.axis == "normal"
    edge = cells["hp3_stereo_edge"].rig
    a, b, c = edge.triangle.points
    lengths = {"AB": abs(b - a), "BC": abs(c - b), "CA": abs(a - c)}
    longest = max(lengths, key=lambda name: float((lengths[name] ** 2).sum()))
    assert edge.axis == longest
    for camera in cells["hp3_stereo_lens"].cameras:
        assert camera.skew_px
        assert camera.lens is not None
        # What bends the picture is estimated, and nothing else.
        assert set(camera.estimate.lens) == set(camera.lens.coefficients)
    assert cells["hp3_stereo_lens"].imaging.noise_percent == 2
    mono = cells["hp3_stereo_mono"]
    assert mono.imaging.grey
    assert mono.rig.identity == "radius"
    assert len(set(mono.rig.marker_colours)) == 1


def test_two_boxes_of_one_name_are_refused() -> None:
    cell = read_cell(SCENES / "hp3_stereo.yaml").model_dump(by_alias=True)
    with pytest.raises(InputError, match=r"my cell: .*'table', 'table'"):
        parse_cell({**cell, "surroundings": cell["surroundings"] * 2}, "my cell")
