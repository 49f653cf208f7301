"""Programmes with a tool change: of one plan with two mounts, or of two plans."""

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


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """One session whose plan has two mounts."""
    folder = tmp_path_factory.mktemp("both") / "out"
    run = Run(start("hp3_stereo_both", folder, 1, 4), NullProgress())
    execute(run, stages_of(run), ("plan",), again=False)
    return run


def test_a_plan_with_two_mounts_is_one_programme(both, tmp_path):
    written = write_programme(both, "json", tmp_path / "p.json", 1.0)
    plan, data = both.plan(), json.loads((tmp_path / "p.json").read_text())
    change = data["tool_change"]
    assert change["before_station"] == plan.tool_change.before
    assert change["take_off"] == "mount 1 (about a normal)"
    assert change["mount"] == "mount 2 (about its edge BC), 90 mm ahead of the flange"
    assert [s["mount"] for s in data["stations"]] == [
        s.mount + 1 for s in plan.stations
    ]
    stated = "tool change: take off mount 1 (about a normal), put on mount 2 (about "
    assert any(line.startswith(stated) for line in data["notice"])
    seconds = seconds_of_moves(written)
    assert seconds == pytest.approx(plan.certificate["cycle_time_s"], rel=1e-12)


def test_the_stations_with_two_mounts_are_judged_again_from_their_file(
    both, tmp_path, capsys
):
    folder, listed = str(both.folder.path), tmp_path / "stations.csv"
    with pytest.raises(SystemExit) as left:
        cli.main(["programme", folder, "csv", "-o", str(listed)])
    assert left.value.code == 0
    assert "put on mount 2 (about its edge BC)" in capsys.readouterr().out
    assert listed.read_text().splitlines()[0].endswith(",mount")
    again = Run(
        start("hp3_stereo_both", tmp_path / "again", 1, None, listed), NullProgress()
    )
    execute(again, stages_of(again), ("plan",), again=False)
    first, second = both.plan(), again.plan()
    assert second.tool_change.before == first.tool_change.before
    assert len(second.half_turns) == len(first.half_turns)
    assert second.certificate["cycle_time_s"] == pytest.approx(
        first.certificate["cycle_time_s"], rel=1e-9
    )


def test_stations_without_their_mounts_are_refused(both, tmp_path, capsys):
    listed = tmp_path / "stations.csv"
    write_programme(both, "csv", listed, 1.0)
    rows = [line.rsplit(",", 1)[0] for line in listed.read_text().splitlines()]
    listed.write_text("\n".join(rows))
    arguments = ["plan", str(tmp_path / "out"), "--cell", "hp3_stereo_both"]
    with pytest.raises(SystemExit) as left:
        cli.main([*arguments, "--certify", str(listed)])
    assert left.value.code == 2
    assert "must have one column mount, since the cell has" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("layout", ["joint_trajectory", "urscript"])
def test_the_other_formats_wait_between_the_mounts(both, layout, tmp_path):
    write_programme(both, layout, tmp_path / "p", 1.0)
    text = (tmp_path / "p").read_text()
    stated = "put on mount 2 (about its edge BC), 90 mm ahead of the flange"
    if layout == "urscript":
        _, after = text.split("popup(")
        assert stated in after.splitlines()[0]
        first = f"{both.plan().tool_change.before}, mount 2 (about its edge BC)"
        assert f'textmsg("station ", "{first}")' in after
    else:
        _, after = text.split("---\n")
        assert stated in after.splitlines()[0]


def test_a_plan_that_changes_the_tool_is_driven_alone(both, runs, tmp_path):
    for first, then in ((both, runs[0]), (runs[0], both)):
        with pytest.raises(InputError, match="its own plan changes the tool, between"):
            write_programme(first, "json", tmp_path / "p", 1.0, then=then)
