"""The cell in MuJoCo: compiled from any arm's model, executed, and rendered."""

from handeye_tri.simulate.compile import compile_mechanism
from handeye_tri.simulate.engine import check_rendering
from handeye_tri.simulate.props import Prop
from handeye_tri.simulate.render import render_views
from handeye_tri.simulate.truth import execute, ground_truth

__all__ = [
    "Prop",
    "check_rendering",
    "compile_mechanism",
    "execute",
    "ground_truth",
    "render_views",
]
