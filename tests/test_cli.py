import subprocess
import sys
import time

import pytest

from handeye_tri import cli
from handeye_tri.storage import find_cell

VERBS = sorted(cli.commands.commands)


def call(capsys, *arguments):
    """Run the command line in this process: exit code, stdout, stderr."""
    with pytest.raises(SystemExit) as left:
        cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return left.value.code, out, err


def changed_cell(tmp_path, *changes):
    text = find_cell("hp3_stereo").read_text()
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    path = tmp_path / "cell.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("verb", VERBS)
def test_help_fits_a_screen_and_has_an_example(capsys, verb):
    code, out, _ = call(capsys, verb, "--help")
    assert code == 0
    assert len(out.splitlines()) <= 30
    assert max(map(len, out.splitlines())) <= 80
    assert f"handeye-tri {verb}" in out.split("Example:")[1]


def test_the_help_of_all_verbs_fits_a_screen_and_is_not_cut_off(capsys):
    code, out, _ = call(capsys, "--help")
    assert code == 0
    assert len(out.splitlines()) <= 30
    assert max(map(len, out.splitlines())) <= 80
    assert "handeye-tri run" in out.split("Example:")[1]
    assert "...\n" not in out.split("Commands:")[1]


def test_help_starts_without_heavy_modules():
    code = (
        "import sys; from handeye_tri import cli\n"
        "try: cli.main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'scipy', 'mujoco', 'pinocchio', 'cv2', 'rerun', 'rich',\n"
        "    'pydantic', 'jinja2', 'PIL', 'matplotlib', 'ruamel', 'joblib'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr.decode()
    assert b"hp3_stereo" in done.stdout


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            [("half_turns: 11", "half_turn: 11")],
            "plan.half_turn: this key is not known",
        ),
        ([("side_ab_mm: 130", "side_ab_m: 0.13")], "rig.side_ab_m: this key is not"),
        ([("angle_deg: 65", "angle_deg: 0.1")], "nearly collinear"),
        ([("flange: flange", "flange: nose")], "nose"),
        ([("model: hp3_like.xml", "model: absent.xml")], "arm.model: no file"),
    ],
)
def test_a_bad_cell_is_one_sentence_and_writes_nothing(
    capsys, tmp_path, changes, message
):
    cell = changed_cell(tmp_path, *changes)
    code, out, err = call(capsys, "run", cell, "-o", tmp_path / "out")
    assert code == 2
    assert message in err
    assert "Traceback" not in err
    assert out == ""
    assert not (tmp_path / "out").exists()


def test_a_cell_without_a_plan_says_which_check_rejected_how_many(capsys, tmp_path):
    cell = changed_cell(
        tmp_path,
        ("look_at_m: [0.45, 0.0, 0.42]", "look_at_m: [2.5, 0.0, 0.42]"),
    )
    started = time.monotonic()
    code, _, err = call(capsys, "run", cell, "-o", tmp_path / "out")
    assert time.monotonic() - started < 20
    assert code == 2
    assert err.count("error:") == 1
    assert any(character.isdigit() for character in err.split("error:")[1])
    assert not (tmp_path / "out").exists()


def test_a_folder_that_holds_something_else_is_left_alone(capsys, tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    code, _, err = call(capsys, "run", "hp3_stereo", "-o", tmp_path)
    assert code == 2
    assert "holds something else" in err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_calibrate_knows_its_methods(capsys, tmp_path):
    code, _, err = call(capsys, "calibrate", tmp_path, "--method", "guess")
    assert code == 2
    assert "joint" in err
    assert "separate" in err


@pytest.mark.parametrize("verb", ["simulate", "detect", "calibrate", "evaluate"])
def test_a_verb_on_no_session_says_so(capsys, tmp_path, verb):
    code, _, err = call(capsys, verb, tmp_path / "absent")
    assert code == 2
    assert "there is no such session folder" in err


@pytest.mark.parametrize(
    "arguments",
    [["run"], ["nonsense"], ["run", "hp3_stereo", "-o", "x", "--seed", "a"]],
)
def test_usage_errors_leave_with_2(capsys, arguments):
    code, _, err = call(capsys, *arguments)
    assert code == 2
    assert "Error:" in err


def test_a_negative_seed_is_refused(capsys, tmp_path):
    code, _, err = call(capsys, "run", "-o", tmp_path / "out", "--seed", "-1")
    assert code == 2
    assert "--seed" in err
    assert "-1 is not in the range x>=0" in err


def test_a_bug_of_ours_leaves_with_1_and_a_log(capsys, monkeypatch):
    def explode(*_, **__):
        raise ZeroDivisionError("whoops")

    monkeypatch.setattr(cli.commands, "main", explode)
    code, _, err = call(capsys, "run")
    assert code == 1
    assert "Traceback" not in err
    log = err.strip().rsplit(" ", 1)[1]
    with open(log) as stream:
        assert "ZeroDivisionError: whoops" in stream.read()


def test_an_interrupt_leaves_with_130(capsys, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.commands, "main", interrupt)
    code, _, err = call(capsys, "run")
    assert code == 130
    assert "goes on where it was" in err


STATIONS = """s_deg,l_deg,u_deg,r_deg,b_deg,t_deg
0,0,0,0,0,0
0,0,0,0,0,180
"""


def test_plan_judges_a_users_own_stations(capsys, tmp_path):
    """Two stations that no camera sees; what they lack, and the verdict's code."""
    listed = tmp_path / "stations.csv"
    listed.write_text(STATIONS)
    code, out, _ = call(
        capsys, "plan", tmp_path / "out", "--cell", "hp3_stereo", "--certify", listed
    )
    assert code == 4
    assert out.startswith("VERDICT  CANNOT TELL")
    assert "1 half-turn: at least 2" in out
    assert "Do: add a half-turn" in out
    assert (tmp_path / "out" / "plan.json").is_file()


def test_plan_names_what_a_list_of_stations_lacks(capsys, tmp_path):
    listed = tmp_path / "stations.csv"
    listed.write_text(STATIONS.replace("t_deg", "t"))
    arguments = ("plan", tmp_path / "out", "--certify", listed)
    code, _, err = call(capsys, *arguments, "--cell", "hp3_stereo")
    assert code == 2
    assert "line 1 must have one column for joint t, t_deg or t_rad" in err
    assert not (tmp_path / "out").exists()
    code, _, err = call(capsys, *arguments)
    assert code == 2
    assert "--certify needs --cell" in err


def test_a_programme_is_written_from_a_plan(capsys, tmp_path):
    session = tmp_path / "out"
    call(capsys, "plan", session, "--cell", "hp3_stereo", "--half-turns", 3)
    listed, script = tmp_path / "stations.csv", tmp_path / "calibrate.script"
    code, out, _ = call(capsys, "programme", session, "csv", "-o", listed)
    assert code == 0
    assert f"wrote {listed}" in out
    code, _, _ = call(
        capsys, "programme", session, "urscript", "-o", script, "--dwell", 2
    )
    assert code == 0
    assert script.read_text().count("sleep(2)") == 12
    # What was written is judged as what was planned: all its stations calibrate.
    again = tmp_path / "again"
    code, out, _ = call(
        capsys, "plan", again, "--cell", "hp3_stereo", "--certify", listed
    )
    assert code == 0
    assert "3 half-turns, 12 stations + 0 held out" in out


def test_no_programme_is_written_of_a_plan_that_fails(capsys, tmp_path):
    listed, session = tmp_path / "stations.csv", tmp_path / "out"
    listed.write_text(STATIONS)
    call(capsys, "plan", session, "--cell", "hp3_stereo", "--certify", listed)
    target = tmp_path / "p.json"
    code, _, err = call(capsys, "programme", session, "json", "-o", target)
    assert code == 4
    assert "the plan's verdict is CANNOT TELL" in err
    assert not target.exists()
    code, _, _ = call(
        capsys, "programme", session, "json", "-o", target, "--even-if-failed"
    )
    assert code == 0
    assert "CANNOT TELL" in target.read_text()


def test_what_to_add_needs_something_detected(capsys, tmp_path):
    session = tmp_path / "out"
    call(capsys, "plan", session, "--cell", "hp3_stereo", "--half-turns", 2)
    code, _, err = call(capsys, "plan", session, "--next", 2)
    assert code == 2
    assert f"handeye-tri simulate {session}" in err
