"""Cell descriptions: what they mean in space, and every way to get one wrong."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from handeye_tri.config import Cell, RigConfig, parse_any_cell, parse_cell
from handeye_tri.errors import InputError
from handeye_tri.triangle import AXES

SCENES = Path(__file__).resolve().parent.parent / "scenes"
Description = dict[str, Any]


@pytest.fixture(scope="module")
def shipped() -> Description:
    return YAML(typ="safe", pure=True).load(  # type: ignore[no-any-return]
        (SCENES / "hp3_stereo.yaml").read_text()
    )


@pytest.fixture
def cell(shipped: Description) -> Description:
    return copy.deepcopy(shipped)


def rig(**changes: Any) -> RigConfig:
    values: Description = {
        "axis": "normal",
        "side_ab_mm": 130,
        "side_ac_mm": 120,
        "angle_deg": 65,
        "ahead_mm": 90,
        "marker_radii_mm": [8, 8, 8],
        "marker_colours": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "identity": "colour",
    }
    return RigConfig.model_validate(values | changes)


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.yaml")), ids=lambda p: p.stem)
def test_shipped_cells_are_valid_and_named_after_their_file(path: Path) -> None:
    description = YAML(typ="safe", pure=True).load(path.read_text())
    assert parse_cell(description, path.name).name == path.stem


def test_units_are_converted_once(cell: Description) -> None:
    parsed = parse_cell(cell, "cell.yaml")
    assert parsed.rig.triangle.side_ab == pytest.approx(0.130)
    assert parsed.rig.triangle.angle == pytest.approx(np.radians(65))
    assert parsed.repeatability.translation == pytest.approx(3e-5)
    assert parsed.repeatability.rotation == pytest.approx(np.radians(0.005))


def test_a_parsed_cell_survives_its_own_dump(cell: Description) -> None:
    parsed = parse_cell(cell, "cell.yaml")
    assert Cell.model_validate(parsed.model_dump(by_alias=True)) == parsed


@pytest.mark.parametrize("turn", [0.0, 37.0])
def test_normal_rig_meets_its_plane_in_the_circumcentre(turn: float) -> None:
    """All markers lie 90 mm ahead, equally far from the flange's axis, facing ahead."""
    config = rig(turn_deg=turn)
    markers = config.flange_from_triangle.apply(config.triangle.points)
    assert markers[:, 2] == pytest.approx(0.09)
    radii = np.hypot(markers[:, 0], markers[:, 1])
    assert radii == pytest.approx(radii[0])
    assert config.flange_from_triangle.rotation[:, 2] == pytest.approx([0, 0, 1])


def test_a_normal_rig_may_state_its_axis() -> None:
    found = rig(o_mm=(31.0, 12.5)).flange_from_triangle
    np.testing.assert_allclose(found.apply([0.031, 0.0125, 0.0])[:2], 0.0, atol=1e-15)


@pytest.mark.parametrize("axis", [a for a in AXES if a != "normal"])
def test_edge_rig_has_its_edge_on_the_flange_axis(axis: str) -> None:
    """Turning by 180 degrees about z keeps the edge and mirrors the third marker."""
    config = rig(axis=axis, turn_deg=20)
    markers = config.flange_from_triangle.apply(config.triangle.points)
    first, second = ("ABC".index(letter) for letter in axis)
    assert markers[[first, second], :2] == pytest.approx(np.zeros((2, 2)), abs=1e-15)
    assert markers[first, 2] == pytest.approx(0.09)
    assert markers[second, 2] > markers[first, 2]
    third = 3 - first - second
    half_turn = config.triangle.half_turn(axis)  # type: ignore[arg-type]
    turned = config.flange_from_triangle @ half_turn
    assert turned.apply(config.triangle.points)[third, :2] == pytest.approx(
        -markers[third, :2]
    )
    # The third marker stands in the direction turn_deg from x.
    assert np.degrees(np.arctan2(markers[third, 1], markers[third, 0])) == (
        pytest.approx(20)
    )


def test_camera_looks_where_it_is_told(cell: Description) -> None:
    """The target is on the optical axis, up is up in the picture, right is right."""
    camera = parse_cell(cell, "cell.yaml").cameras[0]
    seen = camera.world_from_camera.inverse()
    target = seen.apply(camera.look_at_m)
    assert target[:2] == pytest.approx([0, 0], abs=1e-15)
    assert target[2] == pytest.approx(
        np.linalg.norm(np.subtract(camera.look_at_m, camera.position_m))
    )
    above = np.add(camera.look_at_m, (0, 0, 0.1))
    assert seen.apply(above)[1] < -0.09
    # From +x, looking along -x, world +y is on the right.
    beside = np.add(camera.look_at_m, (0, 0.1, 0))
    assert seen.apply(beside)[0] > 0.09


def test_roll_turns_the_camera_about_its_axis(cell: Description) -> None:
    """Rolled by +90 degrees about z forward, what was below appears on the right."""
    cell["cameras"][0]["roll_deg"] = 90
    camera = parse_cell(cell, "cell.yaml").cameras[0]
    below = np.add(camera.look_at_m, (0, 0, -0.1))
    x, y, _ = camera.world_from_camera.inverse().apply(below)
    assert x > 0.09
    assert y == pytest.approx(0, abs=1e-12)


def test_a_camera_may_look_straight_down(cell: Description) -> None:
    cell["cameras"][0] |= {"position_m": [0.4, 0, 2], "look_at_m": [0.4, 0, 0]}
    camera = parse_cell(cell, "cell.yaml").cameras[0]
    assert camera.world_from_camera.rotation[:, 2] == pytest.approx([0, 0, -1])


def test_lens_coefficients_go_by_name(cell: Description) -> None:
    cell["cameras"][0]["lens"] = {"coefficients": {"p2": 1e-3, "k1": -0.1}}
    cell["cameras"][0]["estimate"] = {"skew": False, "lens": ["k1", "p2"]}
    camera = parse_cell(cell, "cell.yaml").cameras[0]
    assert camera.camera.lens.coefficients.tolist() == [-0.1, 0, 0, 1e-3, 0]
    assert camera.info.lens == ("k1", "p2")
    assert not camera.info.skew


def put(*path: Any) -> Callable[[Description], None]:
    """Set the last value at the place that the others name."""

    def change(cell: Description) -> None:
        place: Any = cell
        for key in path[:-2]:
            place = place[key]
        place[path[-2]] = path[-1]

    return change


def rename(section: str, old: str, new: str) -> Callable[[Description], None]:
    def change(cell: Description) -> None:
        place = cell[section][0] if section == "cameras" else cell[section]
        place[new] = place.pop(old)

    return change


def drop(*path: Any) -> Callable[[Description], None]:
    def change(cell: Description) -> None:
        place: Any = cell
        for key in path[:-1]:
            place = place[key]
        place.pop(path[-1])

    return change


UNKNOWN = "this key is not known here"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        # An unknown key, a misspelt key, a wrong unit.
        (put("robot", "hp3"), f"robot: {UNKNOWN}; remove it"),
        (
            rename("arm", "flange", "flnge"),
            f"arm.flnge: {UNKNOWN}; did you mean flange?",
        ),
        (
            rename("cameras", "position_m", "position_mm"),
            f"cameras.0.position_mm: {UNKNOWN}; convert the value and call it "
            "position_m",
        ),
        (
            rename("rig", "angle_deg", "angle_rad"),
            f"rig.angle_rad: {UNKNOWN}; convert the value and call it angle_deg",
        ),
        # A missing key.
        (drop("rig"), "rig: this key is missing; add it"),
        (drop("schema"), "schema: this key is missing; add it"),
        (
            drop("cameras", 1, "focal_px"),
            "cameras.1.focal_px: this key is missing; add it",
        ),
        # A rig that cannot be.
        (
            put("rig", "angle_deg", 0.2),
            "rig: A, B and C are nearly collinear: the smallest angle is 0.200 "
            "degrees (needs at least 1); move one marker off the line",
        ),
        (
            put("rig", "marker_radii_mm", [8, 80, 60]),
            "rig: markers of marker_radii_mm [8.0, 80.0, 60.0] touch each other at "
            "sides of 130.0, 134.6, 120.0 mm; make the markers smaller or the "
            "triangle larger",
        ),
        (
            put("rig", "marker_colours", [[1, 0, 0], [1, 0, 0], [0, 0, 1]]),
            "rig: identity: colour needs three different marker_colours; use three "
            "colours, or identity: radius",
        ),
        (
            put("rig", "holder", "board"),
            "rig: holder: board does not hold an axis normal: a clock's hands turn "
            "about a normal, a board about an edge; use holder: rods",
        ),
        (
            lambda cell: cell["rig"].update(axis="CA", o_mm=[10.0, 20.0]),
            "rig: o_mm says where a normal axis meets the plane, but axis is CA; leave "
            "o_mm out, or use axis: normal",
        ),
        (
            put("rig", "identity", "radius"),
            "rig: identity: radius needs marker_radii_mm at least 10 % apart, got "
            "[8.0, 8.0, 8.0]",
        ),
        # Impossible values.
        (
            put("schema", "handeye_tri.cell/0"),
            "schema: input should be 'handeye_tri.cell/1', got 'handeye_tri.cell/0'",
        ),
        (
            put("rig", "side_ab_mm", -130),
            "rig.side_ab_mm: input should be greater than 0, got -130",
        ),
        (
            put("arm", "repeatability_mm", "30 um"),
            "arm.repeatability_mm: input should be a valid number, got '30 um'",
        ),
        (
            put("arm", "repeatability_mm", True),
            "arm.repeatability_mm: input should be a valid number, got True",
        ),
        (
            put("arm", "repeatability_mm", float("nan")),
            "arm.repeatability_mm: input should be a finite number, got nan",
        ),
        (
            put("plan", "half_turns", 11.5),
            "plan.half_turns: input should be a valid integer, got 11.5",
        ),
        (
            put("imaging", "grey", "no"),
            "imaging.grey: input should be a valid boolean, got 'no'",
        ),
        (
            put("plan", "workspace_max_m", [0.6, -0.2, 0.5]),
            "plan: workspace_max_m must exceed workspace_min_m on every axis, got "
            "sides [0.25, -0.05, 0.23] m",
        ),
        # Cameras.
        (put("cameras", []), "cameras: at least 1 is needed, got 0"),
        (put("cameras", 0, 3), "cameras.0: this must be a mapping of keys, got 3"),
        (
            put("cameras", 1, "name", "left"),
            "the cell: camera names must differ, got ['left', 'left']",
        ),
        (
            put("cameras", 0, "look_at_m", [1.35, 0.125, 0.45]),
            "cameras.0: look_at_m must differ from position_m",
        ),
        (
            put("cameras", 0, "lens", {"coefficients": {"k9": 0.1}}),
            "cameras.0.lens: coefficients ['k9'] are not in a radtan lens; it has "
            "k1 k2 p1 p2 k3",
        ),
        (
            put("cameras", 0, "estimate", {"lens": ["k1", "k1"]}),
            "cameras.0.estimate: lens ['k1', 'k1'] must name coefficients of a radtan "
            "lens, each once: k1 k2 p1 p2 k3",
        ),
    ],
)
def test_one_sentence_names_file_key_value_and_remedy(
    cell: Description, change: Callable[[Description], None], sentence: str
) -> None:
    change(cell)
    with pytest.raises(InputError) as raised:
        parse_cell(cell, "cell.yaml")
    assert str(raised.value) == f"cell.yaml: {sentence}"


def test_every_wrong_key_is_reported_at_once(cell: Description) -> None:
    put("robot", 1)(cell)
    drop("plan", "workspace_min_m")(cell)
    with pytest.raises(InputError, match=r"workspace_min_m: this key is.*; robot: "):
        parse_cell(cell, "cell.yaml")


def test_a_long_value_is_cut(cell: Description) -> None:
    cell["name"] = "x y " * 100
    with pytest.raises(InputError) as raised:
        parse_cell(cell, "cell.yaml")
    assert len(str(raised.value)) < 200


MEASURED = {
    "schema": "handeye_tri.measured_cell/1",
    "name": "bench",
    "arm": {"repeatability_mm": 0.05, "repeatability_deg": 0.01},
    "rig": {
        "axis": "normal",
        "side_ab_mm": 130.0,
        "side_ac_mm": 120.0,
        "angle_deg": 65.0,
        "marker_radii_mm": [8.0, 8.0, 8.0],
        "marker_colours": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "identity": "colour",
    },
    "cameras": [
        {"name": "left", "image_size_px": [640, 480]},
        {"name": "right", "image_size_px": [640, 480], "estimate": {"skew": False}},
    ],
}


def test_a_measured_cell_needs_no_model_and_no_nominal_cameras():
    measured = parse_any_cell(MEASURED, "bench.yaml")
    assert measured.rig.triangle.side_ab == pytest.approx(0.13)
    assert measured.repeatability.translation == pytest.approx(5e-5)
    assert [camera.info.skew for camera in measured.cameras] == [True, False]
    assert measured.track_limit_mm == 1.0
    assert measured.plan.min_plane_spread_deg == 20


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("arm", "repeatability_mm"), None, "arm.repeatability_mm"),
        (("arm", "model"), "hp3_like.xml", "arm.model: this key is not known here"),
        (("rig", "ahead_mm"), 90.0, "rig.ahead_mm: this key is not known here"),
        (("rig", "side_ac_mm"), 15.0, "touch each other"),
    ],
)
def test_a_measured_cell_states_what_counts_and_no_more(path, value, message):
    section = {**MEASURED[path[0]], path[1]: value}
    with pytest.raises(InputError, match=message):
        parse_any_cell({**MEASURED, path[0]: section}, "bench.yaml")


def test_a_measured_cell_cannot_be_planned_or_simulated():
    with pytest.raises(InputError, match="neither planned nor simulated"):
        parse_cell(MEASURED, "bench.yaml")


SECOND = {"axis": "BC", "ahead_mm": 80}


def test_a_second_mount_holds_the_same_triangle_otherwise(cell: Description) -> None:
    parsed = parse_cell(cell | {"second_mount": SECOND}, "cell.yaml")
    first, second = parsed.mounted
    assert first.rig == parsed.rig
    assert second.rig.triangle == first.rig.triangle
    assert second.rig.marker_radii_mm == first.rig.marker_radii_mm
    # The edge BC lies on the flange's z axis, B 80 mm from the flange.
    markers = second.rig.flange_from_triangle.apply(second.rig.triangle.points)
    assert markers[1] == pytest.approx([0, 0, 0.08], abs=1e-12)
    assert markers[2, :2] == pytest.approx([0, 0], abs=1e-12)
    assert first.second_mount is None
    assert second.second_mount is None
    assert parsed.axes == ("normal", "BC")
    assert Cell.model_validate(parsed.model_dump(by_alias=True)) == parsed


def test_a_cell_without_a_second_mount_is_its_own_first(cell: Description) -> None:
    parsed = parse_cell(cell, "cell.yaml")
    assert parsed.mounted == (parsed,)
    assert parsed.axes == ("normal",)


def test_mounts_that_do_not_differ_are_refused(cell: Description) -> None:
    same = {"axis": "normal", "ahead_mm": 90}
    with pytest.raises(InputError, match="no tool to change"):
        parse_cell(cell | {"second_mount": same}, "cell.yaml")


def test_the_holder_of_a_second_mount_must_fit_its_axis(cell: Description) -> None:
    with pytest.raises(InputError, match="holder: hands does not hold an axis BC"):
        parse_cell(cell | {"second_mount": SECOND | {"holder": "hands"}}, "cell.yaml")


def test_a_measured_cell_states_the_axis_of_its_second_mount_only():
    measured = parse_any_cell(MEASURED | {"second_mount": {"axis": "CA"}}, "bench.yaml")
    assert measured.axes == ("normal", "CA")
    with pytest.raises(InputError, match=r"second_mount\.ahead_mm: this key is not"):
        parse_any_cell(MEASURED | {"second_mount": SECOND}, "bench.yaml")
