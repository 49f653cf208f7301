"""The shell completes what README says, with the line that README gives."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

README = (Path(__file__).resolve().parent.parent / "README.md").read_text()
LINES = re.findall(r"^(.*_HANDEYE_TRI_COMPLETE=(\w+)_source.*?)\s+# ", README, re.M)
ENVIRONMENT = os.environ | {
    "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
}


def test_readme_has_a_line_for_each_shell():
    assert [shell for _, shell in LINES] == ["bash", "zsh", "fish"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_every_shell_gets_its_script_and_its_answers(shell):
    def ask(**words):
        return subprocess.run(
            ["handeye-tri"],
            env=ENVIRONMENT | words,
            capture_output=True,
            text=True,
            check=True,
        ).stdout

    script = ask(_HANDEYE_TRI_COMPLETE=f"{shell}_source")
    assert "_handeye_tri_completion" in script
    assert f"_HANDEYE_TRI_COMPLETE={shell}_complete" in script
    number = {"fish": "kal"}.get(shell, "3")
    answer = ask(
        _HANDEYE_TRI_COMPLETE=f"{shell}_complete",
        COMP_WORDS="handeye-tri export out kal",
        COMP_CWORD=number,
    )
    assert "kalibr" in answer
    assert "opencv" not in answer


@pytest.mark.parametrize(
    ("words", "expected"),
    [("comp", ["compare"]), ("export out ka", ["kalibr"]), ("run --s", ["--seed"])],
)
def test_bash_completes_after_the_line_of_readme(words, expected):
    assert shutil.which("bash")
    line = next(line for line, shell in LINES if shell == "bash")
    typed = ["handeye-tri", *words.split()]
    code = (
        f"{line}\nCOMP_WORDS=({' '.join(typed)})\nCOMP_CWORD={len(typed) - 1}\n"
        "_handeye_tri_completion handeye-tri\nprintf '%s\\n' \"${COMPREPLY[@]}\""
    )
    done = subprocess.run(
        ["bash", "-c", code],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == expected
