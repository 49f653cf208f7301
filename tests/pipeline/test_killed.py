"""A run killed at any moment is finished by the same command to the same numbers."""

import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "check_kill.py"


def test_a_killed_run_is_finished_to_the_same_files():
    done = subprocess.run(
        [sys.executable, str(SCRIPT), "--moments", "2"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 of 2 finished to the same files and words" in done.stdout
