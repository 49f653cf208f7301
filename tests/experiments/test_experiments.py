import csv
import re
from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from handeye_tri import cli
from handeye_tri.cli.progress import TimeLeft
from handeye_tri.errors import InputError
from handeye_tri.experiments import NAMES, fig12, run_experiment, run_paper
from handeye_tri.experiments.outcome import Options, finish, new_figure
from handeye_tri.experiments.page import write_page


def finished(folder, name, passed=True, sentence="7 < 8 & all is well"):
    figure, axes = new_figure(3.0, 2.0, 1, 1)
    axes[0][0].plot([0, 1], [0, 1])
    return finish(
        Options(folder),
        name,
        f"Title of {name}",
        passed=passed,
        sentence=sentence,
        rows=[{"x": 0.123456789, "who": "a<b"}, {"x": 2, "who": "c"}],
        figure=figure,
    )


@pytest.mark.parametrize(
    ("passed", "verdict"), [(True, "PASS"), (False, "FAIL"), (None, "CANNOT TELL")]
)
def test_a_verdict_is_a_line(tmp_path, passed, verdict):
    outcome = finished(tmp_path, "made", passed)
    assert outcome.line == f"made: {verdict}: 7 < 8 & all is well"
    assert (tmp_path / "made.txt").read_text() == f"{outcome.line}\n"
    assert (tmp_path / "made.csv").read_text() == "x,who\n0.123456789,a<b\n2,c\n"


def test_the_same_figure_is_the_same_file(tmp_path):
    first = finished(tmp_path / "one", "made").files
    again = finished(tmp_path / "two", "made").files
    for one, two in zip(first, again, strict=True):
        assert one.read_bytes() == two.read_bytes()


def test_the_page_holds_everything_and_asks_for_nothing(tmp_path):
    outcomes = [finished(tmp_path, "one"), finished(tmp_path, "two", False)]
    text = write_page(tmp_path, outcomes).read_text()
    assert "7 &lt; 8 &amp; all is well" in text
    assert "<td>0.12346</td><td>a&lt;b</td>" in re.sub(r"\s*\n\s*", "", text)
    assert text.count("data:image/svg+xml;base64,") == 2
    assert 'class="verdict FAIL"' in text
    assert re.findall(r"(?:src|href)=\"(?!data:|#)", text) == []


def test_every_experiment_has_its_module():
    for name in NAMES:
        assert callable(
            __import__(f"handeye_tri.experiments.{name}", fromlist=["run"]).run
        )


def test_the_paper_is_all_of_them_in_order(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "handeye_tri.experiments.run_experiment",
        lambda name, options: finished(options.folder, name),
    )
    told = []
    run_paper(Options(tmp_path), told.append)
    assert [outcome.name for outcome in told] == list(NAMES)
    page = (tmp_path / "index.html").read_text()
    places = [page.index(f'<h2 id="{name}">') for name in NAMES]
    assert places == sorted(places)


def test_one_trial_is_none(tmp_path):
    with pytest.raises(InputError, match="trials must be at least 2, got 1"):
        Options(tmp_path, trials=1)


@pytest.fixture
def fig12_with(monkeypatch):
    """Fig. 12 of a run that is not done but whose evaluation is given."""

    def prepare(evaluation):
        monkeypatch.setattr(
            fig12, "start", lambda *_: SimpleNamespace(locked=nullcontext)
        )
        monkeypatch.setattr(fig12, "execute", lambda *_, **__: None)
        monkeypatch.setattr(
            fig12, "Run", lambda *_: SimpleNamespace(evaluation=lambda: evaluation)
        )

    return prepare


@pytest.mark.parametrize(
    ("verdict", "mean", "expected"),
    [("PASS", 0.3, "PASS"), ("PASS", 2.9, "FAIL"), ("FAIL", 0.3, "FAIL")],
)
def test_fig12_shows_the_track_of_the_run(
    tmp_path, fig12_with, verdict, mean, expected
):
    fig12_with(
        {
            "verdict": verdict,
            "track": {
                "stations": 1,
                "mean_mm": mean,
                "max_mm": 0.4,
                "predicted_rms_mm": 0.2,
                "positions": [
                    {
                        "station": 22,
                        "marker": marker,
                        "reported_m": [0.4, 0.1, 0.5],
                        "observed_m": [0.4, 0.1, 0.5003],
                        "error_mm": 0.3,
                    }
                    for marker in "ABC"
                ],
            },
        }
    )
    outcome = run_experiment("fig12", Options(tmp_path))
    assert outcome.verdict == expected
    with outcome.files[0].open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["marker"] for row in rows] == ["A", "B", "C"]
    assert float(rows[0]["cameras_z_mm"]) == pytest.approx(500.3)


def call(capsys, *arguments):
    with pytest.raises(SystemExit) as left:
        cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return left.value.code, out, err


@pytest.mark.parametrize(("passed", "code"), [(True, 0), (False, 3), (None, 4)])
def test_the_exit_code_is_the_verdict(capsys, tmp_path, monkeypatch, passed, code):
    monkeypatch.setattr(
        "handeye_tri.experiments.run_experiment",
        lambda name, options: finished(options.folder, name, passed),
    )
    assert call(capsys, "experiment", "fig05", "-o", tmp_path)[0] == code
    left, out, _ = call(capsys, "experiment", "paper", "-o", tmp_path)
    assert left == code
    assert f"wrote {tmp_path / 'index.html'}" in out


def test_an_unknown_experiment_is_none(capsys, tmp_path):
    code, _, err = call(capsys, "experiment", "fig99", "-o", tmp_path / "out")
    assert code == 2
    assert "fig99" in err
    assert not (tmp_path / "out").exists()


def test_time_left_is_told_on_stderr(capsys):
    tell = TimeLeft()
    tell(1, 9, 125.7)
    tell(2, 9, 100.0)
    tell(9, 9, 0.0)
    assert capsys.readouterr().err == ("1/9, 2 min  5 s left\n9/9, 0 min  0 s left\n")
