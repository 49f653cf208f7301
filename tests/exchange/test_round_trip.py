"""A session exported as a bag and imported again is the same session."""

from __future__ import annotations

import json

import numpy as np
import pytest
from drawn_session import drawn_session
from exported import call

from handeye_tri.pipeline import NullProgress, Run, execute, stages_of
from handeye_tri.storage import SessionFolder, read_image


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """The session, what came back, and what the import printed."""
    import contextlib
    import io

    from handeye_tri import cli

    run = drawn_session(tmp_path_factory.mktemp("trip"))
    folder = run.folder.path.parent
    printed = io.StringIO()
    for arguments in (
        ("export", run.folder.path, "mcap", "-o", folder / "session.mcap"),
        ("import", "bag", folder / "session.mcap", "-o", folder / "back"),
    ):
        with contextlib.redirect_stdout(printed), pytest.raises(SystemExit) as left:
            cli.main([str(argument) for argument in arguments])
        assert not left.value.code
    back = Run(SessionFolder.open(folder / "back"), NullProgress())
    with back.folder.locked():
        execute(back, stages_of(back), ("detect", "calibrate"), again=False)
    return run, back, printed.getvalue()


def test_it_calibrates_to_the_same_numbers(both):
    run, back, _ = both
    for read in (Run.cameras, Run.hand_eye):
        ours, theirs = read(run), read(back)
        for one, other in zip(ours.cameras, theirs.cameras, strict=True):
            difference = one.intrinsics.vector - other.intrinsics.vector
            assert np.abs(difference).max() < 1e-9
            lens = one.lens.coefficients - other.lens.coefficients
            assert np.abs(lens).max() < 1e-9
        assert ours.covariance.labels == theirs.covariance.labels
        # In units of the sigmas: a covariance near zero is a difference of large ones.
        sigma = np.sqrt(np.diagonal(ours.covariance.matrix))
        off = ours.covariance.matrix - theirs.covariance.matrix
        assert np.abs(off / np.outer(sigma, sigma)).max() < 1e-9
    ours, theirs = run.hand_eye(), back.hand_eye()
    motions = zip(
        (*ours.base_from_camera, ours.flange_from_triangle),
        (*theirs.base_from_camera, theirs.flange_from_triangle),
        strict=True,
    )
    for one, other in motions:
        assert np.abs(one.matrix - other.matrix).max() < 1e-9
    assert np.abs(ours.markers - theirs.markers).max() < 1e-9
    assert ours.chi2 == pytest.approx(theirs.chi2, rel=1e-9)


def test_stations_half_turns_and_images_are_the_same(both):
    run, back, printed = both
    ours, theirs = run.plan(), back.plan()
    assert theirs.half_turns == ours.half_turns
    assert [s.kind for s in theirs.stations] == [s.kind for s in ours.stations]
    for one, other in zip(ours.stations, theirs.stations, strict=True):
        assert (one.joints == other.joints).all()
        for camera in ("left", "right"):
            name = run.image_name(camera, one.index)
            np.testing.assert_array_equal(
                read_image(run.folder.file(name)), read_image(back.folder.file(name))
            )
    assert "6 half-turns about normal found in the poses" in printed
    assert "proposed and taken: --robot joints:/joint_states" in printed
    held_out = [s.index for s in ours.stations if s.kind == "evaluation"]
    assert f"held out for the test: {', '.join(map(str, held_out))} (" in printed


def test_it_is_real_and_has_no_truth(both):
    _, back, _ = both
    assert not back.session().simulated
    assert back.truth() is None
    assert not back.folder.file("truth.json").exists()
    source = json.loads(back.folder.file("session.json").read_text())["source"]
    assert source["format"] == "bag"


@pytest.mark.parametrize("verb", ["plan", "simulate"])
def test_what_was_imported_is_not_planned_or_rendered_over(capsys, both, verb):
    _, back, _ = both
    before = back.folder.file("session.json").read_bytes()
    code, _, err = call(capsys, verb, back.folder.path, "--again")
    assert code == 2
    assert "this session was imported" in err
    assert back.folder.file("session.json").read_bytes() == before
    code, _, err = call(capsys, "run", "hp3_stereo", "-o", back.folder.path)
    assert code == 2
    assert "a real robot's data" in err


def test_a_second_import_does_not_replace_the_first(capsys, both):
    _, back, _ = both
    bag = back.folder.path.parent / "session.mcap"
    code, _, err = call(capsys, "import", "bag", bag, "-o", back.folder.path)
    assert code == 2
    assert "holds a session already" in err


def test_an_import_that_was_killed_is_done_again(capsys, both, tmp_path):
    _, back, _ = both
    bag = back.folder.path.parent / "session.mcap"
    header = {**back.folder.header, "stages": {}}
    SessionFolder(tmp_path / "killed", header).save()
    code, out, _ = call(capsys, "import", "bag", bag, "-o", tmp_path / "killed")
    assert code == 0
    assert "18 stations, 36 images" in out


def test_frames_give_the_same_stations_as_joints(capsys, both, tmp_path):
    run, back, _ = both
    bag = back.folder.path.parent / "session.mcap"
    *used, left_out = run.plan().half_turns
    named = ",".join(f"{turn.before}-{turn.after}" for turn in used)
    code, out, _ = call(
        *(capsys, "import", "bag", bag, "-o", tmp_path / "tf"),
        *("--robot", "tf:base,flange", "--image", "left=/left/image/compressed"),
        *("--cell", "hp3_stereo", "--half-turns", named),
        *("--held-out", f"{left_out.before},{left_out.after}"),
    )
    assert code == 0
    assert "5 half-turns about normal as named" in out
    plan = Run(SessionFolder.open(tmp_path / "tf"), NullProgress()).plan()
    for one, other in zip(run.plan().stations, plan.stations, strict=True):
        difference = one.base_from_flange.matrix - other.base_from_flange.matrix
        assert np.abs(difference).max() < 1e-12
        assert len(other.joints) == 0
    held_out = [s.index for s in plan.stations if s.kind == "evaluation"]
    assert held_out == [left_out.before, left_out.after]
    assert plan.half_turns == tuple(used)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--robot", "tf:base,hand"], "no chain of frames leads from 'base' to 'hand'"),
        (["--robot", "pose:/tf"], "--direction flange_in_base"),
        (["--robot", "joints:/nothing"], "there is no topic '/nothing'"),
        (["--robot", "everything"], "--robot must be joints:TOPIC"),
        (["--joints", "a,b,c"], "--joints must name 6 joints"),
        (["--joints", "1,2,3,4,5,6"], "never reports the joints 1, 2, 3, 4, 5, 6"),
        (["--image", "left=/tf"], "there is no image topic '/tf'"),
        (["--image", "middle=/x"], "the cell has no camera 'middle'"),
        (["--image", "left"], "--image must be CAMERA=WHERE"),
        (["--half-turns", "{first},{first}"], "is named twice"),
        (["--half-turns", "{other}"], "a half-turn is 180"),
        (["--half-turns", "0-99"], "station 99 is beyond the 18"),
        (["--half-turns", "{first}"], "at least 2 are needed"),
        (["--half-turns", "first"], "--half-turns must be pairs of stations"),
        (["--held-out", "{after}"], "belongs to a half-turn"),
        (["--held-out", "40"], "names station 40, but there are 18"),
        (["--still", "0.1"], "--still must be mm, degrees and seconds"),
        (["--still", "0.1,0.02,9"], "the robot never stood"),
        (["--turn-tolerance", "x,1"], "--turn-tolerance must be degrees and mm"),
        (["--poses", "x.csv"], "a recording has its own poses"),
        (["--cell", "nowhere.yaml"], "there is no such cell file"),
    ],
)
def test_what_does_not_fit_is_one_sentence_and_writes_nothing(
    capsys, both, tmp_path, options, message
):
    run, back, _ = both
    bag = back.folder.path.parent / "session.mcap"
    one, two = run.plan().half_turns[:2]
    stations = {
        "first": f"{one.before}-{one.after}",
        "other": f"{one.before}-{two.after}",
        "after": one.after,
    }
    options = [option.format(**stations) for option in options]
    code, _, err = call(capsys, "import", "bag", bag, "-o", tmp_path / "new", *options)
    assert code == 2
    assert message in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "new").exists()


def test_damage_to_what_was_imported_says_how_to_have_it_again(capsys, both, tmp_path):
    import shutil

    _, back, _ = both
    folder = tmp_path / "copy"
    shutil.copytree(back.folder.path, folder)
    image = folder / "images" / "left_003.png"
    data = bytearray(image.read_bytes())
    data[len(data) // 2] ^= 1
    image.write_bytes(bytes(data))
    code, _, err = call(capsys, "detect", folder, "--again")
    assert code == 2
    assert "left_003.png was changed or damaged" in err
    assert "import it again into another folder" in err
    for source in (7, {}, {"command": ["x"]}):
        SessionFolder(folder, {**back.folder.header, "source": source}).save()
        code, _, err = call(capsys, "detect", folder)
        assert code == 2
        assert "source.command is missing or wrong" in err


def test_without_the_extra_one_sentence_says_how_to_get_it(
    capsys, both, tmp_path, monkeypatch
):
    import sys

    _, back, _ = both
    monkeypatch.setitem(sys.modules, "mcap_ros2", None)
    bag = back.folder.path.parent / "session.mcap"
    code, _, err = call(capsys, "import", "bag", bag, "-o", tmp_path / "new")
    assert code == 2
    assert 'install them with: pip install "handeye-tri[ros]"' in err
    assert len(err.splitlines()) == 1
