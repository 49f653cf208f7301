"""The paper's figures and tables (Zhao, Liu and Zhang 2008, Sec. IV), one file each.

Each takes Options and leaves a table (CSV), a plot (SVG and PNG) and a line of verdict.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from handeye_tri.experiments.outcome import Options, Outcome

# In the order of the paper.
NAMES = ("fig05", "fig06", "fig07", "table1", "fig09", "fig10", "fig12", "fig13")

__all__ = ["NAMES", "run_experiment", "run_paper"]


def run_experiment(name: str, options: Options) -> Outcome:
    """Run one of NAMES.

    Raises:
        InputError: an option is missing or cannot be used.
        StorageError: the folder cannot be written, or holds results of other options.
    """
    module: Any = import_module(f"handeye_tri.experiments.{name}")
    outcome: Outcome = module.run(options)
    return outcome


def run_paper(options: Options, tell: Callable[[Outcome], None]) -> list[Outcome]:
    """Run all of NAMES, and write them on one page, index.html.

    Args:
        options: How.
        tell: Told of each as it is done.
    """
    from handeye_tri.experiments.page import write_page

    outcomes = []
    for name in NAMES:
        outcomes.append(run_experiment(name, options))
        tell(outcomes[-1])
        # Written again each time: an interrupted run leaves what it has.
        write_page(options.folder, outcomes)
    return outcomes
