"""What an experiment is given, what it leaves behind, and how it writes that."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from handeye_tri.errors import InputError
from handeye_tri.storage import write_bytes
from handeye_tri.sweep import Progress, Result, Task, sweep

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Verdict = Literal["PASS", "FAIL", "CANNOT TELL"]


@dataclass(frozen=True, slots=True)
class Options:
    """How to run an experiment.

    Attributes:
        folder: Where its files go; made where it is absent.
        trials: Independent trials per setting.
        jobs: Processes on this machine.
        dask: Address of a Dask scheduler instead.
        images: Folder of real views, for the experiments that use some.
        progress: Told of trials done, trials in all, seconds left.
    """

    folder: Path
    trials: int = 100
    jobs: int = 1
    dask: str | None = None
    images: Path | None = None
    progress: Progress | None = None

    def __post_init__(self) -> None:
        """Raise InputError unless there are at least two trials."""
        if self.trials < 2:
            raise InputError(
                f"trials must be at least 2, got {self.trials}: one has no spread"
            )

    def sweep(
        self,
        name: str,
        task: Task,
        identity: Mapping[str, Any],
        count: int | None = None,
    ) -> list[Result]:
        """Results of seeds 0 to count; those on disk are not done again.

        Args:
            name: Of the experiment.
            task: What to do with a seed.
            identity: Its parameters.
            count: Of seeds; None for one per trial.
        """
        return sweep(
            task,
            range(self.trials if count is None else count),
            checkpoint=self.folder / f"{name}.jsonl",
            identity={"name": name, **identity},
            jobs=self.jobs,
            dask=self.dask,
            progress=self.progress,
        )


@dataclass(frozen=True, slots=True)
class Outcome:
    """What an experiment found.

    Attributes:
        name: As on the command line.
        title: What it shows, in the words of the paper.
        verdict: Whether it is as it should be.
        sentence: The verdict in one line, with its numbers.
        files: What was written; the first is the table.
    """

    name: str
    title: str
    verdict: Verdict
    sentence: str
    files: tuple[Path, ...]

    def with_file(self, path: Path) -> Outcome:
        """The same, with a further file."""
        return replace(self, files=(*self.files, path))

    @property
    def line(self) -> str:
        """One line of text."""
        return f"{self.name}: {self.verdict}: {self.sentence}"


def finish(
    options: Options,
    name: str,
    title: str,
    *,
    passed: bool | None,
    sentence: str,
    rows: Sequence[Mapping[str, object]],
    figure: Figure,
) -> Outcome:
    """Write table, plot and verdict as NAME.csv, .svg, .png and .txt.

    Args:
        options: Where to.
        name: The experiment's name.
        title: What it shows.
        passed: None where the data do not tell.
        sentence: The verdict's numbers.
        rows: The table, at least one row; all rows have the same keys.
        figure: The plot; closed here.
    """
    verdict: Verdict = "CANNOT TELL" if passed is None else "PASS" if passed else "FAIL"
    text = io.StringIO()
    table = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    files = tuple(options.folder / f"{name}{end}" for end in _ENDINGS)
    outcome = Outcome(name, title, verdict, sentence, files)
    contents = [text.getvalue().encode(), *_drawn(figure)]
    for path, data in zip(
        files, [*contents, f"{outcome.line}\n".encode()], strict=True
    ):
        write_bytes(path, data)
    return outcome


_ENDINGS = (".csv", ".svg", ".png", ".txt")


def new_figure(
    width: float, height: float, rows: int, columns: int, *, share_y: bool = False
) -> Any:
    """A figure in inches and its axes, shape (rows, columns), drawn off screen.

    Args:
        width: Inches.
        height: Inches.
        rows: Of axes.
        columns: Of axes.
        share_y: Whether a row shares its vertical axis.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    shared: Literal["row", "none"] = "row" if share_y else "none"
    return figure, figure.subplots(rows, columns, squeeze=False, sharey=shared)


def _drawn(figure: Figure) -> list[bytes]:
    """The figure as SVG and as PNG, the same bytes for the same figure."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    # The layout once, not again for each file.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    drawn = []
    with rc_context({"svg.hashsalt": "handeye-tri", "svg.fonttype": "none"}):
        for form, data in (("svg", {"Date": None}), ("png", {"Software": None})):
            buffer = io.BytesIO()
            figure.savefig(buffer, format=form, metadata=data, dpi=110)
            drawn.append(buffer.getvalue())
    return drawn
