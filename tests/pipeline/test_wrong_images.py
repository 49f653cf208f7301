"""Images that are not what they should be never end as a PASS."""

import shutil

import pytest
from drawn_session import drawn_session

from handeye_tri import cli


def call(capsys, *arguments):
    """Run the command line in this process: exit code, stdout, stderr."""
    with pytest.raises(SystemExit) as left:
        cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return left.value.code, out, err


def record_again(run):
    """Take the images as they are, as an import of them would."""
    entry = run.folder.header["stages"]["simulate"]
    run.folder.record(
        "simulate", entry["inputs"], list(entry["outputs"]), entry["line"]
    )


def test_copies_of_one_image_in_most_half_turns(capsys, tmp_path):
    """A camera that hung: all stations of four half-turns of six show the same."""
    run = drawn_session(tmp_path)
    turns = run.plan().half_turns[:4]
    first, *others = (
        run.folder.file(run.image_name("left", station))
        for turn in turns
        for station in (turn.before, turn.after)
    )
    for path in others:
        shutil.copy(first, path)
    record_again(run)
    code, _, err = call(capsys, "detect", run.folder.path)
    assert code == 0, err
    code, _, err = call(capsys, "calibrate", run.folder.path)
    assert code == 4
    assert "camera 'left': half-turn" in err
    assert "the triangle unturned" in err
    code, out, err = call(capsys, "evaluate", run.folder.path)
    assert (code, out) == (2, "")
    assert "the stage 'cameras' is needed first" in err


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"hello", "this is not an image"),
        (b"", "this is not an image"),
        (b"\x89PNG\r\n\x1a\n" + bytes(40), "this image is damaged"),
    ],
)
def test_what_is_no_image(capsys, tmp_path, content, message):
    run = drawn_session(tmp_path)
    image = run.folder.file(run.image_name("right", 1))
    image.write_bytes(content)
    record_again(run)
    code, out, err = call(capsys, "detect", run.folder.path)
    assert (code, out) == (2, "")
    assert str(image) in err
    assert message in err
    assert len(err.splitlines()) == 1
