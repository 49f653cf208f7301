"""The result as one page of HTML that needs nothing else."""

from handeye_tri.report.page import Origin, render_report

__all__ = ["Origin", "render_report"]
