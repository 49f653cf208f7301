import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from handeye_tri import cli
from handeye_tri.se3 import SE3, se3_exp
from handeye_tri.synthesize import reference_geometry, synthesize

REPO = Path(__file__).resolve().parent.parent
README = (REPO / "README.md").read_text()
COMMANDS = [
    line.split("#")[0].strip()
    for block in re.findall(r"```(?:bash)?\n(.*?)```", README, re.DOTALL)
    for line in block.splitlines()
    if line.startswith("handeye-tri ")
]
LINKS = re.findall(r"\]\(([^)#:]+)\)", README)


@pytest.mark.parametrize("line", COMMANDS)
def test_commands_parse(line):
    verb, *arguments = shlex.split(line)[1:]
    command = cli.commands.commands[verb]
    with command.make_context(verb, arguments) as context:
        assert context.params


def test_there_are_commands_to_parse():
    assert len(COMMANDS) >= 3


def test_python_blocks_run(monkeypatch):
    rng = np.random.default_rng(1)
    session, _ = synthesize(reference_geometry(rng), rng, sigma_px=0.02)
    before = [turn.before for turn in session.half_turns]
    after = [turn.after for turn in session.half_turns]
    b = se3_exp(rng.normal(size=(10, 6)))
    x, z = SE3.exp(rng.normal(size=6)), SE3.exp(rng.normal(size=6))
    names = {
        "before": session.pixels[0, before],
        "after": session.pixels[0, after],
        "a": z.matrix @ b @ x.inverse().matrix,
        "b": b,
    }
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    assert np.abs(names["x"].matrix - x.matrix).max() < 1e-12
    assert names["result"].camera.intrinsics.fx == pytest.approx(1720, abs=5)


@pytest.mark.parametrize("link", LINKS)
def test_links_lead_somewhere(link):
    assert (REPO / link).exists()
