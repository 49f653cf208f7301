"""What scripts/README.md tells a user to type and to write is taken as it stands."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from handeye_tri import cli
from handeye_tri.config import MeasuredCell, parse_any_cell
from handeye_tri.exchange.pose_tables import PoseFormat
from handeye_tri.pipeline.export import FORMATS
from handeye_tri.pipeline.sources import SOURCES

TEXT = (Path(__file__).resolve().parents[2] / "scripts" / "README.md").read_text()
RECIPE = TEXT.partition("## Your own robot in ten steps")[2]
COMMANDS = re.findall(
    r"(?:^\s*|`)(handeye-tri (?!import`)[^`\n]*?)\s*(?:`|$)", RECIPE, re.M
)


def test_the_recipe_has_ten_steps():
    assert re.findall(r"^(\d+)\. \*\*", RECIPE, re.M) == [str(k) for k in range(1, 11)]


@pytest.mark.parametrize(
    "line", [line for line in COMMANDS if "--cell" not in line[-6:]]
)
def test_its_commands_parse(line):
    verb, *arguments = shlex.split(line)[1:]
    with cli.commands.commands[verb].make_context(verb, arguments) as context:
        assert context.params


def test_its_cell_is_a_measured_cell():
    block = re.search(r"```yaml\n(.*?)```", RECIPE, re.S)[1]
    cell = parse_any_cell(YAML(typ="safe").load(block), "bench.yaml")
    assert isinstance(cell, MeasuredCell)
    assert [camera.info.lens for camera in cell.cameras] == [("k1", "k2")] * 2


def first_column(title):
    rows = RECIPE.partition(title)[2].partition("\n### ")[0]
    return re.findall(r"^\| (`[^|]*) \|", rows, re.M)


def test_its_tables_name_every_format():
    read = first_column("### What `import` reads")
    assert [cell.strip("`") for cell in read[: len(SOURCES)]] == list(SOURCES)
    rest = re.findall(r"`([^`]+)`", " ".join(read[len(SOURCES) :]))
    layouts = [word for word in rest if ":" in word]
    assert {PoseFormat.parse(layout).rotation for layout in layouts} == {
        *("matrix", "quaternion-wxyz", "quaternion-xyzw", "rotation-vector"),
        *("axis-angle", "euler"),
    }
    written = first_column("### What `export` writes")
    assert [cell.strip("`") for cell in written] == list(FORMATS)


def test_the_command_line_offers_what_the_pipeline_has():
    def choices(verb):
        (argument,) = (
            p for p in cli.commands.commands[verb].params if p.name == "layout"
        )
        return list(argument.type.choices)

    assert choices("export") == list(FORMATS)
    assert sorted(choices("import")) == sorted(SOURCES)
