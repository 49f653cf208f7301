"""A recorded robot whose triangle was put on another mount on the way."""

from __future__ import annotations

import numpy as np
import pytest
from exported import call
from PIL import Image
from ruamel.yaml import YAML

from handeye_tri.pipeline import NullProgress, Run
from handeye_tri.storage import SessionFolder
from handeye_tri.synthesize import two_mount_geometry

MEASURED = {
    "schema": "handeye_tri.measured_cell/1",
    "name": "bench",
    "arm": {"repeatability_mm": 0.03, "repeatability_deg": 0.005},
    "rig": {
        "axis": "normal",
        "side_ab_mm": 130,
        "side_ac_mm": 120,
        "angle_deg": 65,
        "marker_radii_mm": [8, 8, 8],
        "marker_colours": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "identity": "colour",
    },
    "cameras": [{"name": "left", "image_size_px": [16, 12]}],
}


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A folder with poses, images and two cells, and what was driven."""
    folder = tmp_path_factory.mktemp("bench")
    driven = two_mount_geometry(
        np.random.default_rng(5), half_turns=3, evaluation_stations=1
    )
    poses = [station.base_from_flange.matrix for station in driven.stations]
    rows = [",".join(map(repr, pose.ravel().tolist())) for pose in poses]
    (folder / "poses.csv").write_text("\n".join(rows))
    (folder / "left").mkdir()
    for j in range(len(poses)):
        Image.new("RGB", (16, 12)).save(folder / "left" / f"{j}.png")
    for name, more in (("one", {}), ("two", {"second_mount": {"axis": "BC"}})):
        with (folder / f"{name}.yaml").open("w") as stream:
            YAML(typ="safe").dump({**MEASURED, **more}, stream)
    return folder, driven


def imported(capsys, bench, out, cell, *options):
    folder = bench[0]
    return call(
        *(capsys, "import", "images", folder, "-o", out),
        *("--cell", folder / f"{cell}.yaml", "--poses", folder / "poses.csv"),
        *("--pose-format", "matrix:m", "--direction", "flange_in_base", *options),
    )


def test_half_turns_are_found_within_each_mount(capsys, bench, tmp_path):
    driven = bench[1]
    code, out, err = imported(
        capsys, bench, tmp_path / "out", "two", "--tool-change", "7"
    )
    assert code == 0, err
    plan = Run(SessionFolder.open(tmp_path / "out"), NullProgress()).plan()
    assert plan.half_turns == driven.half_turns
    assert [(s.mount, s.kind) for s in plan.stations] == [
        (s.mount, s.kind) for s in driven.stations
    ]
    assert plan.tool_change is not None
    assert plan.tool_change.before == 7
    assert "mount 1: 3 half-turns about normal found in the poses" in out
    assert "mount 2: 3 half-turns about BC found in the poses" in out
    assert out.count("their axis in the flange") == 2
    assert "held out for the test: 6, 13 (" in out


def test_half_turns_are_named_within_each_mount(capsys, bench, tmp_path):
    code, out, _ = imported(
        *(capsys, bench, tmp_path / "out", "two", "--tool-change", "7"),
        *("--half-turns", "7-8,0-1,2-3"),
    )
    assert code == 0
    plan = Run(SessionFolder.open(tmp_path / "out"), NullProgress()).plan()
    assert [(t.before, t.after, t.axis) for t in plan.half_turns] == [
        (0, 1, "normal"),
        (2, 3, "normal"),
        (7, 8, "BC"),
    ]
    assert "mount 2: 1 half-turn about BC as named" in out


@pytest.mark.parametrize(
    ("cell", "options", "message"),
    [
        ("two", [], "bench has two mounts; say which station, counted from 0, is the"),
        ("one", ["--tool-change", "7"], "--tool-change 7: cell bench has one mount"),
        ("two", ["--tool-change", "0"], "must be one of the stations 1 to 13"),
        ("two", ["--tool-change", "14"], "must be one of the stations 1 to 13"),
        (
            "two",
            ["--tool-change", "1", "--half-turns", "0-1,2-3"],
            "0-1 goes on over the tool change before station 1",
        ),
    ],
)
def test_a_tool_change_must_be_stated_and_possible(
    capsys, bench, tmp_path, cell, options, message
):
    code, _, err = imported(capsys, bench, tmp_path / "out", cell, *options)
    assert code == 2
    assert message in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "out").exists()
