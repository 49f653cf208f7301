"""Two plans, each with its rig, as one programme with a tool change between them."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from handeye_tri import cli, storage
from handeye_tri.errors import InputError
from handeye_tri.pipeline import NullProgress, Run, execute, stages_of, start
from handeye_tri.pipeline.programme import write_programme
from handeye_tri.pipeline.tool_change import seconds_of_moves, way_back
from handeye_tri.plan.sequence import travel_time


def planned(cell, folder):
    run = Run(start(cell, folder, 1, 3), NullProgress())
    execute(run, stages_of(run), ("plan",), again=False)
    return run


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tool_change")
    return [planned(c, folder / c) for c in ("hp3_stereo", "hp3_stereo_edge")]


def test_both_plans_are_driven_free_with_the_rig_that_is_mounted(runs, tmp_path):
    first, second = runs
    write_programme(first, "json", tmp_path / "both.json", 1.0, then=second)
    data = json.loads((tmp_path / "both.json").read_text())
    change, stations = data["tool_change"], data["stations"]
    assert "half-turns about its edge CA; AB 90 mm, AC 130 mm" in change["mount"]
    assert change["mount"] in " ".join(data["notice"])
    begin = change["before_station"]
    for run, part in ((first, stations[:begin]), (second, stations[begin:])):
        wanted = [station.joints.tolist() for station in run.plan().stations]
        assert [station["joints"] for station in part] == wanted
    ways = [[data["home"]], [change["joints"]]]
    for k, station in enumerate(stations):
        ways[int(k >= begin)] += [*station["via"], station["joints"]]
    ways[0] += [*change["via"], change["joints"]]
    for run, way in zip(runs, ways, strict=True):
        for start_, end in pairwise(np.array(way)):
            assert run.arm.path_collision(start_, end) is None


def test_the_time_of_the_moves_is_that_of_both_plans_and_the_way_between(
    runs, tmp_path
):
    both = write_programme(runs[0], "json", tmp_path / "p", 1.0, then=runs[1])
    way = both.way_to_change(both.change.before)
    ramp = runs[0].cell.arm.acceleration_time_s
    between = travel_time(way[:-1], way[1:], runs[0].arm.speed, ramp).sum()
    planned_ = sum(run.plan().certificate["cycle_time_s"] for run in runs)
    assert between > 0
    assert seconds_of_moves(both) == pytest.approx(planned_ + between, rel=1e-12)


def test_the_way_to_the_tool_change_goes_back_as_far_as_it_must(runs, tmp_path):
    class Blocked:
        """An arm for which only the first station is straight before home."""

        def path_collision(self, start, end):
            blocked = end.any() or not np.array_equal(start, programme.stops[0])
            return ("rig", "table") if blocked else None

    programme = write_programme(runs[0], "json", tmp_path / "one.json", 1.0)
    programme = replace(
        programme,
        via=[np.full((1, 6), k) for k in (1, 2, 3)],
        stops=programme.stops[:3],
        kinds=programme.kinds[:3],
    )
    expected = [programme.via[2][0], programme.stops[1], programme.via[1][0]]
    expected.append(programme.stops[0])
    np.testing.assert_array_equal(way_back(Blocked(), programme), expected)


def test_a_list_of_stations_cannot_state_a_tool_change(runs, tmp_path):
    with pytest.raises(InputError, match="csv holds stations only, and this programme"):
        write_programme(runs[0], "csv", tmp_path / "p.csv", 1.0, then=runs[1])
    assert not list(tmp_path.iterdir())


def test_the_same_rig_is_no_tool_change(runs, tmp_path):
    with pytest.raises(InputError, match="both cells have the same rig"):
        write_programme(runs[0], "json", tmp_path / "p", 1.0, then=runs[0])


def test_cells_may_differ_in_their_rig_only(runs, tmp_path):
    path = storage.find_cell("hp3_stereo_edge")
    text = path.read_text().replace("[1720, 1715]", "[1721, 1715]")
    text = text.replace("name: hp3_stereo_edge", "name: other")
    other = tmp_path / "other.yaml"
    other.write_text(text)
    run = Run(start(str(other), tmp_path / "out", 1, 3), NullProgress())
    with pytest.raises(InputError, match="but cameras differs"):
        write_programme(runs[0], "json", tmp_path / "p", 1.0, then=run)


def test_the_two_rigs_are_told_apart_by_name(runs, tmp_path):
    text = storage.find_cell("hp3_stereo_edge").read_text()
    other = tmp_path / "other.yaml"
    other.write_text(text.replace("name: hp3_stereo_edge", "name: hp3_stereo"))
    run = Run(start(str(other), tmp_path / "out", 1, 3), NullProgress())
    with pytest.raises(InputError, match="both cells are called hp3_stereo, and"):
        write_programme(runs[0], "json", tmp_path / "p", 1.0, then=run)


def test_the_command_states_the_tool_change(runs, tmp_path, capsys):
    first, second = (str(run.folder.path) for run in runs)
    target = tmp_path / "both.script"
    arguments = ["programme", first, "urscript", "-o", str(target), "--then", second]
    with pytest.raises(SystemExit) as left:
        cli.main([*arguments, "--even-if-failed"])
    assert left.value.code == 0
    out = capsys.readouterr().out
    assert "VERDICT of hp3_stereo  " in out
    assert "VERDICT of hp3_stereo_edge  " in out
    assert "the robot waits for it in its home after 12 of 24 stations" in out
    assert target.read_text().count("popup(") == 1
